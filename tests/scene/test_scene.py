"""Scenes: reading, writing, derived values, and errors."""

import json
import math
from dataclasses import fields, replace

import pytest

from eddies.pipeline import STAGES as TABLE
from eddies.scene.layers import read_document
from eddies.scene.scene import Eulerian, Flow, Horizons, Scene, SceneError, builtin_scenes, json_schema, load_scene
from eddies.scene.sections import CLOSURES
from eddies.scene.terms import TERMS
from eddies.scene.values import rule_of
from tests.bad_scenes import BAD_OVERRIDES, BAD_TEXTS
from tests.small_scene import TINY, scene_error, scene_file

STAGES = tuple(TABLE)
SMALLEST = '[flow]\nfluid = "incompressible"\ncells = 16\nviscosity = 0.1\n[time]\nduration = 1\n'
NAMES = [name for name, _ in builtin_scenes()]


@pytest.mark.parametrize("name", NAMES)
def test_written_scene_reads_back_equal(name, tmp_path):
    scene = load_scene(name)
    for text in (scene.to_toml(), scene.to_toml(all_keys=True)):
        assert load_scene(scene_file(tmp_path, text, "other-name.toml")) == scene


def test_all_values_survive_writing(tmp_path):
    scene = load_scene(TINY, ['title="a \\"quoted\\" # title"', "tracers.filter_width=0.1234567890123456",
                              "simulation.injection=1e-7", "model.pairs.hidden=[1, 2, 3]", "simulation.start=0",
                              "training.horizons.steps=3", "training.horizons.frames=[2]", "kernel.preset=paper"])
    assert load_scene(scene_file(tmp_path, scene.to_toml())) == scene
    assert (scene.simulation.start, scene.model.settings["pairs"].hidden) == (0.0, (1, 2, 3))
    assert scene.training.horizons == Horizons(steps=3, frames=(2,))


def test_absent_sections_and_defaults(tmp_path):
    scene = load_scene(scene_file(tmp_path, SMALLEST))
    assert scene.name == "case" and scene.stages == ("dns", "report")
    assert scene.forcing is scene.tracers is scene.kernel is scene.model is scene.simulation is None
    assert (scene.flow.precision, scene.time.stepper, scene.seed) == ("float64", "etdrk4", 1)


@pytest.mark.parametrize("override, read", [
    ("flow.viscosity=1", lambda scene: scene.flow.viscosity == 1.0),
    ("flow.precision=float32", lambda scene: scene.flow.precision == "float32"),
    ('flow.precision="float32"', lambda scene: scene.flow.precision == "float32"),
    (" flow.cells = 32 ", lambda scene: scene.flow.cells == 32),
    ("forcing.injection_rate=0.5", lambda scene: scene.forcing.injection_rate == 0.5),
    ("title=a=b", lambda scene: scene.title == "a=b"),
])
def test_override(override, read, tmp_path):
    assert read(load_scene(scene_file(tmp_path, SMALLEST), [override]))


@pytest.mark.parametrize("key", ["tracers.filter_width", "tracers.field_cells", "time.step", "model.path",
                                 "simulation.start"])
def test_none_is_a_key_that_is_left_out(key):
    assert load_scene(TINY, [f"{key}=none"]) == load_scene(TINY)


def test_keys_and_sections_are_left_out_before_others_are_set():
    pairs = ["model.preset=resolved + pairs", "model.pairs.hidden=[4]"]
    scene = load_scene(TINY, pairs, ["seed", "forcing", "model", "training.window"])
    assert scene.forcing is None and scene.seed == 1 and scene.training.frames == 8
    assert scene.model.settings["pairs"].hidden == (4,)


@pytest.mark.parametrize("overrides, missing", [
    (["simulation.step=converged"], ()), ([], ("find-step",)),
    (["simulation.step=converged", "simulation.step_from=runs/a"], ("find-step",)),
    (["simulation.method=none"], ("find-step", "train")), (["simulation.method=eulerian"], ("find-step", "train")),
    (["simulation.method=eulerian", "eulerian.closure=learned"], ("find-step",))])
def test_stages_of_a_whole_scene(overrides, missing):
    scene = load_scene(TINY, overrides)
    assert scene.stages == tuple(stage for stage in STAGES if stage not in ("reconstruct", *missing))
    assert [stage.name for stage in scene.inputs("simulate")] == [
        stage for stage in ("dns", "train-kernel", "train", "find-step") if stage not in missing]


