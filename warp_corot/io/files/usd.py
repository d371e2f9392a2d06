"""Files as OpenUSD takes them: their names, whether one may be written, who is writing it, and what went wrong."""

import functools
import math
import os
import re
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, TypeVar

from pxr import Tf, Usd, UsdGeom

from warp_corot.errors import InputError

from .isolated import read_isolated
from .quiet import USD_MEMORY, bounded, quietly

try:
    import fcntl
except ImportError:  # Windows: two runs on one output are not told apart there
    fcntl = None  # type: ignore[assignment]

STAGE_SUFFIXES = (".usd", ".usda", ".usdc")


def usd_name(path: Path) -> str:
    """A path for OpenUSD, which takes names as UTF-8 whatever the locale is.

    Raises:
        InputError: Its bytes are not UTF-8.
    """
    try:
        return os.fsencode(path).decode("utf-8")
    except UnicodeDecodeError:
        raise InputError(f"{path}: its name is not UTF-8, which OpenUSD files must have") from None


def open_stage(path: Path) -> Any:
    """The stage of a file.

    Raises:
        InputError: Not one, or a binary one on which OpenUSD crashes or does not come to an end.
    """
    if _is_binary(path):
        about = path.stat()
        reason = _trial(path, about.st_size, about.st_mtime_ns)
        if reason:
            raise InputError(f"{path}: is not a USD file that OpenUSD can open ({reason})")
    try:
        return Usd.Stage.Open(usd_name(path))
    except Tf.ErrorException as error:
        text = _text(error)
        where = re.search(rf"{re.escape(path.name)}:(\d+):\d+: ([^\n]+)", text)
        why = f": line {where[1]}: {_short(where[2].rstrip(chr(39)))}" if where else f" ({first_message(text)})"
        raise InputError(f"{path}: is not a USD file that OpenUSD can open{why}") from None


def _is_binary(path: Path) -> bool:
    """Whether a file is a crate or a package, by its beginning."""
    with path.open("rb") as file:
        return file.read(8).startswith((b"PXR-USDC", b"PK"))


@functools.lru_cache(maxsize=64)
def _trial(path: Path, size: int, written: int) -> str | None:
    """Why a stage is not to be opened in this process, if so; files are told apart by size and time, too."""
    return read_isolated(f"{__package__}.usd_trial", path)[1]


P = ParamSpec("P")
R = TypeVar("R")


def reads_stage(read: Callable[Concatenate[Path, P], R]) -> Callable[Concatenate[Path, P], R]:
    """Have a function that reads a file, its first argument, end in one line if OpenUSD finds it damaged on the way."""

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
    except UnicodeDecodeError:  # OpenUSD quotes the file as it is
        return " : 'it has text that is not UTF-8'"


def first_message(text: str) -> str:
    """What went wrong first by OpenUSD's many lines, without where in its code."""
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
        raise InputError(f"{path}: metersPerUnit is {metres}, should be a positive number")
    return metres


def check_stage_path(path: Path) -> None:
    """Says before the simulation begins what would stop its result from being written.

    Raises:
        InputError: Another extension or a name that OpenUSD cannot take, a folder in the way, an output folder that is
            not there or not writable, or a write-protected file.
    """
    if path.suffix.lower() not in STAGE_SUFFIXES:
        raise InputError(f"{path}: extension {path.suffix or '(none)'}, should be {', '.join(STAGE_SUFFIXES)}")
    usd_name(path)
    if path.is_dir():
        raise InputError(f"{path}: is a folder, should be a file name")
    folder = path.parent
    if not folder.is_dir():
        raise InputError(f"{path}: output folder {folder} {'is a file' if folder.exists() else 'is not there'}")
    if path.exists() and not os.access(path, os.W_OK):
        raise InputError(f"{path}: is write-protected")
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(f"{path}: output folder {folder} cannot be written to ({error.strerror})") from None


def take_lock(lock: int) -> None:
    """Lock an open file until it is closed or the process ends.

    Raises:
        OSError: Somebody else has it, or the file system (some network ones) has no locks.
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
    """The operating system's own words out of OpenUSD's many lines."""
    found = re.search(r"Error occurred (?:writing|opening) file: ([^'\n]+)", str(error))
    if found:
        return found.group(1).strip()
    lines = [line for line in str(error).splitlines() if line.strip()]
    return " ".join((lines or ["unknown reason"])[0].split())
