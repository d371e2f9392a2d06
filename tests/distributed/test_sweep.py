"""Sweeps over parameters: every combination is run once, even after an interruption."""

import csv
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import swept
from command_line import run

import warp_corot as wc
import warp_corot.distributed as wd
from warp_corot.cli.sweep import values_of


def calls(folder):
    return sorted((folder / "calls.txt").read_text().splitlines())


def test_every_combination_is_made_once_and_has_a_row(folder):
    grid = {"a": [1, 2, 3], "b": np.array([1.0, 2.0]), "folder": [str(folder)]}
    with ThreadPoolExecutor(2) as engine:
        rows = wd.sweep(swept.product, grid, folder="results", executor=engine)
    assert [(row["a"], row["b"], row["product"]) for row in rows] == [(a, b, a * b) for a in (1, 2, 3) for b in (1, 2)]
    assert len(calls(folder)) == 6
    with open("results/table.csv", newline="") as file:
        table = list(csv.DictReader(file))
    assert [float(row["sum"]) for row in table] == [row["sum"] for row in rows]
    assert list(table[0]) == ["a", "b", "folder", "product", "sum", "seconds", "error"]
    # More of the same: what is done is not done again.
    with ThreadPoolExecutor(2) as engine:
        wd.sweep(swept.product, grid | {"a": [1, 2, 3, 4]}, folder="results", executor=engine)
    assert len(calls(folder)) == 8


def test_runs_go_together_as_worlds_of_one_call_do(folder):
    grid = {"a": [1, 2, 3], "b": [1, 2, 3], "folder": [str(folder)]}
    with ThreadPoolExecutor(1) as engine:
        rows = wd.sweep(swept.side_by_side, grid, together=4, retries=0, folder="results", executor=engine)
        assert [row["product"] for row in rows] == [a * b for a in (1, 2, 3) for b in (1, 2, 3)]
        assert [row["error"] for row in rows] == [""] * 9
        # Four, four with a three that fails, the last one; then each of the second call.
        assert calls(folder) == sorted(["4", "4", "1"] + ["1"] * 4)
        rows = wd.sweep(swept.product, grid, together=4, retries=0, folder="others", executor=engine)
    assert all("TypeError" in row["error"] or "InputError" in row["error"] for row in rows)


def test_a_journal_that_ends_within_a_line_goes_on(folder):
    grid = {"a": [1, 2, 3], "b": [1], "folder": [str(folder)]}
    with ThreadPoolExecutor(1) as engine:
        wd.sweep(swept.product, grid, folder="results", executor=engine)
        journal = folder / "results" / "runs.jsonl"
        journal.write_bytes(journal.read_bytes()[:-7])
        rows = wd.sweep(swept.product, grid, folder="results", executor=engine)
    assert [row["product"] for row in rows] == [1, 2, 3]
    assert len(calls(folder)) == 4


def test_a_worker_that_is_killed_loses_nothing(folder):
    grid = {"a": [1, 2], "b": [1, 2], "folder": [str(folder)]}
    rows = wd.sweep(swept.deadly, grid, folder="results", workers=1)
    assert (folder / "killed").exists()
    assert [row["error"] for row in rows] == [""] * 4
    assert calls(folder) == ["1 1", "1 2", "2 1", "2 2"]


def test_failures_are_reported_and_repeated(folder):
    grid = {"a": [1, 2], "folder": [str(folder)]}
    with ThreadPoolExecutor(1) as engine:
        rows = wd.sweep(swept.failing, grid, folder="results", executor=engine, retries=1)
        assert [row["error"] for row in rows] == ["", "ValueError: a is two"]
        (folder / "right").touch()
        rows = wd.sweep(swept.failing, grid, folder="results", executor=engine)
    assert [row["result"] for row in rows] == [1, 2]


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({}, "no parameters"),
        ({"a": 1}, "a is 1"),
        ({"a": [1, 1]}, "the same parameters"),
        ({"a": [np.inf]}, "inf"),
        (5, "parameters is 5"),
    ],
)
def test_bad_parameters_are_refused(given, said):
    with pytest.raises(wc.InputError, match=said):
        wd.sweep(swept.failing, given)


def test_a_function_that_other_processes_cannot_import_is_refused():
    with pytest.raises(wc.InputError, match="top of a module"):
        wd.sweep(lambda a: {"b": a}, {"a": [1]})
    with pytest.raises(wc.InputError, match="folder is 5"):
        wd.sweep(swept.failing, {"a": [1]}, folder=5)
    with ThreadPoolExecutor(1) as engine:
        assert wd.sweep(lambda a: {"b": 2 * a}, {"a": [1]}, executor=engine)[0]["b"] == 2


def test_values_of_options():
    assert values_of("young=1kPa,5kPa") == ("young", [1e3, 5e3])
    assert values_of("poisson=0.3:0.45:4") == ("poisson", pytest.approx([0.3, 0.35, 0.4, 0.45]))
    assert values_of("young=1kPa:100kPa:3:log") == ("young", pytest.approx([1e3, 1e4, 1e5]))
    assert values_of("model=linear,corotated") == ("model", ["linear", "corotated"])
    for text, said in (
        ("young", "OPTION=VALUES"),
        ("yung=1", "'yung' is not an option"),
        ("young=1kg", "young"),
        ("output=a,b", "sets output itself"),
    ):
        with pytest.raises(wc.InputError, match=said):
            values_of(text)


def test_the_command_sweeps(folder, capsys):
    words = ("sweep", "box", "--vary", "young=500,30MPa", "--duration", "0.05", "--probe", "z == zmax")
    words = (*words, "--device", "cpu")
    assert run(*words, "-o", "results", "--workers", "1") == 0
    assert "2 of 2 runs" in capsys.readouterr().out
    with open("results/table.csv", newline="") as file:
        soft, stiff = csv.DictReader(file)
    assert float(soft["largest displacement [m]"]) > float(stiff["largest displacement [m]"]) > 0.0
    # All have the same kind of steps, also stiff ones, which a run by itself makes implicit.
    assert int(float(stiff["steps"])) > 100 * int(float(soft["steps"]))
    assert len(list((folder / "results" / "runs").glob("*.usd"))) == 2
    assert run(*words, "-o", "results") == 0
    # Other options would give other results.
    assert run(*words, "--duration", "0.2", "-o", "results") == 2
    assert "another folder" in capsys.readouterr().err
    # What no run can read is said before the first one.
    assert run("sweep", "no.stl", "--vary", "young=500,1kPa", "-o", "others") == 2
    assert "no.stl: no such file" in capsys.readouterr().err
    assert not (folder / "others").exists()
