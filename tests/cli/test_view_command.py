"""``warp-corot view``: its options are those of ``simulate``, and it begins and ends quietly."""

import http.client
import os
import re
import signal
import socket
import subprocess
import sys
import tomllib

import pytest
from command_line import run

import warp_corot as wc
from warp_corot.cli import Parser, make_parser
from warp_corot.cli.options import RUN, add_options
from warp_corot.cli.run_file import bodies_of
from warp_corot.cli.run_setup import set_up
from warp_corot.cli.view import _carry_over, run_text
from warp_corot.simulation.remade import remade

#: What simulate writes, and view does not.
OUTPUTS = {"output", "also", "preview", "preview_frames", "preview_views", "probe", "csv", "write_run"}


def spoken(err):
    """The lines of stderr, without those that an empty kernel cache adds."""
    return [line for line in err.splitlines() if "compiling kernels" not in line and "note" not in line]


def asked(*words):
    return bodies_of(make_parser().parse_args(["view", *map(str, words)]))


def test_options_are_those_of_simulate():
    parser = Parser(prog="simulate")
    add_options(parser, RUN)
    (args,) = asked("box", "--device", "cpu")
    for action in parser._actions:
        if action.dest not in ("help", "input", "device"):
            assert getattr(args, action.dest) == action.default, action.dest
    (view,) = (action.choices["view"] for action in make_parser()._actions if action.dest == "command")
    here = {action.dest for action in view._actions}
    there = {action.dest for action in parser._actions}
    assert there - here == OUTPUTS | {"static"}
    assert here - there == {"host", "port", "token"}


def test_what_simulate_refuses_view_refuses(folder, capsys):
    pytest.importorskip("websockets")
    for words, said in (
        (["box", "--young", "-1"], "--young is -1"),
        (["box", "--refine-above", "2"], "--refine-above is for --remesh"),
        (["no.stl"], "no.stl: no such file"),
        (["box", "-o", "a.usd"], "there is no option -o"),
        (["box", "--host", "0.0.0.0", "--token", ""], "token is empty"),
        (["box", "--port", "70000"], "port is 70000; it must be 0 to 65535"),
    ):
        assert run("view", *words) == 2, words
        (line,) = spoken(capsys.readouterr().err)
        assert said in line


def test_a_port_in_use_is_reported_before_meshing(capsys):
    pytest.importorskip("websockets")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        assert run("view", "box", "--port", taken.getsockname()[1]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert re.search(r"port \d+ of 127.0.0.1 cannot be opened \(Address already in use\)", line)


def test_without_websockets_one_line_says_what_to_install(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "websockets", None)
    assert run("view", "box") == 2
    assert 'pip install "warp-corot[view]"' in capsys.readouterr().err


@pytest.mark.skipif(sys.platform == "win32", reason="signals are others there")
@pytest.mark.parametrize(
    ("number", "status"),
    [(signal.SIGINT, 0), pytest.param(signal.SIGTERM, 143, marks=pytest.mark.slow)],
)
def test_ctrl_c_ends_it_quietly(number, status, tmp_path):
    pytest.importorskip("websockets")
    command = [sys.executable, "-m", "warp_corot", "view", "box", "--port", "0", "--device", "cpu"]
    process = subprocess.Popen(
        command,
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=dict(os.environ),
        # Jobs in the background ignore Ctrl-C, and so would their children.
        preexec_fn=lambda: signal.signal(number, signal.SIG_DFL),
    )
    try:
        assert process.stdout is not None
        port = int(re.search(r"http://127.0.0.1:(\d+)/", process.stdout.readline())[1])
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
        connection.request("GET", "/")
        assert connection.getresponse().status == 200
        connection.close()
        process.send_signal(number)
        out, err = process.communicate(timeout=120)
    finally:
        process.kill()
    assert process.returncode == status
    assert out == ""
    assert "Traceback" not in err
    assert spoken(err) == []


def test_the_run_file_has_the_state_of_the_page(folder):
    ready = set_up(asked("box", "--device", "cpu", "--gravity", "0", "0", "-1", "--fix", "z == zmin"))
    body = ready.bodies[0]
    options = [body.args]
    stiffer = wc.Isotropic(young=1e3, poisson=0.3, density=10.0)
    sim = remade(ready.sim, models=[wc.StVenantKirchhoff()], materials=[stiffer], remesh=[wc.OnlineRemesh()])
    light = remade(ready.sim, gravity=(0.0, 0.0, 0.0))
    text = run_text(options, sim)
    told = tomllib.loads(text.decode())
    assert told["model"] == "stvk"
    assert told["young"] == 1e3
    assert (told["poisson"], told["density"]) == (0.3, 10.0)
    assert tomllib.loads(run_text(options, light).decode())["gravity"] == [0.0, 0.0, 0.0]
    assert told["remesh"] is True
    assert told["gravity"] == [0.0, 0.0, -1.0]
    (folder / "run.toml").write_bytes(text)
    again = set_up(asked("run.toml"))
    assert isinstance(again.sim.models[0], wc.StVenantKirchhoff)
    assert again.sim.remeshing.every
    plain = tomllib.loads(run_text(options, ready.sim).decode())
    assert "remesh" not in plain
    assert "model" not in plain  # the default


def test_pressed_patches_stay_pressed_after_a_switch(folder):
    ready = set_up(
        asked("box", "--device", "cpu", "--press", "z == zmax", "10", "--ramp", "0.001", "--gravity", 0, 0, 0)
    )
    sim = remade(ready.sim, models=[wc.StVenantKirchhoff()])
    sim.body.load("all", (0.0, 0.0, 0.0))
    _carry_over(ready, ready.bodies[0].args, sim)
    assert ready.bodies[0].soft is sim.body
    sim.advance(0.05)
    assert sim.body.loads.numpy().sum(axis=0)[2] == pytest.approx(-10 * 0.064**2, rel=1e-3)
