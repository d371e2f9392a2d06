"""Points and surfaces that stay bound to a mesh while it changes."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.kernels.remesh.follow import bind_points
from warp_corot.kernels.remesh.pools import Pools
from warp_corot.mesh import TetForest
from warp_corot.mesh.surfaces.bound import BoundPoints, DeviceBinding

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
        self._inside = wp.array(_coordinates(corners, inside), dtype=wp.vec4d, device=device)
        self._points = wp.array(_coordinates(corners, bound.points), dtype=wp.vec4d, device=device)

    def rebind(self, pools: Pools) -> None:
        """Bind the points to the present leaves of ``kernels.remesh.pools.Pools``."""
        inputs = [self._roots, self._inside, self._points, pools]
        wp.launch(bind_points, len(self.rest), inputs, [self.nodes, self.weights], device=self.device)


def _coordinates(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Barycentric coordinates, float64 [n, 4], of points [n, 3] in tetrahedra [n, 4, 3]."""
    edges = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
    later = np.linalg.solve(edges, (points - corners[:, 0])[..., None])[..., 0]
    return np.column_stack([1 - later.sum(axis=1), later])