def test_lengths_of_the_particles():
    scene = load_scene("hit-small")
    tracers = scene.tracers
    assert (tracers.particles, tracers.cells) == (32**3, 48) and tracers.filter_width == pytest.approx(math.pi / 8)
    radius = tracers.radius_of(scene.kernel.neighbors)
    assert tracers.particles * (4 / 3) * math.pi * radius**3 / (2 * math.pi)**3 == pytest.approx(
        scene.kernel.neighbors, rel=1e-12)
    assert load_scene("tracers-only", ["tracers.particles_per_side=2"]).tracers.filter_width == pytest.approx(math.pi)


def test_coarse_grid_of_the_filter():
    width = load_scene("hit").tracers.filter_width
    assert Eulerian().cells_for(width) == 16  # Nyquist wavenumber 8 = pi / d
    assert Eulerian().cells_for(4 * width) == 8 and Eulerian(cells=24).cells_for(width) == 24


@pytest.mark.parametrize("overrides, message", [
    (["eulerian.cells=50"], "[eulerian] cells = 50: must be at most [flow] cells = 24"),
    (["eulerian.closure=learned", 'model.terms=["pressure", "stress"]'], '[eulerian] closure = "learned": needs'),
    (["eulerian.fluid=compressible", "flow.fluid=incompressible", "flow.sound_speed=none", "model.preset=resolved"],
     '[eulerian] fluid = "compressible": [flow] fluid is incompressible')])
def test_coarse_grids_that_are_refused(overrides, message):
    assert message in scene_error(load_scene, TINY, ["simulation.method=eulerian", *overrides])


def test_a_coarse_grid_that_starts_from_particles_may_be_finer_than_the_flow():
    """Tracks come with a flow that has only the modes that they resolve."""
    scene = load_scene(TINY, ["simulation.method=eulerian", "eulerian.cells=50", "eulerian.start=particles"])
    assert scene.coarse_cells > scene.flow.cells


@pytest.mark.parametrize("equations, closures", [
    ("unfiltered", {"none", "smagorinsky", "dynamic-smagorinsky", "spectral", "learned"}),
    ("filtered", {"none", "smagorinsky", "dynamic-smagorinsky", "gradient", "dynamic-mixed"})])
def test_each_closure_is_for_its_equations_alone(equations, closures):
    for closure in CLOSURES:
        if closure in closures:
            assert Eulerian(equations=equations, closure=closure).closure == closure
        else:
            with pytest.raises(SceneError, match="must be one of"):
                Eulerian(equations=equations, closure=closure)


def test_a_preset_of_the_kernel_fills_absent_keys():
    paper = load_scene("hit-small", ["kernel.preset=paper", "kernel.cutoff=smooth"], ["kernel.learning_rate"]).kernel
    assert (paper.form, paper.positive, paper.cutoff, paper.preset) == ("average", False, "smooth", None)
    assert (paper.normalization_weight, paper.learning_rate, paper.final_learning_rate) == (1.0, 1e-3, 1e-6)
    plain = load_scene("hit-small").kernel
    assert (plain.form, plain.positive, plain.final_learning_rate) == ("kriging", True, pytest.approx(2.5e-4))
    with pytest.raises(SceneError, match=r'\[kernel\] form = "kriging": its weights must be positive'):
        load_scene("hit-small", ["kernel.positive=false", "kernel.form=kriging"])


def test_the_seen_fraction_is_that_of_truths_for_training(tmp_path):
    own, other, linked = (tmp_path / name for name in ("own", "other", "linked"))
    for directory in (own, other, linked):
        directory.mkdir()
    (linked / "ground_truth.h5").symlink_to(own / "ground_truth.h5")  # as in the directory of a variant
    alone, both, others = (load_scene(TINY, [f"training.truths={[str(path) for path in paths]}"])
                           for paths in ([own / "ground_truth.h5"], [other, own], [other]))
    assert [scene.seen_in(own) for scene in (load_scene(TINY), alone, both, others)] == [0.5, 0.5, 0.5, 0.0]
    assert [scene.seen_in(linked) for scene in (alone, others)] == [0.5, 0.0]
    # Only without training on its own ground truth a rollout may start where the window is all of it.
    assert load_scene(TINY, [f'training.truths=["{other}"]', "training.window=1"]).seen_in(own) == 0
    trained = replace(load_scene(TINY, ["model.path=runs/other"]), training=None)
    assert (trained.seen_in(own), trained.window, trained.stages) == (0.0, 0.5, load_scene(TINY).stages)


