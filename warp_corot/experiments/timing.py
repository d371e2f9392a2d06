"""What each stage of a time step costs: rotation, force, and the rest.

Every stage is recorded in a graph of many launches of its own and replayed; all stages of all models are timed in turn,
round after round, so that whatever else the machine does meets all alike. Times of one round are set against the
peer's time in the same round.

Stages are those of the leaf-by-leaf path: corotated forces as shipped go by subtrees, with rotation and force in one
kernel. Only the whole step of that path is timed, beside the stages.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import warp as wp

from warp_corot.body.soft_body import SoftBody
from warp_corot.elasticity import Corotated, ForceField
from warp_corot.elasticity.corotated.model import CorotatedField
from warp_corot.simulation.simulation import Simulation
from warp_corot.solvers import SymplecticEuler
from warp_corot.solvers.steps.pace import Pace
from warp_corot.solvers.system import System

#: Launches of one stage recorded in a graph.
LAUNCHES = 64

#: Steps of the whole-step measurement: a run as a user starts it.
RUN_STEPS = 512

#: A sample replays its graph until it lasts about this long [s].
SAMPLE_SECONDS = 5e-3

REST = "rest"


@dataclass(frozen=True)
class StageTimes:
    """Cost of one time step by stage, in seconds or in units of the peer's.

    Attributes:
        rotation: Extracting the rotations; 0 where there are none, or where it is part of the force's kernel.
        force: Elastic nodal forces.
        rest: Integration of velocities and displacements.
        step: The whole step, not the sum of the stages: a run of steps as users start it, divided by their number.
        shipped: The whole step of the path that the model takes by default; ``step`` where that is leaf by leaf.
    """

    rotation: float
    force: float
    rest: float
    step: float
    shipped: float

    @property
    def total(self) -> float:
        """Sum of the stages."""
        return self.rotation + self.force + self.rest


@dataclass(frozen=True)
class Times:
    """Medians over the rounds.

    Attributes:
        seconds: Absolute [s].
        relative: In units of the peer's stages' sum in the same round.
        spread: Interquartile range of the relative whole step, over its median.
        fused: Rotation and force are one kernel leaf by leaf too; its time is under ``force``.
    """

    seconds: StageTimes
    relative: StageTimes
    spread: float
    fused: bool


@dataclass
class Stages:
    """One model's stages, to be timed in the present state of its body.

    Attributes:
        sim: Leaf by leaf.
        shipped: The same body by the default path; None where that is leaf by leaf.
        graphs: By stage, once recorded.
    """

    sim: Simulation
    shipped: Simulation | None = None
    graphs: dict[str, wp.Graph] = field(default_factory=dict)

    @classmethod
    def of(cls, sim: Simulation) -> Stages:
        """The stages of a simulation of one body that takes the default path."""
        model = sim.models[0]
        if not (isinstance(model, Corotated) and model.subtrees):
            return cls(sim)
        leafwise = replace(model, subtrees=False)
        return cls(Simulation(sim.body, model=leafwise, integrator=sim.integrator, gravity=sim.gravity), sim)

    @property
    def fused(self) -> bool:
        model_field = self.sim.fields[0]
        return isinstance(model_field, CorotatedField) and not self._staged

    @property
    def _staged(self) -> bool:
        """Whether the step extracts rotations in a launch of its own."""
        model_field = self.sim.fields[0]
        return isinstance(model_field, CorotatedField) and model_field.model.rotation_level is not None

    def record(self) -> None:
        """Record each stage of the force many times over; forces go to an array that nobody reads."""
        model_field, u = self.sim.fields[0], self.sim.body.state.displacements
        f = wp.zeros_like(u)
        if self._staged:
            assert isinstance(model_field, CorotatedField)
            rotated = model_field
            self.graphs["rotation"] = recorded(lambda: rotated.extract_rotations(u), u.device)
            self.graphs["force"] = recorded(lambda: rotated.add_rotated_forces(u, f), u.device)
        else:
            self.graphs["force"] = recorded(lambda: model_field.add_forces(u, f), u.device)
        # The graphs hold the address of f only.
        self._forces = f


def recorded(launch: Callable[[], object], device: wp.Device) -> wp.Graph:
    """A graph of many launches, its kernels loaded and run once."""
    launch()
    with wp.ScopedCapture(device=device) as capture:
        for _ in range(LAUNCHES):
            launch()
    return capture.graph


def measure_times(
    stages: dict[str, Stages], peer: str, rounds: int, tell: Callable[[], None] = lambda: None
) -> dict[str, Times]:
    """Median cost of every stage of every simulation, in its present state (whole steps move it on from there).

    Args:
        stages: By name; all on one device.
        peer: The one that the others are set against.
        rounds: How often every stage is timed.
        tell: Called after each round.
    """
    device = stages[peer].sim.device
    for each in stages.values():
        each.record()
    rest, _kept = _integration(stages[peer].sim)
    replays = {
        (name, stage): _replays(graph, device) for name, each in stages.items() for stage, graph in each.graphs.items()
    }
    rest_replays = _replays(rest, device)
    taken: dict[tuple[str, str], list[float]] = {}
    for _ in range(rounds):
        taken.setdefault(("", REST), []).append(_seconds(rest, rest_replays, device))
        for name, each in stages.items():
            for stage, graph in each.graphs.items():
                seconds = _seconds(graph, replays[name, stage], device)
                taken.setdefault((name, stage), []).append(seconds)
            for stage, sim in (("step", each.sim), ("shipped", each.shipped)):
                if sim is not None:
                    start = time.perf_counter()
                    sim.advance_steps(RUN_STEPS)
                    taken.setdefault((name, stage), []).append((time.perf_counter() - start) / RUN_STEPS)
        tell()
    samples = {key: np.array(values) for key, values in taken.items()}
    unit = samples[peer, "force"] + samples["", REST]
    none = np.zeros(rounds)
    found = {}
    for name, each in stages.items():
        of = {stage: samples.get((name, stage), none) for stage in ("rotation", "force", "step")}
        of[REST] = samples["", REST]
        of["shipped"] = samples.get((name, "shipped"), of["step"])
        quarters = np.percentile(of["step"] / unit, [25, 50, 75])
        found[name] = Times(
            seconds=StageTimes(**{stage: float(np.median(s)) for stage, s in of.items()}),
            relative=StageTimes(**{stage: float(np.median(s / unit)) for stage, s in of.items()}),
            spread=float((quarters[2] - quarters[0]) / quarters[1]),
            fused=each.fused,
        )
    return found


class _NoForces(ForceField):
    """Leaves an integrator's launches alone."""

    def scatter_forces(self, u: wp.array, f: wp.array) -> None: ...

    def add_stiffness(self, u: wp.array, p: wp.array, y: wp.array) -> None: ...

    def add_diagonal(self, u: wp.array, blocks: wp.array) -> None: ...

    def write_energies(self, u: wp.array, energies: wp.array) -> None:
        energies.zero_()

    def write_von_mises(self, u: wp.array, stress: wp.array) -> None:
        stress.zero_()


