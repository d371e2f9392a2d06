"""Adds a run of kernels.py to the history of this project's speed, and writes the history as a page.

    python benchmarks/kernels.py --device cuda:0 --json kernels.json
    python benchmarks/history.py kernels.json [--commit HASH] [--date YYYY-MM-DD]

``history.jsonl`` has a line for each run: its date, its commit (the one that is checked out, unless another is named),
the card, the versions, and the throughput of whole forces and whole steps. ``history.md`` is the table of all lines;
without a run the script only writes this page again.
"""

import argparse
import datetime
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
#: Columns of the page: the stage and the variant of a row in a report, and the head.
COLUMNS = {
    "whole force: corotated, own rotations": "force, own rotations",
    "whole force: corotated, rotations 3 up": "three levels up",
    "whole force: corotated, general mesh": "general tetrahedra",
    "whole step: corotated, own rotations": "step of a given length",
    "whole step: the same, the step follows the state": "that follows the state",
    "whole step: 1024 of the paper's beams": "1024 beams",
}
HEAD = """# History of the speed

Billions of tetrahedra a second, of the cube that [benchmarks](README.md#how-it-is-measured) describes; a dash for what
was not measured. Each line is one run. Compare lines of the same card only, and remember that other machines of the
same kind differ by some per cent. `benchmarks/history.py` adds lines; the first four are the figures that these commits
published in [All figures](README.md).

"""


def entry(report: Any, commit: str, date: str) -> dict[str, Any]:
    """The line for a report of kernels.py.

    Raises:
        ValueError: It is no such report.
    """
    try:
        found = {f"{row['stage']}: {row['variant']}": round(float(row["gtet_per_s"]), 4) for row in report["rows"]}
        about = {name: report[name] for name in ("name", "warp", "warp_corot", "tets")}
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"it lacks {error}") from None
    kept = {name: value for name, value in found.items() if name.startswith("whole ")}
    if not kept.keys() & COLUMNS.keys():
        raise ValueError("it has no whole force and no whole step")
    return {"date": date, "commit": commit, **about, "gtet_per_s": kept}


def page(lines: list[dict[str, Any]]) -> str:
    """The history in Markdown, the newest run first."""
    heads = ["date", "commit", "card", "tetrahedra", *COLUMNS.values()]
    rows = [heads, ["---"] * 3 + ["---:"] * (len(heads) - 3)]
    for line in sorted(reversed(lines), key=lambda line: line["date"], reverse=True):
        values = [figure(line["gtet_per_s"].get(name)) for name in COLUMNS]
        rows.append([line["date"], f"`{line['commit']}`", line["name"], f"{line['tets']:,}", *values])
    return HEAD + "\n".join(f"| {' | '.join(row)} |" for row in rows) + "\n"


def figure(value: float | None) -> str:
    return "–" if value is None else f"{value:.1f}" if value >= 10.0 else f"{value:.3g}"


def checked_out() -> str:
    """The commit of the code.

    Raises:
        ValueError: There is none, or files differ from it.
    """
    told = "name the commit that was measured: --commit HASH"
    git = ["git", "-C", str(HERE.parent)]
    try:
        changed = subprocess.run(
            [*git, "status", "--porcelain", "--", "kernels", "warp_corot", "benchmarks/*.py"],
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        commit = subprocess.run([*git, "rev-parse", "--short=8", "HEAD"], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        raise ValueError(f"this is no checkout of Git; {told}") from None
    if changed:
        raise ValueError(f"the code differs from the commit that is checked out; {told}")
    return commit.stdout.strip()


def main() -> int:
    of = argparse.ArgumentParser(prog="history.py", description=__doc__.splitlines()[0])
    of.add_argument("run", type=Path, nargs="?", help="what kernels.py --json wrote")
    of.add_argument("--commit", help="the commit that was measured (default: the one that is checked out)")
    of.add_argument("--date", type=datetime.date.fromisoformat, default=datetime.date.today(), help="of the run")
    of.add_argument("--folder", type=Path, default=HERE, help="where history.jsonl and history.md are")
    options = of.parse_args()
    history = options.folder / "history.jsonl"
    try:
        text = history.read_text(encoding="utf-8") if history.exists() else ""
        if options.run is not None:
            report = json.loads(options.run.read_text(encoding="utf-8"))
            text += json.dumps(entry(report, options.commit or checked_out(), str(options.date))) + "\n"
        table = page([json.loads(line) for line in text.splitlines()])
        for path, content in ((history, text), (options.folder / "history.md", table)):
            draft = path.with_name(path.name + ".part")
            draft.write_text(content, encoding="utf-8")
            draft.replace(path)
    except (OSError, ValueError) as error:
        print(f"history.py: error: {options.run or history}: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
