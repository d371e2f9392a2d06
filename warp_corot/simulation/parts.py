"""Checks of a simulation's arguments."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.body.soft_body import SoftBody
from warp_corot.contact.options import Contact
from warp_corot.contact.shapes import Shape
from warp_corot.contact.tool import Obstacle, Tool
from warp_corot.elasticity import Model
from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_indices, checked_number, checked_things, shown
from warp_corot.solvers import Integrator, QuasiStatic, Stepper
from warp_corot.solvers.halo import ALONE, Halo
from warp_corot.solvers.system import System


def checked_bodies(given: SoftBody | Sequence[SoftBody], ranks: Halo = ALONE) -> tuple[SoftBody, ...]:
    """One or several bodies that can be stepped together.

    Raises:
        InputError: There is no body, one is given twice, they have different devices or numbers of worlds, one has no
            free node, one is a part of a body, or one is something else.
    """
    bodies = checked_things(given, SoftBody, "body", "a SoftBody")
    if not bodies:
        raise InputError("a simulation needs at least one body")
    if len(set(bodies)) < len(bodies):
        raise InputError("a body is given twice; each must be given once")
    first = bodies[0]
    for body in bodies:
        if ranks is ALONE:
            check_whole(body)
        if body.worlds != first.worlds:
            raise InputError(f"bodies have {first.worlds} and {body.worlds} worlds; all must have the same number")
        if body.device != first.device:
            raise InputError(f"bodies are on {first.device} and {body.device}; they must be on one device")
        if not ranks.max(float(body.conditions.inverse_mass.numpy().max(initial=0.0))) > 0.0:
            raise InputError(f"all {body.node_count} nodes of the body are held; at least one must be free to move")
    return bodies


def check_whole(body: SoftBody) -> None:
    """Check that this process holds the whole mesh of a body.

    Raises:
        InputError: It holds a part, and other processes the others.
    """
    if (check := getattr(body.mesh, "check_whole", None)) is not None:
        check()


def checked_models(given: Model | Sequence[Model], count: int) -> tuple[Model, ...]:
    """A model for each body; a single model is used for all.

    Raises:
        InputError: The number of models is wrong, or one is something else.
    """
    models = checked_things(given, Model, "model", "a model such as Corotated()")
    if isinstance(given, Model):
        models *= count
    if len(models) != count:
        raise InputError(f"there are {len(models)} models for {count} bodies; there must be one, or one for each")
    return models


def checked_integrator(given: Any) -> Integrator:
    """A time integrator.

    Raises:
        InputError: It is something else.
    """
    if not isinstance(given, Integrator):
        raise InputError(f"integrator is {shown(given)}; it must be an integrator such as SymplecticEuler()")
    return given


def checked_contact(
    obstacles: Obstacle | Sequence[Obstacle], contact: Contact | None
) -> tuple[tuple[Obstacle, ...], Contact] | None:
    """What bodies touch, and how; None if there is no contact.

    Raises:
        InputError: Something is not an obstacle, or not a ``Contact``.
    """
    given = checked_things(obstacles, Shape | Tool, "an obstacle", "a shape such as Ground() or a Tool")
    if contact is not None and not isinstance(contact, Contact):
        raise InputError(f"contact is {shown(contact)}; it must be a Contact, such as Contact(friction=0.3)")
    if not given and contact is None:
        return None
    return given, Contact() if contact is None else contact


def check_implicit(integrator: Integrator, *, remeshes: bool, ordered: bool) -> None:
    """Check that an implicit integrator supports what the simulation needs.

    Args:
        integrator: Any integrator.
        remeshes: Whether bodies are remeshed.
        ordered: Whether sums must have a fixed order on CUDA, which products with the stiffness do not have.

    Raises:
        InputError: It does not.
    """
    if not integrator.is_implicit:
        return
    name = type(integrator).__name__
    if remeshes and isinstance(integrator, QuasiStatic):
        raise InputError(f"{name} does not support remeshing; with remesh the integrator must be another one")
    if ordered:
        raise InputError(f"{name} is not reproducible on CUDA; with deterministic=True it must be SymplecticEuler")


def check_constraints(system: System, stepper: Stepper, integrator: Integrator) -> None:
    """Check that the integrator supports contact.

    Raises:
        InputError: It does not.
    """
    if system.constraints and not stepper.resolves_constraints:
        raise InputError(f"{type(integrator).__name__} does not support contact; it must be SymplecticEuler")


def checked_gravity(gravity: npt.ArrayLike | None, up_axis: str) -> tuple[float, float, float]:
    """A vector [m/s^2], by default 9.81 against the up axis.

    Raises:
        InputError: It is not three finite numbers.
    """
    if gravity is None:
        down = np.zeros(3)
        down["XYZ".index(up_axis)] = -9.81
    else:
        try:
            down = np.asarray(gravity, dtype=np.float64)
        except (TypeError, ValueError):
            down = np.empty(0)
        if down.shape != (3,) or not np.isfinite(down).all():
            raise InputError(f"gravity is {shown(gravity)}; it must be three finite accelerations in m/s^2")
    x, y, z = (float(a) for a in down)
    return x, y, z


def checked_curvature(forces: Any) -> float:
    """The number ``curvature`` of forces that a user adds [1/s^2]; zero if they have none.

    Raises:
        InputError: They have no method ``add_forces``, or the number is negative or not finite.
    """
    if not callable(getattr(forces, "add_forces", None)):
        raise InputError(f"forces is {shown(forces)}; it must have a method add_forces that launches them")
    curvature = getattr(forces, "curvature", 0.0)
    if not 0.0 <= checked_number(curvature, "curvature", "1/s^2") < math.inf:
        raise InputError(f"curvature is {curvature}; it must be zero or a positive number [1/s^2]")
    return curvature


def chosen_worlds(worlds: npt.ArrayLike | wp.array | None, count: int, device: wp.Device) -> wp.array:
    """Nonzero for each chosen world, int32 [count]; an array on the device is returned as it is.

    Args:
        worlds: None for all; an index, indices or a mask bool [count]; or a Warp array int32 [count].

    Raises:
        InputError: There is no such world, or the array has another type, length or device.
    """
    if isinstance(worlds, wp.array):
        if worlds.dtype != wp.int32 or worlds.shape != (count,) or worlds.device != device:
            raise InputError(
                f"worlds is {worlds.dtype.__name__} {list(worlds.shape)} on {worlds.device}; "
                f"it must be int32 [{count}] on {device}"
            )
        return worlds
    mask = np.zeros(count, np.int32)
    mask[slice(None) if worlds is None else checked_indices(worlds, count, "world")] = 1
    return wp.array(mask, dtype=wp.int32, device=device)
