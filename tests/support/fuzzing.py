"""Damaged files and random option lists for the command line, in a process of their own.

``python fuzzing.py FOLDER FORMATS FIRST COUNT`` damages the seed of each format (their names with commas) COUNT
times, each time as the number of the case says, and has ``warp-corot simulate`` read it; of the first format only from
case FIRST on. A line of JSON a case goes to the file ``cases``: before it begins, so that a crash is known by its
number, and again with what was wrong. A case ends well in a body or in one line and status 2. FORMAT ``options`` makes
random option lists in place of files.
"""

from __future__ import annotations

import faulthandler
import gzip
import importlib
import io
import json
import os
import re
import sys
import tempfile
import time
import traceback
import zipfile
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path

import numpy as np

#: The most that a case may take [s], and the memory of all [bytes].
SECONDS, MEMORY = 60.0, 8 << 30
HUGE = [b"\xff" * 4, b"\xff\xff\xff\x7f", b"\x00\x00\x00\x80", b"\xff" * 8, b"\xff" * 7 + b"\x7f", b"\x00" * 8]
NUMBERS = [b"0", b"-1", b"1e999", b"nan", b"4294967295", b"-2147483648", b"99999999999999999999", b"1.5", b"", b"x"]


#: In most cases a domain is enough, since its mesh takes ten times as long.
MESHED_EVERY = 10


class Reached(BaseException):
    """A body is about to be made: the input was taken."""


# --- seeds: a small good file of each format, one line for each ------------------------------------------------------


def _ball(folder: Path, suffix: str) -> Path:
    import trimesh

    trimesh.creation.icosphere(1, 0.05).export(folder / f"seed{suffix}")
    return folder / f"seed{suffix}"


def _stl_text(folder: Path) -> Path:
    import trimesh

    trimesh.creation.icosphere(0, 0.05).export(folder / "seed.stl", file_type="stl_ascii")
    return folder / "seed.stl"


POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]]) * 0.1
TETS = np.array([[0, 1, 2, 3], [1, 4, 2, 3]])


def _meshio(folder: Path, suffix: str, **options) -> Path:
    import meshio

    regions = {"region": [np.array([1, 2])]}
    if suffix == ".msh":
        regions = {"gmsh:physical": [np.array([1, 2])], "gmsh:geometrical": [np.array([1, 2])]}
    mesh = meshio.Mesh(POINTS, [("tetra", TETS)], cell_data=regions)
    meshio.write(folder / f"seed{suffix}", mesh, **options)
    return folder / f"seed{suffix}"


def _stage(folder: Path, suffix: str, tets: bool) -> Path:
    from input_files import write_surface
    from pxr import Usd, UsdGeom

    if not tets:
        stage = Usd.Stage.Open(str(write_surface(folder / "ball.usda", mm=True)))
    else:
        stage = Usd.Stage.CreateInMemory()
        mesh = UsdGeom.TetMesh.Define(stage, "/Tets")
        mesh.CreatePointsAttr([tuple(p) for p in POINTS.tolist()])
        mesh.CreateTetVertexIndicesAttr([tuple(t) for t in TETS.tolist()])
    stage.Export(str(folder / f"seed{suffix}"))
    (folder / "ball.usda").unlink(missing_ok=True)
    return folder / f"seed{suffix}"


def _nifti(folder: Path, suffix: str) -> Path:
    from input_files import write_scan

    return write_scan(folder / f"seed{suffix}")


def _voxels() -> np.ndarray:
    axis = np.arange(10) - 4.5
    away = np.linalg.norm(np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1), axis=-1)
    return np.where(away < 2.0, 7, np.where(away < 4.0, 2, 0)).astype(np.uint8)


def _itk(folder: Path, suffix: str, compress: bool = False) -> Path:
    import SimpleITK

    image = SimpleITK.GetImageFromArray(_voxels())
    image.SetSpacing((4.0, 4.0, 4.0))
    SimpleITK.WriteImage(image, str(folder / f"seed{suffix}"), compress)
    return folder / f"seed{suffix}"


def _vti(folder: Path) -> Path:
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonDataModel import vtkImageData
    from vtkmodules.vtkIOXML import vtkXMLImageDataWriter

    grid = vtkImageData()
    grid.SetDimensions(10, 10, 10)
    grid.SetSpacing(0.004, 0.004, 0.004)
    grid.GetPointData().SetScalars(numpy_to_vtk(_voxels().ravel(order="F"), deep=True))
    writer = vtkXMLImageDataWriter()
    writer.SetFileName(str(folder / "seed.vti"))
    writer.SetInputData(grid)
    writer.Write()
    return folder / "seed.vti"


