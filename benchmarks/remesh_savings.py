"""What remeshing saves: a notched bar in tension and a pressed slab, on remeshed and on uniform meshes.

``python benchmarks/remesh_savings.py`` measures the reaction force, the displacements and the wall time.
"""

from __future__ import annotations

import argparse
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.body.soft_body import SoftBody
from warp_corot.domain import Domain
from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_device
from warp_corot.kernels.remesh.criteria import elongation, nearness, strain
from warp_corot.materials.isotropic import Isotropic
from warp_corot.mesh import TetForest
from warp_corot.remesh.remeshing import OnlineRemesh
from warp_corot.simulation.simulation import Simulation
from warp_corot.solvers import SymplecticEuler

#: Edge of a root cube [m].
CELL = 0.02
TISSUE = Isotropic(young=1e4, poisson=0.3, density=1000.0)
#: Speed of sound in a thin bar [m/s].
SPEED = 10.0**0.5
#: Duration of the face's motion, and of the rest of the run, in units of the time that sound needs to cross the body.
MOVING, RESTING = 6.0, 12.0
KEYS = 41

Mask = npt.NDArray[np.bool_]
Vectors = npt.NDArray[np.float64]


class Scene(ABC):
    """A body that is fixed at one face, moved slowly at another, and then held until it is at rest.

    Attributes:
        name: Name of the scene.
        size: Size in root cubes along each axis.
        travel: Displacement of the moved face [m], [3].
        across: Distance that sound travels through the strained part [m].
        probes: Displacements to compare: the places of one point or of two, whose difference counts [cubes], and the
            axis.
        criteria: Criteria with their thresholds; ``depth`` is the number of levels between the coarsest and the finest
            elements. ``parameters`` are in cubes; that of the strain is in edges of the coarsest elements.
    """

    name: str
    size: tuple[int, int, int]
    travel: tuple[float, float, float]
    across: float
    probes: ClassVar[Mapping[str, tuple[Sequence[Sequence[float]], int]]]
    criteria: ClassVar[Mapping[str, Mapping[str, Any]]]

    @abstractmethod
    def mesh(self, level: int) -> TetForest:
        """The uniform mesh of this level; the body is the same at each."""

    @abstractmethod
    def held(self, cubes: Vectors) -> Mask:
        """Which nodes are fixed, by their positions in cubes [n, 3]."""

    @abstractmethod
    def moved(self, cubes: Vectors) -> Mask:
        """Which nodes are moved all the way."""

    def coarsest(self, finest: int, criterion: str | None = None) -> int:
        """The initial level of a mesh with a criterion; None: the lowest of all criteria."""
        chosen = self.criteria if criterion is None else [criterion]
        return finest - max(self.criteria[name]["depth"] for name in chosen)

    def remesh(self, criterion: str, finest: int, device: wp.Device) -> OnlineRemesh:
        """The options of one of ``criteria``."""
        options = dict(self.criteria[criterion])
        del options["depth"]
        levels = {"min_level": self.coarsest(finest, criterion), "max_level": finest}
        numbers = CELL * np.asarray(options.pop("parameters", [0.0]))
        if criterion == "strain":
            numbers *= 0.5 ** (levels["min_level"] / 3)
        parameters = wp.array(numbers, dtype=wp.float32, device=device)
        return OnlineRemesh(parameters=parameters, every=20, **levels, **options)


