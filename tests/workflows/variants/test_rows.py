"""What a comparison leaves out where it would not compare, and what it says of that."""

import pytest

from eddies.measures import MEASURES
from eddies.scene.comparison import load_comparison
from eddies.workflows.variants import rows as module
from eddies.workflows.variants.rows import THROUGH_KERNEL, notes, rows
from eddies.workflows.variants.run import VariantRun

HEAD = 'base = "tiny"\nturnovers = 0.25\nset = ["kernel.steps=50"]\n[[variant]]\nname = "plain"\n'


def variant(name, *changes):
    return f'[[variant]]\nname = "{name}"\nset = {list(changes)}\n'


def comparison(tmp_path, *variants):
    (tmp_path / "case.toml").write_text(HEAD + "".join(variants))
    return load_comparison(tmp_path / "case.toml")


@pytest.mark.parametrize("change", ["kernel.neighbors=40", "kernel.steps=60"])
def test_what_a_kernel_of_its_own_shows_is_left_out(tmp_path, monkeypatch, change):
    read = comparison(tmp_path, variant("smaller", "model.pairs.hidden=[8]", "simulation.step=0.05"),
                      variant("own", change))
    runs = [VariantRun(scene, tmp_path / name, tmp_path) for name, scene in read.scenes.items()]
    monkeypatch.setattr(module, "measured",
                        lambda *_: {"status": "complete", **dict.fromkeys(MEASURES, 0.5)})
    table = {row["name"]: row for row in rows(read, runs, None, 1)}
    for name, row in table.items():
        blank = {measure for measure in MEASURES if row[measure] is None}
        assert blank == (set(THROUGH_KERNEL) if name == "own" else set())
    (note,) = notes(read)
    assert note.startswith("own: no KL Q–R and KL Q–R, two samples of the truth. ")


def test_nothing_is_said_where_all_compares(tmp_path):
    assert notes(comparison(tmp_path, variant("none", "simulation.method=none"))) == []


def test_wavenumbers_that_grids_keep_are_told(tmp_path):
    grid = "simulation.method=eulerian"
    read = comparison(tmp_path, variant("grid-18", grid, "eulerian.cells=18"),
                      variant("grid-16", grid, "eulerian.cells=16"), variant("grid", grid))
    # Of 18 cells the mode 18/3 = 6 is not kept; by default there are 8, the fewest.
    assert notes(read) == ["Of a grid the 2/3 rule leaves the wavenumbers |k_i| < cells/3, at most: 5 in grid-18, "
                           "5 in grid-16, 2 in grid; k_d = 3."]