def _checkpoint(folder: Path) -> Path:
    import warp_corot as wc

    body = wc.SoftBody(wc.TetForest.box((1, 1, 1), 0.1, 2), wc.Isotropic(1e4, 0.4, 1e3), device="cpu")
    body.fix("z < 0.01")
    wc.Simulation(body, integrator=wc.SymplecticEuler(1e-4)).save(folder / "seed.npz")
    return folder / "seed.npz"


#: What makes a good file in a folder, by the name of its format. A new format is one line.
SEEDS: dict[str, Callable[[Path], Path]] = {
    "stl": lambda folder: _ball(folder, ".stl"),
    "stl-text": _stl_text,
    "obj": lambda folder: _ball(folder, ".obj"),
    "ply": lambda folder: _ball(folder, ".ply"),
    "off": lambda folder: _ball(folder, ".off"),
    "glb": lambda folder: _ball(folder, ".glb"),
    "usda": lambda folder: _stage(folder, ".usda", tets=False),
    "usdc": lambda folder: _stage(folder, ".usdc", tets=False),
    "usda-tets": lambda folder: _stage(folder, ".usda", tets=True),
    "usdc-tets": lambda folder: _stage(folder, ".usdc", tets=True),
    "msh": lambda folder: _meshio(folder, ".msh", file_format="gmsh", binary=True),
    "msh-text": lambda folder: _meshio(folder, ".msh", file_format="gmsh22", binary=False),
    "vtk": lambda folder: _meshio(folder, ".vtk"),
    "vtk-text": lambda folder: _meshio(folder, ".vtk", binary=False),
    "vtu": lambda folder: _meshio(folder, ".vtu"),
    "inp": lambda folder: _meshio(folder, ".inp"),
    "mesh": lambda folder: _meshio(folder, ".mesh"),
    "nii": lambda folder: _nifti(folder, ".nii"),
    "nii.gz": lambda folder: _nifti(folder, ".nii.gz"),
    "nrrd": lambda folder: _itk(folder, ".nrrd"),
    "nrrd-gz": lambda folder: _itk(folder, ".nrrd", compress=True),
    "mha": lambda folder: _itk(folder, ".mha"),
    "vti": _vti,
    "checkpoint": _checkpoint,
}


#: Formats of which the seed is tetrahedra, for which nothing is said of their number.
TETRAHEDRA = {"usda-tets", "usdc-tets", "msh", "msh-text", "vtk", "vtk-text", "vtu", "inp", "mesh"}


# --- damage ----------------------------------------------------------------------------------------------------------


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """Bytes flipped, cut, swapped, doubled, blanked, or with huge counts; what is compressed is also damaged inside."""
    if data[:2] == b"\x1f\x8b" and rng.random() < 0.6:
        return gzip.compress(damaged(gzip.decompress(data), rng))
    if data[:2] == b"PK" and rng.random() < 0.8:
        return _damaged_archive(data, rng)
    for _ in range(rng.integers(1, 4)):
        data = DAMAGE[rng.integers(len(DAMAGE))](data, rng)
    return data


def _damaged_archive(data: bytes, rng: np.random.Generator) -> bytes:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    names = sorted(entries)
    name = names[rng.integers(len(names))] if rng.random() < 0.6 else "header.npy"
    how = rng.random()
    if how < 0.1:
        del entries[name]
    elif how < 0.2:
        entries[name] = entries[names[rng.integers(len(names))]]
    else:
        entries[name] = damaged(entries[name], rng)
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for each, content in entries.items():
            archive.writestr(zipfile.ZipInfo(each), content)  # of no time, so that it is the same each time
    return out.getvalue()


def _span(data: bytes, rng: np.random.Generator) -> tuple[int, int]:
    start = int(rng.integers(len(data) + 1))
    return start, min(start + int(2 ** rng.uniform(0, 10)), len(data))


def _flip(data: bytes, rng: np.random.Generator) -> bytes:
    flipped = np.frombuffer(data, np.uint8).copy()
    if len(flipped):
        # Headers lie at the beginning.
        reach = len(flipped) if rng.random() < 0.5 else min(len(flipped), 200)
        where = rng.integers(reach, size=int(2 ** rng.uniform(0, 5)))
        flipped[where] ^= (1 << rng.integers(8, size=len(where))).astype(np.uint8)
    return flipped.tobytes()


def _cut(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: rng.integers(len(data) + 1)]


def _without(data: bytes, rng: np.random.Generator) -> bytes:
    start, end = _span(data, rng)
    return data[:start] + data[end:]


