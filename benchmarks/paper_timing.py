"""Times of the stages of a time step: rotation, force, and the rest.

For every stage, a graph of many launches is recorded and replayed. All stages of all models are timed in turn, round
after round, so that other load on the machine affects all alike. The times of a round are relative to the peer's time
in the same round.

The stages are timed leaf by leaf. Corotated forces as shipped use subtrees, with rotation and force in one kernel, so
for that path only the whole step is timed.
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
from warp_corot.solvers.pace import Pace
from warp_corot.solvers.system import System

#: Launches of one stage recorded in a graph.
LAUNCHES = 64

#: Steps of the whole-step measurement, run as a user runs them.
RUN_STEPS = 512

#: A sample replays its graph for about this long [s].
SAMPLE_SECONDS = 5e-3

REST = "rest"


@dataclass(frozen=True)
class StageTimes:
    """Time of a step by stage, in seconds or relative to the peer's.

    Attributes:
        rotation: Extraction of the rotations; 0 if there are none, or if the force's kernel includes it.
        force: Elastic nodal forces.
        rest: Integration of velocities and displacements.
        step: The whole step, not the sum of the stages: the time of a user's run divided by its number of steps.
        shipped: The whole step of the model's default path; equal to ``step`` if that is leaf by leaf.
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
        fused: Whether rotation and force are one kernel also leaf by leaf; its time is then under ``force``.
    """

    seconds: StageTimes
    relative: StageTimes
    spread: float
    fused: bool


@dataclass
class Stages:
    """One model's stages, timed in the current state of its body.

    Attributes:
        sim: The simulation, leaf by leaf.
        shipped: The same body on the default path; None if that is leaf by leaf.
        graphs: Recorded graphs by stage.
    """

    sim: Simulation
    shipped: Simulation | None = None
    graphs: dict[str, wp.Graph] = field(default_factory=dict)

    @classmethod
    def of(cls, sim: Simulation) -> Stages:
        """The stages of a simulation of one body on the default path."""
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
        """Whether the step extracts rotations in a separate launch."""
        model_field = self.sim.fields[0]
        return isinstance(model_field, CorotatedField) and model_field.model.rotation_level is not None

    def record(self) -> None:
        """Record each stage of the force many times; forces go to an array that is not read."""
        model_field, u = self.sim.fields[0], self.sim.body.state.displacements
        f = wp.zeros_like(u)
        if self._staged:
            assert isinstance(model_field, CorotatedField)
            rotated = model_field
            self.graphs["rotation"] = recorded(lambda: rotated.extract_rotations(u), u.device)
            self.graphs["force"] = recorded(lambda: rotated.add_rotated_forces(u, f), u.device)
        else:
            self.graphs["force"] = recorded(lambda: model_field.add_forces(u, f), u.device)
        # The graphs hold only the address of f.
        self._forces = f


def recorded(launch: Callable[[], object], device: wp.Device) -> wp.Graph:
    """A graph of many launches, after its kernels were loaded and run once."""
    launch()
    with wp.ScopedCapture(device=device) as capture:
        for _ in range(LAUNCHES):
            launch()
    return capture.graph


def measure_times(
    stages: dict[str, Stages], peer: str, rounds: int, tell: Callable[[], None] = lambda: None
) -> dict[str, Times]:
    """Median time of every stage of every simulation, in its current state (whole steps change it).

    Args:
        stages: Stages by name; all on one device.
        peer: The name of the reference.
        rounds: Number of timings of each stage.
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
    """A force field without launches, to time an integrator alone."""

    def scatter_forces(self, u: wp.array, f: wp.array) -> None: ...

    def write_energies(self, u: wp.array, energies: wp.array) -> None:
        energies.zero_()

    def write_von_mises(self, u: wp.array, stress: wp.array) -> None:
        stress.zero_()


def _integration(sim: Simulation) -> tuple[wp.Graph, list]:
    """The integrator alone, on a copy of the simulation's body without velocity and weight, which does not move."""
    original = sim.body
    body = SoftBody(original.mesh, original.material, device=original.device)
    body.fix(original.constrained)
    body.displacements = original.displacements.numpy()
    assert isinstance(sim.integrator, SymplecticEuler)
    system = System([body], [_NoForces(body)], Pace(sim.dt, sim.device), (0.0, 0.0, 0.0))
    stepper = sim.integrator.bind(system)
    return recorded(lambda: stepper.steps(1), sim.device), [body, stepper]


def _replays(graph: wp.Graph, device: wp.Device) -> int:
    """The number of replays in one sample; finding it also warms up."""
    count = 1
    while True:
        seconds = LAUNCHES * count * _seconds(graph, count, device)
        if seconds > SAMPLE_SECONDS:
            return count
        count *= 2


def _seconds(graph: wp.Graph, replays: int, device: wp.Device) -> float:
    """Wall time of one launch [s]."""
    wp.synchronize_device(device)
    start = time.perf_counter()
    for _ in range(replays):
        wp.capture_launch(graph)
    wp.synchronize_device(device)
    return (time.perf_counter() - start) / (replays * LAUNCHES)
