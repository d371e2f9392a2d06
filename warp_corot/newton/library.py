"""The only module that imports Newton, and the arguments of a step with Newton's types."""

from __future__ import annotations

from typing import Any, NamedTuple

import warp as wp

from warp_corot.errors import InputError


class MissingNewton(InputError, ImportError):
    """Newton is not installed, or is too old."""


try:
    import newton
    from newton.solvers import SolverBase, SolverSemiImplicit
    from newton.solvers.experimental.coupled import CouplingInterface, ModelView
except ImportError as error:
    raise MissingNewton(
        f'warp_corot.newton needs Newton 1.8 or newer: pip install "warp-corot[newton]" ({error})'
    ) from None

__all__ = [
    "CouplingInterface",
    "MissingNewton",
    "ModelView",
    "SolverBase",
    "SolverSemiImplicit",
    "Step",
    "Structs",
    "newton",
]


class Step(NamedTuple):
    """The arguments of ``SolverCorotated.step`` or of one of its substeps, and the array for the mean wrenches of
    contacts in the step."""

    state_in: newton.State
    state_out: newton.State
    control: newton.Control | None
    contacts: newton.Contacts | None
    dt: float
    reported: wp.array | None = None

    @property
    def first_contact(self) -> int:
        """The entry of ``reported`` for the first soft contact."""
        return 0 if self.contacts is None else int(self.contacts.rigid_contact_max)


#: The most structs that are remembered.
MOST = 8


class Structs:
    """Warp structs of the arrays of a model, of states or of contacts, made once for each of those that take turns.

    Args:
        struct: The struct, whose fields have Newton's names without the prefix; those that nobody has stay empty.
        prefix: The prefix.
        owners: Objects like those that will be given.
        values: Values of other fields.
    """

    def __init__(self, struct: Any, prefix: str, *owners: Any, **values: Any):
        self._struct, self._values, self._made = struct, values, dict[tuple, Any]()
        names = {
            field: (place, name)
            for field in struct.vars
            for place, owner in reversed(list(enumerate(owners)))
            for name in (field, prefix + field)
            if field not in values and hasattr(owner, name)
        }
        self._fields, self._places = list(names), list(names.values())

    def __call__(self, *owners: Any) -> Any:
        arrays = tuple(getattr(owners[place], name) for place, name in self._places)
        if arrays not in self._made:
            if len(self._made) == MOST:
                self._made.clear()
            self._made[arrays] = made = self._struct()
            fields = zip(self._fields, arrays, strict=True)
            for name, value in [*fields, *self._values.items()]:
                if value is not None:
                    setattr(made, name, value)
        return self._made[arrays]
