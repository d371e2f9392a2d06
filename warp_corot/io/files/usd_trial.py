"""A trial reading with OpenUSD: a damaged binary stage can hang it or end its process."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

from numpy.typing import NDArray
from pxr import Tf, Usd

from .quiet import USD_MEMORY, bounded
from .usd import usd_name

#: If memory is overwritten, a first reading may succeed and the next one fail.
READINGS = 2


def read(path: Path) -> dict[str, NDArray[Any]]:
    """Read everything that the first frame of a stage shows, and return nothing: OpenUSD will repeat its complaints in
    the calling process."""
    with bounded(path, USD_MEMORY), suppress(Tf.ErrorException, UnicodeDecodeError):
        for _ in range(READINGS):
            stage = Usd.Stage.Open(usd_name(path))
            for prim in stage.Traverse(Usd.TraverseInstanceProxies()):
                for attribute in prim.GetAttributes():
                    attribute.Get()
                    attribute.Get(Usd.TimeCode.EarliestTime())
            del stage
    return {}
