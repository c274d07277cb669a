"""What a comparison leaves out where it would not compare, and what it says of that."""

import pytest

from eddies.measures import MEASURES
from eddies.scene.comparison import load_comparison
from eddies.workflows.variants import rows as module
from eddies.workflows.variants.rows import THROUGH_KERNEL, notes, rows, together
from eddies.workflows.variants.run import VariantRun

HEAD = 'base = "tiny"\nturnovers = 0.25\nset = ["kernel.steps=50"]\n[[variant]]\nname = "plain"\n'


def variant(name, *changes):
    return f'[[variant]]\nname = "{name}"\nset = {list(changes)}\n'


def comparison(tmp_path, *variants, head=""):
    (tmp_path / "case.toml").write_text(head + HEAD + "".join(variants))
    return load_comparison(tmp_path / "case.toml")


REALISED = {"status": "complete", "end": 1.0, "wall_seconds": 4.0, "wall_seconds_low": 3.0, "wall_seconds_high": 5.0,
            **dict.fromkeys(MEASURES, 0.5)}


def test_realisations_are_told_by_mean_and_spread():
    others = [REALISED | {"energy_ratio": ratio, "wall_seconds": seconds, "wall_seconds_low": seconds - 1.0}
              for ratio, seconds in ((0.7, 3.0), (0.9, 9.0))]
    row = together([REALISED, *others])
    assert (row["realisations"], row["status"], row["qr_kl_spread"]) == (3, "complete", 0.0)
    assert row["energy_ratio"] == pytest.approx(0.7) and row["energy_ratio_spread"] == pytest.approx(0.2)
    assert (row["wall_seconds_low"], row["wall_seconds"], row["wall_seconds_high"]) == (2.0, 4.0, 5.0)
    assert "energy_ratio_spread" not in together([REALISED])


def test_one_realisation_that_came_to_no_end_leaves_no_number():
    stopped = REALISED | {"status": "stopped: step 3", "stopped_at": 0.2, "energy_ratio": None}
    row = together([REALISED, stopped])
    assert (row["status"], row["stopped_at"], row["energy_ratio"]) == ("stopped: step 3", 0.2, None)


@pytest.mark.parametrize("change", ["kernel.neighbors=40", "kernel.steps=60"])
def test_what_a_kernel_of_its_own_shows_is_left_out(tmp_path, monkeypatch, change):
    read = comparison(tmp_path, variant("smaller", "model.pairs.hidden=[8]", "simulation.step=0.05"),
                      variant("own", change))
    runs = {name: [VariantRun(scene, tmp_path / name, tmp_path)] for name, scene in read.scenes.items()}
    monkeypatch.setattr(module, "measured", lambda *_: REALISED)
    monkeypatch.setattr(module, "training_seconds", lambda *_: None)
    table = {row["name"]: row for row in rows(read, runs, None, 1)}
    for name, row in table.items():
        blank = {measure for measure in MEASURES if row[measure] is None}
        assert blank == (set(THROUGH_KERNEL) if name == "own" else set())
    _, note = notes(read)
    assert note.startswith("own: no KL Q–R and KL Q–R, two samples of the truth. ")


def test_it_is_told_of_how_many_flows_the_numbers_are(tmp_path):
    none = variant("none", "simulation.method=none")
    (one,) = notes(comparison(tmp_path, none))
    assert one.startswith("Of one realisation: ")
    (several,) = notes(comparison(tmp_path, none, head="realisations = [2, 5]\n"))
    assert several.startswith("Mean and standard deviation over 2 realisations, seeds 2, 5, that no training")


def test_wavenumbers_that_grids_keep_are_told(tmp_path):
    grid = "simulation.method=eulerian"
    read = comparison(tmp_path, variant("grid-18", grid, "eulerian.cells=18"),
                      variant("grid-16", grid, "eulerian.cells=16"), variant("grid", grid))
    # Of 18 cells the mode 18/3 = 6 is not kept; by default there are 8, the fewest.
    assert notes(read)[1] == ("Of a grid the 2/3 rule leaves the wavenumbers |k_i| < cells/3, at most: 5 in grid-18, "
                              "5 in grid-16, 2 in grid; k_d = 3.")
