"""The division of wall time among parts."""

import threading
from types import SimpleNamespace

import pytest
import warp as wp

from warp_corot.cli import terminal
from warp_corot.inputs import stopwatch
from warp_corot.inputs.stopwatch import KERNELS, WATCH, Stopwatch
from warp_corot.kernels.stepping import pace


@pytest.fixture
def now(monkeypatch):
    clock = SimpleNamespace(seconds=0.0)
    monkeypatch.setattr(stopwatch.time, "perf_counter", lambda: clock.seconds)
    return clock


def test_each_moment_counts_for_the_innermost_part(now):
    watch, done = Stopwatch(), SimpleNamespace(stepping=10.0)
    watch.begin("importing", 0.5)
    now.seconds = 1.0
    with watch.part("stepping", into=done):
        now.seconds = 3.0
        with watch.part(KERNELS):
            now.seconds = 7.0
        now.seconds = 8.0
    now.seconds = 16.0
    watch.switch("writing")
    assert watch.parts == {"importing": 9.5, "stepping": 3.0, KERNELS: 4.0, "writing": 0.0}
    assert sum(watch.parts.values()) == 0.5 + now.seconds
    assert done.stepping == 13.0
    assert watch.clock() == now.seconds - 4.0


def test_other_threads_do_not_count(now):
    watch = Stopwatch()

    def work():
        with watch.part(KERNELS):
            now.seconds += 5.0

    with watch.part("preparing"):
        thread = threading.Thread(target=work)
        thread.start()
        thread.join()
    assert watch.parts["preparing"] == 5.0
    assert KERNELS not in watch.parts


def test_loading_kernels_is_no_stepping():
    """Once the command listens, whichever launch comes first."""
    terminal._listen()
    module = wp.get_module(pace.__name__)
    module.unload()
    WATCH.begin("", 0.0)
    with WATCH.part("stepping"):
        module.load(wp.get_device("cpu"))
    assert 0.0 < WATCH.parts["stepping"] < WATCH.parts[KERNELS]
