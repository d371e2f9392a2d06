"""``warp-corot scene``: steps the soft and rigid bodies of a USD stage and writes a stage over it."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from warp_corot.domain.units import length, pressure
from warp_corot.errors import InputError, UnstableError
from warp_corot.inputs.checks import checked_device
from warp_corot.inputs.stopwatch import WATCH

from .simulate import aligned, milliseconds, speed, unfinished, wall_time
from .terminal import complain, early_end, tell_compiling

if TYPE_CHECKING:
    from warp_corot.io.write.animate import Recording
    from warp_corot.io.write.usd.over import SceneWriter
    from warp_corot.newton.stages.steps import StageSimulation


def run(args: argparse.Namespace) -> int:
    """Run the command; returns the exit status.

    Raises:
        InputError: Newton is missing, bad options, or a bad stage; nothing was simulated or written.
    """
    from warp_corot.io.write import animate
    from warp_corot.io.write.usd.pieces import PieceStore
    from warp_corot.newton.stages.stage import StageOptions
    from warp_corot.newton.stages.steps import StageSimulation

    gravity, ground = None if args.gravity is None else tuple(args.gravity), args.ground
    if ground not in ("auto", "none"):
        try:
            ground = float(ground)
        except ValueError:
            ground = math.nan
        if not math.isfinite(ground):
            raise InputError(f"--ground {args.ground!r}: it must be a height in m, auto or none")
    options = StageOptions(
        args.young,
        args.poisson,
        args.density,
        gravity,
        args.viscosity,
        ground,
        args.fix,
        args.radius,
        not args.no_soft_contact,
    )
    if args.fps is not None:
        animate.frame_count(args.duration, args.fps)
    PieceStore(args.output)  # checks the path, and writes nothing before the first frame
    device = checked_device(args.device)
    tell_compiling(device)
    sim = StageSimulation(
        args.input,
        fps=args.fps,
        dt=args.dt,
        options=options,
        damping=args.damping,
        rigid=args.rigid,
        integrator=args.integrator,
        device=device,
    )
    count = animate.frame_count(args.duration, sim.fps)
    writer = sim.writer(args.output, show_stress=args.show_stress, flatten=args.flatten)
    shortened = None if args.dt is None else animate.shortening(args.dt, sim.fps)
    for note in filter(None, [*sim.parts.notes, animate.rounding(args.duration, sim.fps), shortened]):
        complain(note, kind="note")
    done = animate.Recording(writer.path)
    try:
        with animate.closed_whole(writer, done), animate.progress_bar(count) as progress:
            for frame in range(count + 1):
                if frame:
                    with WATCH.part("stepping", into=done):
                        sim.advance()
                with WATCH.part("writing", into=done), animate.signals_held_back():
                    writer.write(sim.show())
                    done.frames, done.simulated, done.steps = writer.frames, sim.time, sim.frames * sim.steps
                progress(frame, count)
    except (KeyboardInterrupt, UnstableError, OSError) as error:
        return early_end(error, done)
    print(_summary(args.input, sim, writer, done))
    return 0


def _summary(source: Path, sim: StageSimulation, writer: SceneWriter, done: Recording) -> str:
    parts, units = sim.parts, sim.scene.units
    gravity = sim.parts.model.gravity.numpy()[-1] * units.metres
    moved = sim.state.particle_q.numpy().astype(np.float64) - parts.model.particle_q.numpy()
    moved = float(np.linalg.norm(moved, axis=1).max()) * units.metres
    solves, steps = sim.solver.solves, f"{milliseconds(sim.dt)}, largest stable one about "
    if solves.steps:
        steps = f"{milliseconds(sim.dt)}, implicit, {solves.linear_iterations / solves.steps:.0f} iterations each"
        steps += unfinished(solves, "steps", "shorten the steps (--dt)")
    else:
        steps += milliseconds(sim.solver.stable_dt)
    rows = [("stage", f"{units.metres:g} m per unit, {sim.scene.up_axis} up")]
    for body in parts.soft:
        size = f"{len(body.prim.points)} points, {len(body.prim.tets)} tetrahedra"
        material = (
            f"E = {pressure(float(f'{body.young:.4g}'))}, nu = {body.poisson:.4g}, rho = {body.density:.4g} kg/m^3"
        )
        rows.append(("soft body", f"{body.prim.path}: {size}; {material}"))
    if parts.rigid:
        rows.append(("rigid bodies", ", ".join(parts.rigid)))
    rows += [
        ("colliders", f"{parts.model.shape_count}" + (", with a ground" if parts.ground is not None else "")),
        ("gravity", f"{' '.join(f'{g:.4g}' for g in gravity)} m/s^2"),
        ("time step", steps),
        ("speed", speed(done)),
        ("wall time", wall_time()),
        ("displacement", f"{length(moved)} largest at the end"),
        ("stress", f"colours up to {pressure(writer.stress_range[1])} (von Mises)"),
        ("device", f"{parts.model.device} ({parts.model.device.name})"),
        ("written", f"{done.path}, {done.frames} frames, {done.simulated:.4g} s"),
    ]
    return "\n".join([str(source), *aligned(rows)])
