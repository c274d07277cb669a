"""Layers of a scene: base, variants, command line."""

import pytest

from eddies.scene.scene import SceneError, load_scene
from tests.bad_scenes import HEAD
from tests.small_scene import scene_error, scene_file

TWO = HEAD + """training.horizons.steps = 2

[variant.plain]

[variant.wide]
label = "a wider network"
model.pairs.hidden = [32, 32]
training.steps = 70
"""


def test_variants_are_the_scene_with_changes(tmp_path):
    scene = load_scene(scene_file(tmp_path, TWO), ["training.frames=6"])
    plain, wide = scene.variant["plain"], scene.variant["wide"]
    assert (scene.name, plain.name, wide.name) == ("case", "plain", "wide")
    assert (plain.training.steps, plain.simulation.turnovers, plain.training.frames) == (60, 0.25, 6)
    assert (wide.model.settings["pairs"].hidden, wide.training.steps, wide.training.frames) == ((32, 32), 70, 6)
    assert (plain.label, wide.label) == (None, "a wider network") and wide.simulation == plain.simulation


@pytest.mark.parametrize("extra", [
    "", '[variant.paper]\nmodel.preset = "paper"\nsimulation.integrator = "verlet"\nsimulation.step = 0.02\n',
    '[variant.grid]\nunset = ["model.pairs"]\nsimulation.method = "eulerian"\neulerian.cells = 12\n',
    "[variant.free]\nunset = [\"kernel\", \"training.field_weight\"]\nsimulation.method = \"none\"\n",
    '[variant.one-step]\nunset = ["training.horizons"]\n'])
def test_a_written_scene_is_read_back_equal(tmp_path, extra):
    scene = load_scene(scene_file(tmp_path, TWO + extra))
    assert load_scene(scene_file(tmp_path, scene.to_toml(), "again.toml")) == scene


def test_a_base_may_have_a_base_beside_the_file(tmp_path):
    folder = tmp_path / "scenes"
    folder.mkdir()
    scene_file(folder, 'name = "another"\n' + HEAD + "realisations = [7]\n[variant.a]\n", "middle.toml")
    top = 'base = "middle.toml"\nunset = ["forcing", "training.field_weight"]\nflow.cells = 32\n'
    scene = load_scene(scene_file(folder, top, "top.toml"))
    assert (scene.name, scene.title, scene.flow.cells, scene.forcing) == ("top", "a test", 32, None)
    assert (scene.training.field_weight, scene.realisations, list(scene.variant)) == (0.0, (7,), ["a"])
    assert list(load_scene(scene_file(folder, top + "[variant.b]\n", "top.toml")).variant) == ["b"]


def test_the_command_line_reaches_one_variant(tmp_path):
    path = scene_file(tmp_path, TWO)
    scene = load_scene(path, ["variant.wide.training.steps=80", "variant.plain.model.pairs.hidden=[4]"])
    assert (scene.variant["wide"].training.steps, scene.variant["plain"].training.steps) == (80, 60)
    assert scene.variant["plain"].model.settings["pairs"].hidden == (4,)
    assert list(load_scene(path, [], ["variant.wide"]).variant) == ["plain"]
    assert load_scene(path, [], ["variant"]).variant == {}
    assert load_scene(path, [], ["variant.wide.training"]).variant["wide"].training.steps == 60


def test_a_key_is_changed_for_the_variants_that_keep_it(tmp_path):
    short = HEAD + 'training.horizons.steps = 2\n[variant.short]\nunset = ["training.horizons"]\n'
    changed = ["training.horizons.steps=3"]
    with pytest.raises(SceneError, match="--set training.horizons.steps: has no effect, because each variant removes"):
        load_scene(scene_file(tmp_path, short), changed)
    variants = load_scene(scene_file(tmp_path, short + "[variant.long]\n"), changed).variant
    assert variants["short"].training.horizons is None and variants["long"].training.horizons.steps == 3


BAD_OPTIONS = [
    (["training.steps=3"], [], 'the variant "wide" changes this key itself; use --set variant.wide.training.'),
    ([], ["training"], 'the variant "wide" changes this key itself; use --unset variant.wide.training'),
    (["variant.wid.training.steps=3"], [], 'there is no variant "wid"; did you mean wide? there are: plain, wide'),
    (["a.b.c.d=1"], [], "--set a.b.c.d=1: must be section.key=value"),
    ([], ["variant.plain.seed"], "--unset: variant.plain.seed: there is no such key or section to remove"),
    (["variant.plain=3"], [], "--set: variant: must be sections; write [variant.NAME]"),
    (["base=hit"], [], "--set base=hit: base can only be set in a file; write a scene with this base"),
    (['unset=["training"]'], [], "unset can only be set in a file; use --unset"),
    (["variant.plain.name=x"], [], 'variant "plain": name: a variant cannot change this key'),
]


@pytest.mark.parametrize("overrides, removals, message", BAD_OPTIONS)
def test_bad_options(tmp_path, overrides, removals, message):
    assert message in scene_error(load_scene, scene_file(tmp_path, TWO), overrides, removals)
