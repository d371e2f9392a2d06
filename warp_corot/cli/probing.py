"""``--probe`` and ``--csv``: motion of patches and points of bodies, and energies, as a table by frames."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from warp_corot.contact.tool import Obstacle, Tool
from warp_corot.errors import InputError
from warp_corot.io.files.whole import writing

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody
    from warp_corot.simulation.simulation import Simulation

    from .patches import BodyPatches

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_POINT = re.compile(rf"\s*({_NUMBER})[\s,]+({_NUMBER})[\s,]+({_NUMBER})\s*")
#: A point outside by more than this fraction of the body's size is not moved to the nearest point inside.
OUTSIDE = 0.05
#: Names and units of the columns of a probe.
COLUMNS = [f"{what}{axis} [{unit}]" for what, unit in (("u", "m"), ("v", "m/s")) for axis in "xyz"]
COLUMNS += [f"reaction {axis} [N]" for axis in "xyz"]

Array = npt.NDArray[np.float64]


class Probe:
    """A probed point or patch of a body.

    A point interpolates the four nodes of its tetrahedron. A patch has the mass-weighted mean over its nodes, and the
    sum of their reactions. Both are found again when the mesh has changed.

    Args:
        text: "X Y Z" [m] at rest, or a patch's expression.
        body: The body.
        patches: The body's patches.

    Raises:
        InputError: A point outside the body, a patch without nodes, or an invalid expression.
    """

    def __init__(self, text: str, body: SoftBody, patches: BodyPatches):
        self.text, self.body, self._patches = text, body, patches
        match = _POINT.fullmatch(text)
        self.point = np.array([float(part) for part in match.groups()] if match else 3 * [np.nan])
        self.is_patch = match is None
        self._find()

    def values(self) -> list[float]:
        """Displacement [m], velocity [m/s] and reaction [N], nine numbers."""
        if self._revision != self.body.version:
            self._find()
        u, v = (array.numpy()[self._nodes].astype(float) for array in (self.body.displacements, self.body.velocities))
        r = self.body.reactions.numpy()[self._nodes].astype(float)
        share = np.ones(len(r)) if self.is_patch else self._weights
        return [float(x) for x in (*(self._weights @ u), *(self._weights @ v), *(share @ r))]

    def _find(self) -> None:
        """Find the nodes in the current mesh, and their weights."""
        self._revision = self.body.version
        if not self.is_patch:
            self._place()
            return
        mask = self._patches.of_mesh(self.body.mesh).some(self.text, "--probe")
        weights = self.body.masses * mask
        self._nodes = np.flatnonzero(mask)
        self._weights = weights[self._nodes] / weights.sum()

    def _place(self) -> None:
        """Find the tetrahedron that contains the point, or the nearest one."""
        mesh = self.body.mesh
        (element,), (weights,) = mesh.embed(self.point[None])
        inside = np.clip(weights, 0.0, None)
        self._weights, self._nodes = inside / inside.sum(), mesh.tets[element]
        away = float(np.linalg.norm(self._weights @ mesh.points[self._nodes] - self.point))
        size = float(np.linalg.norm(np.ptp(mesh.points[mesh.tets.ravel()], axis=0)))
        if away > OUTSIDE * size:
            raise InputError(f"--probe {self.text!r}: the point is {away:.3g} m outside the body")


def probes_body(text: str, patches: BodyPatches) -> bool:
    """Whether a body has the patch, or contains the point in its box.

    Raises:
        InputError: As in `BodyPatches.nodes`.
    """
    match = _POINT.fullmatch(text)
    if match is None:
        return bool(patches.nodes(text).any())
    point, (low, high) = np.array([float(part) for part in match.groups()]), patches.subject.bounds
    return bool(((low <= point) & (point <= high)).all())


class Table:
    """A CSV file with one row for each frame; each row is written at once, by the first of several ranks.

    Args:
        path: The file; a former one stays until the first row.
        sim: The simulation.
        probes: Probes of its bodies.
        obstacles: Obstacles by name; the forces on them and the places of tools have columns.

    Raises:
        InputError: Another extension, a folder with this name, or no folder to write to.
    """

    def __init__(
        self,
        path: Path,
        sim: Simulation,
        probes: Sequence[Probe],
        obstacles: Mapping[str, Obstacle] | None = None,
    ):
        self.path, self._sim, self._probes = path, sim, probes
        self._obstacles = dict(obstacles or {})
        self._file: IO[str] | None = None

    def add(self) -> None:
        """Add a row with the current state.

        Raises:
            WriteError: It cannot be written.
        """
        energy = self._sim.energy()
        values = [value for probe in self._probes for value in probe.values()]
        values += [value for each in self._obstacles.values() for value in _felt(each)]
        row = [self._sim.time, *values, energy.kinetic, energy.elastic, energy.gravitational, self._sim.dt]
        if not self._sim.is_root:
            return
        with writing(self.path):
            if self._file is None:
                self._file = self.path.open("w", newline="")
                csv.writer(self._file).writerow(self._header())
            csv.writer(self._file).writerow([f"{value:.9g}" for value in row])
            self._file.flush()

    def close(self) -> None:
        if self._file is not None:
            self._file.close()

    def _header(self) -> list[str]:
        bodies = self._sim.bodies
        names = ["time [s]"]
        for probe in self._probes:
            of = f"body {bodies.index(probe.body) + 1}: " if len(bodies) > 1 else ""
            names += [f"{of}{probe.text} {column}" for column in COLUMNS]
        for name, each in self._obstacles.items():
            names += [f"{name} {column}" for column in _felt_columns(each)]
        return [*names, "kinetic [J]", "elastic [J]", "gravitational [J]", "dt [s]"]


def _felt_columns(obstacle: Obstacle) -> list[str]:
    """Names and units of `_felt`."""
    forces = [f"force {axis} [N]" for axis in "xyz"]
    if not isinstance(obstacle, Tool):
        return forces
    return [f"{axis} [m]" for axis in "xyz"] + forces + [f"torque {axis} [N m]" for axis in "xyz"]


def _felt(obstacle: Obstacle) -> list[float]:
    """The force on an obstacle in the last step [N]; for a tool its place [m] before, and the torque about it [N m]
    after."""
    wrench = [float(value) for value in obstacle.wrench.numpy()[0]]
    if not isinstance(obstacle, Tool):
        return wrench[:3]
    return [*obstacle.present_pose[0, :3].tolist(), *wrench]
