"""Which bodies of a simulation are remeshed, and when."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING

from warp_corot.errors import CapacityWarning, InputError, depth_of_user

from .online import OnlineRemesh

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody
    from warp_corot.elasticity import ForceField, Model

    from .changing import Changing


class Remeshing:
    """The passes of a simulation.

    Args:
        bodies, models: The simulation's.
        asked: What was asked for, for all bodies or one for each.
        deterministic: Whether a run must come out the same bit by bit.

    Attributes:
        changing: What remeshes each body, None for those that stay as they are.
        every: Steps after which a pass may be due; 0 if there is none.

    Raises:
        InputError: What was asked for is neither, or cannot be had of these bodies and models.
    """

    def __init__(
        self,
        bodies: Sequence[SoftBody],
        models: Sequence[Model],
        asked: OnlineRemesh | Sequence[OnlineRemesh | None] | None,
        *,
        deterministic: bool,
    ):
        if any(body.changing is not None for body in bodies):
            raise InputError("a body that one simulation remeshes cannot be in another; make a SoftBody of its mesh")
        options = _one_each(asked, len(bodies))
        self.every = math.gcd(*(each.every for each in options if each is not None))
        self.changing: tuple[Changing | None, ...] = (None,) * len(bodies)
        if not self.every:
            return
        if deterministic and bodies[0].device.is_cuda:
            raise InputError("a deterministic run on CUDA cannot be remeshed: new nodes are numbered as threads come")
        from .changing import Changing, fitted

        # All of them before the first one is given pools: what is refused leaves the bodies as they are.
        for each, body, model in zip(options, bodies, models, strict=True):
            if each is not None:
                body.check_own_arrays()
                if model.kept_of_elements is not None:
                    raise InputError(f"{model.kept_of_elements}; a body that is remeshed must have another model")
                fitted(each, body)

        self.changing = tuple(
            None if each is None else Changing(body, each) for body, each in zip(bodies, options, strict=True)
        )
        self._said_full: set[int] = set()

    def serve(self, fields: Sequence[ForceField]) -> None:
        """Let the bodies' force fields, made by now, go through the pools."""
        for changing, field in zip(self.changing, fields, strict=True):
            if changing is not None:
                changing.serve(field)

    def is_due(self, steps: int) -> bool:
        """Whether any pass is due after so many steps."""
        return self.every > 0 and steps % self.every == 0

    def run(self, steps: int) -> bool:
        """The passes that are due after so many steps; whether any was.

        Warns:
            CapacityWarning: A body has no room left for what should be refined; once.
        """
        due = [c for c in self.changing if c is not None and steps % c.options.every == 0]
        for changing in due:
            changing.run()
            if changing.is_full and id(changing) not in self._said_full:
                self._said_full.add(id(changing))
                most = f"{changing.options.capacity} elements"
                message = f"the mesh has no room left, its capacity is {most}; it is refined no further"
                warnings.warn(message, CapacityWarning, stacklevel=depth_of_user())
        return bool(due)

    def step_may_change(self) -> bool:
        """Whether the stable step is to be found anew; to be asked once a pass."""
        return any([changing.survey.step_may_change() for changing in self.changing if changing is not None])


def _one_each(
    asked: OnlineRemesh | Sequence[OnlineRemesh | None] | None, count: int
) -> tuple[OnlineRemesh | None, ...]:
    if isinstance(asked, OnlineRemesh | None):
        return (asked,) * count
    given = tuple(asked) if isinstance(asked, Sequence) else ()
    if len(given) != count or not all(isinstance(each, OnlineRemesh | None) for each in given):
        raise InputError(f"remesh is {asked!r}; it must be an OnlineRemesh, or one or None for each of {count} bodies")
    return given
