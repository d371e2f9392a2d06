"""Run files: TOML files whose keys are the names of ``simulate``'s options."""

from __future__ import annotations

import argparse
import json
import os
import tomllib
from collections.abc import Callable, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any, NoReturn

from warp_corot.errors import InputError
from warp_corot.io.files.whole import check_output, written_whole

from . import StrictParser
from .options import LOADS, OF_THE_RUN, RUN, add_options
from .patches import Load, value_of

#: Keys in tables of loads, besides times and shares.
VALUES = {"pull": "by", "twist": "degrees", "press": "pressure"}


class _Parser(StrictParser):
    """Reports errors in a file."""

    path = Path()

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{self.path}: {message}")


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
    parser, actions = _parser(path)
    asked = {name: getattr(args, name) for name, action in actions.items() if getattr(args, name) != action.default}
    del asked["input"]
    return [_body_of(parser, actions, {**data, **table}, asked, path) for table in tables]


def write_run(path: Path, bodies: Sequence[argparse.Namespace]) -> None:
    """Write a run file, completely or not at all.

    Raises:
        OSError: It cannot be written.
        InputError: A value that TOML cannot hold.
    """
    _, actions = _parser(path)
    folder = path.parent
    if len(bodies) == 1:
        lines = _lines(bodies[0], actions, folder)
    else:
        lines = _lines(bodies[0], {name: actions[name] for name in OF_THE_RUN}, folder)
        own = {name: action for name, action in actions.items() if name not in OF_THE_RUN}
        for body in bodies:
            lines += ["", "[[body]]", *_lines(body, own, folder)]
    try:
        text = "\n".join(lines) + "\n"
        data = text.encode()
    except UnicodeEncodeError:
        raise InputError(f"{path}: a name in the run is not UTF-8, which TOML must be") from None
    with written_whole(path) as part:
        part.write_bytes(data)


def check_run_path(path: Path, source: str) -> None:
    """Check, before a long run, that a run file can be written.

    Raises:
        InputError: It cannot.
    """
    check_output(path, (".toml",))
    if path.exists() and Path(source).exists() and path.samefile(source):
        raise InputError(f"{path}: is the input; it must be another file")


def option_of(name: str) -> Callable[[str], Any]:
    """The function that reads the value of an option with one value.

    Raises:
        InputError: There is no such option, or it does not have one value. The function raises it for a text that the
            option does not accept.
    """
    _, actions = _parser(Path("--vary"))
    action = actions.get(name)
    if action is None or action.nargs is not None or not action.option_strings:
        raise InputError(f"--vary: {name!r} is not an option with one value; see warp-corot simulate --help")
    kind = action.type if callable(action.type) else str

    def read(text: str) -> Any:
        try:
            return kind(text.strip())
        except (argparse.ArgumentTypeError, ValueError) as error:
            raise InputError(f"--vary: {name}: {error}") from None

    return read


def _parser(path: Path) -> tuple[_Parser, dict[str, argparse.Action]]:
    parser = _Parser(add_help=False, prog="simulate")
    parser.path = path
    add_options(parser, RUN)
    return parser, {action.dest: action for action in parser._actions if action.dest != "write_run"}


def _body_of(
    parser: _Parser, actions: dict[str, argparse.Action], table: dict[str, Any], asked: dict[str, Any], path: Path
) -> argparse.Namespace:
    """The options in a table of the file, and those of the command line, which replace them or are added to them."""
    if "input" not in table:
        raise InputError(f"{path}: a body has no 'input'; it must have one")
    body = argparse.Namespace(**{name: action.default for name, action in actions.items()}, curves=[], write_run=None)
    for key, value in table.items():
        name = key.replace("-", "_")
        if name not in actions:
            likely = "".join(f", {near!r} is" for near in get_close_matches(name, actions, 1))
            raise InputError(f"{path}: {key!r} is not an option{likely}; see warp-corot simulate --help")
        if name in LOADS and isinstance(value, list):
            body.curves += [_load(name, entry, path) for entry in value if isinstance(entry, dict)]
            value = [entry for entry in value if not isinstance(entry, dict)]
        if _is_path(actions[name]):
            several = _is_list(actions[name]) and isinstance(value, list)
            value = [_beside(one, path, name) for one in value] if several else _beside(value, path, name)
        try:
            setattr(body, name, _value_of(parser, actions[name], value))
        except TypeError:
            raise InputError(f"{path}: {key} = {value!r} does not fit the option") from None
    for name, value in asked.items():
        setattr(body, name, [*(getattr(body, name) or ()), *value] if _is_list(actions[name]) else value)
    return body


def _value_of(parser: _Parser, action: argparse.Action, value: Any) -> Any:
    """The value of an option from that of its key.

    Raises:
        TypeError: Its type does not fit the option.
    """
    if isinstance(value, bool) and action.nargs in (0, "?"):
        return value if action.nargs == 0 else action.const if value else action.default
    if action.nargs == 0:
        raise TypeError
    if _is_list(action):
        return [_read(parser, action, entry) for entry in (value if isinstance(value, list) else [value])] or None
    return _read(parser, action, value)


def _read(parser: _Parser, action: argparse.Action, value: Any) -> Any:
    """A value or values as argparse reads their texts."""
    words = value if isinstance(action.nargs, int) else [value]
    if not isinstance(words, list) or any(isinstance(word, bool | list | dict) for word in words):
        raise TypeError
    try:
        if isinstance(action.nargs, int) and len(words) != action.nargs:
            raise argparse.ArgumentError(action, f"expected {action.nargs} arguments")
        return parser._get_values(action, [str(word) for word in words])
    except argparse.ArgumentError as error:
        parser.error(str(error))


def _is_list(action: argparse.Action) -> bool:
    """Whether an option can be given several times."""
    return isinstance(action, argparse._AppendAction)


def _is_path(action: argparse.Action) -> bool:
    """Whether an option's value is a path, which is relative to the run file."""
    return action.type is Path or action.dest == "input"


def _beside(value: Any, path: Path, name: str) -> Any:
    if not isinstance(value, str):
        raise InputError(f"{path}: {name} = {value!r} must be a name in quotation marks")
    is_name = name == "input" and (value == "box" or value.startswith("warp:"))
    return value if is_name else str(path.parent / value)


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


def _lines(body: argparse.Namespace, actions: dict[str, argparse.Action], folder: Path) -> list[str]:
    lines = []
    for name, action in actions.items():
        value = getattr(body, name)
        curves = [_table(load) for load in getattr(body, "curves", ()) if load.kind == name]
        if value == action.default and not curves:
            continue
        if _is_path(action):
            several = isinstance(value, list)
            value = [_relative(str(one), folder, name) for one in (value if several else [value])]
            value = value if several else value[0]
        key = action.option_strings[-1].lstrip("-") if action.option_strings else name
        if name in LOADS:
            value = [*([patch, *map(_number, texts)] for patch, *texts in value or ()), *curves]
        lines.append(f"{key} = {_toml(value)}")
    return lines


def _relative(value: str, folder: Path, name: str) -> str:
    if os.path.isabs(value) or (name == "input" and (value == "box" or value.startswith("warp:"))):
        return value
    return os.path.relpath(value, folder)


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
