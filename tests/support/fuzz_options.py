"""Random option lists: commands that nobody would type, or nearly."""

from __future__ import annotations

import argparse
from functools import cache

import numpy as np

#: Text that is typed in full length is repeated in the error message.
LONG_WORD = "x" * 2000
_WORDS = """0 1 -1 2 12 300 1e-3 nan inf -inf 1e400 2147483648 99999999999999999999 x mm cm m inch 5kPa 5furlong 1e-300m
3mm 500ms 1.06g/cm3 0.2:0.4 200 -200:300 200: 9:1 linear corotated warp:bunny warp: box no.stl seed.ply seed.nii
seed.vtk seed.usda run.toml bad.toml . / out.usd out.usda other.usd out.vtu out.pvd a.png a.gif out.csv
nowhere/a.usd nowhere/a.csv nowhere/ cpu cuda:9 auto none all bottom top left left+top 1/0<x (((( z<zmin+.01 - -- @run
NAME=z<0 a=bottom a=a b=nearest(0,0,0,9) 0,0,0 5kPa:0.45 5kPa:0.6 5kPa:0.45:1000:1 liver=3kPa:0.45 2=3kPa:0.45
2=3kPa:0.45,7=1e4:.3 liver@2=3kPa,bone@7=1GPa:.3 = ,, x=y=z material region tissue nodes,stress hypot(x,y)<1
ball(0,0,0,1) box(0,0,0,1,1,1) nearest(0,0,0,5)"""
WORDS = [*_WORDS.split(), "", "z < 0", "z <", "0 0 0", "0.01 0 0", "not x", "\u00e4", LONG_WORD, "x > 0 and y > 0"]
#: Files that lists name: they must exist.
FILES = ("ply", "nii", "vtk-4", "usda", "run")
INPUTS = ["box", "run.toml", "none.stl", "none.toml", "warp:nobody", ""]
INPUTS += ["seed.ply", "seed.nii", "seed.vtk", "seed.usda"]


@cache
def _options(command: str) -> list[argparse.Action]:
    from warp_corot.cli import make_parser

    choices = next(action.choices for action in make_parser()._actions if isinstance(action.choices, dict))
    return [a for a in choices[command]._actions if a.option_strings and "--help" not in a.option_strings]


def random_options(rng: np.random.Generator) -> list[str]:
    """The words of a command."""
    command = str(rng.choice(["simulate"] * 8 + ["scene"]))
    line = [command]
    if rng.random() < 0.95:
        line.append("scene.usda" if command == "scene" and rng.random() < 0.7 else str(rng.choice(INPUTS)))
    if rng.random() < 0.95:
        line += ["-o", "out.usd"]
    if command == "simulate" and rng.random() < 0.6:
        line += ["--tets", "300"]
    options = _options(command)
    for _ in range(rng.integers(0, 5)):
        line += _option(options[rng.integers(len(options))], rng)
    if rng.random() < 0.1:
        line.insert(int(rng.integers(len(line) + 1)), _word(rng))
    return line


def _option(action: argparse.Action, rng: np.random.Generator) -> list[str]:
    count = action.nargs if isinstance(action.nargs, int) else 1
    if rng.random() < 0.1:
        count = max(count + int(rng.integers(-1, 2)), 0)
    choices = list(action.choices or [])
    values = [str(rng.choice(choices)) if choices and rng.random() < 0.7 else _word(rng) for _ in range(count)]
    option = str(rng.choice(action.option_strings))
    return [f"{option}={values[0]}"] if len(values) == 1 and rng.random() < 0.2 else [option, *values]


def _word(rng: np.random.Generator) -> str:
    if rng.random() < 0.25:
        return f"{rng.choice([-1, 1, 1, 1]) * 10 ** rng.uniform(-4, 4):.3g}"
    return WORDS[rng.integers(len(WORDS))]
