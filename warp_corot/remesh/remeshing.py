"""Which bodies of a simulation are remeshed, and when."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING

from warp_corot.errors import CapacityWarning, InputError, depth_of_user
from warp_corot.inputs.checks import shown
from warp_corot.mesh.surfaces.bound import NOT_OPENED

from .online import OnlineRemesh

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody
    from warp_corot.cutting.blade import Blade
    from warp_corot.elasticity import ForceField, Model
    from warp_corot.kernels.remesh.cut_surface import Surface

    from .changing import Changing


class Remeshing:
    """The passes of a simulation.

    Args:
        bodies, models: The simulation's.
        asked: The user's argument: options for all bodies or one entry for each.
        deterministic: Whether runs must be reproducible bit for bit.
        blades: The blades that cut bodies, if any can be cut.

    Attributes:
        changing: The remeshing and cutting of each body; None for bodies whose mesh never changes.
        every: Steps after which a pass may be due; 0 if there is none.

    Raises:
        InputError: The argument has another type, or these bodies and models cannot be remeshed.
    """

    def __init__(
        self,
        bodies: Sequence[SoftBody],
        models: Sequence[Model],
        asked: OnlineRemesh | Sequence[OnlineRemesh | None] | None,
        *,
        deterministic: bool,
        blades: Sequence[Blade] | None = None,
    ):
        are_cut = blades is not None
        if any(body.changing is not None for body in bodies):
            raise InputError(
                "a body that one simulation remeshes or cuts cannot be in another; make a SoftBody of its mesh"
            )
        options = _one_each(asked, len(bodies))
        self.every = math.gcd(*(int(each.every) for each in options if each is not None))
        self.are_cut = are_cut
        self.changing: tuple[Changing | None, ...] = (None,) * len(bodies)
        if not self.every and not are_cut:
            return
        if deterministic and bodies[0].device.is_cuda:
            raise InputError(
                "a deterministic run on CUDA cannot be remeshed or cut: threads number new nodes in any order"
            )
        from .changing import Changing, fitted

        level = max((blade.level for blade in blades or () if blade.level is not None), default=None)
        # All checks come before the first body is given pools: an error leaves the bodies unchanged.
        for each, body, model in zip(options, bodies, models, strict=True):
            if each is not None or are_cut:
                body.check_own_arrays()
                if are_cut and any(binding.normals is not None for binding in body.bindings):
                    raise InputError(NOT_OPENED)
                if model.kept_of_elements is not None:
                    raise InputError(
                        f"{model.kept_of_elements}; a body that is remeshed or cut must have another model"
                    )
                fitted(each or OnlineRemesh(), body)

        self.changing = tuple(
            Changing(body, each, model.carried, is_cut=are_cut, level=level) if each is not None or are_cut else None
            for each, body, model in zip(options, bodies, models, strict=True)
        )
        self._said_full: set[int] = set()

    @property
    def changed(self) -> tuple[Changing, ...]:
        """The remeshing and cutting of the bodies whose mesh changes."""
        return tuple(each for each in self.changing if each is not None)

    def serve(self, fields: Sequence[ForceField]) -> None:
        """Connect the bodies' force fields, which now exist, to the pools."""
        for changing, field in zip(self.changing, fields, strict=True):
            if changing is not None:
                changing.serve(field)

    def is_due(self, steps: int) -> bool:
        """Whether any pass is due after this number of steps."""
        return self.every > 0 and steps % self.every == 0

    def run(self, steps: int) -> bool:
        """Make the passes that are due after this number of steps; returns whether there was any.

        Warns:
            CapacityWarning: A body's capacity does not suffice for the refinement; once.
        """
        due = [c for c in self.changing if c is not None and c.is_remeshed and steps % c.options.every == 0]
        for changing in due:
            changing.run()
            self._say_full(changing)
        return bool(due)

    def cut(self, surface: Surface | float, number: int | None = None) -> float:
        """Cut all bodies, or one, along a surface or where the stress is above a number [Pa]; returns the area [m^2].

        Warns:
            CapacityWarning: As ``run``.
        """
        chosen = self.changing if number is None else self.changing[number : number + 1]
        area = 0.0
        for changing in chosen:
            if changing is not None:
                area += changing.cut(surface)
                self._say_full(changing)
        return area

    def _say_full(self, changing: Changing) -> None:
        if changing.is_full and id(changing) not in self._said_full:
            self._said_full.add(id(changing))
            most = f"{changing.options.capacity} elements"
            message = f"the mesh has reached its capacity of {most}; it is not refined or cut further"
            warnings.warn(message, CapacityWarning, stacklevel=depth_of_user())

    def step_may_change(self) -> bool:
        """Whether the stable step must be found again; call it once after each pass."""
        return any([changing.survey.step_may_change() for changing in self.changing if changing is not None])


def _one_each(
    asked: OnlineRemesh | Sequence[OnlineRemesh | None] | None, count: int
) -> tuple[OnlineRemesh | None, ...]:
    if isinstance(asked, OnlineRemesh | None):
        return (asked,) * count
    given = tuple(asked) if isinstance(asked, Sequence) else ()
    if len(given) != count or not all(isinstance(each, OnlineRemesh | None) for each in given):
        raise InputError(
            f"remesh is {shown(asked)}; it must be an OnlineRemesh, or one or None for each of {count} bodies"
        )
    return given
