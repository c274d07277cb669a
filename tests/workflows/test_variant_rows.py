"""Rows of the table of variants, and the notes on them."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from eddies.io.hdf5 import create_product, write_table
from eddies.io.weights import save_weights
from eddies.measures import MEASURES
from eddies.scene.scene import load_scene
from eddies.workflows.variant_rows import (BEFORE, SEARCH, THROUGH_KERNEL, before, combined, machine, missing_reason,
                                           notes, numbers, rows_of, simulation_seconds)
from tests.small_scene import TINY

HEAD = f'base = "{TINY}"\nsimulation.turnovers = 0.25\nkernel.steps = 50\n'


def scene_of(tmp_path, *variants, head=""):
    tables = [f"[variant.{name}]\n" + "\n".join(changes) + "\n" for name, *changes in variants]
    (tmp_path / "case.toml").write_text("".join([head, HEAD, "[variant.plain]\n", *tables]))
    return load_scene(tmp_path / "case.toml")


REALISED = {"status": "complete", "end": 1.0, "wall_seconds": 4.0, "wall_seconds_low": 3.0, "wall_seconds_high": 5.0,
            **dict.fromkeys(MEASURES, 0.5)}


def test_realisations_have_mean_and_spread():
    others = [REALISED | {"energy_ratio": ratio, "wall_seconds": seconds, "wall_seconds_low": seconds - 1.0}
              for ratio, seconds in ((0.7, 3.0), (0.9, 9.0))]
    row = combined([REALISED, *others])
    assert (row["realisations"], row["status"], row["qr_kl_spread"]) == (3, "complete", 0.0)
    assert row["energy_ratio"] == pytest.approx(0.7) and row["energy_ratio_spread"] == pytest.approx(0.2)
    assert (row["wall_seconds_low"], row["wall_seconds"], row["wall_seconds_high"]) == (2.0, 4.0, 5.0)
    assert "energy_ratio_spread" not in combined([REALISED])
    assert row["busy"] is False and combined([REALISED | {"busy": False}, REALISED | {"busy": True}])["busy"] is True


def test_one_realisation_that_stops_leaves_no_number():
    stopped = REALISED | {"status": "stopped: step 3", "stopped_at": 0.2, "energy_ratio": None}
    row = combined([REALISED, stopped])
    assert (row["status"], row["stopped_at"], row["energy_ratio"]) == ("stopped: step 3", 0.2, None)


@pytest.mark.parametrize("change", ["kernel.neighbors = 40", "kernel.steps = 60"])
def test_numbers_of_another_kernel_are_left_out(tmp_path, change):
    scene = scene_of(tmp_path, ("smaller", "model.pairs.hidden = [8]", "simulation.step = 0.05"), ("own", change))
    rows, different = rows_of(scene, dict.fromkeys(scene.variant, [tmp_path]),
                              dict.fromkeys(scene.variant, [REALISED]), None)
    assert [{measure for measure in MEASURES if row[measure] is None} for row in rows] == [
        set(), set(), set(THROUGH_KERNEL)]
    _, note = notes((), different, {})
    assert note.startswith("own: no ") and all(MEASURES[name] in note for name in THROUGH_KERNEL)


def test_a_variant_without_a_rollout_says_why(tmp_path):
    ((row,), _) = rows_of(scene_of(tmp_path), {"plain": [tmp_path]}, {}, None)
    assert row["status"] == "not run"
    (tmp_path / "failure.txt").write_text("too few slabs\n")
    assert missing_reason(tmp_path) == missing_reason(tmp_path / "realisation-2") == "failed: too few slabs"


def test_a_turnover_costs_as_much_as_its_steps():
    rollout = {"seconds_per_step": 0.3, "seconds_per_step_low": 0.2, "seconds_per_step_high": 0.5, "time_step": 0.1,
               "eddy_turnover_time": 2.0, "status": "complete"}
    found = numbers({"attributes": rollout, "ranks": 3, "accuracy": {"velocity_kl": 0.5}})
    assert [found[f"wall_seconds{end}"] for end in ("", "_low", "_high")] == pytest.approx([6.0, 4.0, 10.0])
    assert found["core_seconds"] == pytest.approx(18.0)
    assert (found["stopped_at"], found["velocity_kl"]) == (None, 0.5)
    # The quartiles differ by 2.5 times; an earlier version has not stored the load.
    assert found["busy"] is True and found["surplus_load"] is None
    calm = rollout | {"seconds_per_step_high": 0.29}
    for surplus in (0.4, 0.6):
        found = numbers({"attributes": calm | {"surplus_load": surplus}, "ranks": 3, "accuracy": {}})
        assert (found["busy"], found["surplus_load"]) == (surplus > 0.5, surplus)
    stopped = numbers({"attributes": {"status": "stopped: here", "turnovers": 0.3}, "ranks": 3, "accuracy": {}})
    assert stopped == {"status": "stopped: here", "ranks": 3, "stopped_at": 0.3, "time_step": None}


def test_a_report_on_a_run_on_gpus_needs_none(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert machine("cuda", 2)["device"] == "cuda" and machine("cpu", 2)["ranks"] == 2


def test_a_note_says_how_many_flows_the_numbers_are_of():
    (one,), (several,) = notes((), [], {}), notes((2, 5), [], {})
    assert "one realisation" in one and "2 realisations, seeds 2, 5" in several


def test_notes_on_the_wavenumbers_that_grids_keep_and_on_different_particles(tmp_path):
    grids = [(f"grid-{cells}", 'simulation.method = "eulerian"', f"eulerian.cells = {cells}") for cells in (18, 16)]
    variants = scene_of(tmp_path, *grids).variant
    # A grid of 18 cells does not keep the mode 18/3 = 6.
    _, note = notes((), [], variants)
    assert "5 in grid-18, 5 in grid-16; the filter wavenumber k_d = pi/d is 3." in note
    few = SimpleNamespace(coarse_cells=0, tracers=variants["plain"].tracers.with_count(27))
    *_, note = notes((), [], {**variants, "few": few})
    assert note.startswith("Variants have different particles")


@pytest.mark.mpi(1)
@pytest.mark.parametrize("stored", [{"weights", "training_seconds", "training_steps"}, {"weights"}, set()],
                         ids=["trained", "weights without their cost", "no model"])
def test_the_cost_of_a_model_is_read_from_its_file(comm, tmp_path, stored):
    phases = [{"phase": "one step", "steps": 4, "seconds": 1.5, "error": 0.1},
              {"phase": "all losses", "steps": 2, "seconds": 0.5, "error": 0.2}]
    description = {"training": phases} if "training_seconds" in stored else {}
    save_weights(comm, tmp_path / "model.h5", "model", description, {"a": np.ones(3), "b": np.ones((2, 2))}, {})
    with create_product(comm, tmp_path / "step.h5", "step", {}) as file:
        file.create_group("found").attrs.update({"integrator": "rk2", "size": 0.1, "seconds": 7.5, "error": 0.3,
                                                 "error_with_half": 0.2})
        write_table(file, "trials/rk2", {"size": [0.4, 0.2, 0.1, 0.05], "error": [0.6, 0.5, 0.3, 0.2]})
    known = {"weights": 7, "training_seconds": 2.0, "training_steps": 6}
    search = dict(zip(SEARCH, ("rk2", 0.1, 7.5, 0.3, 0.2, 0.5)))
    model = tmp_path / "model.h5" if stored else None
    found = before(model, tmp_path / "step.h5", comm)
    assert found == {key: known[key] for key in stored} | search and set(found) <= set(BEFORE)
    for missing in (None, tmp_path / "missing.h5"):
        assert before(missing, missing, comm) == {}


def test_the_direct_simulation_is_timed_with_the_others_where_a_variant_repeats_it():
    rows = [{"name": name, "wall_seconds": seconds} for name, seconds in (("plain", 1.0), ("grid", 2.0), ("dns", 5.0))]
    assert simulation_seconds(rows, ["dns"], 9.0) == 5.0 and simulation_seconds(rows, [], 9.0) == 9.0
