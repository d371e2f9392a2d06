"""Refusals, one line each, of everything that does not work on several ranks yet."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from warp_corot.body.soft_body import SoftBody
from warp_corot.contact.options import SURFACE, TETRAHEDRA
from warp_corot.elasticity import Corotated, Linear, Model, NeoHookean, StVenantKirchhoff
from warp_corot.errors import InputError
from warp_corot.solvers import Integrator

from .divided_mesh import DividedMesh
from .part_simulation import Passes

#: Models whose forces need only the elements around a node.
MODELS = (Corotated, Linear, NeoHookean, StVenantKirchhoff)

#: The preconditioner of linear solves.
DIAGONAL = "diagonal"


def check_supported(
    bodies: Sequence[SoftBody], models: Sequence[Model], integrator: Integrator, others: dict[str, Any], cards: int = 0
) -> None:
    """Check that a simulation can be made on several ranks.

    Args:
        bodies, models, integrator: As for ``Simulation``.
        cards: The number of cards, if the run must give the same bits for any number of them; otherwise 0.
        others: Its other arguments, by name.

    Raises:
        InputError: It cannot.
    """
    in_parts = any(isinstance(body.mesh, DividedMesh) for body in bodies)
    if others.get("remesh") and in_parts:
        raise InputError(
            "remeshing of meshes that no rank holds whole does not work yet; leave remesh out, let every rank make the "
            "whole mesh, or run on one process"
        )
    if others.get("cuts") is not None:
        raise InputError("cutting does not work on several ranks; leave cuts out, or run on one process")
    contact = others.get("contact")
    meets = getattr(contact, "self_contact", False) or (len(bodies) > 1 and (contact or others.get("obstacles")))
    if meets and (in_parts or integrator.is_implicit):
        raise InputError(
            "contact of soft surfaces does not work on several ranks yet in implicit steps, or with meshes that no "
            "rank holds whole; use one body without self_contact, or explicit steps of whole meshes, or one process"
        )
    touches = bool(contact or others.get("obstacles"))
    embedded = any(isinstance(body.mesh, DividedMesh) and body.mesh.is_embedded for body in bodies)
    if touches and embedded and not integrator.is_implicit and getattr(contact, "on", SURFACE) == SURFACE:
        raise InputError(
            f"no rank has the surface of a divided mesh; contact must be Contact(on={TETRAHEDRA!r}), which touches the "
            "tetrahedra around it, or every rank must make the whole mesh"
        )
    if getattr(integrator, "preconditioner", None) not in (None, DIAGONAL) and in_parts:
        raise InputError(
            f"the preconditioner {integrator.preconditioner!r} does not work yet with meshes that no rank holds whole; "  # type: ignore[attr-defined]
            f"it must be None or {DIAGONAL!r}"
        )
    if cards > 1 and touches:
        raise InputError(
            "contact on several cards is not the same bit for bit as on one yet; deterministic must be False, or take "
            "ranks on the CPU, or one card"
        )
    for model in models:
        if not isinstance(model, MODELS):
            raise InputError(f"{type(model).__name__} does not work on several ranks yet; take a law of elements")
    for body in bodies:
        if body.changing is not None and not isinstance(others.get("remesh"), Passes):
            raise InputError("a body that is remeshed does not work on several ranks yet")
