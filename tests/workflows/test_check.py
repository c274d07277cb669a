"""`eddies check`: estimates as text and as JSON, of all variants, without writing anything."""

import json
import logging
from dataclasses import replace
from pathlib import Path

import pytest

from eddies.scene.scene import SceneError, Time, load_scene
from eddies.workflows import check
from tests.small_scene import TINY, one_model


def lines_of(scene, comm, caplog):
    with caplog.at_level(logging.INFO, logger="eddies"):
        check.run(scene, comm)
    return "\n".join(record.getMessage() for record in caplog.records)


def json_of(scene, comm, capfd):
    check.run(scene, comm, as_json=True)
    shown = capfd.readouterr().out
    assert comm.rank == 0 or shown == ""
    return json.loads(shown) if comm.rank == 0 else None


@pytest.mark.mpi(1, 3)
def test_lines_of_the_small_case(comm, tmp_path, monkeypatch, caplog):
    monkeypatch.chdir(tmp_path)
    text = lines_of(one_model("hit-small"), comm, caplog)
    assert list(tmp_path.iterdir()) == [] and (text == "") == (comm.rank > 0)
    for key, value in (("largest_wavenumber", "21"), ("particles", "32768"), ("filter_width", "0.3927"),
                       ("kernel_support", "0.4769"), ("most_ranks", "12"), ("ranks", comm.size)) if text else ():
        assert f"\n{key:20}{value}\n" in text


@pytest.mark.mpi(1, 2)
def test_numbers_for_programs(comm, capfd):
    found = json_of(one_model("hit-small"), comm, capfd)
    if found is None:
        return
    assert (found["particles"], found["largest_wavenumber"], found["most_ranks"]) == (32768, 21, 12)
    assert found["most_ranks"] == min(found["limits"].values()) <= found["most_ranks_dns"]
    assert found["ranks"] == comm.size and found["warnings"] == found["refusals"] == []
    assert found["turbulence"]["reynolds_lambda"] == pytest.approx(50.3, abs=0.05)
    stages, totals = found["stage_costs"], found["totals"]
    assert [row["stage"] for row in stages] == found["stages"]
    for row in stages:
        assert row["seconds"] > 0 and row["memory"] > 1e7 and row["disk"] > 0 and row["scratch"] >= 0
        assert row["least_seconds"] <= row["seconds"] and row["least_memory"] <= row["memory"]
        assert row["most_ranks"] == found["most_ranks_dns" if row["stage"] == "dns" else "most_ranks"]
    for name in ("seconds", "disk"):
        assert totals[name] == pytest.approx(sum(row[name] for row in stages))
    assert totals["memory"] == max(row["memory"] for row in stages) and totals["most_disk"] >= totals["disk"]


@pytest.mark.mpi(1)
def test_every_variant_is_reported_and_what_they_share_once(comm, capfd):
    found = json_of(load_scene("tiny", ["realisations=[2, 3]"]), comm, capfd)
    runs = {(row["variant"], row["stage"]): row["runs"] for row in found["stage_costs"]}
    assert runs[None, "dns"] == 3 and runs[None, "train-kernel"] == 3 and runs["paper", "simulate"] == 2
    assert runs["resolved", "train"] == 3 and runs["resolved", "find-step"] == 1  # its weights are tested on the others
    variants = [*load_scene("tiny").variant]
    assert [name for name, stage in runs if stage == "simulate"] == [*found["rollouts"]] == variants
    assert ("no-force", "train") not in runs and (None, "simulate") not in runs and ("paper", "dns") not in runs
    one = json_of(load_scene("tiny"), comm, capfd)
    seconds = [next(row["seconds"] for row in each["stage_costs"] if row["stage"] == "dns") for each in (found, one)]
    assert seconds[0] == pytest.approx(3 * seconds[1])


@pytest.mark.mpi(1)
def test_every_key_is_described(comm, capfd):
    described = (Path(__file__).parents[2] / "docs/check.md").read_text(encoding="utf-8")

    def keys(value):
        for part in value if isinstance(value, list) else [value] if isinstance(value, dict) else []:
            for key, inner in part.items() if isinstance(part, dict) else []:
                yield key
                yield from keys(inner) if key not in ("limits", "rollouts") else ()

    found = json_of(load_scene(TINY), comm, capfd)
    named = [*keys(found), *found["rollouts"]["tiny"]]
    assert [key for key in dict.fromkeys(named) if f"`{key}`" not in described] == []


@pytest.mark.mpi(1)
def test_what_is_unknown_is_null(comm, capfd, own, caplog):
    found = json_of(load_scene("abc"), comm, capfd)
    assert found["turbulence"] is found["particles"] is found["kernel_support"] is found["mach_turbulent"] is None
    assert found["rollouts"] == {"abc": None}
    sets = load_scene(TINY, ["tracers.few.particles_per_side=4"], ["model", "training", "simulation", "kernel"])
    assert [row["stage"] for row in json_of(sets, comm, capfd)["stage_costs"]] == ["dns", "report"]
    own("own_start", "def swirl(grid, initial, seed): pass\n")
    scene = replace(load_scene("taylor-green", ["initial.kind=own_start:swirl"]), time=Time(duration=1))
    assert check.numbers(scene, comm)["stage_costs"][0]["seconds"] is None
    assert f"{'time_step':20}not known" in lines_of(scene, comm, caplog)


@pytest.mark.mpi(1)
def test_problems_are_reported_and_refusals_raised(comm, caplog):
    assert "k_max eta is about 0.047" in lines_of(load_scene(TINY, ["flow.viscosity=0.001"]), comm, caplog)
    scene = load_scene("taylor-green", ["initial.kind=file", "initial.path=nowhere.h5"])
    with pytest.raises(SceneError, match="nowhere.h5"):
        lines_of(scene, comm, caplog)
    assert f"fails here          {Path.cwd()}/nowhere.h5" in "\n".join(record.getMessage() for record in caplog.records)
