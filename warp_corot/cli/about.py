"""The description of a run in its stage."""

from __future__ import annotations

import argparse
import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .bodies import RunBody

#: Replacement for bytes that are not UTF-8, which USD's strings must be.
_ERRORS = "backslashreplace"


def about(args: argparse.Namespace, bodies: Sequence[RunBody]) -> dict[str, Any]:
    """The command, its run file if any, and for each body its input's name and hash, its supports and its loads; for
    the layer's custom data.

    Args:
        args: The command's arguments.
        bodies: The bodies that it simulates.
    """
    said: dict[str, Any] = {"command": _text(getattr(args, "command_line", "warp-corot simulate"))}
    if args.input.lower().endswith(".toml"):
        said |= {"runFile": _text(args.input), "run": _text(Path(args.input).read_text(encoding="utf-8"))}
    return said | {f"body{number}": _of_body(body) for number, body in enumerate(bodies, start=1)}


def _of_body(body: RunBody) -> dict[str, Any]:
    subject, args = body.subject, body.args
    said = {"name": _text(subject.name), "input": _text(args.input), "held": body.held.words}
    if subject.source is not None:
        said["inputSha256"] = _hash(subject.source)
    for name in ("scale", "unit"):
        if getattr(args, name, None) is not None:
            said[name] = getattr(args, name)
    loads = "; ".join(map(str, body.loads))
    return said | ({"loads": _text(loads)} if loads else {})


def _hash(path: Path) -> str:
    """SHA-256 of a file; for a folder, of the names and contents of its files in order."""
    if not path.is_dir():
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    digest = hashlib.sha256()
    for inside in sorted(each for each in path.rglob("*") if each.is_file()):
        digest.update(str(inside.relative_to(path)).encode(errors=_ERRORS) + bytes.fromhex(_hash(inside)))
    return digest.hexdigest()


def _text(text: str) -> str:
    return text.encode("utf-8", errors=_ERRORS).decode("utf-8")
