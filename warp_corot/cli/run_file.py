"""Run files: TOML files whose keys are the names of ``simulate``'s options."""

from __future__ import annotations

import argparse
import json
import os
import tomllib
from collections.abc import Callable, Iterable, Sequence
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from typing import Any

from warp_corot.errors import InputError
from warp_corot.io.files.whole import written_whole

from .options import LOADS, OF_THE_RUN, RUN, Option, options_of
from .patches import Load, value_of

#: Keys in tables of loads, besides times and shares.
VALUES = {"pull": "by", "twist": "degrees", "press": "pressure"}


def bodies_of(args: argparse.Namespace) -> list[argparse.Namespace]:
    """The options of each body: the command's, or the run file's with the command's added.

    Raises:
        InputError: No such file, not TOML, or a key that is not an option.
    """
    if not args.input.lower().endswith(".toml"):
        return [args]
    path = Path(args.input)
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as text ({error})") from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: is not TOML: {error}") from None
    tables = data.pop("body", [{}])
    if not isinstance(tables, list) or not tables or not all(isinstance(table, dict) for table in tables):
        raise InputError(f"{path}: 'body' must be tables, each below a line [[body]]")
    for key in (key for table in tables for key in table if key in OF_THE_RUN):
        raise InputError(f"{path}: {key!r} is for the whole run; it must stand above the first [[body]]")
    asked = {name: getattr(args, name) for name, option in known().items() if getattr(args, name) != option.default}
    del asked["input"]
    return [_body_of({**data, **table}, asked, path) for table in tables]


def write_run(path: Path, bodies: Sequence[argparse.Namespace]) -> None:
    """Write a run file, completely or not at all.

    Raises:
        OSError: It cannot be written.
        InputError: A value that TOML cannot hold.
    """
    folder = path.parent
    if len(bodies) == 1:
        lines = _lines(bodies[0], known(), folder)
    else:
        lines = _lines(bodies[0], OF_THE_RUN, folder)
        own = [name for name in known() if name not in OF_THE_RUN]
        for body in bodies:
            lines += ["", "[[body]]", *_lines(body, own, folder)]
    try:
        text = "\n".join(lines) + "\n"
        data = text.encode()
    except UnicodeEncodeError:
        raise InputError(f"{path}: a name in the run is not UTF-8, which TOML must be") from None
    with written_whole(path) as part:
        part.write_bytes(data)


def option_of(name: str) -> Callable[[str], Any]:
    """The function that reads the value of an option with one value.

    Raises:
        InputError: There is no such option, or it does not have one value. The function raises it for a text that the
            option does not accept.
    """
    option = known().get(name)
    if option is None or "nargs" in option.settings or not option.flags[0].startswith("-") or option.is_flag:
        raise InputError(f"--vary: {name!r} is not an option with one value; see warp-corot simulate --help")
    return lambda text: _one(option, text.strip(), "--vary")


@cache
def known() -> dict[str, Option]:
    """The options that run files may name."""
    return {option.name: option for option in options_of(RUN) if option.name != "write_run"}


def _body_of(table: dict[str, Any], asked: dict[str, Any], path: Path) -> argparse.Namespace:
    """The options in a table of the file, and those of the command line, which replace them or are added to them."""
    if "input" not in table:
        raise InputError(f"{path}: a body has no 'input'; it must have one")
    body = argparse.Namespace(**{name: option.default for name, option in known().items()}, curves=[], write_run=None)
    for key, value in table.items():
        name = key.replace("-", "_")
        if name not in known():
            likely = "".join(f", {near!r} is" for near in get_close_matches(name, known(), 1))
            raise InputError(f"{path}: {key!r} is not an option{likely}; see warp-corot simulate --help")
        option = known()[name]
        if name in LOADS and isinstance(value, list):
            body.curves += [_load(name, entry, path) for entry in value if isinstance(entry, dict)]
            value = [entry for entry in value if not isinstance(entry, dict)]

        def beside(given: Any, name: str = name) -> str:
            if not isinstance(given, str):
                raise InputError(f"{path}: {name} = {given!r} must be a name in quotation marks")
            return str(path.parent / given)

        value = _moved(option, value, beside)
        try:
            setattr(body, name, _value_of(option, value, path))
        except TypeError:
            raise InputError(f"{path}: {key} = {value!r} does not fit the option") from None
    for name, value in asked.items():
        setattr(body, name, [*(getattr(body, name) or ()), *value] if known()[name].is_list else value)
    return body


