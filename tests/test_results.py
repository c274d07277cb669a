"""The tables of README and docs are those of the results that are kept with them."""

import importlib.util
import json
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[1] / "docs"
RECORD = {"rows": [
    {"name": "one", "velocity_error_half": 0.02134, "velocity_error_half_spread": 0.00312, "energy_ratio": 0.99584,
     "qr_kl": 1.5e-5, "qr_kl_floor": 0.0251, "wall_seconds": 131.2},
    {"name": "two", "velocity_error_half": None, "energy_ratio": None, "qr_kl": 0.0, "qr_kl_floor": 0.0251,
     "wall_seconds": 0.0689}]}
PAGE = """before
<!-- table of own: wall_seconds velocity_error_half energy_ratio qr_kl
heads: model | needs
one: the **first** | pairs
two: 2: another |
floor: samples |
-->
{}<!-- end of table -->
after
"""
LINES = """| model | needs | seconds a turnover | velocity error at T/2 | energy, model / truth | KL Q–R |
|---|---|---|---|---|---|
| the **first** | pairs | 130 | 0.021 ± 0.003 | 0.996 | 1.5e-05 |
| 2: another | | 0.069 |  |  | 0 |
| samples | |  |  |  | 0.025 |
"""


@pytest.fixture
def tables():
    """docs/tables.py, imported."""
    spec = importlib.util.spec_from_file_location("tables", DOCS / "tables.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_table_is_that_of_its_results(tables):
    for page in tables.PAGES:
        text = page.read_text(encoding="utf-8")
        assert tables.written(text) == text, f"{page.name}: .venv/bin/python docs/tables.py"
        assert text.count("<!-- table of ") == len(tables.TABLE.findall(text))
        assert text.count("<!-- numbers of ") == len(tables.NUMBERS.findall(text))
    for path, written in ((tables.STEPS, tables.steps), (tables.CHOICES, tables.choices)):
        assert path.read_text(encoding="utf-8") == written(), ".venv/bin/python docs/tables.py"


@pytest.mark.parametrize("metrics, left", [
    ({"rows": RECORD["rows"], "rollouts": {"one": {}}} | dict.fromkeys(
        ("name", "title", "machine", "flow", "simulation_seconds", "summary"), "a word"), {"rollouts"}),
    ({"rollouts": {"one": {}}, "warnings": []}, set())])
def test_of_a_comparison_the_rows_are_kept_and_of_another_run_all(tables, tmp_path, monkeypatch, metrics, left):
    for directory in ("run/report", "results"):
        (tmp_path / directory).mkdir(parents=True)
    (tmp_path / "run/report/metrics.json").write_text(json.dumps(metrics))
    monkeypatch.setattr(tables, "HERE", tmp_path)
    tables.keep("own", tmp_path / "run")
    assert tables.record_of("own") == {key: value for key, value in metrics.items() if key not in left}


def test_rows_of_forced_rollouts_are_kept_with_their_averages(tables, tmp_path, monkeypatch):
    for directory in ("run/report", "results"):
        (tmp_path / directory).mkdir(parents=True)
    metrics = dict.fromkeys(tables.KEPT, "a word") | {
        "rows": [{"name": "one"}, {"name": "two"}, {"name": "short"}],
        "rollouts": {"one": {"turnovers": 20.0}, "short": {"turnovers": 1.0}},
        "forced": {"one": {"energy": {"model": 1.5, "standard error": 0.03, "stationary flow": 1.25},
                           "spectrum_error": {"model": 0.1, "standard error": 0.02}},
                   "short": {"energy": {"model": 1.5, "standard error": None, "stationary flow": 1.25},
                             "spectrum_error": {"model": 0.1, "standard error": None}}}}
    (tmp_path / "run/report/metrics.json").write_text(json.dumps(metrics))
    monkeypatch.setattr(tables, "HERE", tmp_path)
    tables.keep("own", tmp_path / "run")
    page = "<!-- table of own: turnovers forced_energy_ratio forced_spectrum_error\n-->\n{}<!-- end of table -->"
    lines = ("| | turnovers | energy | spectrum error |\n|---|---|---|---|\n"
             "| `one` | 20 | 1.200 ± 0.024 | 0.10 ± 0.02 |\n| `two` |  |  |  |\n| `short` | 1 | 1.200 | 0.1 |\n")
    assert tables.written(page.format("")) == page.format(lines)


def test_numbers_of_a_run_are_those_of_its_metrics(tables, tmp_path, monkeypatch):
    (tmp_path / "results").mkdir()
    record = {"rollout": {"energy_ratio": 0.99584, "bands": {"1-2": 1.25}}}
    (tmp_path / "results/own.json").write_text(json.dumps(record))
    monkeypatch.setattr(tables, "HERE", tmp_path)
    page = ("<!-- numbers of own\nenergy = {{rollout[energy_ratio]:.2f}}\n"
            "bands k = 1 = {{rollout[bands][1-2]:.1f}}\n-->\n{}<!-- end of numbers -->")
    lines = "| quantity | value |\n|---|---|\n| energy | 1.00 |\n| bands k = 1 | 1.2 |\n"
    assert tables.written(page.format("old\n")) == page.format(lines)


def test_a_table_has_the_rows_and_columns_that_its_comment_names(tables, tmp_path, monkeypatch):
    (tmp_path / "results").mkdir()
    (tmp_path / "results/own.json").write_text(json.dumps(RECORD))
    monkeypatch.setattr(tables, "HERE", tmp_path)
    assert tables.written(PAGE.format("anything\n")) == PAGE.format(LINES)
    with pytest.raises(KeyError, match="three"):
        tables.written(PAGE.format("").replace("two:", "three:"))


def test_a_table_without_rows_has_all_and_one_may_have_rows_of_others(tables, tmp_path, monkeypatch):
    (tmp_path / "results").mkdir()
    (tmp_path / "results/own.json").write_text(json.dumps(RECORD))
    other = {"rows": [{"name": "one", "energy_ratio": "stopped"}]}
    (tmp_path / "results/other-0.08.json").write_text(json.dumps(other))
    monkeypatch.setattr(tables, "HERE", tmp_path)
    page = "<!-- table of {}: energy_ratio\n{}-->\n{}<!-- end of table -->"
    head = "| | energy, model / truth |\n|---|---|\n"
    lines = head + "| `one` | 0.996 |\n| `two` |  |\n"
    assert tables.written(page.format("own", "", "")) == page.format("own", "", lines)
    rows = "one: here\nother-0.08/one: there\n"
    assert tables.written(page.format("own", rows, "")) == page.format(
        "own", rows, head + "| here | 0.996 |\n| there | stopped |\n")
