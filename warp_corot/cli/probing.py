"""``--probe`` and ``--csv``: what patches and points of bodies do, and energies, frame by frame as a table."""

from __future__ import annotations

import csv
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import IO, TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from warp_corot.errors import InputError

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody
    from warp_corot.simulation.simulation import Simulation

    from .patches import Patches

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_POINT = re.compile(rf"\s*({_NUMBER})[\s,]+({_NUMBER})[\s,]+({_NUMBER})\s*")
#: A point this share of the body's size outside is not taken for the nearest one in it.
OUTSIDE = 0.05

Array = npt.NDArray[np.float64]


class Probe:
    """A point of a body, or a patch, and what becomes of it.

    A point is what the tetrahedron around it makes of its four nodes. Of a patch it is the mean over its nodes, each
    counted with its mass; reactions are summed. Both are found again where the mesh has become another one.

    Args:
        text: "X Y Z" [m] at rest, or a patch's expression.
        body: Whose.
        patches: Of the body.

    Raises:
        InputError: A point that is not in the body, a patch without nodes, or no expression.
    """

    def __init__(self, text: str, body: SoftBody, patches: Patches):
        self.text, self.body, self._patches = text, body, patches
        match = _POINT.fullmatch(text)
        self.point = np.array([float(part) for part in match.groups()] if match else 3 * [np.nan])
        self.is_patch = match is None
        self._find()

    @property
    def columns(self) -> list[str]:
        """Names and units."""
        names = [f"{what}{axis} [{unit}]" for what, unit in (("u", "m"), ("v", "m/s")) for axis in "xyz"]
        return names + [f"reaction {axis} [N]" for axis in "xyz"]

    def values(self) -> list[float]:
        """Displacement [m], velocity [m/s] and reaction [N], nine numbers."""
        if self._revision != self.body.version:
            self._find()
        u, v = (array.numpy()[self._nodes].astype(float) for array in (self.body.displacements, self.body.velocities))
        r = self.body.reactions.numpy()[self._nodes].astype(float)
        share = np.ones(len(r)) if self.is_patch else self._weights
        return [float(x) for x in (*(self._weights @ u), *(self._weights @ v), *(share @ r))]

    def _find(self) -> None:
        """Find the nodes in the present mesh, and how much each counts."""
        self._revision = self.body.version
        if not self.is_patch:
            self._place()
            return
        mask = self._patches.of_mesh(self.body.mesh).some(self.text, "--probe")
        weights = self.body.masses * mask
        self._nodes = np.flatnonzero(mask)
        self._weights = weights[self._nodes] / weights.sum()

    def _place(self) -> None:
        """Find the tetrahedron that the point is in, or the nearest."""
        mesh = self.body.mesh
        corners = mesh.points[mesh.tets]
        edges = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
        inner = np.linalg.solve(edges, (self.point - corners[:, 0])[:, :, None])[:, :, 0]
        weights = np.concatenate([1.0 - inner.sum(axis=1, keepdims=True), inner], axis=1)
        best = int(np.argmax(weights.min(axis=1)))
        inside = np.clip(weights[best], 0.0, None)
        self._weights, self._nodes = inside / inside.sum(), mesh.tets[best]
        away = float(np.linalg.norm(self._weights @ mesh.points[self._nodes] - self.point))
        size = float(np.linalg.norm(np.ptp(mesh.points[mesh.tets.ravel()], axis=0)))
        if away > OUTSIDE * size:
            raise InputError(f"--probe {self.text!r}: the point is {away:.3g} m outside the body")


def probes_body(text: str, patches: Patches) -> bool:
    """Whether a body has the patch, or the point in its box.

    Raises:
        InputError: As `Patches.nodes`.
    """
    match = _POINT.fullmatch(text)
    if match is None:
        return bool(patches.nodes(text).any())
    point, (low, high) = np.array([float(part) for part in match.groups()]), patches.subject.bounds
    return bool(((low <= point) & (point <= high)).all())


class Table:
    """A CSV file of one row a frame; each row is in it as soon as it is made.

    Args:
        path: The file; what was there stays until the first row.
        sim: The simulation.
        probes: Of its bodies.

    Raises:
        InputError: Another extension, a folder, or none to write to.
    """

    def __init__(self, path: Path, sim: Simulation, probes: Sequence[Probe]):
        self.path, self._sim, self._probes = path, sim, probes
        self._file: IO[str] | None = None

    def add(self) -> None:
        """Add a row of the present state.

        Raises:
            OSError: It cannot be written.
        """
        try:
            if self._file is None:
                self._file = self.path.open("w", newline="")
                csv.writer(self._file).writerow(self._header())
            energy = self._sim.energy()
            values = [value for probe in self._probes for value in probe.values()]
            row = [self._sim.time, *values, energy.kinetic, energy.elastic, energy.gravitational, self._sim.dt]
            csv.writer(self._file).writerow([f"{value:.9g}" for value in row])
            self._file.flush()
        except OSError as error:
            raise OSError(f"{self.path}: cannot be written: {error.strerror or error}") from None

    def close(self) -> None:
        if self._file is not None:
            self._file.close()

    def _header(self) -> list[str]:
        bodies = self._sim.bodies
        names = ["time [s]"]
        for probe in self._probes:
            of = f"body {bodies.index(probe.body) + 1}: " if len(bodies) > 1 else ""
            names += [f"{of}{probe.text} {column}" for column in probe.columns]
        return [*names, "kinetic [J]", "elastic [J]", "gravitational [J]", "dt [s]"]


def check_table_path(path: Path) -> None:
    """Say before a long run what would stop a table from being written.

    Raises:
        InputError: Something would.
    """
    if path.suffix.lower() != ".csv":
        raise InputError(f"{path}: extension {path.suffix or '(none)'}, should be .csv")
    if path.is_dir():
        raise InputError(f"{path}: is a folder, should be a file name")
    if not path.parent.is_dir():
        raise InputError(f"{path}: output folder {path.parent} is not there")
    if not os.access(path if path.exists() else path.parent, os.W_OK):
        raise InputError(f"{path}: cannot be written to")
