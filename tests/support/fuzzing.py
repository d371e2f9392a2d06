"""Damaged files and random option lists for the command line, in separate processes.

``python fuzzing.py FOLDER FORMATS FIRST COUNT`` damages the seed of each format (names separated by commas) for
each case number from FIRST up to COUNT, and lets ``warp-corot simulate`` read it; ``FORMAT:COUNT`` gives a format a
count of its own. A line of JSON for each case goes to the file ``cases``: before it begins, so that a crash is
identified by its number, and again with the error. A good case ends with a body or with one line and status 2. FORMAT
``options`` makes random option lists in place of files.
"""

from __future__ import annotations

import faulthandler
import functools
import gc
import json
import os
import signal
import sys
import tempfile
import time
import traceback
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
from fuzz_damage import damaged
from fuzz_options import FILES, LONG_WORD, random_options
from fuzz_seeds import SEEDS

#: Limits of a case: processor time and time [s], memory beyond that of the process at its start [bytes].
SECONDS, WALL, MEMORY = 30.0, 900.0, 6 << 30
#: More memory than this in use [bytes] is noted.
MUCH = 500 << 20
#: A process that keeps more memory than this between cases [bytes] ends with this status, and another goes on: GDCM
#: keeps what it takes for a damaged length in a DICOM file.
KEPT, FULL = 1 << 30, 98
#: Most cases stop at a domain, since its mesh takes a hundred times as long, or at a mesh without its supports, or at a
#: body without its options.
MESHED_EVERY, HELD_EVERY, MADE_EVERY = 100, 4, 10
#: Of the first cases, which the short run has, fewer get supports or a domain from their surface, and none a mesh.
FIRST, FIRST_HELD_EVERY, FIRST_ENCLOSED_EVERY = 300, 20, 5
#: Formats whose seed is tetrahedra: their number is not reported.
TETRAHEDRA = {form for form in SEEDS if form.startswith(("msh", "vtu", "mesh", "vol"))}
TETRAHEDRA |= {*("usda-tets", "usdc-tets", "bdf", "inp", "tetgen", "run", "vtk-4", "vtm", "pvtu", "vtkhdf", "xdmf")}
TETRAHEDRA |= {*("med", "cgns", "su2")}


class Reached(BaseException):
    """The input was accepted: a body is about to be made, or its motion to be written."""


#: The current case; the file for its output; whether bodies and meshes are made.
case: dict = {}
cases: list = []
making: set[str] = set()


def say(words: dict) -> None:
    print(json.dumps({**case, **words}), file=cases[0], flush=True)


# --- the package as cases want it ------------------------------------------------------------------------------------


def prepared(scenes: bool) -> None:
    """Nothing is simulated, readers run here, the parser is made once, no warnings; Newton only for scenes."""
    import warnings

    import warp as wp

    from warp_corot import cli
    from warp_corot.body.soft_body import SoftBody
    from warp_corot.cli import bodies, scene, simulate  # noqa: F401 (all modules that read files)
    from warp_corot.domain import surface
    from warp_corot.io.read import filemesh as files
    from warp_corot.io.write import animate
    from warp_corot.mesh import TetForest

    def stop(*_, **__):
        raise Reached

    made = SoftBody.__init__

    def body(self, mesh, *arguments, **options) -> None:
        _see(mesh)
        if "bodies" not in making:
            raise Reached
        made(self, mesh, *arguments, **options)

    enclosed = surface.surface_domain

    def encloses(*arguments, **options):
        if "domains" not in making:
            raise Reached
        return enclosed(*arguments, **options)

    held = bodies.held_by_default

    def holds(subject, *arguments, **options):
        _see(subject.mesh)
        if "holds" not in making:
            raise Reached
        return held(subject, *arguments, **options)

    meshed = TetForest.from_domain

    def mesh(*arguments, **options) -> TetForest:
        if "meshes" not in making:
            raise Reached
        return meshed(*arguments, **options)

    surface.surface_domain = encloses
    bodies.held_by_default = holds
    SoftBody.__init__ = body  # type: ignore[method-assign]
    TetForest.from_domain = mesh  # type: ignore[method-assign]
    animate.record = stop
    cli.make_parser = functools.cache(cli.make_parser)
    read = files.read_with

    def read_said(module: str, path: Path):
        """What a reader finds; it says that it has begun: where it ends this process, its library does so."""
        say({"reads": module})
        found = read(module, path)
        say({"has read": module})
        return found

    for name, module in list(sys.modules.items()):
        if name.startswith("warp_corot") and hasattr(module, "read_with"):
            module.read_with = read_said
        if name.startswith("warp_corot") and hasattr(module, "begin_loading"):
            # A fork of a process whose other threads load kernels would wait for their locks for ever.
            module.begin_loading = lambda *_, **__: []
    warnings.simplefilter("ignore")
    wp.config.log_level = wp.LOG_ERROR
    with suppress(Exception):  # without Newton there are no scenes
        if not scenes:
            return
        from warp_corot.newton.stages.steps import StageSimulation

        solver = StageSimulation._new_solver

        def prepared_scene(self, *arguments):
            return solver(self, *arguments) if "meshes" in making else stop()

        StageSimulation._new_solver = prepared_scene  # type: ignore[method-assign]
        StageSimulation.writer = stop  # type: ignore[method-assign]


