"""A run made ready: inputs read and meshed, bodies held and moved, the simulation of all of them."""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from warp_corot.body.soft_body import SoftBody
from warp_corot.cutting.blade import Blade
from warp_corot.elasticity import Corotated
from warp_corot.errors import InputError, UnstableError
from warp_corot.inputs import loading
from warp_corot.inputs.checks import checked_device
from warp_corot.inputs.stopwatch import WATCH
from warp_corot.mesh import TetForest
from warp_corot.simulation.resting import bring_to_rest
from warp_corot.simulation.simulation import Simulation
from warp_corot.simulation.static import solve_static
from warp_corot.solvers import INTEGRATORS, BackwardEuler, Integrator, QuasiStatic, SymplecticEuler

from .bodies import RunBody, asked_bodies, find_body, find_patches, gravity_of, make_body
from .contact import RunContact, moved, place_ground, say_reach, touched_by
from .options import IMPLICIT_DT, integrator_name, is_static
from .patches import press_patches, ramp_of
from .results import Probe
from .terminal import are_several, complain, tell_compiling, waiting

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
    loading.begin_loading(_modules(bodies, touches or touched.contact is not None, chooses, device), device)
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
    names = [*loading.SURFACES, *loading.MESHING] if meshed else []
    explicit = not INTEGRATORS[integrator_name(bodies[0].args)].is_implicit
    contact, steps = (
        (loading.CONTACT_ON_CPU, loading.STEPS_ON_CPU) if device.is_cpu else (loading.CONTACT, loading.STEPS)
    )
    names += [*loading.BODY, *(contact if touches and explicit else ()), *steps]
    if meshed and not touches and chooses and may_choose(bodies):
        return [*names, *loading.IMPLICIT, *loading.IMPLICIT_ON_FORESTS]
    return [*names, *(loading.EXPLICIT if explicit else ())]


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


# --- the simulation, with a tested time step -------------------------------------------------------------------------

#: Length of a blade over the size of the largest body, unless the user says.
LONG = 3.0


def make_simulation(args: argparse.Namespace, bodies: Sequence[RunBody], touched: RunContact) -> Simulation:
    """The simulation, its kernels compiled; a given step is shortened until a whole number of them makes a frame."""
    from warp_corot.io.write.animate import shortening, steps_per_frame

    if is_static(args):
        for name in ("integrator", "dt", "damping", "viscosity"):
            if getattr(args, name) is not None:
                raise InputError(f"--static has no steps in time; leave out --{name}")
        if args.drop is not None:
            raise InputError("--static has no fall; leave out --drop (--ground lets the bodies stand on the ground)")
        if touched.contact is not None and are_several():
            raise InputError("--static with contact runs in one process, and there are several ranks")
        if any(body.remesh for body in bodies):
            raise InputError("--static does not support remeshing; leave out --remesh")
    first = bodies[0].subject
    damping = first.damping if args.damping is None else args.damping
    viscosity = args.viscosity or 0.0
    SymplecticEuler(args.dt, damping, viscosity)  # checks all values; the step is shortened later
    if args.dt is not None and (note := shortening(args.dt, args.fps)):
        first.notes.append(note)
    integrator: Integrator
    if is_static(args):
        # There are no steps in time; for bodies that only contact holds there are none from frame to frame, too.
        held = touched.contact is None or all(body.soft.conditions.held_mask().any() for body in bodies)
        if not held and moves(bodies, touched):
            raise InputError(
                "--static: tools and loads that move can only follow bodies that are held; add --fix, or leave out "
                "--static"
            )
        integrator = QuasiStatic(1.0 / args.fps) if held else BackwardEuler(1.0 / args.fps)
    elif INTEGRATORS[integrator_name(args)].is_implicit:
        steps = steps_per_frame(args.fps, args.dt or IMPLICIT_DT)
        integrator = INTEGRATORS[integrator_name(args)](1.0 / (args.fps * steps), damping, viscosity)  # type: ignore[call-arg]
    else:
        tried = min(_tried_step(body, damping, viscosity) for body in bodies)
        steps = steps_per_frame(args.fps, args.dt or tried)  # refuses an excessive number
        integrator = SymplecticEuler(None if args.dt is None else 1.0 / (args.fps * steps), damping, viscosity)
    for body in bodies if args.blade else ():
        kept = "--skin input" if body.args.skin == "input" else "--draw-labels" if body.args.draw_labels else None
        if kept:
            raise InputError(f"{kept} draws a surface that does not come apart; with --blade leave it out")
    size = max(float(np.ptp(body.subject.mesh.points, axis=0).max()) for body in bodies)
    half = 0.5 * (args.blade_length or LONG * size)
    cuts = [moved(Blade([(0.0, 0.0, -half), (0.0, 0.0, half)]), path) for path in args.blade or ()]
    kind = Simulation
    if are_several():
        from warp_corot.distributed import Simulation as kind
    return kind(
        bodies=[body.soft for body in bodies],
        model=[body.model for body in bodies],
        integrator=integrator,
        gravity=gravity_of(args, first),
        remesh=[body.remesh for body in bodies] if any(body.remesh for body in bodies) else None,
        obstacles=list(touched.obstacles.values()),
        contact=touched.contact,
        cuts=cuts or None,
    )


def _tried_step(one: RunBody, damping: float, viscosity: float) -> float:
    """The length of a trial step [s], made at rest and without weight: it loads every kernel and moves nothing."""
    tried = body = one.soft
    model, remesh = one.model, one.remesh
    if remesh:
        # The body's own mesh must not change before the run begins.
        tried, remesh = SoftBody(body.mesh, body.material, device=body.device, threads=1), replace(remesh, every=1)
        tried.fix(body.constrained)
    integrator = SymplecticEuler(damping=damping, viscosity=viscosity)
    trial = Simulation(tried, model=model, integrator=integrator, gravity=(0, 0, 0), remesh=remesh)
    dt = trial.dt
    trial.step()
    trial.von_mises()
    if tried is body:
        body.displacements = still = np.zeros_like(body.mesh.points)
        body.state.set_velocities(still)
    return dt


