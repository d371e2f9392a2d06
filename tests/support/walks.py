"""Follows a user's values from file to file, to the kernels that get them: ``python tests/support/walks.py``. A file
counts if a variable of one of its functions holds the value, or a number made of it. A move from one file to another
counts once; it is a return if the other file was left before. Prints for each word the files entered, the returns, and
the files in the order of their first entry."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

import warp_corot as wc

ROOT = Path(wc.__file__).parent
YOUNG, POISSON, DT = 12345.678, 0.31, 1.2345e-6
WORDS = ("young", "dt", "rotation_level", "body")
LAME = (YOUNG / (2 + 2 * POISSON), YOUNG * POISSON / ((1 + POISSON) * (1 - 2 * POISSON)))


class Level(int):
    """A number that can be recognised again."""


def holds_number(value: Any, wanted: tuple[float, ...]) -> bool:
    """Whether a value is one of some numbers, or an array or struct that begins with one."""
    if isinstance(value, wp.array):
        if not value.size or value.dtype not in (wp.float32, wp.float64) or not value.ptr:
            return False
        value = value.numpy()
    if isinstance(value, np.ndarray):
        if not value.size or value.dtype.kind != "f":
            return False
        value = value.flat[0]
    if isinstance(value, float | np.floating):
        return any(abs(value - number) <= 1e-6 * number for number in wanted)
    return False


def parts_of(value: Any) -> list[Any]:
    """The parts of a value, if it is a list or a struct of Warp's."""
    if isinstance(value, list | tuple):
        return [part for each in value for part in (each, *parts_of(each))]
    if type(value).__name__ == "StructInstance" or hasattr(value, "_cls"):
        names = getattr(getattr(value, "_cls", None), "vars", {})
        return [part for name in names for part in (getattr(value, name), *parts_of(getattr(value, name)))]
    return []


def walk(call: Callable[[], None], is_it: Callable[[Any], bool]) -> list[str]:
    """The files in which something is held while a function runs, as they are entered; kernels' when launched."""
    entered: list[str] = []

    def enter(name: str) -> None:
        if not entered or entered[-1] != name:
            entered.append(name)

    def see(frame: Any, event: str, _: Any) -> None:
        path = Path(frame.f_code.co_filename)
        if event in ("call", "return") and ROOT in path.parents and "kernels" not in path.parts:
            values = list(frame.f_locals.values())
            if any(is_it(value) for value in (*values, *parts_of(values))):
                enter(str(path.relative_to(ROOT)))

    launch = wp.launch

    def launched(kernel: wp.Kernel, *args: Any, **options: Any) -> Any:
        sys.setprofile(None)
        given = [*args, *options.values()]
        if any(is_it(value) for value in parts_of(given)):
            enter(kernel.func.__module__.removeprefix("warp_corot.").replace(".", "/") + ".py")
        done = launch(kernel, *args, **options)
        sys.setprofile(see)
        return done

    wp.launch = launched
    sys.setprofile(see)
    try:
        call()
    finally:
        sys.setprofile(None)
        wp.launch = launch
    return entered


def walks(words: Iterable[str] = WORDS) -> dict[str, list[str]]:
    """The files in which Young's modulus, a time step, a level of rotations and a body are held, from making a body and
    a simulation to a few steps on the CPU."""
    mesh = wc.TetForest.box((1, 1, 2), 0.1, 6)

    def body() -> wc.SoftBody:
        return wc.SoftBody(mesh, wc.Isotropic(YOUNG, POISSON, 1000.0), device="cpu")

    def simulate(made: wc.SoftBody, rotation_level: int | None = None) -> None:
        model, integrator = wc.Corotated(rotation_level=rotation_level), wc.SymplecticEuler(DT)
        wc.Simulation(made, model=model, integrator=integrator).advance(4 * DT)

    simulate(body())  # modules are loaded and kernels compiled
    given = body()
    ways: dict[str, tuple[Callable[[], None], Callable[[Any], bool]]] = {
        "young": (lambda: simulate(body()), lambda value: holds_number(value, (YOUNG, *LAME))),
        "dt": (lambda: simulate(body()), lambda value: holds_number(value, (DT,))),
        "rotation_level": (lambda: simulate(body(), Level(5)), lambda value: isinstance(value, Level)),
        "body": (lambda: simulate(given), lambda value: value is given),
    }
    return {word: walk(*ways[word]) for word in words}


def files_and_returns(entered: list[str]) -> tuple[list[str], int]:
    """The files as they are entered first, and the number of returns."""
    files = list(dict.fromkeys(entered))
    return files, len(set(pairwise(entered))) - len(files) + 1


def main() -> None:
    wp.config.quiet = True
    for word, entered in walks().items():
        files, returns = files_and_returns(entered)
        print(f"{word}: {len(files)} files, {returns} returns\n  " + " → ".join(files))


if __name__ == "__main__":
    main()
