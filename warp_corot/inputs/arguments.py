"""Names that are not known, arguments that do not fit, and attributes of wrapped objects."""

from __future__ import annotations

import difflib
import functools
import inspect
from collections.abc import Callable, Iterable
from operator import attrgetter
from typing import Any, TypeVar

from warp_corot.errors import InputError


def meant(name: str, known: Iterable[str]) -> str:
    """The words " (did you mean NAME?)" if a known name is similar, else none; case does not matter."""
    lower = {each.lower(): each for each in known}
    near = difflib.get_close_matches(name.lower(), lower, n=1, cutoff=0.6)
    return f" (did you mean {lower[near[0]]}?)" if near else ""


C = TypeVar("C")


def forwards(to: str, *names: str) -> Callable[[type[C]], type[C]]:
    """Decorate a class whose attributes of these names are those of its attribute ``to``."""

    def decorate(cls: type[C]) -> type[C]:
        for name in names:
            setattr(cls, name, property(attrgetter(f"{to}.{name}")))
        return cls

    return decorate


@functools.cache
def explained(found: Any) -> Any:
    """A class whose constructors, class methods included, name their arguments in one line if a call does not fit;
    anything else as it is. It is the same class: types, signatures and docstrings do not change."""
    if isinstance(found, type) and not issubclass(found, BaseException):
        if inspect.isfunction(found.__init__):
            found.__init__ = _checked(found.__init__, "")  # type: ignore[method-assign]
        for name, member in list(vars(found).items()):
            if isinstance(member, classmethod) and not name.startswith("_"):
                setattr(found, name, classmethod(_checked(member.__func__, f".{name}")))
    return found


def _checked(function: Callable[..., Any], suffix: str) -> Callable[..., Any]:
    @functools.wraps(function)
    def called(*args: Any, **options: Any) -> Any:
        try:
            return function(*args, **options)
        except TypeError:
            signature = inspect.signature(function)
            try:
                signature.bind(*args, **options)
            except TypeError as misfit:
                said = str(misfit)
            else:
                raise
        _own, *known = (each.replace(annotation=inspect.Parameter.empty) for each in signature.parameters.values())
        name = (args[0] if suffix else type(args[0])).__name__ + suffix
        names = [each.name for each in known]
        likely = next((meant(each, names) for each in options if each not in names), "")
        right = signature.replace(parameters=known, return_annotation=inspect.Signature.empty)
        raise InputError(f"{name}: {said}{likely}; it must be {name}{right}")

    return called
