"""The simulation of a run's bodies, with a tested time step."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from warp_corot.body.soft_body import SoftBody
from warp_corot.cutting.blade import Blade
from warp_corot.errors import InputError
from warp_corot.simulation.simulation import Simulation
from warp_corot.solvers import INTEGRATORS, Integrator, SymplecticEuler

from .bodies import RunBody, gravity_of
from .exit_status import as_options
from .implicit import integrator_name, is_static
from .options.defaults import IMPLICIT_DT
from .ranks import are_several
from .remesh import ARGUMENTS
from .static import check_static, static_integrator
from .tool_paths import make_blade
from .touching import RunContact

#: Length of a blade over the size of the largest body, unless the user says.
LONG = 3.0


def make_simulation(args: argparse.Namespace, bodies: Sequence[RunBody], touched: RunContact) -> Simulation:
    """The simulation, its kernels compiled; a given step is shortened until a whole number of them makes a frame."""
    from warp_corot.io.write.animate import shortening, steps_per_frame

    check_static(args, touches=touched.contact is not None, remeshes=any(body.remesh for body in bodies))
    first = bodies[0].subject
    damping = first.damping if args.damping is None else args.damping
    viscosity = args.viscosity or 0.0
    SymplecticEuler(args.dt, damping, viscosity)  # checks all values; the step is shortened later
    if args.dt is not None and (note := shortening(args.dt, args.fps)):
        first.notes.append(note)
    integrator: Integrator
    if is_static(args):
        integrator = static_integrator(args, bodies, touched)
    elif INTEGRATORS[integrator_name(args)].is_implicit:
        steps = steps_per_frame(args.fps, args.dt or IMPLICIT_DT)
        integrator = INTEGRATORS[integrator_name(args)](1.0 / (args.fps * steps), damping, viscosity)  # type: ignore[call-arg]
    else:
        tried = min(_tried_step(body, damping, viscosity) for body in bodies)
        steps = steps_per_frame(args.fps, args.dt or tried)  # refuses an excessive number
        integrator = SymplecticEuler(None if args.dt is None else 1.0 / (args.fps * steps), damping, viscosity)
    cuts = blades_of(args, bodies)
    with as_options(ARGUMENTS):
        made: Simulation = (_on_ranks() if are_several() else Simulation)(
            bodies=[body.soft for body in bodies],
            model=[body.model for body in bodies],
            integrator=integrator,
            gravity=gravity_of(args, first),
            remesh=[body.remesh for body in bodies] if any(body.remesh for body in bodies) else None,
            obstacles=list(touched.obstacles.values()),
            contact=touched.contact,
            cuts=cuts or None,
        )
        return made


def _on_ranks() -> type[Simulation]:
    """The simulation that all ranks step."""
    from warp_corot.distributed import Simulation as OnRanks

    return OnRanks


def blades_of(args: argparse.Namespace, bodies: Sequence[RunBody]) -> list[Blade]:
    """The blades of ``--blade``.

    Raises:
        InputError: A file is no path, or there is a length and no blade.
    """
    if not args.blade and args.blade_length is not None:
        raise InputError("--blade-length is for --blade, which is not given")
    for body in bodies if args.blade else ():
        kept = "--skin input" if body.args.skin == "input" else "--draw-labels" if body.args.draw_labels else None
        if kept:
            raise InputError(f"{kept} draws a surface that does not come apart; with --blade leave it out")
    size = max(float(np.ptp(body.subject.mesh.points, axis=0).max()) for body in bodies)
    return [make_blade(path, args.blade_length or LONG * size) for path in args.blade or ()]


def _tried_step(one: RunBody, damping: float, viscosity: float) -> float:
    """The length of a trial step [s], made at rest and without weight: it loads every kernel and moves nothing."""
    tried = body = one.soft
    model, remesh = one.model, one.remesh
    if remesh:
        # The body's own mesh must not change before the run begins.
        tried, remesh = SoftBody(body.mesh, body.material, device=body.device, threads=1), replace(remesh, every=1)
        tried.fix(body.constrained)
    integrator = SymplecticEuler(damping=damping, viscosity=viscosity)
    with as_options(ARGUMENTS):
        trial = Simulation(tried, model=model, integrator=integrator, gravity=(0, 0, 0), remesh=remesh)
    dt = trial.dt
    trial.step()
    trial.von_mises()
    if tried is body:
        body.displacements = still = np.zeros_like(body.mesh.points)
        body.state.set_velocities(still)
    return dt
