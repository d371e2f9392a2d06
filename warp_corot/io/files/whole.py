"""Files that are written completely or not at all."""

from __future__ import annotations

import os
import tempfile
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from os import PathLike
from pathlib import Path

from warp_corot.errors import InputError


def check_output(path: str | PathLike[str], suffixes: Sequence[str] = ()) -> Path:
    """Check, before a long run, that a file can be written; returns its path.

    Raises:
        InputError: Another extension than these, a folder with this name, a folder of the file that does not exist or
            cannot be written to, or a write-protected file.
    """
    path = Path(path)
    if suffixes and path.suffix.lower() not in suffixes:
        raise InputError(f"{path}: extension {path.suffix or '(none)'}; it must be {', '.join(suffixes)}")
    if path.is_dir():
        raise InputError(f"{path}: is a folder; it must be a file name")
    folder = path.parent
    if not folder.is_dir():
        raise InputError(f"{path}: output folder {folder} {'is a file' if folder.exists() else 'does not exist'}")
    if path.exists() and not os.access(path, os.W_OK):
        raise InputError(f"{path}: is write-protected")
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(f"{path}: output folder {folder} cannot be written to ({error.strerror})") from None
    return path


class WriteError(OSError):
    """A file cannot be written; the message names it."""


@contextmanager
def writing(target: Path) -> Iterator[None]:
    """Raise errors of the system, and those of HDF5, as a `WriteError` of ``target``."""
    try:
        yield
    except WriteError:
        raise
    except (OSError, RuntimeError) as error:  # HDF5 raises both, with long texts
        number = getattr(error, "errno", None)
        raise WriteError(f"{target}: cannot be written: {os.strerror(number) if number else error}") from None


@contextmanager
def written_whole(target: Path) -> Iterator[Path]:
    """A path beside ``target``, with its extension, to write to: at the end of the block it is synced and renamed over
    ``target``.

    If an exception is raised, it is removed and ``target`` stays unchanged.

    Raises:
        WriteError: It cannot be written.
    """
    part = target.with_name(f".{target.stem}.{uuid.uuid4().hex[:8]}.part{target.suffix}")
    try:
        with writing(target):
            yield part
            sync(part)
            os.replace(part, target)
            sync(target.parent)
    finally:
        part.unlink(missing_ok=True)


def sync(path: Path) -> None:
    """Sync a file, or a folder's entries where the system can, to the disk.

    Raises:
        OSError: The file could not be written, for example because the disk is full.
    """
    try:
        descriptor = os.open(path, os.O_RDWR if os.name == "nt" and path.is_file() else os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    except OSError:
        if not path.is_dir():
            raise