class NotchedBar(Scene):
    """A bar with a notch through half its height, stretched by a fifth of its length."""

    name = "notched bar, pulled"
    size = (9, 2, 1)
    travel = (0.2 * 9 * CELL, 0.0, 0.0)
    across = 9 * CELL
    probes: ClassVar = {
        "opening of the notch": (([5, 2, 0.5], [4, 2, 0.5]), 0),
        "opening of its root": (([5, 1, 0.5], [4, 1, 0.5]), 0),
        "bending": (([4, 0, 0.5],), 1),
    }
    criteria: ClassVar = {
        "elongation": {"criterion": elongation, "depth": 3, "refine_above": 1.16, "simplify_below": 1.03},
        "strain": {
            "criterion": strain,
            "depth": 4,
            "refine_above": 0.45,
            "simplify_below": 0.18,
            "parameters": [1.0],
        },
    }

    def mesh(self, level: int) -> TetForest:
        x, y, z = CELL * np.array(self.size)
        notch = Domain.box([4 * CELL, CELL, -CELL], [5 * CELL, 2 * y, 2 * z], device="cpu")
        bar = Domain.box([0.0, 0.0, 0.0], [x, y, z], device="cpu") - notch
        return TetForest.from_domain(bar, CELL, min_level=level, max_level=level)

    def held(self, cubes: Vectors) -> Mask:
        return cubes[:, 0] < 1e-6

    def moved(self, cubes: Vectors) -> Mask:
        return cubes[:, 0] > self.size[0] - 1e-6


class PressedSlab(Scene):
    """A slab on a table; a square punch that sticks to it presses it by 15 % of its thickness."""

    name = "slab, pressed"
    size = (5, 2, 5)
    travel = (0.0, -0.15 * 2 * CELL, 0.0)
    across = 2 * CELL
    probes: ClassVar = {
        "beside the punch": (([1.5, 2, 2.5],), 1),
        "below it": (([2.5, 1.5, 2.5],), 1),
        "further below": (([2.5, 1, 2.5],), 1),
    }
    criteria: ClassVar = {
        "nearness": {
            "criterion": nearness,
            "depth": 3,
            "refine_above": 0.58,
            "simplify_below": 0.23,
            "parameters": [2.5, 2.0, 2.5, 0.5, 0.0, 0.5, 0.0, 0.1],
        },
    }

    def mesh(self, level: int) -> TetForest:
        return TetForest.box(self.size, CELL, level)

    def held(self, cubes: Vectors) -> Mask:
        return cubes[:, 1] < 1e-6

    def moved(self, cubes: Vectors) -> Mask:
        beside = np.abs(cubes[:, [0, 2]] - 2.5).max(axis=1)
        return (cubes[:, 1] > self.size[1] - 1e-6) & (beside < 0.5 + 1e-6)


@dataclass(frozen=True)
class Outcome:
    """The result of a run.

    Attributes:
        mesh: "uniform", or the criterion's name.
        level: The finest level.
        elements: Number of elements at the end.
        most: Largest number of elements during the run.
        force: Force on the moved face, along its path [N].
        displacements: By the names of the scene's probes [m].
        field: Displacements of the nodes of the coarse mesh, which all meshes share [m], [n, 3].
        unrest: Kinetic over elastic energy.
        steps: Number of time steps.
        seconds: Wall time of the steps, and of the passes between them.
    """

    mesh: str
    level: int
    elements: int
    most: int
    force: float
    displacements: dict[str, float]
    field: Vectors
    unrest: float
    steps: int
    seconds: float

    def errors(self, reference: Outcome) -> dict[str, float]:
        """Relative errors of force and displacements against a reference; that of the field is a root mean square."""
        off = np.linalg.norm(self.field - reference.field) / np.linalg.norm(reference.field)
        found = {"force": self.force / reference.force - 1.0, "field": float(off)}
        return found | {name: u / reference.displacements[name] - 1.0 for name, u in self.displacements.items()}


