"""The paper's experiment: a beam fixed at one end sags under its weight, by model and by the level of its rotations.

After Tagawa, Yamada and Tanaka (IEEE EMBC 2013), section III. Parameters that the paper does not publish reproduce its
two figures (3.6 and 22 mm): symplectic Euler, a step of 0.2 ms and mass-proportional damping of 15 /s.

Errors and shapes come from the models as shipped; the stages of steps are timed leaf by leaf, as in the paper.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
import warp as wp
from paper_timing import Stages, Times, measure_times

from warp_corot.body.soft_body import SoftBody
from warp_corot.elasticity import Corotated, Linear, Model, NeoHookean, StVenantKirchhoff
from warp_corot.elasticity.dilatation import ELEMENT
from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_device
from warp_corot.materials.isotropic import Isotropic
from warp_corot.mesh import TetForest
from warp_corot.mesh.topology import signed_volumes
from warp_corot.simulation.simulation import Simulation
from warp_corot.solvers import SymplecticEuler
from warp_corot.solvers.system import GRAPH_STEPS

Array = npt.NDArray[np.float64]

#: Simulated times of the experiment and of its short form [s].
FULL_DURATION, SHORT_DURATION = 80.0, 4.0

CELLS, CELL_SIZE = (1, 1, 3), 0.064
#: The observed node [m]: the middle of the free end.
OBSERVED = (0.032, 0.032, 0.192)
GRAVITY = (0.0, -9.8, 0.0)
MATERIAL = {"young": 500.0, "poisson": 0.49, "density": 10.0}

#: Names of the reference models.
REFERENCE, PEER, OWN = "stvk", "linear", "corotated"

#: Steps between samples; one graph records as many, so that sampling costs next to nothing.
SAMPLE_STEPS = GRAPH_STEPS


@dataclass(frozen=True)
class Settings:
    """Settings of the experiment.

    Attributes:
        duration: Simulated time [s].
        dt: Time step [s].
        damping: Rate of mass-proportional damping [1/s].
        level: Bisections of the mesh; the paper's is 6.
        rounds: Number of timings of each stage, in turn.

    Raises:
        InputError: A value out of its range.
    """

    duration: float = SHORT_DURATION
    dt: float = 2e-4
    damping: float = 15.0
    level: int = 6
    rounds: int = 21

    def __post_init__(self) -> None:
        if self.level < 2:
            raise InputError(f"level is {self.level}; it must be at least 2, where the observed node appears")
        if not (np.isfinite(self.dt) and self.dt > 0):
            raise InputError(f"dt is {self.dt}; it must be a positive number of seconds")
        if not (np.isfinite(self.duration) and self.duration >= SAMPLE_STEPS * self.dt):
            least = SAMPLE_STEPS * self.dt
            raise InputError(f"duration is {self.duration} s; it must be at least {SAMPLE_STEPS} steps, {least:.3g} s")
        if self.rounds < 1:
            raise InputError(f"rounds is {self.rounds}; it must be at least 1")

    @property
    def samples(self) -> int:
        """Number of samples; the run ends at the last one, which is nearest to ``duration``."""
        return max(round(self.duration / (SAMPLE_STEPS * self.dt)), 1)


@dataclass(frozen=True)
class Case:
    """One of the models.

    Attributes:
        name: Short name in results.json.
        label: Label in figures and tables.
        model: The elastic model.
        rotation_level: Level of shared rotations of a corotated model.
    """

    name: str
    label: str
    model: Model
    rotation_level: int | None = None


def cases(level: int) -> list[Case]:
    """The models for a mesh of that level, the reference first."""
    own = ELEMENT  # as the paper has it
    levels = [Corotated(rotation_level=k, dilatation=own) for k in range(level + 1)]
    return [
        Case(REFERENCE, "St. Venant–Kirchhoff", StVenantKirchhoff(dilatation=own)),
        Case("neo-hookean", "neo-Hookean", NeoHookean(dilatation=own)),
        Case(PEER, "linear", Linear(dilatation=own)),
        *(Case(f"{OWN}-{k}", f"corotated, level {k}", model, k) for k, model in enumerate(levels)),
        Case(OWN, "corotated, own", Corotated(dilatation=own)),
    ]


@dataclass(frozen=True)
class Run:
    """One model's run.

    Attributes:
        case: The model.
        path: Displacement of the observed node at each sample [m], float64 [S, 3].
        growth: Volume of the beam over its volume at rest, less 1, at each sample, float64 [S].
        positions: Nodes at the end [m], float64 [N, 3].
        speed: Largest speed of a node at the end [m/s]; because of rounding it never becomes zero.
        rotations: Number of rotations that a step extracts.
        times: Times of a step; None if they were not measured.
    """

    case: Case
    path: Array
    growth: Array
    positions: Array
    speed: float
    rotations: int
    times: Times | None = None


@dataclass(frozen=True)
class Results:
    """The whole experiment.

    Attributes:
        settings: The settings.
        mesh: The beam.
        device: The device of the runs.
        times: Time of each sample [s], float64 [S].
        runs: Runs by name, in the order of ``cases``.
    """

    settings: Settings
    mesh: TetForest
    device: wp.Device
    times: Array
    runs: dict[str, Run] = field(default_factory=dict)

    def error(self, name: str, reference: str = REFERENCE) -> Array:
        """Distance of the observed node from its place in the reference's run at the same time [m], float64 [S]."""
        return np.linalg.norm(self.runs[name].path - self.runs[reference].path, axis=1)

    @cached_property
    def levels(self) -> list[Run]:
        """Runs with shared rotations, by level."""
        return [run for run in self.runs.values() if run.case.rotation_level is not None]


