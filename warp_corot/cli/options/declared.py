"""Options declared as dataclasses: argparse, run files and the help follow from fields and docstrings.

The annotation of a field says how its option is read: ``bool`` for a flag, ``list[...]`` for an option that can be
given several times, ``tuple[...]`` for several values, ``Annotated[type, function]`` for a text that a function reads.
The field's metadata are further arguments of ``add_argument``. Its entry below "Attributes:" in the docstring of its
class, ``name (METAVARS): help``, is its help; names in braces there are values of `defaults` and `choices`.
"""

from __future__ import annotations

import argparse
import inspect
import re
from collections.abc import Callable
from dataclasses import MISSING, field, fields
from types import NoneType
from typing import Annotated, Any, get_args, get_origin, get_type_hints

from warp_corot.inputs import choices

from . import defaults

_ENTRY = re.compile(r"^    (\w+)(?: \(([^)]*)\))?: (.*(?:\n {8}.*)*)", re.MULTILINE)
_VALUES = {**vars(choices), **vars(defaults)}


def one_of(*words: str, default: str | None = None, type: Callable[[str], str] = str) -> Any:
    """A field with one of several words."""
    return field(default=default, metadata={"choices": words, "type": type})


def add_declared(parser: argparse.ArgumentParser, kind: type) -> None:
    """Add the options of a dataclass, and before them those of its base classes, the last one first, as fields are.

    The options of a class with a ``TITLE`` are a group of the help.
    """
    for part in reversed(kind.__mro__[:-1]):
        own, title = inspect.get_annotations(part), vars(part).get("TITLE")
        if own:
            _add_fields(parser.add_argument_group(title) if title else parser, part, own)


def _add_fields(group: Any, kind: Any, own: dict[str, Any]) -> None:
    hints = get_type_hints(kind, include_extras=True)
    said = {name: (metavars, text) for name, metavars, text in _ENTRY.findall(inspect.getdoc(kind) or "")}
    exclusive: Any = None
    for each in (each for each in fields(kind) if each.name in own):
        metavars, text = said.get(each.name, ("", ""))
        options = {"flags": (f"--{each.name.replace('_', '-')}",), **_read_by(hints[each.name]), **each.metadata}
        options["help"] = " ".join(text.split()).replace("%", "%%").format(**_VALUES)
        if metavars:
            options["metavar"] = tuple(metavars.split()) if isinstance(options.get("nargs"), int) else metavars
        if each.default is not MISSING:
            options["default"] = each.default
        elif options["flags"][0].startswith("-"):
            options["required"] = True
        to = group
        if options.pop("exclusive", False):
            to = exclusive = exclusive or group.add_mutually_exclusive_group()
        to.add_argument(*options.pop("flags"), **options)


def _read_by(hint: Any) -> dict[str, Any]:
    """The arguments of ``add_argument`` for an annotation."""
    kind = get_origin(hint)
    if kind is Annotated:
        return {"type": hint.__metadata__[0]}
    if kind is list:
        return {"action": "append", **_read_by(get_args(hint)[0])}
    if kind is tuple:
        return {"nargs": len(get_args(hint)), **_read_by(get_args(hint)[0])}
    if kind is not None:  # a union with None
        return _read_by(next(each for each in get_args(hint) if each is not NoneType))
    if hint is bool:
        return {"action": "store_true"}
    return {} if hint is str else {"type": hint}