def run(scene: Scene, finest: int, device: wp.Device, criterion: str | None = None, *, coarse: bool = False) -> Outcome:
    """Run the scene on the uniform mesh of the finest level, on the coarsest mesh, or on a remeshed one."""
    lowest = scene.coarsest(finest)
    level = lowest if coarse else finest if criterion is None else scene.coarsest(finest, criterion)
    mesh = scene.mesh(level)
    shared = _keys(mesh if level == lowest else scene.mesh(lowest))
    body = SoftBody(mesh, TISSUE, device=device)
    cubes, crossing = mesh.points / CELL, scene.across / SPEED
    body.fix(scene.held(cubes))
    share = np.linspace(0.0, 1.0, KEYS)
    way = np.outer(share**2 * (3.0 - 2.0 * share), scene.travel)
    body.prescribe(scene.moved(cubes), times=MOVING * crossing * share, displacements=way)
    sim = Simulation(
        body,
        integrator=SymplecticEuler(damping=np.pi / crossing),
        gravity=(0.0, 0.0, 0.0),
        remesh=None if criterion is None else scene.remesh(criterion, finest, device),
    )
    sim.advance_steps(1)  # loads kernels and records steps
    most = body.element_count
    started = time.perf_counter()
    for end in crossing * np.linspace(0.0, MOVING + RESTING, KEYS)[1:]:
        sim.advance_until(end)
        most = max(most, body.element_count)
    seconds, steps = time.perf_counter() - started, sim.steps
    assert isinstance(body.mesh, TetForest)
    mesh = body.mesh
    cubes, u = mesh.points / CELL, body.displacements.numpy().astype(np.float64)
    force = body.reactions.numpy()[scene.moved(cubes)].sum(axis=0) @ np.sign(scene.travel)
    energy = sim.energy()
    return Outcome(
        criterion or "uniform",
        level if criterion is None else finest,
        body.element_count,
        most,
        float(force),
        {name: _displacement(cubes, u[:, axis], places) for name, (places, axis) in scene.probes.items()},
        u[np.argsort(_keys(mesh))[np.searchsorted(np.sort(_keys(mesh)), shared)]],
        energy.kinetic / energy.elastic,
        steps,
        seconds,
    )


def _keys(mesh: TetForest) -> npt.NDArray[np.int64]:
    """A number for each node's position, the same in all meshes."""
    return mesh.lattice[: len(mesh.points)].astype(np.int64) @ np.array([1 << 42, 1 << 21, 1])


def _displacement(cubes: Vectors, u: npt.NDArray[np.float64], places: Sequence[Sequence[float]]) -> float:
    """The displacement of one node, or the difference between two."""
    found = [u[np.argmin(np.linalg.norm(cubes - np.asarray(place), axis=1))] for place in places]
    return float(found[0] - found[1] if len(found) == 2 else found[0])


SCENES: dict[str, Scene] = {"bar": NotchedBar(), "slab": PressedSlab()}


def study(scene: Scene, finest: int, device: wp.Device) -> list[Outcome]:
    """Run the scene on the uniform fine mesh, on the uniform coarse one, and with each criterion."""
    uniform = [run(scene, finest, device, coarse=coarse) for coarse in (False, True)]
    return uniform + [run(scene, finest, device, criterion) for criterion in scene.criteria]


def table(scene: Scene, outcomes: Sequence[Outcome]) -> list[str]:
    """The numbers, one line for each run; errors are relative to the first."""
    first = outcomes[0]
    lines = [f"{scene.name}, level {first.level}: {first.force:.4f} N; errors of {', '.join(first.errors(first))}"]
    lines.append(f"{'mesh':11} {'elements':>9} {'share':>6} {'steps':>6} {'seconds':>8} {'faster':>7}  errors")
    for o in outcomes:
        errors = "  ".join(f"{100 * e:+6.2f} %" for e in o.errors(first).values())
        name = o.mesh if o.mesh != "uniform" else f"level {o.level}"
        share, faster = o.most / first.elements, first.seconds / o.seconds
        lines.append(f"{name:11} {o.most:9} {share:6.3f} {o.steps:6} {o.seconds:8.2f} {faster:7.1f}  {errors}")
    return lines


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--device", help="cpu or cuda:0")
    parser.add_argument("--scene", choices=list(SCENES), help="one of them only")
    parser.add_argument("--level", type=int, default=9, help="of the finest elements, at least 5 (default: 9)")
    args = parser.parse_args(arguments)
    try:
        device = checked_device(args.device)
        if args.level < 5:
            raise InputError(f"--level is {args.level}; it must be at least 5")
        for name in [args.scene] if args.scene else SCENES:
            print(*table(SCENES[name], study(SCENES[name], args.level, device)), sep="\n")
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
