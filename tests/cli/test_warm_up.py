"""``warp-corot warm-up``."""

import pytest

from warp_corot.cli import main, warm_up


@pytest.fixture(autouse=True)
def one_run(monkeypatch):
    monkeypatch.setattr(warm_up, "RUNS", {"a box": ["box", "--level", "3"]})


def test_it_makes_its_runs_and_says_how_long_they_take(capfd):
    assert main(["warm-up", "--device", "cpu"]) == 0
    out, err = capfd.readouterr()
    assert out.startswith("1 of 1: a box ... ")
    assert out.endswith(" s\n")
    assert not err


def test_a_run_that_fails_says_why(monkeypatch, capfd):
    monkeypatch.setattr(warm_up, "RUNS", {"a file": ["nowhere.stl"]})
    assert main(["warm-up", "--device", "cpu"]) == 2
    assert "nowhere.stl" in capfd.readouterr().err


def test_a_device_that_is_not_there_is_refused_first(capfd):
    assert main(["warm-up", "--device", "cuda:99"]) == 2
    assert capfd.readouterr().out == ""
