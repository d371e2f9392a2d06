"""``warp-corot simulate`` on several ranks, of which none makes the whole mesh."""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Sequence
from contextlib import closing, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from warp_corot.body.soft_body import SoftBody
from warp_corot.domain.units import length
from warp_corot.errors import InputError, UnstableError
from warp_corot.inputs.device import checked_device
from warp_corot.simulation.parts import checked_gravity
from warp_corot.solvers import SymplecticEuler

from .bodies import model_of
from .meshes_in_parts import (
    OF_ORGANS,
    box_in_parts,
    is_one_body,
    material_in_parts,
    material_lines,
    needs_young,
    organ_in_parts,
)
from .patches import Load, loads_of, ramp_of
from .ranks import are_several, hands_out
from .results import Probe, Table
from .summary import aligned, milliseconds, speed, wall_time
from .terminal import complain, early_end, tell_compiling

if TYPE_CHECKING:
    from warp_corot.distributed import Simulation
    from warp_corot.io.write.animate import Recording

    from .input_mesh import InputMesh

#: The options with which a mesh is made in parts; with others every rank makes the whole.
OPTIONS = (
    {"command", "command_line", "input", "output", "device", "level", "scale", "offset"}
    | {"young", "poisson", "density", "model", "rotation_level", "dilatation"}
    | {"fix", "gravity", "pull", "ramp", "damping", "viscosity", "duration", "fps", "dt", "probe", "csv"}
)
#: Words of expressions that need the whole mesh.
WHOLE = frozenset({"flat", "surface", "bottom", "top", "nearest"})
#: The fewest bisections of a box in parts.
LEAST_LEVEL = 3


def is_in_parts(options: Sequence[argparse.Namespace]) -> bool:
    """Whether ranks make a box in parts; rank 0 says why not if another option than these is given."""
    args = options[0]
    is_box = args.input == "box"
    if not are_several() or len(options) > 1 or not (is_box or args.level is not None):
        return False
    known = OPTIONS if is_box else OPTIONS | OF_ORGANS
    others = sorted(name for name, value in vars(args).items() if name not in known and value)
    if is_box and args.level is not None and args.level < LEAST_LEVEL:
        others.append("level")
    if not is_box:
        needed = ["fix", *(["young"] if needs_young(args) else [])]
        others += [f"{name} that is not given" for name in needed if getattr(args, name) is None]
    expressions = [*(args.fix or ()), *(each[0] for each in args.pull or ()), *(args.probe or ())]
    words = {word for text in expressions for word in re.findall(r"[A-Za-z_]\w*", text)}
    if any(not re.search("[A-Za-z_]", text) for text in args.probe or ()):
        others.append("probe")
    others += sorted(words & WHOLE)
    if others:
        who = "rank 0" if hands_out(options) else "every rank"
        complain(f"{who} makes the whole mesh, because of {', '.join(others)}", kind="note")
    return not others and (is_box or is_one_body(args))


def run_in_parts(args: argparse.Namespace) -> int:
    """Run the command on this rank; returns the exit status.

    Raises:
        InputError: Bad options; nothing was simulated or written.
    """
    import warp_corot.distributed as wd
    from warp_corot.io.write.animate import Recording, frame_count, progress_bar, rounding

    done = Recording(args.output)
    tell_compiling(checked_device(args.device))
    subject = box_in_parts(args) if args.input == "box" else organ_in_parts(args)
    duration = subject.duration if args.duration is None else args.duration
    if note := rounding(duration, args.fps):
        complain(note, kind="note")
    sim, loads = _simulation(args, subject, duration)
    probes = [_PartProbe(text, sim) for text in args.probe or () if args.csv]
    # All ranks sum the rows, and rank 0 writes them.
    table = Table(args.csv if sim.rank == 0 else Path(os.devnull), sim, probes) if args.csv else None
    try:
        with (
            progress_bar(frame_count(duration, args.fps)) as progress,
            nullcontext() if table is None else closing(table),
        ):

            def each_frame(frame: int, count: int) -> None:
                if table is not None:
                    table.add()
                progress(frame, count)

            wd.record(sim, args.output, duration=duration, fps=args.fps, progress=each_frame, recording=done)
    except (UnstableError, OSError) as error:
        return early_end(error, done)
    print(_summary(args, sim, loads, subject, done))
    return 0


