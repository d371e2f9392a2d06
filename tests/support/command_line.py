"""The command line as tests call it."""

import csv
from pathlib import Path

import numpy as np
import warp as wp

from warp_corot.cli import main

SHORT = ["--duration", "0.05", "--fps", "40", "--device", "cpu"]


def run(*args: object) -> int:
    """The exit status of a command; Warp's settings are restored."""
    before = wp.config.log_level
    try:
        return main([*map(str, args)])
    except SystemExit as left:  # argparse's way
        return left.code
    finally:
        wp.config.log_level = before


def simulate(*args: object) -> int:
    return run("simulate", *args)


def lines_of(err: str) -> list[str]:
    """The lines on stderr but for the one about compiling, which depends on what ran before."""
    return [line for line in err.splitlines() if "compiling kernels" not in line]


def assert_refused(folder: Path, capsys, said: str, *args: object) -> None:
    """The error is one line on stderr and status 2, and no file is touched."""
    before = {file.name: file.read_bytes() for file in folder.iterdir()}
    assert simulate(*args) == 2
    out, err = capsys.readouterr()
    assert out == ""
    (error,) = lines_of(err)
    assert error.startswith("warp-corot: error: ")
    assert said in error
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == before


def table(path: str | Path) -> dict[str, np.ndarray]:
    """The columns of a table that --csv wrote, by name."""
    with Path(path).open() as file:
        header, *rows = csv.reader(file)
    return dict(zip(header, np.array(rows, float).T, strict=True))