def _doubled(data: bytes, rng: np.random.Generator) -> bytes:
    start, end = _span(data, rng)
    return data[:end] + data[start:]


def _swapped(data: bytes, rng: np.random.Generator) -> bytes:
    (a, b), (c, d) = sorted((_span(data, rng), _span(data, rng)))
    return data if b > c else data[:a] + data[c:d] + data[b:c] + data[a:b] + data[d:]


def _blanked(data: bytes, rng: np.random.Generator) -> bytes:
    start, end = _span(data, rng)
    return data[:start] + bytes([rng.integers(256)]) * (end - start) + data[end:]


def _huge(data: bytes, rng: np.random.Generator) -> bytes:
    """A number in the text or somewhere among the first bytes that counts something."""
    found = list(re.finditer(rb"-?\d+(\.\d+)?", data[:4000]))
    if found and rng.random() < 0.6:
        which = found[rng.integers(len(found))]
        return data[: which.start()] + NUMBERS[rng.integers(len(NUMBERS))] + data[which.end() :]
    value = HUGE[rng.integers(len(HUGE))]
    start = int(rng.integers(max(min(len(data), 2000 if rng.random() < 0.8 else len(data)), 1)))
    return data[:start] + value + data[start + len(value) :]


DAMAGE = [_flip, _cut, _without, _doubled, _swapped, _blanked, _huge, _huge]


# --- option lists ----------------------------------------------------------------------------------------------------

WORDS = ["", "0", "1", "-1", "1e-3", "nan", "inf", "-inf", "1e400", "2147483648", "x", "mm", "cm", "m", "inch", "5kPa"]
WORDS += ["linear", "corotated", "warp:bunny", "box", "no.stl", "seed.ply", "seed.nii", "seed.vtk", ".", "/", "out.usd"]
WORDS += [
    "z < 0",
    "all",
    "none",
    "z <",
    "hypot(x,y)<1",
    "1/0<x",
    "((((",
    "x" * 2000,
    "z<zmin+.01",
    "not x",
    "\u00e4",
    "-",
]
WORDS += [
    "liver=3kPa:0.45",
    "2=3kPa:0.45",
    "2=3kPa:0.45,7=1e4:.3",
    "=",
    ",,",
    "cpu",
    "cuda:9",
    "nowhere/a.usd",
    "a.png",
]
INPUTS = ["box", "seed.ply", "seed.nii", "seed.vtk", "seed.usda", "none.stl", "warp:nobody", ""]


def random_options(rng: np.random.Generator) -> list[str]:
    """A command of ``simulate`` as nobody would type it, or nearly."""
    from warp_corot.cli import make_parser

    subparsers = next(
        a for a in make_parser()._actions if hasattr(a, "choices") and a.choices and "simulate" in a.choices
    )
    actions = [a for a in subparsers.choices["simulate"]._actions if a.option_strings]

    def word() -> str:
        return str(rng.choice(WORDS)) if rng.random() < 0.8 else f"{10 ** rng.uniform(-4, 4):.3g}"

    line = ["simulate", str(rng.choice(INPUTS)), "-o", "out.usd"] if rng.random() < 0.9 else ["simulate"]
    if rng.random() < 0.7:
        line += ["--tets", "300"]
    for _ in range(rng.integers(0, 5)):
        action = actions[rng.integers(len(actions))]
        if "--help" in action.option_strings:
            continue
        count = action.nargs if isinstance(action.nargs, int) else 1
        count = max(count + int(rng.integers(-1, 2)) * int(rng.random() < 0.1), 0)
        choices = list(action.choices or [])
        values = [str(rng.choice(choices)) if choices and rng.random() < 0.7 else word() for _ in range(count)]
        line += [str(rng.choice(action.option_strings)), *values]
    if rng.random() < 0.1:
        line.insert(int(rng.integers(len(line) + 1)), word())
    return [w for w in line if "\0" not in w]


# --- cases -----------------------------------------------------------------------------------------------------------


@contextmanager
def said_by_all():
    """What is written to stdout and stderr, by libraries too."""
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


def wrong_with(command: list[str], folder: Path) -> str | None:
    """What is wrong with how a command ends, if anything: neither a body nor one line, or a file is touched."""
    from warp_corot.cli import main

    before = {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}
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
    if {path.name: path.stat().st_mtime_ns for path in folder.iterdir()} != before:
        return f"files are touched: {sorted(path.name for path in folder.iterdir())}"
    foreign = [line for line in said if not line.startswith("warp-corot: ")]
    errors = [line for line in said if line.startswith("warp-corot: error: ")]
    if outcome in (0, 2) and "--help" in " ".join(said):
        return None if outcome == 2 and len(errors) == 1 else f"said: {said}"
    if foreign and outcome != 0:
        return f"says more than its lines: {foreign[:3]}"
    if outcome == "a body":
        return None
    if outcome != 2 or len(errors) != 1:
        return f"status {outcome}, {said[:5]}"
    return None if len(errors[0]) < 600 else f"a line of {len(errors[0])} characters"


