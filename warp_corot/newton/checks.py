"""Checks of what users give to ``SolverCorotated``: arguments, and recordings that do not go on from one another."""

from __future__ import annotations

import math
import warnings
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from warp_corot.errors import InputError, depth_of_user
from warp_corot.inputs.checks import checked_choice, checked_count, checked_number, shown

from .library import ModelView, newton
from .scene import STATE, attribute_of

INTEGRATORS = ("explicit", "implicit")
#: Meanings of k_mu and k_lambda: mu = a k_mu, lambda = k_lambda + b k_mu, as (a, b).
LAME = {"documented": (1.0, 0.0), "semi-implicit": (0.75, -0.625)}


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
    if not isinstance(model, newton.Model | ModelView):
        raise InputError(f"model is {_named(model)}; it must be a newton.Model, the result of builder.finalize()")
    if cuts is not None:
        raise InputError(
            "cuts is given, but a cut makes new particles, and the number of a Newton model's particles is fixed; "
            "warp_corot.Simulation(..., cuts=[blade]) cuts"
        )
    checked_choice(lame, "lame", LAME)
    checked_choice(integrator, "integrator", INTEGRATORS)
    if not 0.0 <= checked_number(damping, "damping", "1/s") < math.inf:
        raise InputError(f"damping is {damping!r}; it must be zero or a positive rate in 1/s")
    if substeps is not None:
        checked_count(substeps, "substeps", 1)
    if stable_dt is not None and not checked_number(stable_dt, "stable_dt", "s") > 0.0:
        raise InputError(f"stable_dt is {stable_dt!r}; it must be a positive number of seconds or None")
    if self_contact_margin is None:
        return
    if not 0.0 < checked_number(self_contact_margin, "self_contact_margin", "m") < math.inf:
        raise InputError(f"self_contact_margin is {self_contact_margin!r}; it must be a positive distance in m or None")
    if integrator == "implicit":
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
    found, control, contacts = [], step.control, step.contacts
    for name, state in (("state_in", step.state_in), ("state_out", step.state_out)):
        if getattr(state, "particle_q", model) is model:
            raise InputError(f"{name} is {_named(state)}; it must be a newton.State, the result of model.state()")
        found.append((name, state.particle_q, "particles", model.particle_count))
        found += [(name, attribute_of(state, each), f"warp_corot.{each}", model.tet_count) for each in STATE]
    if control is not None:
        found.append(("control", control.tet_activations, "tet_activations", model.tet_count))
    for name, array, what, count in found:
        if (0 if array is None else len(array)) != count and (array is not None or what == "particles"):
            raise InputError(f"{name} has {0 if array is None else len(array)} {what}; the model has {count}")
        if getattr(array, "device", model.device) != model.device:
            raise InputError(f"{name} is on {array.device}; the model is on {model.device}")
    if contacts is not None and contacts.soft_contact_max and contacts.soft_contact_count.device != model.device:
        raise InputError(f"contacts are on {contacts.soft_contact_count.device}; the model is on {model.device}")


def checked_dt(dt: Any) -> float:
    """A time step [s].

    Raises:
        InputError: It is not positive, or not finite.
    """
    if isinstance(dt, bool) or not 0.0 < checked_number(dt, "dt", "s") < math.inf:
        raise InputError(f"dt is {dt!r}; it must be a positive number of seconds")
    return float(dt)


def checked_mask(world_mask: Any, model: newton.Model) -> wp.array:
    """A mask of worlds, bool [world_count + 1].

    Raises:
        InputError: It is not such an array, or is on another device.
    """
    shape = (model.world_count + 1,)
    fits = isinstance(world_mask, wp.array) and world_mask.dtype == wp.bool and world_mask.shape == shape
    if not fits or world_mask.device != model.device:
        raise InputError(
            f"world_mask is {shown(world_mask)}; it must be bool [{shape[0]}], a Warp array on {model.device}"
        )
    return world_mask


def _named(value: Any) -> str:
    return "None" if value is None else f"a {type(value).__name__}"


def why_none(model: newton.Model) -> str:
    """In one line, why a model has no tetrahedra, and what to do."""
    bodies = 0 if model.volume_particle_start is None else len(model.volume_particle_start)
    if not bodies:
        return "the model has no tetrahedra; add some with add_soft_mesh, add_soft_grid or add_forest"
    labels = [str(label) for label in model.volume_label]
    named = f"{bodies} soft bod{'y' if bodies == 1 else 'ies'} ({', '.join(labels[:3])}{', ...' * (bodies > 3)})"
    return (
        f"the model has no tetrahedra, though {named}: Newton's builder leaves out those that are wrongly wound; "
        "build with warp_corot.newton.add_mesh(builder, warp_corot.TetMesh(points, tets), ...), which repairs them"
    )


class Recordings:
    """The states between which recordings lead.

    A graph keeps the addresses of the states. If a frame swaps two states an odd number of times, its replay reads the
    same old state again and again, unless the result is copied back.

    Args:
        device: The model's device.
    """

    def __init__(self, device: wp.Device):
        self._device, self._told = device, False
        self._begin: wp.array | None = None
        #: Where recordings begin, and where they end.
        self._ways: dict[int, tuple[wp.array, wp.array]] = {}

    def follow(self, state_in: newton.State, state_out: newton.State) -> None:
        """Follow a step, if it is recorded; the steps of a recording come one after the other."""
        if not self._device.is_capturing:
            self._begin = None
            return
        self._begin = state_in.particle_q if self._begin is None else self._begin
        self._ways[self._begin.ptr] = self._begin, state_out.particle_q

    def check(self) -> None:
        """Warn, once, of a recording whose result no recording reads; waits for the device."""
        lost = (way for way in self._ways.values() if way[1].ptr not in self._ways)
        if self._told or self._device.is_capturing or all(np.array_equal(a.numpy(), b.numpy()) for a, b in lost):
            return
        self._told = True
        warnings.warn(
            "recorded steps end in another state than that from which they begin, and nothing copies it back: each "
            "replay begins where the first one did; record an even number of swaps, or end the recording with "
            "state_in.assign(state_out)",
            UserWarning,
            stacklevel=depth_of_user(),
        )
