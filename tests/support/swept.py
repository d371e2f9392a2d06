"""Functions for sweeps, which other processes find here."""

import os
import signal
from pathlib import Path


def product(a: float, b: float, folder: str) -> dict[str, float]:
    """Note the call, and multiply."""
    with open(Path(folder) / "calls.txt", "a") as calls:
        calls.write(f"{a} {b}\n")
    return {"product": a * b, "sum": a + b}


def deadly(a: float, b: float, folder: str) -> dict[str, float]:
    """The first call with a = 2 and b = 1 kills its process."""
    mark = Path(folder) / "killed"
    if (a, b) == (2, 1) and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return product(a, b, folder)


def failing(a: float, folder: str) -> float:
    """Fails for a = 2 until the cause is removed."""
    if a == 2 and not (Path(folder) / "right").exists():
        raise ValueError("a is two")
    return a


def side_by_side(a: list[float], b: list[float], folder: list[str]) -> dict[str, list[float]]:
    """All products in one call; it fails if an a is 3 beside others."""
    with open(Path(folder[0]) / "calls.txt", "a") as calls:
        calls.write(f"{len(a)}\n")
    if 3 in a and len(a) > 1:
        raise ValueError("three stands alone")
    return {"product": [x * y for x, y in zip(a, b, strict=True)]}
