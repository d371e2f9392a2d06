"""The state of contact, for checkpoints."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import warp as wp

from warp_corot.errors import InputError

from .contacts import Contacts

#: Arrays that follow from the shapes and the meshes.
GIVEN = {"meeting", "shapes"}
#: Arrays that each simulation has for itself: of motions, of its clock, and of when to search again.
OWN = ("obstacles.", "search.", "rigid._pace.")


def kept_arrays(contacts: Contacts) -> dict[str, wp.array]:
    """All arrays that contact keeps from one step to the next, by name."""
    owners = {name: getattr(contacts, name) for name in ("search", "rigid", "pairs", "obstacles")}
    found = {
        f"{owner}.{name}": array
        for owner, thing in {"contact": contacts, **owners}.items()
        if thing is not None
        for key, value in vars(thing).items()
        if key not in GIVEN
        for name, array in _arrays_in(key, value)
    }
    return {name: array for name, array in found.items() if array.size}


def keep_again(contacts: Contacts, rooms: list[list[int]], room: int, kept: dict[str, Any]) -> None:
    """Restore the arrays of ``kept_arrays``.

    Args:
        contacts: Contact of the same bodies and obstacles.
        rooms: The former ``contacts.surface.rooms``.
        room: The former ``contacts.pairs.room``; 0 without pairs.
        kept: The arrays' values.

    Raises:
        InputError: They do not fit.
    """
    contacts.take_rooms(rooms, room)
    arrays = kept_arrays(contacts)
    for name, array in arrays.items():
        if name not in kept:
            # A file of another device may lack what each step finds again.
            continue
        values = kept[name]
        if values.shape[: array.ndim] != array.shape:
            raise InputError(f"{name} has shape {list(values.shape)}; it must begin with {list(array.shape)}")
        array.assign(values)


def take_state(contacts: Contacts, former: Contacts) -> None:
    """Go on from the forces of another simulation of the same bodies and obstacles. Obstacles keep their motion.

    Raises:
        InputError: The bodies or obstacles are others.
    """
    bodies = contacts.system.bodies
    felt = [wp.clone(body.state.contact_forces) for body in bodies]
    contacts.take_rooms(former.surface.rooms, 0 if former.pairs is None else former.pairs.room)
    for body, forces in zip(bodies, felt, strict=True):
        wp.copy(body.state.contact_forces, forces)
    arrays, others = kept_arrays(contacts), kept_arrays(former)
    for name, array in arrays.items():
        if name.startswith(OWN) and name != "obstacles.wrenches":
            continue
        if name not in others or others[name].shape != array.shape:
            raise InputError("contact is that of other bodies or obstacles")
        wp.copy(array, others[name])


def _arrays_in(name: str, value: Any) -> Iterator[tuple[str, wp.array]]:
    """An array, the arrays of a list, or those of a Warp struct."""
    if isinstance(value, wp.array):
        yield name, value
    elif isinstance(value, list):
        for k, each in enumerate(value):
            if isinstance(each, wp.array):
                yield f"{name}.{k}", each
    elif hasattr(value, "native_name"):
        fields = [field for kind in type(value).__mro__ for field in getattr(kind, "__annotations__", {})]
        for field in fields:
            yield from _arrays_in(f"{name}.{field}", getattr(value, field))
