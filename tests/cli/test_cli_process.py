"""The command line as a process: signals, streams that are closed, full or abandoned, locales."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import warp as wp
from pxr import Usd

import warp_corot as wc

pytestmark = pytest.mark.skipif(os.name != "posix", reason="POSIX signals, pipes and locales")

COMMAND = [sys.executable, "-m", "warp_corot"]
BOX = ["simulate", "box", "-o", "a.usd", "--duration", "0.05", "--fps", "40", "--device", "cpu"]


def started(folder: Path, *args: str, **options) -> subprocess.Popen:
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "encoding": "utf-8"}
    return subprocess.Popen([*COMMAND, *args], cwd=folder, **(streams | options))


def frame_count(path: Path) -> int:
    stage = Usd.Stage.Open(str(path))
    return int(stage.GetEndTimeCode() - stage.GetStartTimeCode()) + 1


def record_block(path: Path) -> None:
    """A stage with a few tetrahedra."""
    mesh = wc.TetForest.box((1, 1, 1), 0.1, 3)
    body = wc.SoftBody(mesh, wc.Isotropic(1e4, 0.4, 1e3), device="cpu")
    wc.record(wc.Simulation(body), path, duration=0.05)


@pytest.mark.parametrize(
    ("number", "status"), [pytest.param(signal.SIGTERM, 143, marks=pytest.mark.slow), (signal.SIGINT, 130)]
)
def test_signals_keep_frames(tmp_path, number, status):
    command = ["simulate", "box", "-o", "a.usd", "--duration", "1000", "--device", "cpu"]
    # Background processes ignore SIGINT, and so would their children.
    process = started(tmp_path, *command, preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL))
    try:
        for _ in range(600):  # until the first frames exist
            if (tmp_path / "a.usd").exists() or process.poll() is not None:
                break
            time.sleep(0.1)
        process.send_signal(number)
        out, err = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == status, err
    assert out == ""
    # On a fresh machine kernels are compiled first, with a message.
    said = r"(?:warp-corot: compiling kernels .*\n)?warp-corot: interrupted; (\d+) frames?\b.* kept in a\.usd\n"
    match = re.fullmatch(said, err)
    assert match, err
    assert frame_count(tmp_path / "a.usd") == int(match[1]) > 1
    assert [file.name for file in tmp_path.iterdir()] == ["a.usd"]


@pytest.mark.parametrize(
    ("module", "number", "status"),
    [
        ("warp", signal.SIGINT, 130),
        ("warp_corot.body.soft_body", signal.SIGTERM, 143),
        pytest.param("pxr", signal.SIGINT, 130, marks=pytest.mark.slow),
        pytest.param("warp", signal.SIGTERM, 143, marks=pytest.mark.slow),
        pytest.param("warp_corot.body.soft_body", signal.SIGINT, 130, marks=pytest.mark.slow),
        pytest.param("pxr", signal.SIGTERM, 143, marks=pytest.mark.slow),
    ],
)
def test_a_signal_while_modules_are_imported_is_one_line(tmp_path, module, number, status):
    """Python reports each module at the start of its import; the signal comes at the first import of this one."""
    (tmp_path / "interrupted.py").write_text(f"""
import runpy, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
came = []
def heard(event, args):
    if event == "import" and args[0] == {module!r} and not came:
        came.append(event)
        signal.raise_signal({int(number)})