# --- the choice between explicit and implicit steps, if the user makes none ------------------------------------------

#: The steps that follow the state, over the largest stable one at rest.
SHORTER = 0.75
#: The largest stable step over its estimate, for meshes other than forests.
UNSURE = 2.5
#: Bodies with shorter stable steps than this [s] are left to the explicit ones, which refuse them.
SHORTEST = 1e-12
#: Steps up to this length [s] are explicit if users give it.
SHORT_STEP = 2e-3
#: Implicit steps are chosen if they are faster by this factor, since explicit ones resolve more of the motion.
FASTER = 2.0


#: What explicit and implicit steps of organs take [s], on a CPU core and on an H200: at least, for each element, and
#: the factor of both with contact. They are rough: the choice must not depend on how busy a machine is.
ON_CPU = (3e-5, 25e-9, 2.4), (1e-3, 0.7e-6, 6.0)
ON_CUDA = (12e-6, 25e-12, 40.0), (1.5e-3, 50e-9, 3.0)


def choose_steps(args: argparse.Namespace, bodies: Sequence[RunBody], touched: RunContact, device: wp.Device) -> None:
    """Set ``integrator`` of the options to implicit steps if explicit ones would be unstable with the step that users
    give, or slower than real time and much slower than implicit ones; a note says so.

    Speeds are compared for one body of the corotated law on a forest, which touches neither itself nor other bodies.
    """
    if args.integrator or is_static(args) or are_several():
        return
    step = min(map(_stable_step, bodies))
    sure = 1.0 if all(isinstance(body.soft.mesh, TetForest) for body in bodies) else UNSURE
    if args.dt is not None and args.dt > FASTER * sure * step:
        why = f"unstable in steps of {1e3 * args.dt:.3g} ms"
    elif args.dt is None and may_choose(bodies):
        model, mesh = bodies[0].model, bodies[0].soft.mesh
        compared = isinstance(model, Corotated) and model.level is None and isinstance(mesh, TetForest)
        if not compared or step < SHORTEST:
            return
        costs = ON_CUDA if device.is_cuda else ON_CPU
        of_contact = [touching if touched.contact is not None else 1.0 for *_, touching in costs]
        takes = [(least + one * len(mesh.tets)) * more for (least, one, _), more in zip(costs, of_contact, strict=True)]
        slow, fast = SHORTER * step / takes[0], IMPLICIT_DT / takes[1]
        if slow >= 1.0 or fast < FASTER * slow:
            return
        why = f"about {float(f'{fast / slow:.1g}'):.0f} times as slow"
    else:
        return
    args.integrator = "backward-euler"
    bodies[0].subject.notes.append(
        f"implicit steps, which damp vibrations, since explicit ones would be {why} "
        "(--integrator symplectic-euler makes those)"
    )


def may_choose(bodies: Sequence[RunBody]) -> bool:
    """Whether the options leave the choice to the speeds of steps."""
    args = bodies[0].args
    is_short = args.dt is not None and args.dt <= SHORT_STEP
    given = args.integrator or is_short or args.viscosity or is_static(args) or are_several()
    return not (given or args.self_contact or len(bodies) > 1 or bodies[0].remesh is not None)


def _stable_step(body: RunBody) -> float:
    """An estimate of the largest stable step at rest [s]: the smallest height of an element over the speed of sound. It
    was within 10 % for four uniform organs and a box, is within 25 % where stiffness jumps, and was 0.43 of it for a
    bear of split voxels."""
    mesh, material = body.soft.mesh, body.soft.discretization
    x = mesh.points[mesh.tets].astype(float)
    faces = np.array([(1, 2, 3), (0, 2, 3), (0, 1, 3), (0, 1, 2)])
    a, b, c = np.moveaxis(x[:, faces], 2, 0)
    areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=2)
    volumes = np.abs(np.linalg.det(x[:, 1:] - x[:, :1])) / 6.0
    heights = 3.0 * volumes / areas.max(axis=1)
    stiffness = material.lam.numpy().astype(float) + 2.0 * material.mu.numpy()
    return float((heights * np.sqrt(np.asarray(body.soft.material.density, dtype=float) / stiffness)).min())


def rest(args: argparse.Namespace, sim: Simulation) -> list[str]:
    """With --static, find where bodies are at rest before anything moves them; returns a line for each.

    Raises:
        UnstableError: No state at rest was found for a body.
    """
    if not is_static(args):
        return []
    if sim.contact is not None:
        began, found = WATCH.clock(), bring_to_rest(sim)
        if not found.converged.all():
            raise UnstableError(f"--static: {found.message}")
        took = f"{found.iterations} long steps, {found.linear_iterations} linear iterations"
        return [f"at rest in contact after {took}, {WATCH.clock() - began:.2f} s"]
    lines = []
    for body, model in zip(sim.bodies, sim.models, strict=True):
        report = solve_static(body, model=model, gravity=sim.gravity)
        if not report.converged:
            raise UnstableError(f"--static: {report.message}")
        lines.append(
            f"at rest after {report.iterations} iterations of Newton's method, {report.linear_iterations} linear, "
            f"{report.time:.2f} s"
        )
    return lines


def moves(bodies: Sequence[RunBody], touched: RunContact) -> bool:
    """Whether loads or tools move, so that bodies at rest follow them from frame to frame."""
    return touched.moves or any(body.loads for body in bodies)
