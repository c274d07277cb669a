"""Layers of a scene: base, variants, command line."""

import pytest

from eddies.scene.scene import SceneError, load_scene
from tests.small_scene import TINY

HEAD = f'title = "a test"\nbase = "{TINY}"\nsimulation.turnovers = 0.25\n'
TWO = HEAD + """training.horizons.steps = 2

[variant.plain]

[variant.wide]
label = "a wider network"
model.pairs.hidden = [32, 32]
training.steps = 70
"""


def written(tmp_path, text, name="case.toml"):
    path = tmp_path / name
    path.write_text(text)
    return path


def test_variants_are_the_scene_with_changes(tmp_path):
    scene = load_scene(written(tmp_path, TWO), ["training.frames=6"])
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
    scene = load_scene(written(tmp_path, TWO + extra))
    assert load_scene(written(tmp_path, scene.to_toml(), "again.toml")) == scene


def test_a_base_may_have_a_base_beside_the_file(tmp_path):
    folder = tmp_path / "scenes"
    folder.mkdir()
    written(folder, 'name = "another"\n' + HEAD + "realisations = [7]\n[variant.a]\n", "middle.toml")
    top = 'base = "middle.toml"\nunset = ["forcing", "training.field_weight"]\nflow.cells = 32\n'
    scene = load_scene(written(folder, top, "top.toml"))
    assert (scene.name, scene.title, scene.flow.cells, scene.forcing) == ("top", "a test", 32, None)
    assert (scene.training.field_weight, scene.realisations, list(scene.variant)) == (0.0, (7,), ["a"])
    assert list(load_scene(written(folder, top + "[variant.b]\n", "top.toml")).variant) == ["b"]


def test_the_command_line_reaches_one_variant(tmp_path):
    path = written(tmp_path, TWO)
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
        load_scene(written(tmp_path, short), changed)
    variants = load_scene(written(tmp_path, short + "[variant.long]\n"), changed).variant
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
    with pytest.raises(SceneError) as error:
        load_scene(written(tmp_path, TWO), overrides, removals)
    assert message in str(error.value)


BAD = [
    ('base = "tine"\n', "base: tine: no such scene; did you mean tiny?"),
    ("base = 3\n", "base = 3: must be the name or the path of a scene"),
    ('base = "case.toml"\n', 'base = "case.toml": this scene is its own base'),
    ('unset = ["forcing"]\n', "unset: there is no base to remove keys from"),
    (HEAD + 'unset = "forcing"\n', 'unset = "forcing": must be a list of keys or sections'),
    ('unset = ["forcng"]\n' + HEAD, "forcng: there is no such key or section to remove"),
    (HEAD + "variant = 3\n", "variant: must be sections; write [variant.NAME]"),
    (HEAD + '[variant."a/b"]\n', 'variant "a/b": name = "a/b": must be the name of a directory'),
    (HEAD + "[variant.report]\n", 'variant "report": a run directory uses this name for something else'),
    (HEAD + "[variant.checkpoints-train]\n", "a run directory uses this name for something else"),
    (HEAD + "[variant.realisation-2]\n", "a run directory uses this name for something else"),
    (HEAD + "[variant.a]\nmodel.pairs.hiden = [8]\n", "[model.pairs] hiden: no such key; did you mean hidden?"),
    (HEAD + "[variant.a]\nsimulation.turnovers = 0.1\n", "[simulation] turnovers = 0.1 where the scene has 0.25"),
    (HEAD + "[variant.a]\nkernel.form = 'linear'\n", '[kernel] form = "linear" where the scene has "kriging"'),
    (HEAD + "[variant.a]\ntraining.window = 0.4\n", "[training] window = 0.4 where the scene has 0.5"),
    (HEAD + "[varaint.a]\n", "[varaint]: no such section; did you mean variant?"),
    ('bas = "tiny"\n', "bas: no such key; did you mean base?"),
    (HEAD + "realisations = [3, 1]\n", "realisations = [3, 1]: 1 is the seed of the scene"),
    (HEAD + "realisations = [3, 3]\n", "realisations = [3, 3]: 3 is given more than once"),
    ('base = "taylor-green"\n[variant.a]\n', 'variant "a": variants are compared by their rollouts; add [simulation]'),
    (HEAD + "[variant.a]\nrealisations = [3]\n", 'variant "a": realisations: a variant cannot change this key'),
]


@pytest.mark.parametrize("text, message", BAD, ids=range(len(BAD)))
def test_bad_scene(text, message, tmp_path):
    path = written(tmp_path, text)
    with pytest.raises(SceneError) as error:
        load_scene(path)
    assert str(error.value).startswith(f"{path}: ") and message in str(error.value)
