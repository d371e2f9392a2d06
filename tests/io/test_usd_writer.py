"""USD output: the content of the stage, and that a valid stage exists whatever ends the run."""

import errno
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import written
from pxr import Usd, UsdGeom, UsdValidation
from written import Cube, frames_of

from warp_corot.errors import InputError
from warp_corot.io.pictures.colors import color_index, stress_colors
from warp_corot.io.read.meshes import load_tets
from warp_corot.io.write.usd import pieces as usd_pieces
from warp_corot.io.write.usd.writer import SURFACE, TETS, UsdWriter
from warp_corot.mesh.topology import signed_volumes


class Material:
    young, poisson, density = 5e3, np.array([0.3, 0.4]), 1000.0


def write_frames(writer: UsdWriter, frames, flush_every: int = 0) -> None:
    for x, v, stress in frames:
        writer.write(x, velocities=v, von_mises=stress)
        if flush_every and writer.frames % flush_every == 0:
            writer.flush()


def write_all(path: Path, count: int, flush_every: int = 0, **options) -> UsdWriter:
    with UsdWriter(path, Cube, fps=25, **options) as writer:
        write_frames(writer, frames_of(Cube, count), flush_every)
    return writer


def prims_of(path: Path) -> tuple[Usd.Stage, UsdGeom.TetMesh, UsdGeom.Mesh]:
    stage = Usd.Stage.Open(str(path))
    return stage, UsdGeom.TetMesh(stage.GetPrimAtPath(TETS)), UsdGeom.Mesh(stage.GetPrimAtPath(SURFACE))


def frames_in(path: Path) -> int:
    return round(prims_of(path)[0].GetEndTimeCode()) + 1


def validation_errors(path: Path) -> list[str]:
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 10
    found = UsdValidation.ValidationContext(validators).Validate(Usd.Stage.Open(str(path)))
    return [error.GetErrorAsString() for error in found]


def assert_frames(path: Path, count: int, mesh=Cube) -> None:
    """The stage plays exactly these frames, with values bit for bit."""
    stage, tets, surface = prims_of(path)
    times = [float(index) for index in range(count)]
    assert tets.GetPointsAttr().GetTimeSamples() == times
    assert surface.GetPointsAttr().GetTimeSamples() == times
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0.0, count - 1.0)
    nodes = np.unique(mesh.tets)  # of meshes this small all nodes of tetrahedra lie on the surface
    for time_code, (x, v, stress) in zip(times, frames_of(mesh, count), strict=True):
        assert np.array_equal(np.asarray(tets.GetPointsAttr().Get(time_code)), x)
        assert np.array_equal(np.asarray(tets.GetVelocitiesAttr().Get(time_code)), v)
        assert np.array_equal(np.asarray(tets.GetPrim().GetAttribute("primvars:vonMises").Get(time_code)), stress)
        assert np.array_equal(np.asarray(surface.GetPointsAttr().Get(time_code)), x[nodes])
        assert np.array_equal(np.asarray(tets.GetExtentAttr().Get(time_code)), [x.min(axis=0), x.max(axis=0)])


@pytest.mark.parametrize("suffix", [".usd", ".usda", ".usdc"])
@pytest.mark.parametrize("flush_every", [0, 1, 3], ids=["at once", "a piece a frame", "pieces"])
def test_round_trip_is_exact_and_valid(tmp_path, suffix, flush_every):
    path = tmp_path / f"with space{suffix}"
    write_all(path, 7, flush_every, fixed=[0, 2], material=Material())
    assert os.listdir(tmp_path) == [path.name]
    assert_frames(path, 7)
    assert validation_errors(path) == []


def test_stage_metadata_and_primvars(tmp_path):
    path = tmp_path / "out.usd"
    write_all(path, 2, fixed=Cube.points[:, 2] < 0.1, material=Material())
    stage, tets, _ = prims_of(path)
    assert str(stage.GetDefaultPrim().GetPath()) == "/SoftBody"
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert stage.GetTimeCodesPerSecond() == stage.GetFramesPerSecond() == 25.0
    primvars = {p.GetPrimvarName(): p for p in UsdGeom.PrimvarsAPI(tets).GetPrimvars()}
    assert np.array_equal(np.asarray(primvars["fixed"].Get()), [1, 1, 1, 0, 1, 0])
    assert primvars["fixed"].GetInterpolation() == primvars["rest"].GetInterpolation() == "vertex"
    assert primvars["young"].Get() == 5e3
    assert primvars["young"].GetInterpolation() == "constant"
    assert np.allclose(primvars["poisson"].Get(), [0.3, 0.4])
    assert primvars["poisson"].GetInterpolation() == primvars["vonMises"].GetInterpolation() == "uniform"


