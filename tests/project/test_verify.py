"""The cases of ``warp-corot verify``: all pass, and what the command says."""

import json
from dataclasses import replace

import pytest

from warp_corot.cli import main
from warp_corot.cli.verify import write_json
from warp_corot.experiments import CASES, Row, Setup, run_case


@pytest.mark.parametrize("full", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", CASES)
def test_every_row_passes(name, full, device):
    rows, _ = run_case(name, Setup(device, full))
    assert rows
    for each in rows:
        assert each.passes, each


@pytest.mark.slow
@pytest.mark.parametrize(("name", "least"), [("cantilever", 3.7), ("torsion", 3.5), ("pipe", 3.0)])
def test_halving_elements_divides_the_error(name, least, device):
    """Displacements converge with the second order."""
    coarse, fine = (run_case(name, Setup(device, full))[0][0] for full in (False, True))
    assert abs(coarse.error) > least * abs(fine.error)


def test_errors_are_relative_to_the_reference_or_a_scale():
    assert Row("force", 1.1, 1.0, 0.2).passes
    assert not Row("force", 1.1, 1.0, 0.05).passes
    assert not Row("force", -1.0, 1.0, 0.5).passes
    assert Row("gap", 0.1, 0.0, 0.02, scale=10.0).error == pytest.approx(0.01)


def test_the_command_prints_a_table_and_writes_json(tmp_path, capsys):
    path = tmp_path / "rows.json"
    assert main(["verify", "slope", "--device", "cpu", "--json", str(path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    read = json.loads(path.read_text(encoding="utf-8"))
    assert lines[-1].startswith("4 of 4 rows pass")
    assert [each["quantity"] in line for each, line in zip(read["rows"], lines[1:-1], strict=True)] == [True] * 4
    assert read["schema"] == "warp-corot/verify"
    assert all(each["passes"] and each["source"] == "Coulomb" for each in read["rows"])


def test_a_row_beyond_its_bound_is_said(tmp_path, capsys, monkeypatch):
    def wrong(setup):
        return [Row("weight", float("nan"), 1.0, 0.1, "N")]

    monkeypatch.setitem(CASES, "slope", replace(CASES["slope"], run=wrong))
    path = tmp_path / "rows.json"
    assert main(["verify", "slope", "--device", "cpu", "--json", str(path)]) == 4
    assert "FAILS" in capsys.readouterr().out
    assert json.loads(path.read_text(encoding="utf-8"))["rows"][0]["result"] is None


def test_cases_are_listed_and_unknown_ones_refused(capsys):
    assert main(["verify", "--list"]) == 0
    assert capsys.readouterr().out.count("reference: ") == len(CASES)
    assert main(["verify", "slop", "--device", "cpu"]) == 2
    assert "did you mean slope" in capsys.readouterr().err


def test_a_failed_write_leaves_no_part(tmp_path, monkeypatch):
    (tmp_path / "rows.json").write_text("old")
    monkeypatch.setattr("os.replace", lambda *args: (_ for _ in ()).throw(OSError(28, "No space left")))
    with pytest.raises(OSError, match="No space"):
        write_json(tmp_path / "rows.json", {"rows": []})
    assert [(each.name, each.read_text()) for each in tmp_path.iterdir()] == [("rows.json", "old")]