def _see(mesh) -> None:
    assert np.isfinite(mesh.points).all()
    assert 0 <= mesh.tets.min() <= mesh.tets.max() < len(mesh.points)


# --- cases -----------------------------------------------------------------------------------------------------------


@contextmanager
def said_by_all():
    """The output to stdout and stderr, including that of libraries."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept = [os.dup(1), os.dup(2)]
    with tempfile.TemporaryFile() as file:
        for number in (1, 2):
            os.dup2(file.fileno(), number)
        said: list[str] = []
        try:
            yield said
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            for number, before in zip((1, 2), kept, strict=True):
                os.dup2(before, number)
                os.close(before)
            file.seek(0)
            said += file.read().decode(errors="replace").splitlines()


def files_in(folder: Path) -> dict[str, tuple[int, int]]:
    """All files with their sizes and times, except those that Warp's compiler keeps until the process ends."""
    found = {}
    for below, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith("wp_pch_")]
        for name in names:
            path = os.path.join(below, name)
            about = os.stat(path)
            found[os.path.relpath(path, folder)] = (about.st_size, about.st_mtime_ns)
    return found


def outputs(command: list[str]) -> set[str]:
    """The files that a command writes before the first frame."""
    found = {"out.csv"}
    for word, value in zip(command, [*command[1:], ""], strict=True):
        for option in ("--csv", "--write-run"):
            found |= {value} if word == option else {word.removeprefix(f"{option}=")} - {word}
    return found


def wrong_with(command: list[str], folder: Path) -> str | None:
    """What is wrong with the end of a command, if anything: it is neither a body nor one line, or it touched a file."""
    from warp_corot.cli import main

    before = files_in(folder)
    outcome: object = None
    with said_by_all() as said:
        try:
            outcome = main(command)
        except Reached:
            outcome = "a body"
        except SystemExit as left:
            outcome = left.code
        except BaseException:
            return traceback.format_exc()
    case["taken"] = outcome == "a body"
    now = files_in(folder)
    touched = {name for name in before.keys() | now.keys() if before.get(name) != now.get(name)}
    if touched - (outputs(command) if outcome == "a body" else set()):
        return f"files are touched: {sorted(touched)}"
    foreign = [line for line in said if not line.startswith(("warp-corot: ", "Short form: "))]
    errors = [line for line in said if line.startswith("warp-corot: error: ")]
    if foreign:
        return f"says more than its lines: {foreign[:3]}"
    if outcome == "a body":
        return None if not errors else f"a body in spite of {errors}"
    if outcome != 2 or len(errors) != 1:
        return f"status {outcome}, {said[:5]}"
    own = errors[0].lower().replace(LONG_WORD, "")
    return None if len(own) < 600 else f"a line of {len(own)} characters, beside what was typed: {errors[0]}"


def wrong_with_checkpoint(path: Path) -> str | None:
    """The same for a checkpoint, which ``Simulation.load`` reads."""
    import warp_corot as wc

    try:
        wc.Simulation.load(path, device="cpu")
        case["taken"] = True
    except wc.InputError as error:
        return None if "\n" not in str(error) and len(str(error)) < 600 else f"more than a line: {error}"
    except BaseException:
        return traceback.format_exc()
    return None


def wrong_with_run(command: list[str], folder: Path) -> str | None:
    """An error in a run file that was just written: it does not make the command's body."""
    written = [name for name in outputs(command) if name.endswith(".toml") and (folder / name).is_file()]
    return next((wrong for name in written if (wrong := wrong_with(["simulate", name], folder))), None)


def command_for(form: str, seed: Path) -> list[str]:
    """The command that reads a seed."""
    command = ["scene" if form == "scene" else "simulate", seed.name, "-o", "out.usd", "--device", "cpu"]
    return command if form in TETRAHEDRA or form == "scene" else [*command, "--tets", "300"]


