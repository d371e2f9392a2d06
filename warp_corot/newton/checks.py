"""Checks of what users give to ``SolverCorotated``: arguments; models whose builder left tetrahedra out; and recordings
that do not go on from one another."""

from __future__ import annotations

import math
import warnings
from numbers import Real
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.errors import InputError, depth_of_user
from warp_corot.mesh.topology import boundary_faces

from .library import ModelView, newton
from .scene import STATE, attribute_of

INTEGRATORS = ("explicit", "implicit")
#: Meanings of k_mu and k_lambda: mu = a k_mu, lambda = k_lambda + b k_mu, as (a, b).
LAME = {"documented": (1.0, 0.0), "semi-implicit": (0.75, -0.625)}
_REPAIR = "build with warp_corot.newton.add_mesh(builder, warp_corot.TetMesh(points, tets), ...), which repairs them"


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


def why_none(model: newton.Model) -> str:
    """In one line, why a model has no tetrahedra, and what to do."""
    bodies = 0 if model.volume_particle_start is None else len(model.volume_particle_start)
    if not bodies:
        return "the model has no tetrahedra; add some with add_soft_mesh, add_soft_grid or add_forest"
    labels = [str(label) for label in model.volume_label]
    named = f"{bodies} soft bod{'y' if bodies == 1 else 'ies'} ({', '.join(labels[:3])}{', ...' * (bodies > 3)})"
    return (
        f"the model has no tetrahedra, though {named}: Newton's builder leaves out wrongly wound tetrahedra and their "
        f"mass, and all of these are wrongly wound; {_REPAIR}"
    )


def warn_of_lost(model: newton.Model, tets: npt.NDArray[np.integer]) -> None:
    """Warn if soft bodies of a model seem to lack tetrahedra.

    Their surface triangles were found from all tetrahedra: if some were left out, the rest have more outer faces. Or
    particles are in no tetrahedron, and the triangles do not show that they never were in one.
    """
    if model.volume_particle_start is None or not len(model.volume_particle_start):
        return
    in_body, of_body = np.zeros(model.particle_count, bool), np.zeros(len(tets), bool)
    ranges = (model.volume_particle_start, model.volume_particle_end, model.volume_tet_start, model.volume_tet_end)
    for first, last, first_tet, last_tet in zip(*(array.numpy() for array in ranges), strict=True):
        in_body[first:last] = True
        of_body[first_tet:last_tet] = True
    single = in_body.copy()
    single[tets] = False
    surface = faces = 0
    if model.tri_count:
        triangles = model.tri_indices.numpy().reshape(-1, 3)
        surface = int(np.count_nonzero(in_body[triangles].all(axis=1)))
        faces = len(boundary_faces(tets[of_body])[0])
    lost = []
    if single.any() and not faces == surface > 0:
        lost.append(f"{np.count_nonzero(single)} particles of soft bodies are in no tetrahedron")
    if faces > surface > 0:
        lost.append(f"soft bodies with {surface} surface triangles have {faces} outer faces")
    if lost:
        warnings.warn(
            f"{' and '.join(lost)}: Newton's builder leaves out wrongly wound tetrahedra and their mass; {_REPAIR}",
            UserWarning,
            stacklevel=5,
        )


class Recordings:
    """The states between which recordings lead.

    A graph keeps the addresses of the states. If a frame swaps two states an odd number of times, its replay reads the
    same old state again and again, unless the result is copied back.

    Args:
        device: The model's device.
    """

    def __init__(self, device: wp.Device):
        self._device = device
        self._ways: list[tuple[wp.array, wp.array]] = []
        self._recording = self._told = False

    def follow(self, state_in: newton.State, state_out: newton.State) -> None:
        """Follow a step, if it is recorded; the steps of a recording come one after the other."""
        goes_on, self._recording = self._recording, self._device.is_capturing
        if self._recording and not self._told:
            begin = self._ways.pop()[0] if goes_on else state_in.particle_q
            self._ways = [way for way in self._ways if way[0] is not begin] + [(begin, state_out.particle_q)]

    def check(self) -> None:
        """Warn, once, of a recording whose result no recording reads; waits for the device."""
        begins = {begin.ptr for begin, _ in self._ways}
        lost = (way for way in self._ways if way[1].ptr not in begins)
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
