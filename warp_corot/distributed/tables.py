"""Tables of a sweep's parameters and results, and a picture of them."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from warp_corot.io.files.whole import written_whole

from .journal import Row

#: Maximum number of columns that are drawn.
MOST_DRAWN = 6


def write_tables(rows: Sequence[Row], parameters: Sequence[str], folder: Path) -> list[Path]:
    """Write ``table.csv``; with pyarrow ``table.parquet``; with matplotlib ``results.png``. Each is written whole.

    Args:
        rows: The rows of all runs.
        parameters: Names of the parameters, which come first.
        folder: The folder.

    Returns:
        The files.
    """
    names = list(dict.fromkeys([*parameters, *(name for row in rows for name in row)]))
    names = [name for name in names if name not in ("seconds", "error")] + ["seconds", "error"]
    written = [folder / "table.csv"]
    with written_whole(written[0]) as part, part.open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, names, restval="")
        table.writeheader()
        table.writerows(rows)
    if find_spec("pyarrow") is not None:
        import pyarrow
        import pyarrow.parquet

        columns = {name: [row.get(name) for row in rows] for name in names}
        written.append(folder / "table.parquet")
        with written_whole(written[-1]) as part:
            pyarrow.parquet.write_table(pyarrow.table(columns), part)
    results = [name for name in names if name not in (*parameters, "seconds", "error")]
    drawn = [name for name in results if all(_is_number(row.get(name)) for row in rows)][:MOST_DRAWN]
    if drawn and find_spec("matplotlib") is not None:
        written.append(folder / "results.png")
        _draw(rows, parameters, drawn, written[-1])
    return written


def _draw(rows: Sequence[Row], parameters: Sequence[str], drawn: Sequence[str], path: Path) -> None:
    """Draw each result over the first parameter, with a line for each combination of the others."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    first, others = parameters[0], parameters[1:]
    figure = Figure(figsize=(6.4, 2.6 * len(drawn)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(drawn), squeeze=False)[:, 0]
    lines = list(dict.fromkeys(tuple(row[name] for name in others) for row in rows))
    for axis, name in zip(axes, drawn, strict=True):
        for line in lines:
            of_line = [row for row in rows if tuple(row[other] for other in others) == line]
            said = ", ".join(f"{other} {value}" for other, value in zip(others, line, strict=True))
            values = np.array([row[name] for row in of_line], float)
            axis.plot([row[first] for row in of_line], values, marker=".", label=said or None)
        axis.set_ylabel(name)
    axes[-1].set_xlabel(first)
    if others and len(lines) <= 12:
        axes[0].legend(fontsize="small")
    with written_whole(path) as part:
        figure.savefig(part, format="png", dpi=120)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
