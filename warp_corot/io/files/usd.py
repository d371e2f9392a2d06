"""Rules of OpenUSD for files: names, permission to write, locks, and error messages."""

import functools
import itertools
import math
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray
from pxr import Tf, Usd, UsdGeom

from warp_corot.errors import InputError

from .quiet import USD_MEMORY, bounded, quietly
from .whole import check_output

try:
    import fcntl
except ImportError:  # Windows: two runs with the same output are not detected there
    fcntl = None  # type: ignore[assignment]

STAGE_SUFFIXES = (".usd", ".usda", ".usdc")


def usd_name(path: Path) -> str:
    """A path for OpenUSD, which takes names in UTF-8 in every locale.

    Raises:
        InputError: Its bytes are not UTF-8.
    """
    try:
        return os.fsencode(path).decode("utf-8")
    except UnicodeDecodeError:
        raise InputError(f"{path}: its name is not UTF-8; names of OpenUSD files must be") from None


def open_stage(path: Path) -> Any:
    """Open the stage of a file.

    Raises:
        InputError: It is not a stage.
    """
    try:
        stage = Usd.Stage.Open(usd_name(path))
    except Tf.ErrorException as error:
        text = _text(error)
        where = re.search(rf"{re.escape(path.name)}:(\d+):\d+: ([^\n]+)", text)
        why = f": line {where[1]}: {_short(where[2].rstrip(chr(39)))}" if where else f" ({first_message(text)})"
        raise InputError(f"{path}: is not a USD file that OpenUSD can open{why}") from None
    _check_types(stage, path)
    return stage


#: Attributes that are read here. OpenUSD returns the type in the file, not that of the schema.
_READ = (
    *("points", "faceVertexCounts", "faceVertexIndices", "holeIndices", "tetVertexIndices"),
    *("orientation", "subdivisionScheme", "physics:gravityMagnitude", "physics:gravityDirection"),
)


def _check_types(stage: Any, path: Path) -> None:
    """Refuse a stage if points, faces or other attributes in use have a type other than their schema's.

    Another precision is allowed: points may be double.
    """
    for prim in stage.Traverse(Usd.TraverseInstanceProxies()):
        for name in _READ:
            attribute, definition = prim.GetAttribute(name), prim.GetPrimDefinition().GetAttributeDefinition(name)
            if not definition or not attribute.HasAuthoredValue():
                continue
            value, due = first_value(attribute), definition.GetTypeName()
            if value is not None and not _is_of(value, due):
                raise InputError(f"{path}: {attribute.GetPath()} must be of type {due}; its values are of another type")


def _is_of(value: Any, due: Any) -> bool:
    """Whether a value is of a type's kind (numbers, whole numbers, text), dimension and rank."""
    wanted = np.asarray(due.scalarType.defaultValue)
    found = np.asarray(value)
    kinds = {"f": "fiu", "i": "iu"}.get(wanted.dtype.kind, wanted.dtype.kind)
    if due.isArray and not found.size:
        return found.ndim > 0
    rank = wanted.ndim + int(due.isArray)
    return found.ndim == rank and found.shape[rank - wanted.ndim :] == wanted.shape and found.dtype.kind in kinds


def free_name(name: str, taken: set[str]) -> str:
    """The name, or with the first number from 2 on that makes it none of those taken; it is taken then."""
    numbered = (f"{name}_{count}" for count in itertools.count(2))
    found = name if name not in taken else next(each for each in numbered if each not in taken)
    taken.add(found)
    return found


def first_value(attribute: Any) -> Any:
    """The default value of an attribute or a primvar, else its first time sample; None without one."""
    value = attribute.Get()
    return attribute.Get(Usd.TimeCode.EarliestTime()) if value is None else value


def in_world(prim: Any, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points [N, 3] of a prim in the world, in the stage's unit, at its first time."""
    world = world_matrix(prim)
    return points @ world[:3, :3] + world[3, :3]


def world_matrix(prim: Any, time: Usd.TimeCode | None = None) -> NDArray[np.float64]:
    """From a prim's space to the world, for row vectors, float64 [4, 4]; None: at the first time."""
    cache = UsdGeom.XformCache(Usd.TimeCode.EarliestTime() if time is None else time)
    return np.array(cache.GetLocalToWorldTransform(prim), dtype=np.float64)


P = ParamSpec("P")
R = TypeVar("R")


def reads_stage(read: Callable[Concatenate[Path, P], R]) -> Callable[Concatenate[Path, P], R]:
    """Make a function that reads a file, its first argument, raise one line if OpenUSD finds the file damaged."""

    @functools.wraps(read)
    def reading(path: Path, *args: P.args, **kwargs: P.kwargs) -> R:
        try:
            with quietly(), bounded(path, USD_MEMORY):
                return read(path, *args, **kwargs)
        except Tf.ErrorException as error:
            raise InputError(f"{path}: is damaged: {first_message(_text(error))}") from None
        except UnicodeDecodeError:
            raise InputError(f"{path}: is damaged: it has text that is not UTF-8") from None

    return reading


def _text(error: Tf.ErrorException) -> str:
    try:
        return str(error)
    except UnicodeDecodeError:  # OpenUSD quotes the file's bytes
        return " : 'it has text that is not UTF-8'"


def first_message(text: str) -> str:
    """The first error in OpenUSD's many lines, without the place in its code."""
    found = re.search(r" : '([^\n]*)'", text)
    return _short(found[1] if found else " ".join(text.split()) or "unknown reason")


def _short(text: str) -> str:
    return text if len(text) <= 200 else f"{text[:197]}..."


def metres_per_unit(stage: Any, path: Path) -> float:
    """Length of a stage's unit [m].

    Raises:
        InputError: Not a positive number.
    """
    metres = float(UsdGeom.GetStageMetersPerUnit(stage))
    if not (math.isfinite(metres) and metres > 0.0):
        raise InputError(f"{path}: metersPerUnit is {metres}; it must be a positive number")
    return metres


def check_stage_path(path: Path) -> None:
    """Check, before a simulation, that its result can be written.

    Raises:
        InputError: Another extension or a name that OpenUSD cannot take, a folder with this name, an output folder that
            does not exist or is not writable, or a write-protected file.
    """
    usd_name(path)
    check_output(path, STAGE_SUFFIXES)


def take_lock(lock: int) -> None:
    """Lock an open file until it is closed or the process ends.

    Raises:
        OSError: Another process has the lock, or the file system has no locks (some network ones).
    """
    if fcntl:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)


def is_locked(lock: Path) -> bool:
    """Whether a living process holds a lock file; the system frees the locks of dead ones."""
    try:
        with lock.open("r+") as file:
            take_lock(file.fileno())
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False


def reason(error: Tf.ErrorException) -> str:
    """The operating system's message from OpenUSD's many lines."""
    found = re.search(r"Error occurred (?:writing|opening) file: ([^'\n]+)", str(error))
    if found:
        return found.group(1).strip()
    lines = [line for line in str(error).splitlines() if line.strip()]
    return " ".join((lines or ["unknown reason"])[0].split())
