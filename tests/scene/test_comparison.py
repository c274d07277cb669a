"""Comparison files: what is read, what is refused and in which words."""

from pathlib import Path

import pytest

from eddies.scene.comparison import BUILT_IN, load_comparison
from eddies.scene.scene import SceneError

HEAD = 'title = "a test"\nbase = "tiny"\nturnovers = 0.25\n'
NAMES = sorted(path.stem for path in BUILT_IN.glob("*.toml"))


def variant(name, *changes, **keys):
    lines = ["[[variant]]", f'name = "{name}"', f"set = {list(changes)}"]
    return "\n".join(lines + [f'{key} = "{value}"' for key, value in keys.items()]) + "\n"


def written(tmp_path, text):
    path = tmp_path / "case.toml"
    path.write_text(text)
    return path


def test_variants_are_the_base_with_changes(tmp_path):
    shared = 'set = ["training.steps=50"]\n'
    comparison = load_comparison(written(tmp_path, HEAD + shared + variant("plain") + variant(
        "wide", "model.pairs.hidden=[32, 32]", "training.steps=70", group="size")))
    plain, wide = comparison.scenes["plain"], comparison.scenes["wide"]
    assert (plain.name, plain.training.steps, plain.simulation.turnovers) == ("plain", 50, 0.25)
    assert (wide.model.settings["pairs"].hidden, wide.training.steps) == ((32, 32), 70)
    assert wide.simulation == plain.simulation
    assert [one.group for one in comparison.variant] == ["model", "size"]
    assert (comparison.name, comparison.subject, comparison.repeats) == ("case", "plain", 3)
    assert comparison.columns is None


def test_measures_are_shown_in_the_order_in_which_they_are_asked_for(tmp_path):
    comparison = load_comparison(written(tmp_path, HEAD + 'columns = ["qr_kl", "energy_ratio"]\n' + variant("a")))
    assert comparison.columns == ("qr_kl", "energy_ratio")


def test_ground_truth_is_the_bases_unless_a_variant_has_its_own(tmp_path):
    path = written(tmp_path, HEAD + variant("a") + variant("more", "tracers.particles_per_side=14", run="runs/more"))
    comparison = load_comparison(path)
    assert [str(comparison.ground_truth_of(name)) for name in ("a", "more")] == ["runs/tiny", "runs/more"]
    assert str(load_comparison(path, "elsewhere").ground_truth_of("a")) == "elsewhere"


@pytest.mark.parametrize("name", NAMES)
def test_built_in_comparison(name):
    comparison = load_comparison(name)
    for variant_name in comparison.scenes:
        runs = comparison.runs_of(variant_name, Path("out"))
        rollouts = [run for run in runs if "simulate" in run.scene.stages]
        assert len(rollouts) == len(comparison.realisations or [None]) >= len(runs) - 1
    groups = {one.name: one.group for one in comparison.variant}
    assert groups[comparison.subject] != "baseline" and "baseline" in groups.values()
    methods = {scene.simulation.method for scene in comparison.scenes.values()}
    assert methods == {"learned", "none", "eulerian"}


BAD = [
    (HEAD, "[[variant]]: a comparison needs at least one"),
    ('title = "x"\n' + variant("a"), "base: this key is missing"),
    (HEAD + 'repets = 3\n' + variant("a"), "repets: no such key; did you mean repeats?"),
    (HEAD + 'realisations = [3, 1]\n' + variant("a"), "realisations = [3, 1]: 1 is the seed of the base, on whose"),
    (HEAD + 'realisations = [3, 3]\n' + variant("a"), "realisations = [3, 3]: 3 stands there more than once"),
    (HEAD + 'realisations = [4]\n' + variant("a", "training.truths=[\"runs/tiny-seed-4\"]"),
     'realisations = [4]: variant "a" is trained on runs/tiny-seed-4/ground_truth.h5, by [training] truths'),
    (HEAD + 'repeats = 0\n' + variant("a"), "repeats = 0: must be a whole number at least 1"),
    (HEAD + 'set = "training.steps=3"\n' + variant("a"), "must be a list of texts"),
    (HEAD + 'model = "lerned"\n' + variant("learned"), "did you mean learned?"),
    (HEAD + 'variant = 3\n', "variant = 3: must be sections; write [[variant]] before each"),
    (HEAD + variant("a", grup="y"), '[[variant]] number 1 ("a"): [variant] grup: no such key; did you mean group?'),
    (HEAD + '[[variant]]\nset = []\n', "[[variant]] number 1: [variant] name: this key is missing"),
    (HEAD + variant("a") + variant("a"), 'variant "a": 2 variants have this name'),
    (HEAD + 'columns = ["qr_kl", "tetrad_error"]\n' + variant("a"), "did you mean tetrad_size_error?"),
    (HEAD + 'columns = []\n' + variant("a"), "columns = []: name at least one of velocity_error_early, "),
    (HEAD + variant("a/b"), '[[variant]] number 1 ("a/b"): [variant] name = "a/b": must be the name of a directory'),
    (HEAD + variant(".."), '[variant] name = "..": must be the name of a directory'),
    (HEAD + 'name = "a/b"\n' + variant("a"), 'name = "a/b": must be the name of a directory'),
    (HEAD + 'repeats = 100000000000\n' + variant("a"), "whole numbers of a scene are at most 1,000,000,000"),
    (HEAD.replace("0.25", "1e300") + variant("a"), "turnovers = 1e+300: must be a number above 0"),
    (HEAD + variant("figures"), 'variant "figures": its name is that of a directory'),
    (HEAD + variant("a", "model.hiden=[8]"), 'variant "a": '),
    (HEAD + variant("a", "model.pairs.hiden=[8]"), "[model.pairs] hiden: no such key; did you mean hidden?"),
    (HEAD + variant("a", "flow.viscosity=0.07"), 'variant "a": its changes concern the ground truth'),
    (HEAD + variant("a", "simulation.turnovers=0.1"), "[simulation] turnovers = 0.1 where the base has 0.25"),
    (HEAD + variant("a", "simulation.start=0.6"), "[simulation] start = 0.6 where the base has None"),
    (HEAD + variant("a", "training.window=0.4"), "[training] window = 0.4 where the base has 0.5: rollouts start"),
    (HEAD.replace("tiny", "taylor-green") + variant("a"), '"taylor-green": has no [simulation], of which errors'),
    (HEAD.replace("tiny", "tine") + variant("a"), "tine: no such scene; did you mean tiny?"),
]


@pytest.mark.parametrize("text, message", BAD, ids=range(len(BAD)))
def test_bad_comparison(text, message, tmp_path):
    path = written(tmp_path, text)
    with pytest.raises(SceneError) as error:
        load_comparison(path)
    assert str(error.value).startswith(f"{path}: ") and message in str(error.value)


def test_unknown_comparison_lists_those_there_are():
    with pytest.raises(SceneError, match="compare-smal: no such comparison; did you mean compare-small.*compare-hit"):
        load_comparison("compare-smal")
