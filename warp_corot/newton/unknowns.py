"""The places of particles and bodies in the vectors of implicit steps."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import warp as wp

from .library import newton

#: Worlds are solved side by side if their vectors, all as long as the longest, have at most this many times as many
#: entries as are needed.
PADDING = 2


class Unknowns:
    """Entries of vectors: one for each particle, two for each body, world after world.

    Each world is solved by itself if everything that moves is in a world; otherwise all worlds are solved together.

    Args:
        model: The model.

    Attributes:
        worlds: Number of worlds that are solved side by side.
        count: Number of entries of each.
        particle, body: Entries of particles, and of bodies' translations, int32 [P], [B].
        owner: The body of an entry, or -1, int32 [worlds * count].
    """

    def __init__(self, model: newton.Model):
        particles, bodies = _worlds_of(model)
        size = np.bincount(particles, minlength=1)
        size = size + np.pad(2 * np.bincount(bodies, minlength=0), (0, len(size)))[: len(size)]
        if len(size) * size.max() > PADDING * size.sum():
            particles, bodies = np.zeros_like(particles), np.zeros_like(bodies)
            size = np.array([len(particles) + 2 * len(bodies)])
        self.worlds, self.count = len(size), int(size.max())
        of_particles = particles * self.count + _places(particles)
        first = np.bincount(particles, minlength=self.worlds)
        of_bodies = bodies * self.count + first[bodies] + 2 * _places(bodies)
        owner = np.full(self.worlds * self.count, -1, np.int32)
        owner[of_bodies] = np.arange(len(bodies))
        self.particle, self.body, self.owner = (
            wp.array(values, dtype=wp.int32, device=model.device) for values in (of_particles, of_bodies, owner)
        )

    def __len__(self) -> int:
        return self.worlds * self.count


def _worlds_of(model: newton.Model) -> tuple[npt.NDArray[np.integer], npt.NDArray[np.integer]]:
    """Worlds of particles and bodies, all zero if something that moves is in no world."""
    particles = model.particle_world.numpy()
    bodies = model.body_world.numpy() if model.body_count else np.zeros(0, np.int32)
    if min(particles.min(initial=0), bodies.min(initial=0)) < 0:
        return np.zeros_like(particles), np.zeros_like(bodies)
    numbers, places = np.unique(np.concatenate([particles, bodies]), return_inverse=True)
    if not len(numbers):
        return particles, bodies
    return places[: len(particles)], places[len(particles) :]


def _places(worlds: npt.NDArray[np.integer]) -> npt.NDArray[np.integer]:
    """The number of each entry among those of its world."""
    order = np.argsort(worlds, kind="stable")
    starts = np.searchsorted(worlds[order], worlds[order], "left")
    places = np.empty_like(order)
    places[order] = np.arange(len(worlds)) - starts
    return places