def _simulation(args: argparse.Namespace, subject: InputMesh, duration: float) -> tuple[Simulation, list[Load]]:
    """The simulation of this rank's part, held and moved, and its loads."""
    import warp_corot.distributed as wd
    from warp_corot.distributed import mpi
    from warp_corot.io.write.animate import shortening, steps_per_frame

    loads, mesh = loads_of(args), subject.mesh
    comm = mpi.world()
    body = SoftBody(mesh, material_in_parts(args, subject, comm), device=args.device, threads=1)
    held = args.fix or [str(subject.fix)]
    for expression in held:
        body.fix(expression)
    if not (loads or any(comm.allgather(bool(body.constrained.any())))):
        complain(f"no node is held ({' or '.join(held)!r}): the body falls freely", kind="note")
    for load in loads:
        times, shares = load.curve(ramp_of(args, duration))
        if not any(comm.allgather(len(body.node_indices(load.patch)) > 0)):
            raise InputError(f"--{load.kind} {load.patch!r}: there are no nodes in it")
        body.prescribe(load.patch, times=times, displacements=shares[:, None] * load.values)
    if not any(comm.allgather(len(body.constrained) > np.count_nonzero(body.constrained))):
        raise InputError("options hold or move all nodes; at least one must be free to move")
    damping = subject.damping if args.damping is None else args.damping
    dt = args.dt
    SymplecticEuler(dt, damping, args.viscosity or 0.0)  # checks all values
    if dt is not None:
        if note := shortening(dt, args.fps):
            complain(note, kind="note")
        dt = 1.0 / (args.fps * steps_per_frame(args.fps, dt))
    sim = wd.Simulation(
        body,
        model=model_of(args.model, args.rotation_level, args.dilatation),
        integrator=SymplecticEuler(dt, damping, args.viscosity or 0.0),
        gravity=checked_gravity(subject.gravity if args.gravity is None else tuple(args.gravity), mesh.up_axis),
    )
    return sim, loads


class _PartProbe(Probe):
    """A probed patch of a body of which each rank has a part.

    Args:
        text: The patch's expression.
        sim: The simulation.

    Raises:
        InputError: A patch without nodes.
    """

    def __init__(self, text: str, sim: Simulation):
        self.text, self.body, self.is_patch, self._sim = text, sim.body, True, sim
        self._find()

    def values(self) -> list[float]:
        """The values of all ranks' nodes; all ranks must call."""
        return [float(x) for x in np.sum(self._sim.comm.allgather(np.array(super().values())), axis=0)]

    def _find(self) -> None:
        self._revision, part = self.body.version, self._sim.syncs[0].part
        own = part.is_own
        self._nodes = np.flatnonzero(own & np.isin(np.arange(len(own)), self.body.node_indices(self.text)))
        weights = part.masses[self._nodes]
        total = sum(self._sim.comm.allgather(float(weights.sum())))
        if not total > 0.0:
            raise InputError(f"--probe {self.text!r}: there are no nodes in it")
        self._weights = weights / total


def _summary(
    args: argparse.Namespace, sim: Simulation, loads: Sequence[Load], subject: InputMesh, done: Recording
) -> str:
    from warp_corot.distributed.divided_mesh import DividedForest

    mesh = sim.body.mesh
    assert isinstance(mesh, DividedForest)
    nodes = sim.syncs[0].part.numbers.node_count
    held = " or ".join(args.fix or [str(subject.fix)])
    shortest, longest = sim.dt_range
    rows = [
        ("mesh", f"{nodes} nodes, {mesh.element_count} tetrahedra; {sim.elements_here[0]} on rank 0"),
        *material_lines(args, subject),
        ("fixed", f"where {held}"),
        *[("moved", str(load)) for load in loads],
        ("gravity", f"{' '.join(f'{g:g}' for g in sim.gravity)} m/s^2"),
        ("time step", f"{milliseconds(shortest)} to {milliseconds(longest)}"),
        ("speed", speed(done)),
        ("wall time", wall_time()),
        ("displacement", f"{length(done.largest_displacement)} largest, {length(done.final_displacement)} at the end"),
        ("device", f"{sim.device} ({sim.device.name}), {sim.size} ranks"),
        ("written", f"{done.path} and a piece for each rank, {done.frames} frames, {done.simulated:.4g} s"),
    ]
    return "\n".join(
        [f"{subject.name} in parts", *aligned(rows), *([f"  {'table':<14}{args.csv}"] if args.csv else [])]
    )