def _value_of(option: Option, value: Any, path: Path) -> Any:
    """The value of an option from that of its key.

    Raises:
        TypeError: Its type does not fit the option.
    """
    if isinstance(value, bool) and (option.is_flag or "const" in option.settings):
        return value if option.is_flag else option.settings["const"] if value else option.default
    if option.is_flag:
        raise TypeError
    count, found = option.settings.get("nargs"), []
    for entry in value if option.is_list and isinstance(value, list) else [value]:
        words = entry if isinstance(count, int) else [entry]
        if not isinstance(words, list) or any(isinstance(word, bool | list | dict) for word in words):
            raise TypeError
        if isinstance(count, int) and len(words) != count:
            raise InputError(f"{path}: argument {option.flags[-1]}: expected {count} arguments")
        read = [_one(option, str(word), path) for word in words]
        found.append(read if isinstance(count, int) else read[0])
    return (found or None) if option.is_list else found[0]


def _one(option: Option, text: str, where: object) -> Any:
    """The value in a text.

    Raises:
        InputError: The option does not accept it; the message begins with where it stands.
    """
    try:
        if text == "--":
            raise ValueError("'--' is not a value")
        value = option.settings["type"](text)
    except (argparse.ArgumentTypeError, ValueError) as error:
        raise InputError(f"{where}: argument {option.flags[-1]}: {error}") from None
    listed = option.settings.get("choices")
    if listed and value not in listed:
        raise InputError(f"{where}: argument {option.flags[-1]}: {text!r} is none of {', '.join(listed)}")
    return value


def _moved(option: Option, value: Any, place: Callable[[Any], str]) -> Any:
    """The value of an option with its paths, if it has any, at another place: in run files they are relative."""
    if option.settings.get("type") is not Path and option.name != "input":
        return value
    given = value if option.is_list and isinstance(value, list) else [value]
    is_name = option.name == "input" and isinstance(value, str) and (value == "box" or value.startswith("warp:"))
    found = [each if is_name else place(each) for each in given]
    return found if given is value else found[0]


def _load(kind: str, table: dict[str, Any], path: Path) -> Load:
    wanted = {"patch", VALUES[kind], "times", "shares", *(["axis"] if kind == "twist" else [])}
    known = ", ".join(sorted(wanted))
    if not {"patch", VALUES[kind]} <= table.keys() <= wanted or ("times" in table) != ("shares" in table):
        raise InputError(f"{path}: {kind} has {', '.join(map(str, table))}; it may have {known}, times with shares")
    try:
        given = table[VALUES[kind]]
        values = tuple(value_of(kind, str(value)) for value in (given if isinstance(given, list) else [given]))
        times, shares = (tuple(float(value) for value in table.get(name, ())) for name in ("times", "shares"))
        axis = tuple(float(value) for value in table["axis"]) if "axis" in table else None
    except InputError as error:
        raise InputError(f"{path}: {kind} of {table['patch']!r}: {error}") from None
    except (TypeError, ValueError):
        raise InputError(f"{path}: {kind} = {table!r}: a value in it is not a number; it must be one") from None
    if len(values) != LOADS[kind] or (axis is not None and len(axis) != 3):
        needed = f"{VALUES[kind]} must be {LOADS[kind]} numbers, an axis 3"
        raise InputError(f"{path}: {kind} of {table['patch']!r}: {needed}")
    return Load(kind, str(table["patch"]), values, times, shares, axis)


def _lines(body: argparse.Namespace, names: Iterable[str], folder: Path) -> list[str]:
    lines = []
    for name in names:
        option, value = known()[name], getattr(body, name)
        curves = [_table(load) for load in getattr(body, "curves", ()) if load.kind == name]
        if value == option.default and not curves:
            continue
        value = _moved(option, value, lambda one: str(one) if os.path.isabs(one) else os.path.relpath(one, folder))
        if name in LOADS:
            value = [*([patch, *map(_number, texts)] for patch, *texts in value or ()), *curves]
        lines.append(f"{option.flags[-1].lstrip('-')} = {_toml(value)}")
    return lines


def _number(text: str) -> float | str:
    """A number, or a quantity as text."""
    try:
        return float(text)
    except ValueError:
        return text


def _table(load: Load) -> dict[str, Any]:
    values: Any = list(load.values) if len(load.values) > 1 else load.values[0]
    table = {"patch": load.patch, VALUES[load.kind]: values}
    if load.times:
        table |= {"times": list(load.times), "shares": list(load.shares)}
    return table | ({"axis": list(load.axis)} if load.axis else {})


def _toml(value: Any) -> str:
    match value:
        case bool():
            return str(value).lower()
        case int() | float():
            return repr(value)
        case list() | tuple():
            return f"[{', '.join(_toml(one) for one in value)}]"
        case dict():
            return "{ " + ", ".join(f"{key} = {_toml(one)}" for key, one in value.items()) + " }"
    return json.dumps(str(value), ensure_ascii=False).replace("\x7f", "\\u007f")