def taken_checkpoint(path: Path) -> str | None:
    """The same for a checkpoint, which ``Simulation.load`` reads."""
    import warp_corot as wc

    try:
        wc.Simulation.load(path, device="cpu")
    except wc.InputError as error:
        return None if "\n" not in str(error) else f"more than a line: {error}"
    except BaseException:
        return traceback.format_exc()
    return None


def read_here(module: str, path: Path):
    """What a reader in a process of its own finds, found in this one, which takes a hundredth of the time.

    One that crashes ends this process; it has said before that it reads, and in its own process it may.
    """
    from warp_corot.io.files.quiet import bounded, quietly

    say({"reads": module})
    try:
        with quietly(), bounded(path):
            found = importlib.import_module(module).read(path)
    except (Exception, SystemExit) as error:
        return None, " ".join(str(error).split()) or type(error).__name__
    finally:
        say({"has read": module})
    if found is None:
        return None, None
    return (found if isinstance(found, dict) else found.to_arrays()), None


def prepared() -> None:
    """This process as cases want it: no body is made, readers read here, memory is bounded, nothing warns."""
    import resource
    import warnings

    import warp_corot.cli.simulate  # noqa: F401 (all that reads files)
    from warp_corot.body.soft_body import SoftBody
    from warp_corot.mesh import TetForest

    make = SoftBody.__init__

    def reached(self, *arguments, **options) -> None:
        if not making.get("allowed"):
            raise Reached
        make(self, *arguments, **options)

    SoftBody.__init__ = reached  # type: ignore[method-assign]
    mesh = TetForest.from_domain

    def meshed(*arguments, **options) -> TetForest:
        if case.get("case", 0) % MESHED_EVERY:
            raise Reached
        return mesh(*arguments, **options)

    TetForest.from_domain = meshed  # type: ignore[method-assign]
    for module in list(sys.modules.values()):
        if module.__name__.startswith("warp_corot") and hasattr(module, "read_isolated"):
            module.read_isolated = read_here
    warnings.simplefilter("ignore")
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))


#: Whether bodies may be made, as checkpoints need it.
making: dict[str, bool] = {}


def run(folder: Path, form: str, first: int, count: int, stderr) -> None:
    """So many cases of a format in a folder, from a number on."""
    making["allowed"] = form == "checkpoint"
    os.chdir(folder)
    if form == "options":
        for kind in ("ply", "nii", "vtk", "usda"):
            SEEDS[kind](folder)
        seed, good = None, b""
    else:
        seed = SEEDS[form](folder)
        good = seed.read_bytes()
        if form != "checkpoint":  # compiles kernels
            wrong_with(command_for(form, seed), folder)
    for number in range(first, first + count):
        rng = np.random.default_rng([number, *form.encode()])
        case.clear()
        case.update(form=form, case=number)
        say({})
        started = time.process_time()
        faulthandler.dump_traceback_later(SECONDS, exit=True, file=stderr)
        command = random_options(rng) if seed is None else command_for(form, seed)
        if seed is not None:
            seed.write_bytes(damaged(good, rng))
        wrong = taken_checkpoint(seed) if form == "checkpoint" and seed else wrong_with(command, folder)
        faulthandler.cancel_dump_traceback_later()
        say(
            {
                "seconds": round(time.process_time() - started, 3),
                **({"wrong": wrong, "command": command} if wrong else {}),
            }
        )


def command_for(form: str, seed: Path) -> list[str]:
    """The command that reads a seed."""
    command = ["simulate", seed.name, "-o", "out.usd", "--device", "cpu"]
    return command if form in TETRAHEDRA else [*command, "--tets", "300"]


#: The case that runs, and where its words go.
case: dict = {}
cases: list = []


def say(words: dict) -> None:
    print(json.dumps({**case, **words}), file=cases[0], flush=True)


def main(folder: Path, forms: list[str], first: int, count: int) -> None:
    stderr = os.fdopen(os.dup(2), "w")
    faulthandler.enable(stderr)
    prepared()
    with open(folder / "cases", "a") as file:
        cases.append(file)
        for form in forms:
            own = folder / form
            own.mkdir(exist_ok=True)
            run(own, form, first, count - first, stderr)
            first = 0


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2].split(","), int(sys.argv[3]), int(sys.argv[4]))
