"""A run made ready: inputs read and meshed, bodies held and moved, the simulation of all of them."""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import warp as wp

from warp_corot.inputs.device import checked_device
from warp_corot.inputs.loading import (
    BODY,
    CONTACT,
    EXPLICIT,
    IMPLICIT,
    IMPLICIT_ON_FORESTS,
    MESHING,
    STEPS,
    STEPS_ON_CPU,
    SURFACES,
    begin_loading,
)
from warp_corot.inputs.stopwatch import WATCH
from warp_corot.simulation.simulation import Simulation
from warp_corot.solvers import INTEGRATORS

from .bodies import RunBody, asked_bodies, find_body, find_patches, gravity_of, make_body
from .choosing import choose_steps, may_choose
from .compiling import tell_compiling
from .exit_status import complain
from .implicit import integrator_name, is_static
from .loading import ramp_of
from .pressing import press_patches
from .probing import Probe
from .static import moves
from .stepping import make_simulation
from .touching import RunContact, place_ground, say_overlaps, say_reach, touched_by
from .waiting import waiting

#: The command warns that a run will take long if a frame has more steps than this.
MANY_STEPS = 1e5


@dataclass(frozen=True, eq=False)
class RunSetup:
    """A run that is ready to start.

    Attributes:
        bodies: The bodies.
        sim: The simulation of all of them.
        probes: The probes of the table.
        duration: Simulated time [s].
        count: Number of frames after the first one.
        touched: What the bodies touch.
    """

    bodies: Sequence[RunBody]
    sim: Simulation
    probes: Sequence[Probe]
    duration: float
    count: int
    touched: RunContact


def set_up(
    options: Sequence[argparse.Namespace],
    *,
    touches: bool = False,
    chooses: bool = True,
) -> RunSetup:
    """Read and mesh the bodies, set up their simulation, and print their notes, and then warnings.

    Args:
        options: Options of each input.
        touches: Whether something may come that the bodies touch.
        chooses: Whether steps may be implicit if the user does not say; otherwise all runs of a kind are explicit.
    """
    with warnings.catch_warnings(record=True) as heard:
        ready = _made_ready(options, touches, chooses)
    for body in ready.bodies:
        name = f"{body.subject.name}: " if len(ready.bodies) > 1 else ""
        for note in body.subject.notes:
            complain(f"{name}{note}", kind="note")
    for each in heard or ():
        warnings.showwarning(each.message, each.category, each.filename, each.lineno)
    return ready


def _made_ready(options: Sequence[argparse.Namespace], touches: bool, chooses: bool) -> RunSetup:
    shared = options[0]
    device = checked_device(shared.device)
    touched = touched_by(options)
    inputs = []
    for each in options:
        with waiting(f"reading {each.input}"):
            inputs.append(asked_bodies(each))
    bodies = [body for found in inputs for body in found]
    tell_compiling(device)
    begin_loading(_modules(bodies, touches or touched.contact is not None, chooses, device), device)
    for body in bodies:
        with waiting(f"meshing {body.args.input}"):
            body.subject = find_body(body)
    duration, count = _frames(shared, bodies, touched)
    started = WATCH.clock()
    for found in inputs:
        find_patches(found)
    for body in bodies:
        make_body(body, duration, alone=len(bodies) == 1)
    place_ground(touched, shared, bodies, gravity_of(shared, bodies[0].subject))
    if chooses:
        choose_steps(shared, bodies, touched, device)
    with waiting("preparing the simulation"):
        sim = make_simulation(shared, bodies, touched)
        say_overlaps(touched, bodies, sim)
        say_reach(bodies, sim)
    for body in bodies:
        press_patches(sim, body.soft, body.loads, body.patches, ramp_of(shared, duration))
    probes = [Probe(text, body.soft, body.patches) for body in bodies for text in body.probes]
    bodies[0].subject.times["body"] = WATCH.clock() - started
    steps = 1.0 / (shared.fps * sim.dt)
    if steps > MANY_STEPS:
        bodies[0].subject.notes.append(f"{steps:.2g} steps of {sim.dt:.2g} s make a frame: this will take long")
    return RunSetup(bodies, sim, probes, duration, count, touched)


def _modules(bodies: Sequence[RunBody], touches: bool, chooses: bool, device: wp.Device) -> list[str]:
    """Modules of kernels that the run is known to launch, in the order in which it needs them."""
    meshed = any(body.opened.kind in ("surface", "scan") for body in bodies)
    names = [*SURFACES, *MESHING] if meshed else []
    explicit = not INTEGRATORS[integrator_name(bodies[0].args)].is_implicit
    names += [*BODY, *(CONTACT if touches and explicit else ()), *(STEPS_ON_CPU if device.is_cpu else STEPS)]
    if meshed and not touches and chooses and may_choose(bodies):
        return [*names, *IMPLICIT, *IMPLICIT_ON_FORESTS]
    return [*names, *(EXPLICIT if explicit else ())]


def _frames(args: argparse.Namespace, bodies: Sequence[RunBody], touched: RunContact) -> tuple[float, int]:
    """The duration [s], and the number of frames after the first one."""
    from warp_corot.io.write.animate import frame_count, rounding

    duration, notes = args.duration, bodies[0].subject.notes
    if is_static(args) and not moves(bodies, touched):
        if duration is not None:
            notes.append("nothing moves a body at rest: one frame shows it, whatever --duration is")
        return 0.0, 0
    if duration is not None and (note := rounding(duration, args.fps)):
        notes.append(note)
    if duration is None:
        duration = max(body.subject.duration for body in bodies)
    return duration, frame_count(duration, args.fps)
