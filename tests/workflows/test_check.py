"""Numbers told before a run, for people and for programs, and nothing is written; times of stages against runs."""

import json
import logging
from dataclasses import replace
from pathlib import Path

import pytest

from eddies.scene.scene import Time, builtin_scenes, load_scene
from eddies.workflows import check
from tests.small_scene import TINY, one_model


def lines_of(scene, comm, caplog):
    with caplog.at_level(logging.INFO, logger="eddies"):
        check.run(scene, comm)
    return "\n".join(record.getMessage() for record in caplog.records)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("name", [name for name, _ in builtin_scenes()])
def test_check_of_any_scene_writes_nothing(comm, tmp_path, monkeypatch, caplog, name):
    monkeypatch.chdir(tmp_path)
    text = lines_of(load_scene(name), comm, caplog)
    for subject in ("grid", "turbulence", "steps", "ranks", "stages"):
        assert subject in text
    assert list(tmp_path.iterdir()) == []


@pytest.mark.mpi(2, 3)
def test_check_on_more_ranks(comm, caplog):
    text = lines_of(one_model("hit-small"), comm, caplog)
    assert text == "" if comm.rank > 0 else "at most 12" in text and f"on {comm.size} ranks" in text


@pytest.mark.mpi(1, 2)
def test_numbers_for_programs(comm, capfd):
    check.run(one_model("hit-small"), comm, as_json=True)
    shown = capfd.readouterr().out
    if comm.rank > 0:
        assert shown == ""
        return
    told = json.loads(shown)
    assert (told["particles"], told["largest_wavenumber"], told["most_ranks"]) == (32768, 21, 12)
    assert told["most_ranks"] == min(told["limits"].values()) <= told["most_ranks_dns"] and told["ranks"] == comm.size
    assert told["turbulence"]["reynolds_lambda"] == pytest.approx(50.3, abs=0.05)
    assert told["warnings"] == told["refusals"] == []
    stages, totals = told["stage_costs"], told["totals"]
    assert [row["stage"] for row in stages] == told["stages"]
    for row in stages:
        assert row["seconds"] > 0 and row["memory"] > 1e7 and row["disk"] > 0 and row["scratch"] >= 0
        assert row["least_seconds"] <= row["seconds"] and row["least_memory"] <= row["memory"]
        assert row["most_ranks"] == told["most_ranks_dns" if row["stage"] == "dns" else "most_ranks"]
    for name in ("seconds", "disk"):
        assert totals[name] == pytest.approx(sum(row[name] for row in stages))
    assert totals["memory"] == max(row["memory"] for row in stages) and totals["most_disk"] >= totals["disk"]
    assert told["rollout"]["evaluations"] == 3 * told["rollout"]["steps"] + 1


@pytest.mark.mpi(1)
def test_every_key_is_described(comm, capfd):
    described = (Path(__file__).parents[2] / "docs/check.md").read_text(encoding="utf-8")
    check.run(load_scene(TINY), comm, as_json=True)

    def keys(value):
        for part in value if isinstance(value, list) else [value] if isinstance(value, dict) else []:
            for key, inner in part.items() if isinstance(part, dict) else []:
                yield key
                yield from keys(inner) if key != "limits" else ()

    assert [key for key in dict.fromkeys(keys(json.loads(capfd.readouterr().out))) if f"`{key}`" not in described] == []


@pytest.mark.mpi(1)
def test_what_is_not_known_is_null(comm, capfd, own, caplog):
    check.run(load_scene("abc"), comm, as_json=True)
    told = json.loads(capfd.readouterr().out)
    assert told["turbulence"] is told["particles"] is told["kernel_support"] is None
    assert told["rollout"] is told["mach_turbulent"] is None
    own("own_start", "def swirl(grid, initial, seed): pass\n")
    scene = replace(load_scene("taylor-green", ["initial.kind=own_start:swirl"]), time=Time(duration=1))
    assert check.numbers(scene, comm)["stage_costs"][0]["seconds"] is None
    text = lines_of(scene, comm, caplog)
    assert "not known: the speed of the initial flow is not known" in text


@pytest.mark.mpi(1)
def test_numbers_of_the_small_case(comm, caplog):
    text = lines_of(one_model("hit-small"), comm, caplog)
    for part in ("spacing 0.09817, k_max 21", "32^3 = 32768, mean spacing 0.1963 = 2 cells", "Re_lambda 50.3",
                 "filter width 0.3927", "kernel support 0.4769, 60 neighbours", "at most 12"):
        assert part in text


@pytest.mark.mpi(1)
def test_warnings_and_refusals_are_told(comm, caplog):
    assert "k_max eta is about 0.047, below 1" in lines_of(load_scene(TINY, ["flow.viscosity=0.001"]), comm, caplog)
    text = lines_of(load_scene("taylor-green", ["initial.kind=file", "initial.path=nowhere.h5"]), comm, caplog)
    assert "fails here  nowhere.h5" in text
