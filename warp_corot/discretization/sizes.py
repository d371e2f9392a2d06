"""Numbers of nodes and elements of a body and of its launches, nodal vectors, and the clock that lower folders read."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.kernels.stepping.pace import Pace


class Clock(Protocol):
    """Steps and seconds of a simulation; ``solvers.pace.Pace`` is one.

    Attributes:
        arrays: ``kernels.stepping.pace.Pace`` for kernels.
    """

    @property
    def arrays(self) -> Pace: ...


def allocated(struct: Any, device: wp.Device, sizes: Iterable[tuple[Any, str]], **values: int) -> Any:
    """A struct of kernels with new arrays.

    Args:
        struct: The struct.
        device: Where the arrays are.
        sizes: Sizes or shapes, each with the names of arrays.
        values: What fills arrays that do not begin with zeros.
    """
    made = struct()
    for shape, names in sizes:
        for name in names.split():
            dtype = struct.vars[name].type.dtype
            setattr(made, name, wp.full(shape, values.get(name, 0), dtype=dtype, device=device))
    return made


# --- nodal vectors ---------------------------------------------------------------------------------------------------


def padded(vectors: np.ndarray) -> npt.NDArray[np.float32]:
    """[N, 3] as float32 [N, 4], the form of nodal arrays."""
    padded = np.zeros((len(vectors), 4), np.float32)
    padded[:, :3] = vectors
    return padded


def vec3_view(a: wp.array) -> wp.array:
    """The first three lanes of a vec4 array as a live (strided) vec3 array; a vec3 array as it is."""
    return a if a.dtype == wp.vec3 else a.view(wp.float32)[:, :3].view(wp.vec3)


def same_array(a: wp.array, b: wp.array) -> bool:
    """Whether two arrays are the same memory for launches."""
    return (a.ptr, a.dtype, a.strides) == (b.ptr, b.dtype, b.strides)


# --- sizes -----------------------------------------------------------------------------------------------------------


@dataclass
class Sizes:
    """Counts of a mesh on the device. They follow a mesh that changes.

    Attributes:
        worlds: Copies of the body.
        world_nodes, world_elements: Numbers in one copy.
        launch_nodes, launch_elements: Sizes of launches; items beyond the counts do nothing.
        version: A counter of changes of the mesh.
        revision: A counter of changes of the arrays, or the sizes, of launches.
    """

    worlds: int
    world_nodes: int
    world_elements: int
    launch_nodes: int
    launch_elements: int
    version: int = 0
    revision: int = 0

    @classmethod
    def of(cls, worlds: int, nodes: int, elements: int) -> Sizes:
        """The sizes of copies of a mesh that never changes."""
        return cls(worlds, nodes, elements, worlds * nodes, worlds * elements)

    @property
    def nodes(self) -> int:
        """Nodes of all worlds."""
        return self.worlds * self.world_nodes

    @property
    def elements(self) -> int:
        """Elements of all worlds."""
        return self.worlds * self.world_elements

    def mesh_changed(self, nodes: int, elements: int) -> None:
        """Record that the mesh has changed, with its new numbers of nodes and elements."""
        self.world_nodes, self.world_elements = nodes, elements
        self.version += 1

    def set_launches(self, nodes: int, elements: int) -> bool:
        """Set the sizes of launches; return whether they changed."""
        before = self.launch_nodes, self.launch_elements
        self.launch_nodes, self.launch_elements = nodes, elements
        return before != (nodes, elements)

    def relaunch(self) -> None:
        """Record that the launches of a step have changed."""
        self.revision += 1