class Cases:
    """The cases of a format.

    Args:
        form: Name of the format, or "options".
        folder: An empty folder.
    """

    def __init__(self, form: str, folder: Path):
        self.form, self.folder, self.seed = form, folder, None
        making.add("bodies")  # some seeds are made of one
        if form == "options":
            for kind in FILES:
                SEEDS[kind](folder)
            if "warp_corot.newton.stages.steps" in sys.modules:
                SEEDS["scene"](folder).rename(folder / "scene.usda")
                SEEDS["usda"](folder)
        else:
            self.seed = SEEDS[form](folder)
        self.good = {folder / name: (folder / name).read_bytes() for name in sorted(files_in(folder))}
        self.sizes = files_in(folder)
        self.broken: Path | None = None

    def run(self, number: int, broken: bool = True) -> str | None:
        """Run a case; returns its error, if any."""
        rng = np.random.default_rng([number, *self.form.encode()])
        if self.seed is None:
            command = random_options(rng)
        else:
            command = command_for(self.form, self.seed)
            path = list(self.good)[rng.integers(len(self.good))]
            if self.form == "run" and rng.random() < 0.9:
                path = self.seed
            if broken:
                self.broken = path
                path.write_bytes(damaged(self.good[path], rng))
        making.clear()
        meshed = number >= FIRST and number % MESHED_EVERY == MESHED_EVERY - 1
        if meshed or (self.form in ("options", "run") and number % MADE_EVERY == 0):
            making.add("meshes")
        if number % (HELD_EVERY if number >= FIRST else FIRST_HELD_EVERY) == 0:
            making.add("holds")
        if number >= FIRST or number % FIRST_ENCLOSED_EVERY == 0:
            making.add("domains")
        if self.form.startswith("checkpoint") or (self.form in ("options", "run") and number % MADE_EVERY == 0):
            making.update(("bodies", "holds", "domains"))
        if self.form.startswith("checkpoint"):
            wrong = wrong_with_checkpoint(self.seed)
        else:
            wrong = wrong_with(command, self.folder) or (
                wrong_with_run(command, self.folder) if case["taken"] else None
            )
        self._restore()
        return f"{wrong}\n{command}" if wrong else None

    def _restore(self) -> None:
        now = files_in(self.folder)
        for name in now.keys() - self.sizes.keys():
            (self.folder / name).unlink()
        for path, content in self.good.items():
            name = os.path.relpath(path, self.folder)
            if path == self.broken or now.get(name) != self.sizes[name]:
                path.write_bytes(content)
                about = path.stat()
                self.sizes[name] = about.st_size, about.st_mtime_ns
        if self.form == "scene":  # a stage that stays open would be taken for that of the next file
            gc.collect()


def run(found: Cases, first: int, count: int, stderr) -> None:
    """Run cases from a number on, in this process, which a case may end."""
    import resource

    faulthandler.enable(stderr)
    faulthandler.register(signal.SIGPROF, stderr, all_threads=False, chain=True)
    start = _memory("VmData")
    resource.setrlimit(resource.RLIMIT_DATA, (start + MEMORY, start + MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    usual, resting = _memory("VmHWM"), _memory("VmRSS")
    for number in range(first, count):
        case.clear()
        case.update(form=found.form, case=number, taken=False)
        say({})
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        signal.setitimer(signal.ITIMER_REAL, WALL)
        started = time.process_time()
        wrong = found.run(number)
        words: dict = {"seconds": round(time.process_time() - started, 4), **({"wrong": wrong} if wrong else {})}
        most = _memory("VmHWM")
        if most > usual + MUCH:
            words["megabytes"] = (most - usual) >> 20
            Path("/proc/self/clear_refs").write_text("5")
        say(words)
        if _memory("VmRSS") > resting + KEPT:
            os._exit(FULL)


def _memory(name: str) -> int:
    """Linux's count of this process's memory [bytes]."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) << 10 for line in lines if line.startswith(f"{name}:"))


def run_all(folder: Path, form: str, first: int, count: int) -> None:
    """Run all cases of a format, in a new process after each that ended one."""
    own = folder / form
    own.mkdir()
    os.chdir(own)
    os.environ["TMPDIR"] = tempfile.tempdir = str(own)  # any file left there is an error
    found = Cases(form, own)
    case.clear()
    case.update(form=form, case=-1, taken=False)
    if found.seed is not None:
        wrong = found.run(0, broken=False)
        if wrong or not case["taken"]:
            say({"wrong": f"its seed is not taken: {wrong}"})
            return
    gc.collect()
    gc.freeze()
    stderr = os.fdopen(os.dup(2), "w")
    while first < count:
        process = os.fork()
        if not process:
            try:
                run(found, first, count, stderr)
                os._exit(0)
            except BaseException:
                traceback.print_exc(file=stderr)
                stderr.flush()
                os._exit(99)
        status = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
        if not status:
            break
        last = json.loads((folder / "cases").read_text(encoding="utf-8").splitlines()[-1])
        if status == FULL:
            first = last["case"] + 1
            continue
        case.clear()
        case.update(form=form, case=last["case"], taken=False)
        # The libraries that read binary files may end a process.
        say({"ended": status, "reads": last["reads"]} if "reads" in last else {"wrong": f"ended with status {status}"})
        found._restore()
        first = last["case"] + 1


def main(folder: Path, forms: list[str], first: int, count: int) -> None:
    prepared(any(form.startswith(("options", "scene")) for form in forms))
    with open(folder / "cases", "a", encoding="utf-8") as file:
        cases.append(file)
        for form in forms:
            name, _, own = form.partition(":")
            run_all(folder, name, first, int(own or count))


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2].split(","), int(sys.argv[3]), int(sys.argv[4]))
