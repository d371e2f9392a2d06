"""OpenUSD put to the test: a binary stage that is damaged can hang it or end its process."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

from numpy.typing import NDArray
from pxr import Tf, Usd

from .quiet import USD_MEMORY, bounded
from .usd import usd_name

#: Where memory is overwritten a first reading may end well, and the next one not.
READINGS = 2


def read(path: Path) -> dict[str, NDArray[Any]]:
    """Reads all that the first frame of a stage shows, and tells nothing: what OpenUSD complains of, it will complain
    of again to the process that asked."""
    with bounded(path, USD_MEMORY), suppress(Tf.ErrorException, UnicodeDecodeError):
        for _ in range(READINGS):
            stage = Usd.Stage.Open(usd_name(path))
            for prim in stage.Traverse(Usd.TraverseInstanceProxies()):
                for attribute in prim.GetAttributes():
                    attribute.Get()
                    attribute.Get(Usd.TimeCode.EarliestTime())
            del stage
    return {}
