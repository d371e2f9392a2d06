"""Bodies given by formulas, in the form for the mesher."""

import numpy as np
import warp as wp

from warp_corot.domain import Domain


class Body(Domain):
    """A signed function of points [n, 3], negative inside, in float64, rounded once."""

    def __init__(self, function, bounds, lipschitz=1.0, labels=None, label_names=()):
        super().__init__(bounds, lipschitz, label_names=label_names, device="cpu")
        self.function = function
        self.labels = labels
        self.asked = []

    def phi(self, points):
        x = points.numpy() if isinstance(points, wp.array) else np.asarray(points)
        self.asked.append(x)
        found = self.function(x.astype(float)).astype(np.float32)
        return wp.array(found, dtype=wp.float32, device=points.device) if isinstance(points, wp.array) else found

    def labels_at(self, points, nearest=False):
        found = self.labels(np.asarray(points, float))
        return found if nearest else np.where(self.phi(points) <= 0, found, 0)


def ball(radius=0.4, centre=(0.0, 0.0, 0.0)):
    c = np.array(centre)
    return Body(lambda x: np.linalg.norm(x - c, axis=1) - radius, [c - radius, c + radius])


def ring(major=0.35, minor=0.12):
    reach = np.array([major + minor, major + minor, minor])
    return Body(lambda x: np.hypot(np.hypot(x[:, 0], x[:, 1]) - major, x[:, 2]) - minor, [-reach, reach])


def box_distance(x, half):
    beyond = np.abs(x) - half
    return np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(axis=1), 0)


def turned_box(half, turn):
    """A box about the origin, rotated by a matrix."""
    half = np.array(half)
    reach = np.abs(turn) @ half
    return Body(lambda x: box_distance(x @ turn, half), [-reach, reach])


def united(*bodies):
    low = np.min([b.bounds[0] for b in bodies], axis=0)
    high = np.max([b.bounds[1] for b in bodies], axis=0)
    return Body(lambda x: np.min([b.function(x) for b in bodies], axis=0), [low, high])


def without(body, hole):
    return Body(lambda x: np.maximum(body.function(x), -hole.function(x)), body.bounds)
