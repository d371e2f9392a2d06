"""``--press``: pressures on the surfaces of patches, as nodal forces that follow the mesh."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from warp_corot.errors import InputError
from warp_corot.mesh.surfaces.bodies import boundary_surface

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody
    from warp_corot.mesh.surfaces.bound import SurfaceMesh
    from warp_corot.simulation.simulation import Simulation

    from .loading import Load
    from .patches import BodyPatches

#: A changing pressure is updated at least this often.
UPDATES = 200

Array = npt.NDArray[np.float64]


def press_patches(sim: Simulation, body: SoftBody, loads: Sequence[Load], patches: BodyPatches, ramp: float) -> None:
    """Apply the pressures of ``--press``.

    Args:
        sim: The simulation.
        body: One of its bodies; it may be remeshed.
        loads: The body's loads.
        patches: The body's patches.
        ramp: Time over which loads without times grow [s].

    Raises:
        InputError: A patch contains no part of the surface.
    """
    pressing = [load for load in loads if load.kind == "press"]
    if not pressing:
        return
    pressure = _Pressure(body, pressing, patches, ramp)
    pressure.set(0.0)
    sim.on_step(lambda sim: pressure.set(sim.time), every=max(1, int(pressure.span / UPDATES / sim.dt)))
    for options in sim.remesh:
        if options is not None:
            sim.on_step(lambda sim: pressure.set(sim.time), every=options.every)


class _Pressure:
    """The pressures on a body over time.

    Args:
        body: The body.
        loads: Pressures.
        patches: The body's patches.
        ramp: Time over which loads without times grow [s].

    Attributes:
        span: Time from the first to the last change of a pressure [s].
    """

    def __init__(self, body: SoftBody, loads: Sequence[Load], patches: BodyPatches, ramp: float):
        surface = surface_of(patches)
        forces = [load.values[0] * pressed(load, patches, surface) for load in loads]
        self._curves = [load.curve(ramp) for load in loads]
        self._first = min(times[0] for times, _ in self._curves)
        self._last = max(times[-1] for times, _ in self._curves)
        self.span = float(self._last - self._first)
        self._body = body
        there = np.any([each.any(axis=1) for each in forces], axis=0)
        self._forces = np.stack([each[there] for each in forces])
        follows = body.changing is not None
        self._following = body.bind(surface.points[there]) if follows else None
        self._nodes, self._weights = surface.nodes[there], surface.weights[there]
        self._revision = -1
        self._done = False

    def set(self, time: float) -> None:
        """Load the body's nodes for a time [s], if the loads have changed."""
        if self._revision != self._body.version:
            self._done = False
        if self._done or (self._revision == self._body.version and time < self._first):
            return
        if self._following is not None and self._revision != self._body.version:
            self._nodes, self._weights = self._following.nodes.numpy(), self._following.weights.numpy()
        self._revision = self._body.version
        shares = [np.interp(time, times, shares) for times, shares in self._curves]
        at_points = np.einsum("p,pvx->vx", shares, self._forces)
        self._body.load("all", nodal(at_points, self._nodes, self._weights, self._body.node_count))
        self._done = time >= self._last


def surface_of(patches: BodyPatches) -> SurfaceMesh:
    """The surface of a body, bound to its nodes."""
    return patches.subject.surface or boundary_surface(patches.subject.mesh)


def pressed(load: Load, patches: BodyPatches, surface: SurfaceMesh) -> Array:
    """The nodal forces of a pressure of one pascal on a patch, at the points of the surface [N], [V, 3].

    Raises:
        InputError: The patch contains no part of the surface.
    """
    inside = patches.on_surface(load.patch, surface)
    triangles = surface.triangles[inside[surface.triangles].all(axis=1)]
    if not len(triangles):
        raise InputError(f"--{load.kind} {load.patch!r}: no part of the surface is in it")
    a, b, c = np.moveaxis(surface.points[triangles], 1, 0)
    forces = np.zeros_like(surface.points)
    np.add.at(forces, triangles.ravel(), np.repeat(-np.cross(b - a, c - a) / 6.0, 3, axis=0))
    return forces


def nodal(forces: Array, nodes: npt.NDArray[np.integer], weights: npt.NDArray[np.floating], count: int) -> Array:
    """Forces at bound points [N], [V, 3], distributed to the nodes [N], [count, 3]."""
    found = np.zeros((count, 3))
    np.add.at(found, nodes.ravel(), (weights[:, :, None] * forces[:, None]).reshape(-1, 3))
    return found
