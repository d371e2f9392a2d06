"""The state and material that nodes and tetrahedra of a changing forest carry: the host's side."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.sizes import allocated, padded
from warp_corot.errors import InputError
from warp_corot.kernels.remesh.derived import bind_points
from warp_corot.kernels.remesh.pools import MEAN, NO_ROW, SINKS, Carried, Pools
from warp_corot.mesh import TetForest
from warp_corot.mesh.lattice import MAX_LEVEL, lattice_spacing, volume_shares
from warp_corot.mesh.surfaces.bound import BoundPoints, DeviceBinding
from warp_corot.mesh.topology import coordinates_in


@dataclass(frozen=True, eq=False)
class Column:
    """Values of leaves, [T] or one for all, and the rule for a parent's value; see ``kernels.remesh.pools``."""

    values: npt.ArrayLike
    merging: int = int(MEAN)


@dataclass(frozen=True, eq=False)
class Numbers:
    """Whole numbers of leaves, [T] or one for all; a parent gets its first child's."""

    values: npt.ArrayLike


class Carriage:
    """State of nodes and material of tetrahedra, in arrays as large as the pools.

    A new node is the midpoint of its deformed edge, so that children have their parent's deformation gradient. Mass is
    lumped, a quarter of each leaf's at its nodes, and carries its momentum along; momentum that a held node cannot take
    up is counted in ``arrays.impulse``. A node between two held ones is held. Loads stay where they are; half of a
    removed node's load goes to each end of its edge. Children have their parent's density and values; a parent has its
    children's mean, or the value by the rule of its ``Column``.

    Args:
        source: The first forest.
        nodes, elements: Places for nodes and for tetrahedra of all levels.
        density: Mass per rest volume [kg/m^3], a number or one for each leaf [T].
        values: Other quantities of leaves by name.
        device: Where the arrays are.

    Attributes:
        arrays: ``kernels.remesh.pools.Carried``; nodal arrays by the nodes' places in the pool, with the places that
            padding names behind them, others by those of the tetrahedra. ``rest``, ``u``, ``v``, ``load``,
            ``reaction``, ``mass32`` and ``inverse_mass`` are what stepping reads and writes.
        names, number_names: Names of the columns of ``arrays.values`` and ``arrays.numbers``.
    """

    def __init__(
        self,
        source: TetForest,
        nodes: int,
        elements: int,
        density: npt.ArrayLike,
        values: Mapping[str, npt.ArrayLike | Column | Numbers],
        device: wp.Device,
    ):
        self.device = device
        self._nodes = nodes + int(SINKS)
        self._first_nodes = len(source.points)
        leaves = source.tree.leaves
        fill = 1.0 if source.fill is None else source.fill
        numbers = {name: given.values for name, given in values.items() if isinstance(given, Numbers)}
        columns = {name: _as_column(given) for name, given in values.items() if name not in numbers}
        if source.fill is not None:
            columns["fill"] = Column(source.fill)
        self.names, self.number_names = tuple(columns), tuple(numbers)
        per_leaf = _of_leaves("density", density, len(leaves)) * fill
        zeros = "u v load reaction snap held inverse_mass row gained_mass gained_momentum gain_count gainers"
        arrays = allocated(Carried, device, [(self._nodes, zeros), (1, "cut_area impulse")], row=int(NO_ROW))
        arrays.origin = wp.vec3d(*source.origin)
        arrays.spacing = lattice_spacing(source.cell_size)
        volume = volume_shares(np.arange(MAX_LEVEL + 1)) * source.cell_size**3
        arrays.volume = wp.array(volume, dtype=wp.float64, device=self.device)
        arrays.size = wp.array(np.cbrt(volume), dtype=wp.float64, device=self.device)
        arrays.density = self._of_elements(leaves, per_leaf, elements, wp.float64)
        labels = np.zeros(len(leaves)) if source.labels is None else source.labels
        arrays.label = self._of_elements(leaves, labels, elements, wp.int32)
        arrays.values = self._table(leaves, {n: c.values for n, c in columns.items()}, elements, wp.float32)
        merging = [column.merging for column in columns.values()]
        arrays.merging = wp.array(merging, dtype=wp.int32, device=self.device)
        for name in ("fill", "mu", "lam"):
            setattr(arrays, f"{name}_column", self.names.index(name) if name in columns else -1)
        arrays.numbers = self._table(leaves, numbers, elements, wp.int32)
        masses = np.zeros(self._nodes)
        np.add.at(masses, source.tets, (0.25 * per_leaf * volume[source.levels])[:, None])
        arrays.mass = wp.array(masses, dtype=wp.float64, device=self.device)
        arrays.mass32 = wp.array(masses, dtype=wp.float32, device=self.device)
        rest = np.zeros((self._nodes, 4), np.float32)
        rest[: self._first_nodes] = padded(source.points)
        if source.snap is not None:
            arrays.snap[: self._first_nodes].assign(padded(source.snap[: self._first_nodes]))
        arrays.rest = wp.array(rest, dtype=wp.vec4, device=self.device)
        self.arrays = arrays
        self.update_inverse_mass()

    def values(self, name: str) -> npt.NDArray[np.float32]:
        """A quantity at all places for tetrahedra; only the values of leaves count."""
        return self.arrays.values.numpy()[:, self.names.index(name)]

    def update_inverse_mass(self) -> None:
        """Find the inverse masses again, which are zero where nodes are held."""
        masses, held = self.arrays.mass.numpy(), self.arrays.held.numpy() != 0
        free = ~held & (masses > 0)
        inverse = np.zeros(len(masses))
        inverse[free] = 1.0 / masses[free]
        self.arrays.inverse_mass.assign(inverse.astype(np.float32))

    def _of_elements(self, leaves: np.ndarray, values: np.ndarray, count: int, dtype: type) -> wp.array:
        spread = np.zeros(count, wp.dtype_to_numpy(dtype))
        spread[leaves] = values
        return wp.array(spread, dtype=dtype, device=self.device)

    def _table(self, leaves: np.ndarray, given: Mapping[str, npt.ArrayLike], count: int, dtype: type) -> wp.array:
        table = np.zeros((count, len(given)), wp.dtype_to_numpy(dtype))
        for column, (name, value) in zip(table.T, given.items(), strict=True):
            column[leaves] = _of_leaves(name, value, len(leaves))
        return wp.array(table, dtype=dtype, device=self.device, ndim=2)