def test_tetrahedra_are_right_handed_and_the_surface_looks_outward(tmp_path):
    path = tmp_path / "out.usd"
    assert sorted(np.sign(signed_volumes(Cube.points, Cube.tets))) == [-1.0, 1.0]
    write_all(path, 1)
    _, tets, surface = prims_of(path)
    rest = np.asarray(UsdGeom.PrimvarsAPI(tets).GetPrimvar("rest").Get(), dtype=float)
    assert np.allclose(rest, Cube.points)
    indices = np.asarray(tets.GetTetVertexIndicesAttr().Get())
    volumes = signed_volumes(rest, indices)
    assert np.allclose(volumes, 1.0 / 6.0)
    # The divergence theorem: outward faces enclose the volume of the tetrahedra.
    faces = np.asarray(tets.GetSurfaceFaceVertexIndicesAttr().Get())
    assert np.isclose(np.linalg.det(rest[faces]).sum() / 6.0, volumes.sum())
    compact = np.asarray(surface.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
    assert np.array_equal(np.unique(Cube.tets)[compact], faces)
    assert compact.max() + 1 == len(surface.GetPointsAttr().Get(0.0)) == 5  # the unused node is left out


@pytest.mark.parametrize("flush_every", [0, 1, 3], ids=["at once", "a piece a frame", "pieces"])
def test_one_color_range_holds_for_all_frames(tmp_path, flush_every):
    path = tmp_path / "out.usd"
    writer = write_all(path, 6, flush_every)
    stage, _, surface = prims_of(path)
    legend = stage.GetDefaultPrim().GetCustomDataByKey("stressColors")
    lowest, highest = legend["lowest"], legend["highest"]
    assert (lowest, highest) == writer.stress_range
    peak = max(stress.max() for _, _, stress in frames_of(Cube, 6))
    assert 0.99 * peak <= highest <= 1.51 * peak
    # Both tetrahedra have the same volume: nodes of both show the mean, the others their own.
    table = np.asarray(UsdGeom.PrimvarsAPI(surface).GetPrimvar("displayColor").Get())
    assert len(table) == 256
    for time_code, (_, _, stress) in enumerate(frames_of(Cube, 6)):
        own = np.array([stress.mean(), stress[0], stress.mean(), stress.mean(), stress[1], 0.0])
        expected = table[color_index(own, lowest, highest)]
        outside = UsdGeom.PrimvarsAPI(surface).GetPrimvar("displayColor").ComputeFlattened(float(time_code))
        assert np.allclose(outside, expected[:5], atol=0.02)


def test_the_color_map_is_perceptually_even():
    """OKLab lightness falls in even steps: no band of colours hides or invents a gradient."""
    rgb = stress_colors(64)
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    cones = linear @ np.array(
        [
            [0.4122214708, 0.2119034982, 0.0883024619],
            [0.5363325363, 0.6806995451, 0.2817188376],
            [0.0514459929, 0.1073969566, 0.6299787005],
        ]
    )
    lightness = np.cbrt(cones) @ np.array([0.2104542553, 0.7936177850, -0.0040720468])
    steps = -np.diff(lightness)
    assert steps.min() > 0.0
    assert steps.max() < 1.6 * steps.mean()


def test_positions_only(tmp_path):
    path = tmp_path / "out.usdc"
    with UsdWriter(path, Cube, fps=30, up_axis="Y") as writer:
        writer.write(Cube.points)
    _, tets, surface = prims_of(path)
    assert not tets.GetVelocitiesAttr().HasAuthoredValue()
    assert len(surface.GetDisplayColorAttr().Get()) == 1
    assert validation_errors(path) == []


def test_a_written_stage_is_a_mesh_again(tmp_path):
    path = tmp_path / "out.usd"
    write_all(path, 3)
    loaded = load_tets(path)
    assert np.allclose(loaded.points, Cube.points)  # the rest shape, not the first frame
    assert [sorted(tet) for tet in loaded.cells.tolist()] == [sorted(tet) for tet in Cube.tets.tolist()]
    assert loaded.up_axis == "Z"


def test_the_stage_grows_and_what_was_there_stays_until_it_is_safe(tmp_path):
    path = tmp_path / "out.usd"
    path.write_text("a good file")
    frames = list(frames_of(Cube, 6))
    writer = UsdWriter(path, Cube, fps=25, flush_seconds=60.0)
    write_frames(writer, frames[:3])
    assert path.read_text(encoding="utf-8") == "a good file"
    writer.flush()
    assert_frames(path, 3)
    assert validation_errors(path) == []
    write_frames(writer, frames[3:], flush_every=2)
    writer.flush()
    assert_frames(path, 6)
    assert validation_errors(path) == []
    # The stage and its pieces move together.
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    subprocess.run(["cp", "-r", path, f"{path}.pieces", elsewhere], check=True)
    assert_frames(elsewhere / path.name, 6)
    writer.close()
    assert_frames(path, 6)


def test_pieces_are_written_without_being_asked_for(tmp_path):
    path = tmp_path / "out.usd"
    writer = UsdWriter(path, Cube, fps=25, flush_seconds=0.0)
    frames = list(frames_of(Cube, 3))
    write_frames(writer, frames[:1])
    assert not path.exists()  # a run that fails at once replaces nothing
    while not path.exists():
        write_frames(writer, frames[1:2])
    assert 1 <= frames_in(path) <= writer.frames
    writer.flush()
    assert frames_in(path) == writer.frames
    writer.close()


def test_no_frames_leave_no_file(tmp_path):
    path = tmp_path / "out.usd"
    path.write_text("a good file")
    with UsdWriter(path, Cube, fps=25):
        pass
    assert path.read_text(encoding="utf-8") == "a good file"
    assert os.listdir(tmp_path) == [path.name]


def test_an_exception_in_the_run_keeps_the_frames(tmp_path):
    path = tmp_path / "out.usd"

    def frames_then_ctrl_c():
        yield from frames_of(Cube, 4)
        raise KeyboardInterrupt

    with UsdWriter(path, Cube, fps=25) as writer, pytest.raises(KeyboardInterrupt):
        write_frames(writer, frames_then_ctrl_c())
    assert_frames(path, 4)
    assert os.listdir(tmp_path) == [path.name]


def test_pieces_of_a_killed_run_are_replaced_and_foreign_files_kept(tmp_path):
    path = tmp_path / "out.usd"
    killed = UsdWriter(path, Cube, fps=25)
    write_frames(killed, frames_of(Cube, 3), flush_every=1)
    killed._release()  # like a kill: the lock is gone, the files stay
    assert_frames(path, 3)
    (tmp_path / "out.usd.pieces" / "notes.txt").write_text("mine")
    (stale,) = (tmp_path / "out.usd.pieces").glob("run-*")
    (stale / "part-joined.aB3xYz").write_text("OpenUSD's own temporary file")
    writer = UsdWriter(path, Cube, fps=25, flush_seconds=60.0)
    assert_frames(path, 3)
    write_frames(writer, frames_of(Cube, 5))
    assert_frames(path, 3)
    writer.flush()
    assert_frames(path, 5)
    assert not stale.exists()
    writer.close()
    assert_frames(path, 5)
    assert os.listdir(tmp_path / "out.usd.pieces") == ["notes.txt"]


RUN = """
import sys
import numpy as np
sys.path[:0] = {path!r}
from written import Cube, frames_of
from warp_corot.io.write.usd.writer import UsdWriter
with UsdWriter({out!r}, Cube, fps=25, flush_seconds={flush_seconds}) as writer:
    print("ready", flush=True)
    for x, v, stress in frames_of(Cube, {count}):
        writer.write(x, velocities=v, von_mises=stress)
        if writer.frames % {flush_every} == 0:
            writer.flush()
            print(writer.frames, flush=True)
"""


def run_code(out: Path, count: int, flush_every: int, flush_seconds: float = 60.0) -> str:
    path = [str(Path(written.__file__).parent), *sys.path]
    return RUN.format(path=path, out=str(out), count=count, flush_every=flush_every, flush_seconds=flush_seconds)


def start_run(out: Path, flush_every: int, flush_seconds: float) -> subprocess.Popen:
    code = run_code(out, 10**6, flush_every, flush_seconds)
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    return process


@pytest.mark.skipif(os.name == "nt", reason="needs SIGKILL")
@pytest.mark.parametrize("attempts", [3, pytest.param(21, marks=pytest.mark.slow)])
def test_kill_at_any_moment_leaves_a_stage_that_opens(attempts, tmp_path):
    """Runs are killed at random moments, mostly while writing; each overwrites the one before. They wait for pieces of
    one frame or of five, or leave them to the thread."""
    moments = random.Random(7)
    out = tmp_path / "out.usd"
    out.write_text("a good file")
    for attempt in range(attempts):
        before = out.read_bytes()
        process = start_run(out, *((5, 60.0), (1, 60.0), (10**6, 0.0))[attempt % 3])
        time.sleep(moments.uniform(0.0, 0.25))
        # On a busy machine none of them may have come so far; the last one does.
        latest = time.monotonic() + 60.0
        while attempt == attempts - 1 and out.read_bytes() == b"a good file" and time.monotonic() < latest:
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
        said = process.communicate()[0].splitlines()
        flushed = int(said[-1]) if said else 0
        if out.read_bytes() == before:
            assert flushed == 0
            continue
        count = frames_in(out)
        assert count >= max(flushed, 1)
        assert_frames(out, count)
    assert out.read_bytes() != b"a good file"


@pytest.mark.skipif(os.name == "nt", reason="needs resource limits")
@pytest.mark.parametrize(("limit", "what"), [(30_000, "join"), (1_000, "first piece")])
def test_a_full_disk_is_one_clear_line_and_keeps_what_is_there(tmp_path, limit, what):
    """A limit on file size: the joined file cannot be written, or not even a first piece."""
    out = tmp_path / "out.usd"
    out.write_text("a good file")
    limits = f"import resource; resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, {limit}))\n"
    code = limits + run_code(out, 200, flush_every=20)
    done = subprocess.run([sys.executable, "-B", "-c", code], capture_output=True, text=True)
    assert done.returncode == 1
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith(f"OSError: {out}: cannot be written")
    assert "File too large" in last
    if what == "join":
        assert "are kept in" in last
        assert_frames(out, 200)
        assert validation_errors(out) == []
    else:
        assert "no frame could be kept" in last
        assert out.read_text(encoding="utf-8") == "a good file"
        assert os.listdir(tmp_path) == [out.name]


def fill_disk(monkeypatch, folder: Path, room: int) -> None:
    """Leave room for this many bytes in all files that exist at once."""
    sync = usd_pieces.sync

    def synced(path: Path) -> None:
        if path.is_file() and sum(f.stat().st_size for f in folder.rglob("*") if f.is_file()) > room:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        sync(path)

    monkeypatch.setattr(usd_pieces, "sync", synced)


@pytest.mark.parametrize("room", [25_000, 40_000, 60_000])
def test_a_full_disk_keeps_the_frames_of_the_pieces(tmp_path, monkeypatch, room):
    """Those that waited, too: they are written into the room that was kept for them."""
    out, added = tmp_path / "out.usd", []
    fill_disk(monkeypatch, tmp_path, room)
    add = usd_pieces.PieceStore.add
    monkeypatch.setattr(usd_pieces.PieceStore, "add", lambda *given: added.append(given) or add(*given))
    with pytest.raises(OSError, match=r"No space left on device; the frames up to \d+ are kept in .*out.usd plays"):
        write_all(out, 200, 6)
    kept = frames_in(out)
    assert 6 < kept == len(added) < 200
    assert_frames(out, kept)
    assert validation_errors(out) == []


def test_a_disk_without_room_for_a_frame_keeps_the_file_that_was_there(tmp_path, monkeypatch):
    out = tmp_path / "out.usd"
    out.write_text("a good file")
    fill_disk(monkeypatch, tmp_path, 3_000)
    with pytest.raises(OSError, match="no frame could be kept"):
        write_all(out, 20, 7)
    assert out.read_text(encoding="utf-8") == "a good file"
    assert os.listdir(tmp_path) == [out.name]


def test_two_writers_on_one_stage_are_refused(tmp_path):
    pytest.importorskip("fcntl")
    path = tmp_path / "out.usd"
    first = UsdWriter(path, Cube, fps=25)
    first.write(Cube.points)
    first.flush()
    with pytest.raises(InputError, match="another process is writing it"):
        UsdWriter(path, Cube, fps=25)
    first.close()
    UsdWriter(path, Cube, fps=25).close()


def test_bad_outputs_are_refused_before_the_run(tmp_path):
    (tmp_path / "folder.usd").mkdir()
    (tmp_path / "file").write_text("")
    for name, word in [
        ("out.obj", "extension .obj"),
        ("out", "extension"),
        ("missing/out.usd", "does not exist"),
        ("file/out.usd", "is a file"),
        ("folder.usd", "is a folder"),
        ("/proc/out.usd", "cannot be written to"),
    ]:
        if name.startswith("/proc") and not Path("/proc").is_dir():
            continue
        with pytest.raises(InputError, match=word) as raised:
            UsdWriter(tmp_path / name, Cube, fps=25)
        assert "\n" not in str(raised.value)
        assert name in str(raised.value)
    for options in [{"fps": 0.0}, {"fps": np.nan}, {"up_axis": "y"}]:
        with pytest.raises(InputError):
            UsdWriter(tmp_path / "out.usd", Cube, **{"fps": 25.0, **options})


def test_bad_frames_are_refused(tmp_path):
    with UsdWriter(tmp_path / "out.usd", Cube, fps=25) as writer:
        writer.write(Cube.points, von_mises=[1.0, 2.0])
        with pytest.raises(InputError, match="every frame or for none"):
            writer.write(Cube.points)
        with pytest.raises(InputError, match=r"positions has shape \[3, 3\]"):
            writer.write(Cube.points[:3], von_mises=[1.0, 2.0])
        with pytest.raises(InputError, match="von_mises has shape"):
            writer.write(Cube.points, von_mises=[1.0])
    with pytest.raises(InputError, match="closed"):
        writer.write(Cube.points, von_mises=[1.0, 2.0])
