"""The colours of a surface: sources of values by name, and the range of the colours."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.body.soft_body import SoftBody
from warp_corot.contact.reading import pressure_at_nodes
from warp_corot.io.pictures.colors import round_limit
from warp_corot.kernels.viewing import values as kernels
from warp_corot.mesh import TetForest
from warp_corot.mesh.topology import signed_volumes
from warp_corot.simulation.simulation import Simulation

from .shown import Shown

Values: TypeAlias = npt.NDArray[np.floating]

#: A range of colours that is more than this many times too wide becomes narrower.
TOO_WIDE = 3.0
#: Colours end at this displacement over the body's size and this stress over Young's modulus at least: smaller ones are
#: no news, and after a reset there is only rounding.
LEAST_MOTION, LEAST_STRESS = 1e-3, 1e-2


@dataclass(frozen=True)
class Source:
    """Values that colours can show.

    Attributes:
        label: What the values are, for people.
        unit: The unit of the values.
        values: The values at the points of a shown surface, [V], for a simulation and one of its bodies.
        least: The least end of the colours for a shown surface.
        applies: Whether a body has such values.
    """

    label: str
    unit: str
    values: Callable[[Simulation, Shown], Values]
    least: Callable[[Shown], float] = lambda _: 0.0
    applies: Callable[[SoftBody], bool] = lambda _: True


def displacement(sim: Simulation, shown: Shown) -> Values:
    """The distances of the points from their rest positions [m]."""
    return np.linalg.norm(shown.positions - shown.rest, axis=1)


class ElementValues:
    """Values of elements, averaged to nodes by volume and carried to the points of a surface, on the device.

    Args:
        values: The values of the shown world's elements, float32 [T], on the body's device.
    """

    def __init__(self, values: Callable[[Simulation, Shown], wp.array]):
        self._values = values
        self._averages: dict[SoftBody, _Average] = {}

    def __call__(self, sim: Simulation, shown: Shown) -> Values:
        body = shown.body
        average = self._averages.get(body)
        if average is None or average.version != body.version:
            average = self._averages[body] = _Average(body)
        return average(self._values(sim, shown), shown)


class _Average:
    """Averages of the elements around each node of a body's present mesh."""

    def __init__(self, body: SoftBody):
        mesh, self._device, self.version = body.mesh, body.device, body.version
        volumes = np.abs(signed_volumes(mesh.points, mesh.tets))
        around = np.bincount(mesh.tets.ravel(), np.repeat(volumes, 4), len(mesh.points))
        self._tets = wp.array(mesh.tets, dtype=wp.vec4i, device=self._device)
        # Over the mean, as float32 holds no cubes of small lengths.
        scale = float(volumes.mean())
        self._volumes, self._around = (
            wp.array(each / scale, dtype=wp.float32, device=self._device) for each in (volumes, around)
        )
        self._sums = wp.zeros_like(self._around)

    def __call__(self, values: wp.array, shown: Shown) -> Values:
        binding, found = shown.binding, wp.empty(len(shown.rest), dtype=wp.float32, device=self._device)
        self._sums.zero_()
        inputs = [values, self._tets, self._volumes]
        wp.launch(kernels.add_to_nodes, len(self._tets), inputs, [self._sums], device=self._device)
        inputs = [binding.nodes, binding.weights, self._sums, self._around]
        wp.launch(kernels.carry_to_points, len(found), inputs, [found], device=self._device)
        return found.numpy()


def _stress(sim: Simulation, shown: Shown) -> wp.array:
    body = shown.body
    field = sim.fields[sim.bodies.index(body)]
    stress = wp.zeros(field.element_count, dtype=wp.float32, device=body.device)
    with field.state_kept():
        field.write_von_mises(body.state.displacements, stress)
    return stress[shown.world.elements]


def _level(sim: Simulation, shown: Shown) -> wp.array:
    mesh = shown.body.mesh
    assert isinstance(mesh, TetForest)
    return wp.array(mesh.levels, dtype=wp.float32, device=shown.body.device)


def contact_pressure(sim: Simulation, shown: Shown) -> Values:
    """Contact pressure in the last step [Pa]: triangles' values, averaged to nodes by area."""
    body = shown.body
    pressure = body.contact_pressure.numpy().reshape(body.worlds, -1)[shown.world.index]
    nodal = pressure_at_nodes(body.contact_surface, body.world_node_count, pressure)
    return np.einsum("vn,vn->v", shown.binding.weights.numpy(), nodal[shown.binding.nodes.numpy()])


def _least_motion(shown: Shown) -> float:
    return LEAST_MOTION * float(np.ptp(shown.rest, axis=0).max(initial=0.0))


def _least_stress(shown: Shown) -> float:
    return LEAST_STRESS * float(np.mean(shown.body.material.isotropic.young))


def sources() -> dict[str, Source]:
    """The sources by name. Sources that keep data of a body belong to one session."""
    return {
        "stress": Source("von Mises stress", "Pa", ElementValues(_stress), _least_stress),
        "displacement": Source("displacement", "m", displacement, _least_motion),
        "contact pressure": Source(
            "contact pressure", "Pa", contact_pressure, _least_stress, lambda body: body.state.is_touched
        ),
        "level": Source(
            "level of the mesh", "", ElementValues(_level), applies=lambda body: isinstance(body.mesh, TetForest)
        ),
    }


class Range:
    """The range of the colours: from zero to a round number that follows the largest value."""

    def __init__(self) -> None:
        self.highest = 0.0

    def follow(self, largest: float, least: float) -> float:
        """The upper end of the range, after values with this maximum; not below ``least``."""
        largest = max(largest, least)
        if largest > self.highest or largest < self.highest / TOO_WIDE:
            self.highest = round_limit(largest)
        return self.highest