sys.addaudithook(heard)
sys.argv = ["warp-corot", *{BOX!r}]
runpy.run_module("warp_corot", run_name="__main__")
""")
    folder = tmp_path / "empty"
    folder.mkdir()
    command = [sys.executable, str(tmp_path / "interrupted.py")]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout, done.stderr) == (status, "", "warp-corot: interrupted\n")
    assert list(folder.iterdir()) == []


def test_reader_that_leaves_is_no_error(tmp_path):
    read, write = os.pipe()
    os.close(read)
    process = started(tmp_path, *BOX, stdout=write)
    os.close(write)
    _, err = process.communicate(timeout=120)
    assert err == ""
    assert process.returncode == 141
    assert frame_count(tmp_path / "a.usd") == 3


@pytest.mark.parametrize(
    ("streams", "status", "said"),
    [
        pytest.param(">&-", 0, "", marks=pytest.mark.slow),
        pytest.param("2>&-", 0, "", marks=pytest.mark.slow),
        ("<&- >&- 2>&-", 0, ""),
        (">/dev/full", 1, "warp-corot: error: standard output: No space left on device\n"),
        pytest.param("2>/dev/full", 0, "", marks=pytest.mark.slow),
    ],
)
def test_full_or_closed_streams_lose_no_frames(tmp_path, streams, status, said):
    """The notes about the missing --young go to stderr, the summary to stdout."""
    if "/dev/full" in streams and not os.path.exists("/dev/full"):
        pytest.skip("no /dev/full")
    record_block(tmp_path / "b.usd")
    command = ["b.usd" if word == "box" else word for word in BOX]
    shell = ["sh", "-c", f'exec "$@" {streams}', "sh", *COMMAND, *command]
    done = subprocess.run(shell, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == status, done.stderr
    # The message about compiling depends on what ran before.
    lines = [line for line in done.stderr.splitlines(True) if "note:" not in line and "compiling kernels" not in line]
    assert lines == said.splitlines(True)
    assert frame_count(tmp_path / "a.usd") == 3


def test_a_kernel_cache_that_cannot_be_made_is_one_line(tmp_path):
    (tmp_path / "file").write_text("in the way")
    process = started(tmp_path, *BOX, env=os.environ | {"WARP_CACHE_PATH": str(tmp_path / "file" / "cache")})
    _, err = process.communicate(timeout=120)
    assert process.returncode == 1
    assert re.fullmatch(r"warp-corot: error: Warp's kernel cache .*; name a folder .* WARP_CACHE_PATH\n", err), err


def test_names_are_utf8_in_every_locale_and_the_parts_of_the_wall_time_are_all_of_it(tmp_path):
    plain = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    record_block(tmp_path / "bär.usd")
    command = [word.replace("box", "bär.usd").replace("a.usd", "ö.usd") for word in BOX]
    began = time.perf_counter()
    process = started(tmp_path, *command, "--preview", "ü.png", env=os.environ | plain)
    out, err = process.communicate(timeout=300)
    took = time.perf_counter() - began
    assert process.returncode == 0, err
    assert frame_count(tmp_path / "ö.usd") == 3
    assert {file.name for file in tmp_path.iterdir()} == {"bär.usd", "ö.usd", "ü.png"}
    (line,) = [line for line in out.splitlines() if line.startswith("  wall time")]
    total, *parts = map(float, re.findall(r"([\d.]+) s", line))
    assert total == pytest.approx(sum(parts), abs=0.005 * (1 + len(parts)))
    for name in ("importing", "kernels", "preparing", "stepping", "writing", "drawing"):
        assert re.search(rf"s (\w+ )?{name}", line), (name, line, err)
    # The interpreter's own start and end are missing.
    assert 0.85 * took < total < took


def test_compiling_is_announced_only_if_kernels_are_compiled(tmp_path):
    """The message comes once, on stderr, in a separate line.

    The cache has all kernels that were compiled before except those of the clock.
    """
    known = Path(wp.config.kernel_cache_dir)
    folder = tmp_path / "cache" / known.name
    folder.mkdir(parents=True)
    for module in known.iterdir():
        if "stepping.pace" not in module.name:
            (folder / module.name).symlink_to(module)
    cache = os.environ | {"WARP_CACHE_PATH": str(tmp_path / "cache")}
    out, err = started(tmp_path, *BOX, env=cache).communicate(timeout=120)
    assert re.fullmatch(r"warp-corot: compiling kernels for cpu, once: .*\n", err), err
    assert " s compiling kernels" in out


@pytest.mark.parametrize(
    ("words", "said", "without"),
    [
        (["--version"], f"warp-corot {wc.__version__} (warp {wp.__version__})\n", "warp|numpy|scipy|pxr"),
        (["--help"], "usage: warp-corot [-h] [--version] COMMAND", "warp|numpy|scipy|pxr"),
    ],
)
def test_imports_of_a_start(words, said, without, tmp_path):
    """Large libraries are imported when they are needed, so that the command starts quickly."""
    process = started(tmp_path, *words, env=os.environ | {"PYTHONPROFILEIMPORTTIME": "1"})
    out, imported = process.communicate(timeout=60)
    assert process.returncode == 0
    assert out.startswith(said)
    assert re.search(r"\| +warp_corot.cli\n", imported)
    assert not re.search(rf"\| +({without})\n", imported)


@pytest.mark.parametrize(("module", "frozen"), [("__main__", True), ("cli", False)])
def test_the_end_of_the_command_collects_no_garbage(module, frozen):
    """Nor does it skip what others registered for the end. A Python program's own end is its own."""
    code = (
        "import atexit, gc, sys\n"
        "atexit.register(lambda: print(gc.get_freeze_count() > 0))\n"
        f"from warp_corot.{module} import main\n"
        "sys.argv[1:] = ['--version']\nmain()"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.splitlines()[-1] == str(frozen)


def test_warp_says_each_line_once_in_python():
    """Its banner, and that there is no card; users of the command see neither (their stderr is empty above)."""
    code = (
        "import warp as wp, warp_corot as wc\n"
        "for _ in range(2):\n"
        "    body = wc.SoftBody(wc.TetForest.box((1, 1, 1), 0.1, 3), wc.Isotropic(1e4, 0.4, 1e3), device='cpu')\n"
        "    wp.get_devices(), wp.init()"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    lines = [line for line in (ran.stdout + ran.stderr).splitlines() if re.search("CUDA driver|initialized", line)]
    assert len(lines) == len(set(lines))