def run_experiment(
    settings: Settings | None = None,
    *,
    device: str | wp.Device | None = None,
    progress: Callable[[str, int], None] | None = None,
) -> Results:
    """Run every model, then time the stages of their steps in turn.

    Args:
        settings: None: the short form.
        device: "cpu", "cuda:0", …; None for Warp's default.
        progress: Called with the current activity and the units of work done since the last call; ``work(settings)``
            is their total number.

    Raises:
        InputError: The device does not exist, or the step is too large for the mesh.
        UnstableError: A state is no longer finite.
    """
    chosen = settings or Settings()
    tell = progress or (lambda what, done: None)
    where = checked_device(device)
    mesh = TetForest.box(CELLS, CELL_SIZE, chosen.level)
    count = chosen.samples
    times = (SAMPLE_STEPS * chosen.dt * np.arange(1, count + 1)).astype(np.float64)
    runs, stages = {}, {}
    for case in cases(chosen.level):
        tell(case.label, 0)
        sim = beam(mesh, case.model, chosen, where)
        runs[case.name] = follow(sim, case, count, tell)
        stages[case.name] = Stages.of(sim)
    measured = measure_times(stages, PEER, chosen.rounds, lambda: tell("timing the stages", 1))
    timed = {name: replace(run, times=measured[name]) for name, run in runs.items()}
    return Results(chosen, mesh, where, times, timed)


def work(settings: Settings) -> int:
    """Units of work of the experiment: one for each sample of a model and each round of timing."""
    return settings.samples * len(cases(settings.level)) + settings.rounds


def beam(mesh: TetForest, model: Model, settings: Settings, device: wp.Device) -> Simulation:
    """The beam at rest, fixed at z = 0, before it sags.

    Raises:
        InputError: The step is beyond the largest stable one.
    """
    body = SoftBody(mesh, Isotropic(**MATERIAL), device=device)
    body.fix(mesh.points[:, 2] < 1e-9)
    integrator = SymplecticEuler(damping=settings.damping)
    stable = Simulation(body, model=model, integrator=integrator, gravity=GRAVITY).stable_dt
    if settings.dt > stable:
        raise InputError(
            f"dt is {settings.dt:.3g} s; on a mesh of level {settings.level} it must be below {stable:.3g} s"
        )
    integrator = SymplecticEuler(dt=settings.dt, damping=settings.damping)
    return Simulation(body, model=model, integrator=integrator, gravity=GRAVITY)


def follow(sim: Simulation, case: Case, samples: int, tell: Callable[[str, int], None]) -> Run:
    """Run the simulation and sample it."""
    body = sim.body
    mesh = body.mesh
    node = int(np.argmin(np.linalg.norm(mesh.points - OBSERVED, axis=1)))
    side = np.sign(signed_volumes(mesh.points, mesh.tets))
    rest = float(mesh.volumes.sum())
    path, growth = np.empty((samples, 3)), np.empty(samples)
    positions = mesh.points
    for sample in range(samples):
        sim.advance_steps(SAMPLE_STEPS)
        u = body.displacements.numpy().astype(np.float64)
        positions = mesh.points + u
        path[sample] = u[node]
        growth[sample] = float(side @ signed_volumes(positions, mesh.tets)) / rest - 1.0
        tell(case.label, 1)
    speed = float(np.linalg.norm(body.velocities.numpy(), axis=1).max())
    units = getattr(sim.fields[0], "unit_count", 0)
    return Run(case, path, growth, positions, speed, units)
