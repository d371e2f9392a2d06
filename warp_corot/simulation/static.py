"""Static solutions: the state in which a body is at rest under its loads."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_corot.body.soft_body import SoftBody
from warp_corot.contact.contacts import Contacts
from warp_corot.contact.options import Contact
from warp_corot.contact.reading import ContactPoint, contact_points
from warp_corot.contact.shapes import Shape
from warp_corot.elasticity import Corotated, ForceField, Model
from warp_corot.errors import ConvergenceError, InputError
from warp_corot.inputs.checks import checked_count, checked_number, refuse_tape, shown
from warp_corot.inputs.simulation_lock import under_lock
from warp_corot.solvers.implicit.preconditioners import check_preconditioner
from warp_corot.solvers.implicit.static import StaticSolver, nested_start, status_words

from .parts import check_whole, checked_gravity, checked_models
from .resting import LoadedBody, Rest, checked_obstacles, rest_on

#: Rounding of float32 displacements and forces hides what is smaller: Newton's method would stop without an answer.
LEAST_TOLERANCE = 1e-6

#: Parts of messages on bodies that are held nowhere, at a point or on a line.
LOADS_TURN = "the body is free to turn as a whole, and its loads turn it"
FIX_MORE = "fix nodes that are not on one line"

#: Precisions of answers.
FLOAT32, FLOAT64 = "float32", "float64"


@dataclass(frozen=True)
class StaticReport:
    """The result of ``solve_static``.

    Attributes:
        converged: Whether every world is at rest.
        message: What happened, in one line.
        iterations: Newton's iterations on the body's own mesh.
        linear_iterations: Iterations of conjugate gradients in all of Newton's iterations together.
        residual: The norm of the unbalanced forces over that of external and reaction forces, in the last iteration of
            the world where it is largest. Rounding of float32 leaves some 1e-5 on fine meshes.
        correction: The largest displacement of the last iteration over the largest displacement.
        energy: Elastic energy minus the work of loads and gravity from the rest shape, of all worlds [J].
        time: Wall time [s].
        load_share: Share of loads and gravity that the state carries in worlds that did not converge; else 1.
        world_converged: Whether each world is at rest, bool [worlds].
        displacements: With ``precision="float64"`` those of the answer [m], float64 [worlds * N, 3]; else None.
        contacts: The places where obstacles or the body itself push it.
    """

    converged: bool
    message: str
    iterations: int
    linear_iterations: int
    residual: float
    correction: float
    energy: float
    time: float
    load_share: float
    world_converged: npt.NDArray[np.bool_]
    displacements: npt.NDArray[np.float64] | None = None
    contacts: tuple[ContactPoint, ...] = field(default=(), repr=False)


@under_lock
def solve_static(
    body: SoftBody,
    *,
    model: Model | None = None,
    gravity: npt.ArrayLike | None = None,
    tolerance: float = 1e-6,
    iterations: int = 100,
    load_steps: int = 1,
    preconditioner: str | None = None,
    obstacles: Shape | Sequence[Shape] = (),
    contact: Contact | None = None,
    precision: str = "float32",
) -> StaticReport:
    """Find the state in which a body is at rest under gravity and its loads, by Newton's method.

    The search begins at the body's displacements, and held nodes stay there: set ``body.displacements`` to prescribe
    others. Each iteration solves for a step by preconditioned conjugate gradients with the exact derivative of the
    forces; a line search on the energy shortens the step if necessary. If the method does not converge, loads and
    gravity are added in smaller and smaller parts. The body ends in the last state of rest that was found, or where it
    began, with zero velocities; the report says which share of the load that state carries.

    Args:
        body: The body.
        model: Elastic model; None for ``Corotated()``.
        gravity: [m/s^2]; None for 9.81 down the up axis of the mesh.
        tolerance: A world is at rest where its residual is below this, or the last whole step moves no node by more
            than this share of the largest displacement. Less than 1e-6 counts as 1e-6: float32 hides the rest.
        iterations: The most iterations of Newton's method for each part of the load.
        load_steps: Equal parts in which loads and gravity are added. If there are several states of rest, more parts
            follow the path of a growing load.
        preconditioner: Of conjugate gradients: "multigrid" on the levels of a forest, "diagonal" with each node's own
            3x3 block, or None: multigrid for forests, the diagonal for general meshes.
        obstacles: Shapes at rest on which the body may rest; their ``wrench`` is that of the answer. The search then
            is one of long steps of backward Euler, each from rest, without a line search; ``load_steps`` must be 1.
        contact: Friction; with ``self_contact`` the body may touch itself.
        precision: "float32"; or "float64", which goes on from the answer of float32 with Newton's method and a direct
            solver on the host, to the rounding of float64: for isotropic materials of Linear, Corotated,
            StVenantKirchhoff, NeoHookean and EdgeStVK with biquadratic springs, bodies that are held in each world,
            and meshes of up to some 50,000 elements.

    Raises:
        InputError: An argument has another type or is out of its range, the model does not support the mesh or the
            precision, or all its nodes are held.
    """
    search = (tolerance, iterations, load_steps, preconditioner)
    return static_answer(body, model, gravity, *search, obstacles, contact, precision)[0]


def static_answer(
    body: SoftBody,
    model: Model | None,
    gravity: npt.ArrayLike | None,
    tolerance: float = 1e-6,
    iterations: int = 100,
    load_steps: int = 1,
    preconditioner: str | None = None,
    obstacles: Shape | Sequence[Shape] = (),
    contact: Contact | None = None,
    precision: str = FLOAT32,
) -> tuple[StaticReport, Contacts | None]:
    """As ``solve_static``, with the contact of the answer if it touches anything, which the report does not keep."""
    refuse_tape()
    began = time.perf_counter()
    if not isinstance(body, SoftBody):
        raise InputError(f"body is {shown(body)}; it must be a SoftBody")
    check_whole(body)
    if not 0.0 < checked_number(tolerance, "tolerance") < 1.0:
        raise InputError(f"tolerance is {tolerance}; it must be between 0 and 1")
    tolerance = max(tolerance, LEAST_TOLERANCE)
    most, steps = checked_count(iterations, "iterations", least=1), checked_count(load_steps, "load_steps", least=1)
    check_preconditioner(preconditioner)
    (law,) = checked_models(Corotated() if model is None else model, 1)
    down = checked_gravity(gravity, body.mesh.up_axis)
    if not (body.conditions.inverse_mass.numpy() > 0).any():
        raise InputError(f"all {body.node_count} nodes of the body are held; at least one must be free to move")

    body.state.adopt_positions()
    forces = law.bind(body)
    forces.relax_fully()
    answer = _Answer(body, forces, down, began)
    things = checked_obstacles(obstacles)
    _check_precision(precision, body, law, touches=bool(things) or contact is not None)
    if things or contact is not None:
        if steps != 1:
            raise InputError(f"load_steps is {steps}; with obstacles or contact it must be 1")
        options: dict[str, Any] = {"tolerance": tolerance, "most": most, "preconditioner": preconditioner}
        rest = rest_on([answer], [law], down, things, contact, **options)
        return answer.resting(rest), rest.contact
    if answer.falls():
        return answer.report(
            "no node is held, and the loads do not balance: the body has no state of rest; fix some nodes"
        ), None
    if forces.is_linear and answer.turns():
        return answer.report(f"{LOADS_TURN}: under a linear law it has no state of rest; {FIX_MORE}"), None
    solver = StaticSolver(
        body, forces, down, tolerance=tolerance, most=most, load_steps=steps, preconditioner=preconditioner
    )
    found = solver.solve(nested_start(body, law, forces, answer.loads) if steps == 1 else None)
    answer.finish()
    converged = found.converged
    if precision == FLOAT64 and converged.all():
        return _precise(answer, law, solver), None
    known: dict[str, Any] = {"iterations": solver.iterations, "linear_iterations": solver.linear_iterations}
    known |= {"residual": float(found.residual.max()), "correction": float(found.correction.max())}
    known |= {"load_share": solver.share, "world_converged": converged}
    why = "the body is at rest"
    if not converged.all():
        why = _what_stopped(answer, solver, status_words(found), converged)
    return answer.report(why, **known), None


def _check_precision(precision: str, body: SoftBody, law: Model, *, touches: bool) -> None:
    """Check that an answer exists in this precision.

    Raises:
        InputError: It does not.
    """
    if precision not in (FLOAT32, FLOAT64):
        raise InputError(f"precision is {shown(precision)}; it must be {FLOAT32!r} or {FLOAT64!r}")
    if precision == FLOAT32:
        return
    from warp_corot.solvers.implicit.precise import checked_float64_law

    checked_float64_law(body, law)
    if touches:
        raise InputError("precision is 'float64'; with obstacles or contact it must be 'float32'")
    if not body.conditions.held_mask().reshape(body.worlds, -1).any(axis=1).all():
        raise InputError("precision is 'float64'; it needs held nodes in each world")


def _precise(answer: _Answer, law: Model, solver: StaticSolver) -> StaticReport:
    """The answer in float64, from that in float32."""
    from warp_corot.solvers.implicit.precise import PreciseRest

    body = answer.body
    solves: dict[str, Any] = {"linear_iterations": solver.linear_iterations, "load_share": 1.0}
    try:
        found = PreciseRest(body, answer.field, law, answer.loads)
    except ConvergenceError as error:
        message = f"not converged: {error}; the body is at rest in float32"
        return answer.report(message, iterations=solver.iterations, **solves)
    body.state.adopt_positions()
    answer.finish()
    report = answer.report(
        "the body is at rest",
        iterations=solver.iterations + found.iterations,
        residual=found.residual,
        correction=found.correction,
        world_converged=np.ones(body.worlds, bool),
        **solves,
    )
    return replace(report, displacements=found.u.reshape(-1, 3))


class _Answer(LoadedBody):
    """A body and the state that a solve ends in, which began at a time [s]."""

    def __init__(self, body: SoftBody, field: ForceField, gravity: tuple[float, float, float], began: float):
        super().__init__(body, field, gravity)
        self._began = began

    def report(self, message: str, **known: Any) -> StaticReport:
        """The report, with what is known of the solve, if there was one."""
        body = self.body
        u = body.state.displacements.numpy()[: body.sizes.nodes, :3].astype(np.float64)
        energy = self.field.elastic_energy(body.state.displacements) - float(np.sum(self.loads * u))
        nothing: dict[str, Any] = dict.fromkeys(("iterations", "linear_iterations"), 0)
        nothing |= dict.fromkeys(("residual", "correction"), math.inf)
        known = nothing | {"load_share": 0.0, "world_converged": np.zeros(body.worlds, bool)} | known
        converged, took = bool(known["world_converged"].all()), time.perf_counter() - self._began
        return StaticReport(converged=converged, message=message, energy=energy, time=took, **known)

    def resting(self, found: Rest) -> StaticReport:
        """The report on an answer in contact."""
        self.finish()
        known = {name: getattr(found, name) for name in ("iterations", "linear_iterations", "residual", "correction")}
        known |= {"load_share": float(found.converged.all()), "world_converged": found.converged}
        report = self.report(found.message, **known)
        return replace(report, contacts=() if found.contact is None else tuple(contact_points(found.contact)))


def _what_stopped(answer: _Answer, solver: StaticSolver, why: str, converged: npt.NDArray[np.bool_]) -> str:
    """The message of a solve that did not converge in all worlds."""
    from warp_corot.mesh.topology import pieces_of

    body = answer.body
    piece = pieces_of(body.mesh.tets)
    held = np.asarray(body.conditions.held_mask().reshape(body.worlds, -1).any(axis=0))
    pieces = np.unique(piece[held[body.mesh.tets].any(axis=1)])
    loose = int(piece.max()) + 1 - len(pieces)
    if loose and len(pieces):
        why = f"nothing holds {loose} of the {int(piece.max()) + 1} pieces of the mesh"
    elif answer.turns():
        why = f"{LOADS_TURN}; {FIX_MORE}"
    where, kept = "", "the body is left at rest under {:.3g} of its load"
    if converged.any():
        where = f" in {int((~converged).sum())} of {body.worlds} worlds"
        kept = "these are left at rest under {:.3g} of their load"
    return f"not converged{where}: {why}; {kept.format(solver.share)}"
