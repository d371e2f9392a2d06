"""Checks of the arguments that users give to ``SolverCorotated``."""

from __future__ import annotations

import math
from numbers import Real
from typing import Any, NamedTuple

import warp as wp

from warp_corot.errors import InputError

from .library import ModelView, newton
from .state import STATE, attribute_of
from .tetrahedra import LAME

INTEGRATORS = ("explicit", "implicit")


class Step(NamedTuple):
    """The arguments of ``SolverCorotated.step`` or of one of its substeps, and the array for the mean wrenches of
    contacts in the step."""

    state_in: newton.State
    state_out: newton.State
    control: newton.Control | None
    contacts: newton.Contacts | None
    dt: float
    reported: wp.array | None = None


def check_options(
    model: Any,
    *,
    lame: Any,
    damping: Any,
    integrator: Any,
    substeps: Any,
    stable_dt: Any,
    self_contact_margin: Any,
    cuts: Any,
) -> None:
    """Check the options of ``SolverCorotated``.

    Raises:
        InputError: One is out of its range.
    """
    if not isinstance(model, newton.Model) and not isinstance(model, ModelView):
        raise InputError(f"model is {_named(model)}; it must be a newton.Model, the result of builder.finalize()")
    if cuts is not None:
        raise InputError(
            "cuts is given, but a cut makes new particles, and the number of a Newton model's particles is fixed; "
            "warp_corot.Simulation(..., cuts=[blade]) cuts"
        )
    choices = (("lame", lame, LAME), ("integrator", integrator, INTEGRATORS))
    for name, value, among in choices:
        if not isinstance(value, str) or value not in among:
            raise InputError(f"{name} is {value!r}; it must be one of {', '.join(among)}")
    if not (is_finite(damping) and damping >= 0):
        raise InputError(f"damping is {damping!r}; it must be zero or a positive rate in 1/s")
    if substeps is not None and not (is_finite(substeps) and substeps == int(substeps) and substeps >= 1):
        raise InputError(f"substeps is {substeps!r}; it must be a positive whole number or None")
    if stable_dt is not None and not (isinstance(stable_dt, Real) and float(stable_dt) > 0):
        raise InputError(f"stable_dt is {stable_dt!r}; it must be a positive number of seconds or None")
    if self_contact_margin is not None and not (is_finite(self_contact_margin) and self_contact_margin > 0):
        raise InputError(f"self_contact_margin is {self_contact_margin!r}; it must be a positive distance in m or None")
    if self_contact_margin is not None and integrator == "implicit":
        raise InputError(
            "self_contact_margin is given, and integrator is 'implicit', in whose steps soft bodies do not touch one "
            "another: use integrator='explicit', or no self_contact_margin"
        )


def check_step(step: Step, model: newton.Model) -> None:
    """Check the arguments of ``SolverCorotated.step`` except dt.

    Args:
        step: The arguments.
        model: The model.

    Raises:
        InputError: An argument belongs to another model, or is on another device.
    """
    for name, state in (("state_in", step.state_in), ("state_out", step.state_out)):
        _check_state(name, state, model)
    device, control, contacts = model.device, step.control, step.contacts
    if control is not None and control.tet_activations is not None:
        activations = control.tet_activations
        if len(activations) != model.tet_count:
            raise InputError(f"control has {len(activations)} tet_activations; there are {model.tet_count}")
        if activations.device != device:
            raise InputError(f"control is on {activations.device}; the model is on {device}")
    if contacts is not None and contacts.soft_contact_max and contacts.soft_contact_count.device != device:
        raise InputError(f"contacts are on {contacts.soft_contact_count.device}; the model is on {device}")


def checked_dt(dt: Any) -> float:
    """A time step [s].

    Raises:
        InputError: It is not positive, or not finite.
    """
    if not (is_finite(dt) and dt > 0):
        raise InputError(f"dt is {dt!r}; it must be a positive number of seconds")
    return dt


def checked_mask(world_mask: Any, model: newton.Model) -> wp.array:
    """A mask of worlds, bool [world_count + 1].

    Raises:
        InputError: It is not such an array, or is on another device.
    """
    wanted = f"it must be bool [{model.world_count + 1}] on {model.device}"
    if not isinstance(world_mask, wp.array):
        raise InputError(f"world_mask is {world_mask!r}; {wanted}")
    right = world_mask.dtype == wp.bool and world_mask.shape == (model.world_count + 1,)
    if not right or world_mask.device != model.device:
        found = f"{world_mask.dtype.__name__} {list(world_mask.shape)} on {world_mask.device}"
        raise InputError(f"world_mask is {found}; {wanted}")
    return world_mask


def is_finite(value: Any) -> bool:
    """Whether a value is a finite number."""
    return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)


def _check_state(name: str, state: Any, model: newton.Model) -> None:
    if getattr(state, "particle_q", model) is model:
        raise InputError(f"{name} is {_named(state)}; it must be a newton.State, the result of model.state()")
    if state.particle_q is None or len(state.particle_q) != model.particle_count:
        there = 0 if state.particle_q is None else len(state.particle_q)
        raise InputError(f"{name} has {there} particles; the model has {model.particle_count}")
    if state.particle_q.device != model.device:
        raise InputError(f"{name} is on {state.particle_q.device}; the model is on {model.device}")
    for attribute in STATE:
        array = attribute_of(state, attribute)
        if array is not None and len(array) != model.tet_count:
            raise InputError(f"{name} has {attribute} of {len(array)} tetrahedra; there are {model.tet_count}")


def _named(value: Any) -> str:
    return "None" if value is None else f"a {type(value).__name__}"
