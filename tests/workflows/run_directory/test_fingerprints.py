"""Fingerprints and provenance: a product depends on the keys, files and classes that its stage reads, on no others."""

from dataclasses import replace

import pytest

from eddies.io.hdf5 import create_product
from eddies.pipeline import STAGES as TABLE
from eddies.scene.scene import load_scene
from eddies.workflows.run_directory.fingerprints import stage_fingerprint, stage_provenance
from tests.small_scene import TINY

STAGES = list(TABLE)
FIRST = {"flow.viscosity=0.061": "dns", "seed=2": "dns", "kernel.steps=99": "train-kernel",
         "kernel.cutoff=sigmoid": "train-kernel", "training.window=0.4": "train-kernel", "device=cuda": "train",
         "model.pairs.hidden=[4]": "train", "training.steps=59": "train", "simulation.skin=0.2": "find-step",
         "simulation.turnovers=0.2": "simulate", "simulation.start=0.5": "simulate", "kernel.form=average": None,
         "name=x": None, "title=y": None}


def prints_of(scene):
    return [stage_fingerprint(scene, stage) for stage in STAGES]


def changed(scene, other):
    """The stages whose fingerprints differ."""
    return [stage for stage, one, two in zip(STAGES, prints_of(scene), prints_of(other)) if one != two]


@pytest.mark.parametrize("override, first", FIRST.items())
def test_fingerprint_changes_from_the_stage_that_reads_the_key(override, first):
    given = ["simulation.step=converged"]
    found = changed(load_scene(TINY, given), load_scene(TINY, [*given, override]))
    assert found == (STAGES[STAGES.index(first):] if first else [])


def test_a_rollout_without_a_model_does_not_depend_on_training():
    given = ["simulation.method=none"]
    scene = load_scene(TINY, given)
    assert changed(scene, load_scene(TINY, [*given, "model.pairs.hidden=[4]", "training.steps=50"])) == []
    assert changed(scene, load_scene(TINY, [*given, 'training.truths=["runs/b"]'])) == ["simulate", "report"]
    assert stage_provenance(scene, "simulate")["made_from"] == ["ground_truth", "kernel"]
    assert stage_provenance(load_scene(TINY), "simulate")["made_from"] == ["ground_truth", "kernel", "model"]


def test_the_window_without_training_is_the_default_of_training():
    scene = load_scene(TINY)
    alone = replace(scene, model=None, training=None, simulation=None)
    assert stage_fingerprint(alone, "train-kernel") == stage_fingerprint(scene, "train-kernel")


def test_files_of_a_series_with_equal_names_all_count(tmp_path):
    (tmp_path / "a.toml").write_text(f'[tracks]\npath = "{tmp_path}/*/t.csv"\nbox = 1\n')
    found = set()
    for texts in (("one", "two"), ("another", "two"), ("one", "another")):
        for folder, text in zip("12", texts):
            (tmp_path / folder).mkdir(exist_ok=True)
            (tmp_path / folder / "t.csv").write_text(text)
        found.add(stage_fingerprint(load_scene(tmp_path / "a.toml"), "dns"))
    assert len(found) == 3


@pytest.mark.parametrize("key, name, first", [("initial.path", "start.h5", "dns"), ("model.path", "model.h5", "train"),
                                              ("simulation.step_from", "step.h5", "simulate")])
def test_the_content_of_files_counts_not_their_place(tmp_path, key, name, first):
    base = ["initial.kind=file"] if key == "initial.path" else ["simulation.step=converged"]
    unset = ["initial.peak_wavenumber"] if key == "initial.path" else []
    scenes = []
    for folder, content in (("a", "one"), ("b", "another"), ("c", "one")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / name).write_text(content)
        path = tmp_path / folder / ("start.h5" if key == "initial.path" else "")
        scenes.append(load_scene(TINY, [*base, f"{key}={path}"], unset))
    one, another, same = scenes
    assert changed(one, another)[0] == first and stage_fingerprint(one, first) != stage_fingerprint(another, first)
    assert changed(one, same) == []


@pytest.mark.mpi(1)
def test_other_ground_truths_count_by_their_fingerprints(comm, tmp_path):
    scene = load_scene(TINY, [f'training.truths=["{tmp_path}"]'])
    prints = [stage_fingerprint(scene, "train")]
    for seed in (2, 3):
        origin = stage_provenance(load_scene(TINY, [f"seed={seed}"]), "dns")
        with create_product(comm, tmp_path / "ground_truth.h5", "ground_truth", origin):
            pass
        prints.append(stage_fingerprint(scene, "train"))
    assert len(set(prints)) == 3
    assert stage_fingerprint(scene, "train-kernel") == stage_fingerprint(load_scene(TINY), "train-kernel")


OWN = """
from dataclasses import dataclass
from eddies import Term, TermSettings
from eddies.flow.navier_stokes import CompressibleFluid as Honey0

class Drag(Term):
    def forward(self, context): return None
class Honey(Honey0): pass
def swirl(grid, initial, seed): pass
class Run:
    needs = ("model",)
    def advance(self, until, number): pass
    frame = status = series = description = has_density = advance
"""


@pytest.mark.parametrize("overrides, first", [
    (['model.terms=["pressure", "own_edited:Drag"]'], "train"), (["initial.kind=own_edited:swirl"], "dns"),
    (["simulation.method=own_edited:Run"], "find-step"), (["flow.fluid=own_edited:Honey"], "dns"),
    (['model.terms=["pressure", "pairs"]', "model.pairs.network=own_edited:Drag"], "train")])
def test_an_edited_class_is_another(own, overrides, first):
    path = own("own_edited", OWN)
    scene = load_scene(TINY, ["simulation.step=converged", *overrides])
    before = prints_of(scene)
    path.write_text(path.read_text() + "\n# tried another way\n")
    assert [stage for stage, old, new in zip(STAGES, before, prints_of(scene)) if new != old] == (
        STAGES[STAGES.index(first):])
    (name,) = scene.foreign
    assert stage_provenance(scene, "dns")["foreign"][name]["sha256"]
    assert "foreign" not in stage_provenance(load_scene(TINY), "train")
