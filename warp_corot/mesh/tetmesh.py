"""General tetrahedral meshes: any shapes, a rest matrix each."""

from __future__ import annotations

from functools import cached_property
from os import PathLike

import numpy as np

from ..errors import InputError
from .surface import signed_volumes

#: A tetrahedron of less volume than this times its longest edge cubed cannot be told from a flat one in float32.
FLAT = 1e-7


class TetMesh:
    """Tetrahedra of any shape.

    Wrongly wound tetrahedra (negative volume) are turned round by exchanging their last two nodes; ``repaired`` says
    how many. Nodes that no tetrahedron names are kept, in their place, and stay at rest.

    Args:
        points: Rest positions [m], [N, 3].
        tets: Node indices, [T, 4].
        up_axis: "X", "Y" or "Z": which axis points up where results are drawn.
        scale: Factor by which the points are multiplied.

    Attributes:
        points: float64 [N, 3] [m].
        tets: int32 [T, 4], positively oriented.
        repaired: Number of tetrahedra that were turned round.
        up_axis: As given.

    Raises:
        InputError: Wrong shapes, non-finite coordinates, indices out of range, or a degenerate tetrahedron; the message
            names the first one.
    """

    def __init__(self, points: np.ndarray, tets: np.ndarray, *, up_axis: str = "Y", scale: float = 1.0):
        points = np.array(points, dtype=np.float64)
        given = np.asarray(tets)
        if points.ndim != 2 or points.shape[1] != 3 or not len(points):
            raise InputError(f"points has shape {points.shape}; it must be [N, 3] with at least one node")
        if given.ndim != 2 or given.shape[1] != 4 or not len(given):
            raise InputError(f"tets has shape {given.shape}; it must be [T, 4] with at least one tetrahedron")
        if not np.issubdtype(given.dtype, np.integer):
            raise InputError(f"tets has dtype {given.dtype}; node indices are whole numbers")
        if up_axis not in ("X", "Y", "Z"):
            raise InputError(f"up_axis is {up_axis!r}; it must be 'X', 'Y' or 'Z'")
        if not (np.isfinite(scale) and scale > 0):
            raise InputError(f"scale is {scale}; it must be a positive number")
        bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
        if len(bad):
            raise InputError(f"node {bad[0]} has the coordinates {points[bad[0]].tolist()}; they must be finite")
        bad = np.flatnonzero(((given < 0) | (given >= len(points))).any(axis=1))
        if len(bad):
            raise InputError(f"tetrahedron {bad[0]} names the nodes {given[bad[0]].tolist()}; there are {len(points)}")
        self.points = points * scale
        self.tets = np.array(given, dtype=np.int32)
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

    @classmethod
    def load(cls, path: str | PathLike[str], scale: float = 1.0) -> TetMesh:
        """Read tetrahedra from a USD file (TetMesh, or Mesh with ``tetraIndices``), from any format that meshio reads,
        or from ``warp:bear``.

        Args:
            path: File, or the name of an asset.
            scale: Factor by which the points are multiplied, after the file's own unit has been turned into metres.

        Raises:
            InputError: No such file, unknown format, no tetrahedra in it, or a mesh that cannot be simulated.
        """
        from ..io.formats import load_tets

        loaded = load_tets(path, scale=scale)
        return cls(loaded.points, loaded.tets, up_axis=loaded.up_axis)

    @cached_property
    def volumes(self) -> np.ndarray:
        """Rest volume of each tetrahedron [m^3], float64 [T]."""
        return signed_volumes(self.points, self.tets)


def _longest_edges(points: np.ndarray, tets: np.ndarray) -> np.ndarray:
    x = points[tets]
    pairs = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
    return np.max([np.linalg.norm(x[:, i] - x[:, j], axis=1) for i, j in pairs], axis=0)