def _integration(sim: Simulation) -> tuple[wp.Graph, list]:
    """The integrator alone on a body like the simulation's, without velocity and weight, so that it stays put."""
    original = sim.body
    body = SoftBody(original.mesh, original.material, device=original.device)
    body.fix(original.constrained)
    body.displacements = original.displacements.numpy()
    assert isinstance(sim.integrator, SymplecticEuler)
    system = System([body], [_NoForces(body)], Pace(sim.dt, sim.device), (0.0, 0.0, 0.0))
    stepper = sim.integrator.bind(system)
    return recorded(lambda: stepper.steps(1), sim.device), [body, stepper]


def _replays(graph: wp.Graph, device: wp.Device) -> int:
    """How many replays make one sample; warms up on the way."""
    count = 1
    while True:
        seconds = LAUNCHES * count * _seconds(graph, count, device)
        if seconds > SAMPLE_SECONDS:
            return count
        count *= 2


def _seconds(graph: wp.Graph, replays: int, device: wp.Device) -> float:
    """Seconds of wall time a launch."""
    wp.synchronize_device(device)
    start = time.perf_counter()
    for _ in range(replays):
        wp.capture_launch(graph)
    wp.synchronize_device(device)
    return (time.perf_counter() - start) / (replays * LAUNCHES)