def test_forcing_while_tracers_are_followed_needs_a_forcing():
    scene = load_scene(TINY, ["tracers.forced=true"])
    replace(scene, spin_up=None)
    with pytest.raises(SceneError, match=r"\[tracers\] forced = true: needs a section \[forcing\]"):
        replace(scene, forcing=None)


@pytest.mark.parametrize("text, message", BAD_TEXTS, ids=range(len(BAD_TEXTS)))
def test_bad_text(text, message, tmp_path):
    path = scene_file(tmp_path, text)
    error = scene_error(load_scene, path)
    assert error.startswith(f"{path}: ") and message in error


@pytest.mark.parametrize("override, message", BAD_OVERRIDES, ids=[override[:50] for override, _ in BAD_OVERRIDES])
def test_bad_override(override, message):
    assert message in scene_error(load_scene, TINY, [override])


@pytest.mark.parametrize("removal, message", [
    ("spinup", "--unset: spinup: there is no such key or section to remove; there are: title, seed, flow"),
    ("flow.forcing", "there are: fluid, cells, viscosity, sound_speed"), ("seed.x", "there are: title"),
    ("flow.cells", r"tiny.toml, --unset: \[flow\] cells: this key is missing"),
    ("flow", r"tiny.toml, --unset: \[flow\]: this section is missing")])
def test_a_removal_that_is_refused(removal, message):
    with pytest.raises(SceneError, match=message):
        load_scene(TINY, (), [removal])


def test_steps_of_a_dense_scheme_need_not_fall_on_frames():
    scene = load_scene(TINY, ["simulation.integrator=rk3", "simulation.step=0.07"])
    assert (scene.simulation.step, scene.simulation.frame_interval) == (0.07, 0.1)
    assert load_scene(TINY, ["simulation.integrator=verlet", "simulation.step=0.05"]).simulation.step == 0.05


def test_every_key_is_explained_and_listed():
    text = load_scene("abc").to_toml(all_keys=True)
    for field in fields(Scene):
        kind = field.metadata.get("section")
        assert kind is None or f"[{field.name}]" in text
        for key in fields(kind or Flow):
            rule = rule_of(kind or Flow, key)
            assert rule is None or rule.about and f"\n{key.name} = " in text.replace("\n# ", "\n").replace(": ", " = ")
    for word, kind in TERMS.items():
        assert kind.word == word and kind.__doc__ and all(rule_of(kind, key).about for key in fields(kind))


@pytest.mark.parametrize("name", NAMES)
def test_built_in_scenes_have_the_schema(name):
    jsonschema = pytest.importorskip("jsonschema")
    check = jsonschema.Draft202012Validator(json.loads(json.dumps(json_schema())))
    check.validate(read_document(name)[1])


@pytest.mark.parametrize("override, accepted", [
    ("flow.cells = 7", False), ("flow.cels = 8", False), ("simulation.step = 0.1", True), ("time.step = 'none'", True),
    ("simulation.step = 'long'", False), ("forcing.wavenumber = 1", False), ("model.Drag.k = 1", True),
    ("model.terms = ['pairs', 'own:Drag']", True),
    ("model.terms = ['pears']", False), ("kernel.hidden = [8, 0]", False), ("variant.a.flow.cells = 7", False),
    ("tracks.volume = 'auto'", True), ("tracks.volume = [0, 1]", True), ("tracks.volume = ['auto']", False),
    ("tracks.columns.x = 0", False), ("tracks.columns = {x = 1, y = 'Y'}", True)])
def test_the_schema_accepts_what_a_scene_may_hold(override, accepted):
    import tomllib
    jsonschema = pytest.importorskip("jsonschema")
    assert jsonschema.Draft202012Validator(json_schema()).is_valid(tomllib.loads(override)) is accepted


def test_a_name_from_a_file_that_no_directory_can_have_names_the_file(tmp_path):
    for name in ("my scene", "écoulement"):
        text = scene_error(load_scene, scene_file(tmp_path, f'base = "{TINY}"\n', f"{name}.toml"))
        assert f'name = "{name}": must be' in text and "rename the file, or add the key" in text
        path = scene_file(tmp_path, f'base = "{TINY}"\nname = "own"\n', f"{name}.toml")
        assert load_scene(path).name == "own"
    given = scene_error(load_scene, path, ["name=../evil"])
    assert "must be the name of a directory" in given and "rename the file" not in given


def test_a_file_name_that_is_not_utf_8_is_refused_before_any_work():
    """The scene of the run could not be written."""
    text = scene_error(load_scene, TINY, ["model.path=runs/\udcff"])
    assert '[model] path = "runs/\udcff"' in text and "UTF-8, but this is not; rename the file or directory" in text
