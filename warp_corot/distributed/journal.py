"""The journal of a sweep: a line of JSON for each finished run, on the disk before the next one is noted."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from warp_corot.errors import InputError

Row = dict[str, Any]


def key_of(run: Mapping[str, Any]) -> str:
    """The name of a run: its parameters, in any order."""
    return json.dumps(dict(run), sort_keys=True)


class Journal:
    """Rows of runs, kept in a folder.

    Args:
        folder: The folder, made if necessary; None: rows are kept in memory only.

    Raises:
        InputError: The folder or its journal cannot be written to, or the journal is of another kind.
    """

    NAME = "runs.jsonl"

    def __init__(self, folder: Path | None):
        self._rows: dict[str, Row] = {}
        self._path = None if folder is None else folder / self.NAME
        if self._path is None:
            return
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._path.touch()
            data = self._path.read_bytes()
        except OSError as error:
            raise InputError(f"{self._path}: {error.strerror or error}") from None
        whole, _, torn = data.rpartition(b"\n")
        for number, line in enumerate(whole.splitlines(), start=1):
            try:
                found = json.loads(line)
                self._rows[key_of(found["parameters"])] = found["row"]
            except (ValueError, KeyError, TypeError):
                raise InputError(f"{self._path}, line {number}: is no line of a sweep's journal") from None
        if torn:  # a sweep was ended within a line
            os.truncate(self._path, len(data) - len(torn))

    def is_done(self, run: Mapping[str, Any]) -> bool:
        """Whether a run has succeeded."""
        return self._rows.get(key_of(run), {"error": "not made"})["error"] == ""

    def row(self, run: Mapping[str, Any]) -> Row:
        """The row of a run."""
        return self._rows[key_of(run)]

    def note(self, run: Mapping[str, Any], row: Row) -> None:
        """Keep the row of a run; it is on the disk when the call returns.

        Raises:
            OSError: It cannot be written, for example because the disk is full.
        """
        self._rows[key_of(run)] = row
        if self._path is not None:
            with self._path.open("a", encoding="utf-8") as file:
                file.write(json.dumps({"parameters": dict(run), "row": row}) + "\n")
                file.flush()
                os.fsync(file.fileno())