def _as_column(given: npt.ArrayLike | Column | Numbers) -> Column:
    assert not isinstance(given, Numbers)
    return given if isinstance(given, Column) else Column(given)


def _of_leaves(name: str, given: npt.ArrayLike, count: int) -> npt.NDArray[np.float64]:
    values = np.asarray(given, dtype=np.float64)
    if values.shape not in ((), (count,)):
        raise InputError(
            f"{name} has shape {values.shape}; it must be a number or have one entry for each of {count} leaves"
        )
    if not np.isfinite(values).all():
        raise InputError(f"{name} must be finite")
    return np.broadcast_to(values, count)


# --- points and surfaces that stay bound -----------------------------------------------------------------------------
#
# Points and surfaces that stay bound to a mesh while it changes.


#: Before a point is bound to a child of its element, it moves this fraction of the way from the element's border
#: inwards.
INWARD = 1e-3


class FollowingBinding(DeviceBinding):
    """Points bound to a mesh that may change: each pass binds them to the elements that contain them afterwards.

    Args:
        bound: Bound to the nodes of ``mesh``.
        mesh: The present mesh.
        leaves: The leaf that each point is bound to, int32 [V].
        device: The body's device.
    """

    def __init__(self, bound: BoundPoints, mesh: TetForest, leaves: npt.NDArray[np.integer], device: wp.Device):
        super().__init__(bound, device)
        tree = mesh.tree
        roots = tree.ancestors(tree.leaves[leaves], 0)
        corners = mesh.lattice_points[tree.tets[roots]]
        inward = np.clip(bound.weights, 0.0, None)
        inward = (1.0 - INWARD) * inward / inward.sum(axis=1, keepdims=True) + INWARD / 4.0
        inside = np.einsum("vn,vnc->vc", inward, mesh.points[mesh.tets[leaves]])
        self._roots = wp.array(roots, dtype=wp.int32, device=device)
        self._inside = wp.array(coordinates_in(corners, inside), dtype=wp.vec4d, device=device)
        self._points = wp.array(coordinates_in(corners, bound.points), dtype=wp.vec4d, device=device)

    def rebind(self, pools: Pools) -> None:
        """Bind the points to the present leaves of ``kernels.remesh.pools.Pools``."""
        inputs = [self._roots, self._inside, self._points, pools]
        wp.launch(bind_points, len(self.rest), inputs, [self.nodes, self.weights], device=self.device)
