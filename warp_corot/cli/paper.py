"""``warp-corot paper``: the paper's experiment as a table, results.json and figures."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from warp_corot.errors import InputError

from .exit_status import complain, interrupt_status

if TYPE_CHECKING:
    from warp_corot.experiments.paper import Results, Settings

RESULTS = "results.json"


def run(args: argparse.Namespace) -> int:
    """Run the command; returns the exit status.

    Raises:
        InputError: Bad options; nothing was simulated or written.
        UnstableError: A state is no longer finite; nothing was written.
    """
    from warp_corot.experiments import figures, report
    from warp_corot.experiments.paper import Settings
    from warp_corot.inputs.choices import FULL_DURATION, SHORT_DURATION

    settings = Settings(duration=FULL_DURATION if args.full else args.duration, level=args.level, dt=args.dt)
    figures.check_matplotlib()
    folder = checked_folder(args.output, [RESULTS, *figures.FILES.values()])
    if not args.full and args.duration == SHORT_DURATION:
        print(
            f"Short form: {SHORT_DURATION:g} s simulated, until the beam is at rest; "
            f"the paper's {FULL_DURATION:g} s with --full.",
            flush=True,
        )
    results = _with_progress(settings, args.device)
    # The table comes last: a reader that goes away, like `head`, must not cost the files, nor a full disk the table.
    text = report.table(results)
    try:
        folder.mkdir(exist_ok=True)
        report.write_json(folder / RESULTS, report.to_json(results))
        files = [folder / RESULTS, *figures.draw_figures(folder, results)]
    except KeyboardInterrupt as signalled:
        complain(f"interrupted while writing; every file in {folder} is complete", kind="")
        return interrupt_status(signalled)
    except OSError as error:
        print(text, flush=True)
        complain(str(error))
        return 1
    print(text)
    print(f"\nWritten to {folder}: {', '.join(file.name for file in files)}")
    return 0


def checked_folder(folder: Path, names: Iterable[str] = ()) -> Path:
    """Check, before a long run, that files of these names can be written there; makes nothing yet.

    Raises:
        InputError: A file or folder with this name exists, its parent folder does not, or permission is missing.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file; it must be a folder")
    there = folder if folder.exists() else folder.absolute().parent
    if not there.is_dir():
        raise InputError(f"{folder}: its parent folder {there} does not exist")
    if not os.access(there, os.W_OK | os.X_OK):
        raise InputError(f"{folder}: cannot be written to")
    for name in names:
        if (folder / name).is_dir():
            raise InputError(f"{folder / name}: is a folder; it must be a file or nothing")
    return folder


def _with_progress(settings: Settings, device: str | None) -> Results:
    from tqdm import tqdm

    from warp_corot.experiments.paper import run_experiment, work
    from warp_corot.inputs.device import checked_device
    from warp_corot.simulation.progress import hidden

    from .compiling import tell_compiling

    where = checked_device(device)
    with tqdm(
        total=work(settings),
        desc="preparing",
        unit="look",
        leave=False,
        disable=None,
        bar_format="{desc:24}{percentage:3.0f} % |{bar}| {remaining} left",
    ) as bar:

        def tell(what: str, done: int) -> None:
            bar.set_description_str(what, refresh=not done)
            bar.update(done)

        tell_compiling(where)
        with hidden():
            return run_experiment(settings, device=where, progress=tell)
