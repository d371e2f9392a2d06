"""The arrays of the pools and of carried data, by nodes and tetrahedra, and the contents of unused places."""

import numpy as np
import numpy.typing as npt

from warp_corot.kernels.remesh.pools import SINKS

#: Arrays of ``kernels.remesh.pools.Pools``, without those that have no meaning after a pass.
OF_NODES: tuple[str, ...] = ("lattice", "ends", "valence")
OF_TETRAHEDRA: tuple[str, ...] = ("tets", "level", "parent", "first_child", "code", "cut")

#: Of ``kernels.remesh.state.Carried``.
CARRIED_BY_NODES: tuple[str, ...] = (
    "rest",
    "u",
    "v",
    "load",
    "reaction",
    "snap",
    "mass",
    "held",
    "row",
    "mass32",
    "inverse_mass",
)
CARRIED_BY_TETRAHEDRA: tuple[str, ...] = ("density", "label", "values", "numbers")


def padding(start: int, stop: int, sink: int) -> npt.NDArray[np.int32]:
    """The contents of ``Pools.leaf_tets`` in places without leaves, int32 [stop - start, 4].

    Args:
        start, stop: The places.
        sink: ``Pools.sink``, the first place past the last node.
    """
    sinks = sink + np.arange(start, stop, dtype=np.int32) % int(SINKS)
    return np.repeat(sinks[:, None], 4, axis=1)
