"""General tetrahedral meshes: tetrahedra of any shape, each with a rest matrix."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from os import PathLike

import numpy as np
import numpy.typing as npt

from warp_corot.domain.units import check_float32
from warp_corot.errors import InputError
from warp_corot.inputs.checks import (
    checked_axis,
    checked_indices,
    checked_number,
    checked_numbers,
    checked_strings,
    shown,
)
from warp_corot.kernels.tables.shapes import EDGES

from .forest_arrays import LabelledMesh
from .surfaces.bound import embed_in_tets
from .topology import signed_volumes

#: A tetrahedron with less volume than this times the cube of its longest edge is flat in float32.
FLAT = 1e-7


class TetMesh(LabelledMesh):
    """Tetrahedra of any shape.

    Mirrored tetrahedra (negative volume) are repaired by exchanging their last two nodes; ``repaired`` says how many.
    Nodes that belong to no tetrahedron are kept and stay at rest.

    Args:
        points: Rest positions [m], [N, 3].
        tets: Node indices, [T, 4].
        up_axis: "X", "Y" or "Z": the axis that points up in drawings.
        scale: Factor by which the points are multiplied.
        labels: Each tetrahedron's region, its place in ``label_names`` plus one, 0 for none, [T]; None: no regions.
        label_names: Names of the regions.
        node_sets: Named sets of nodes, masks bool [N] or indices; ``SoftBody.fix`` and other methods take the names.

    Attributes:
        points: float64 [N, 3] [m].
        tets: int32 [T, 4], positively oriented.
        repaired: Number of mirrored tetrahedra that were repaired.
        up_axis: As given.
        labels: int32 [T] or None, as given.
        label_names: As given.
        node_sets: Masks bool [N] by name.

    Raises:
        InputError: An array has the wrong shape, a coordinate is not finite, an index is out of range, or a tetrahedron
            is degenerate; the message names the first one.
    """

    def __init__(
        self,
        points: np.ndarray,
        tets: np.ndarray,
        *,
        up_axis: str = "Y",
        scale: float = 1.0,
        labels: np.ndarray | None = None,
        label_names: Sequence[str] = (),
        node_sets: Mapping[str, npt.ArrayLike] | None = None,
    ):
        points = checked_numbers(points, "points", "[N, 3]; TetMesh.load reads a file").copy()
        try:
            given = np.asarray(tets)
        except ValueError:
            raise InputError("tets has rows of different lengths; it must be [T, 4]") from None
        if points.ndim != 2 or points.shape[1] != 3 or not len(points):
            raise InputError(f"points has shape {points.shape}; it must be [N, 3] with at least one node")
        if given.ndim != 2 or given.shape[1] != 4 or not len(given):
            raise InputError(f"tets has shape {given.shape}; it must be [T, 4] with at least one tetrahedron")
        if not np.issubdtype(given.dtype, np.integer):
            raise InputError(f"tets has dtype {given.dtype}; node indices must be integers")
        checked_axis(up_axis)
        if not 0 < checked_number(scale, "scale") < np.inf:
            raise InputError(f"scale is {shown(scale)}; it must be a positive number")
        bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
        if len(bad):
            raise InputError(f"node {bad[0]} has the coordinates {points[bad[0]].tolist()}; they must be finite")
        bad = np.flatnonzero(((given < 0) | (given >= len(points))).any(axis=1))
        if len(bad):
            raise InputError(f"tetrahedron {bad[0]} names the nodes {given[bad[0]].tolist()}; there are {len(points)}")
        self.points = points * scale
        #: Groups of elements that share a dilatation, int32 [T], if a larger mesh gives them; None: they are found when
        #: needed.
        self.element_groups: np.ndarray | None = None
        self.tets = np.array(given, dtype=np.int32)
        used = self.points[np.unique(self.tets)]
        check_float32(np.stack([used.min(axis=0), used.max(axis=0)]))
        self.up_axis = up_axis
        volumes = signed_volumes(self.points, self.tets)
        bad = np.flatnonzero(np.abs(volumes) <= FLAT * _longest_edges(self.points, self.tets) ** 3)
        if len(bad):
            raise InputError(
                f"tetrahedron {bad[0]} with the nodes {self.tets[bad[0]].tolist()} is degenerate: its volume is "
                f"{volumes[bad[0]]:.3g} m^3 ({len(bad)} of {len(volumes)} are)"
            )
        turned = volumes < 0
        self.tets[turned] = self.tets[turned][:, [0, 1, 3, 2]]
        self.repaired = int(turned.sum())
        self.label_names = checked_strings(label_names, "label_names")
        self.labels = None if labels is None else _checked_labels(labels, len(self.tets), len(self.label_names))
        if not (node_sets is None or isinstance(node_sets, Mapping)):
            raise InputError(f"node_sets is {shown(node_sets)}; it must give nodes by name: {{'tip': [0, 1]}}")
        self.node_sets = {name: _mask(nodes, len(points)) for name, nodes in (node_sets or {}).items()}

    def __repr__(self) -> str:
        return f"<TetMesh of {len(self.tets)} tetrahedra and {len(self.points)} nodes>"

    @classmethod
    def load(
        cls,
        path: str | PathLike[str],
        scale: float = 1.0,
        *,
        unit: str | float | None = None,
        up_axis: str | None = None,
        regions: str | None = None,
    ) -> TetMesh:
        """Read the volume cells of a file: USD (TetMesh, or Mesh with ``tetraIndices``), VTK, Gmsh, Abaqus, Medit,
        TetGen, NetGen and other formats of meshio; or of ``warp:bear``.

        Hexahedra, wedges and pyramids become conforming tetrahedra; cells of higher order become tetrahedra of their
        corners. Physical groups, sets and cell data become ``labels``. Sets of nodes, groups of points, curves and
        surfaces, and point data with few different whole numbers become ``node_sets``.

        Args:
            path: File, or the name of an asset.
            scale: Factor by which the points are multiplied, after conversion to metres.
            unit: The unit of the coordinates, any length such as "mm" or "3.2cm", or metres as a number. None: the
                file's unit, or metres.
            up_axis: "X", "Y" or "Z". None: the file's axis, or Z.
            regions: Name of the file's array that numbers regions; None: the likeliest.

        Raises:
            InputError: The file does not exist, its format is unknown, it has no volume cells, or its mesh cannot be
                simulated.
        """
        from warp_corot.io.read.meshes import load_tets

        loaded = load_tets(path, scale=scale, unit=unit, regions=regions)
        found = loaded.regions
        return cls(
            loaded.points,
            loaded.cells,
            up_axis=up_axis or loaded.up_axis or "Z",
            labels=None if found is None else found.of_tet,
            label_names=() if found is None else found.names,
            node_sets=loaded.node_sets,
        )

    @cached_property
    def volumes(self) -> np.ndarray:
        """Rest volume of each tetrahedron [m^3], float64 [T]."""
        return signed_volumes(self.points, self.tets)

    def embed(self, points: npt.ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        return embed_in_tets(self.points, self.tets, np.asarray(points))


def _mask(nodes: npt.ArrayLike, count: int) -> npt.NDArray[np.bool_]:
    mask = np.zeros(count, bool)
    mask[checked_indices(nodes, count, "node")] = True
    return mask


def _checked_labels(given: np.ndarray, count: int, names: int) -> np.ndarray:
    try:
        labels = np.asarray(given)
    except ValueError:
        raise InputError(f"labels has rows of different lengths; it must be integers [{count}]") from None
    if labels.shape != (count,) or labels.dtype.kind not in "iu":
        raise InputError(f"labels have shape {labels.shape} and dtype {labels.dtype}; they must be integers [{count}]")
    if len(labels) and not 0 <= labels.min() <= labels.max() <= names:
        raise InputError(f"labels run from {labels.min()} to {labels.max()}; there are {names} label_names")
    return labels.astype(np.int32)


def _longest_edges(points: np.ndarray, tets: np.ndarray) -> np.ndarray:
    x = points[tets]
    return np.max([np.linalg.norm(x[:, i] - x[:, j], axis=1) for i, j in EDGES], axis=0)
