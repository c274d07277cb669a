"""Scenes: what is read, what is refused and in which words."""

import dataclasses

import pytest

from eddies.io.hdf5 import create_product
from eddies.pipeline import STAGES as TABLE
from eddies.scene.scene import Eulerian, Flow, Horizons, Scene, SceneError, Time, builtin_scenes, load_scene
from eddies.scene.sections import CLOSURES
from eddies.scene.values import rule_of
from eddies.workflows.run_directory.fingerprints import stage_fingerprint, stage_provenance
from tests.bad_scenes import BAD_OVERRIDES, BAD_TEXTS
from tests.small_scene import TINY

STAGES = tuple(TABLE)

SMALLEST = '[flow]\nfluid = "incompressible"\ncells = 16\nviscosity = 0.1\n[time]\nduration = 1\n'
NAMES = [name for name, _ in builtin_scenes()]


def scene_file(tmp_path, text, name="case"):
    path = tmp_path / f"{name}.toml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("name", NAMES)
def test_written_scene_reads_back_equal(name, tmp_path):
    scene = load_scene(name)
    assert load_scene(scene_file(tmp_path, scene.to_toml(), "other-name")) == scene


def test_all_values_survive_writing(tmp_path):
    scene = load_scene(TINY, ['title="a \\"quoted\\" # title"', "tracers.filter_width=0.1234567890123456",
                              "simulation.injection=1e-7", "model.pairs.hidden=[1, 2, 3]", "simulation.start=0"])
    assert load_scene(scene_file(tmp_path, scene.to_toml())) == scene
    assert scene.simulation.start == 0.0
    assert scene.model.settings["pairs"].hidden == (1, 2, 3)


def test_absent_sections_and_defaults(tmp_path):
    scene = load_scene(scene_file(tmp_path, SMALLEST))
    assert scene.name == "case"
    assert scene.forcing is scene.tracers is scene.kernel is scene.model is scene.simulation is None
    assert (scene.flow.precision, scene.time.stepper, scene.seed) == ("float64", "etdrk4", 1)
    assert scene.stages == ("dns", "report")


@pytest.mark.parametrize("override, read", [
    ("seed=7", lambda scene: scene.seed == 7),
    ("flow.viscosity=1", lambda scene: scene.flow.viscosity == 1.0),
    ("flow.precision=float32", lambda scene: scene.flow.precision == "float32"),
    ('flow.precision="float32"', lambda scene: scene.flow.precision == "float32"),
    (" flow.cells = 32 ", lambda scene: scene.flow.cells == 32),
    ("forcing.injection_rate=0.5", lambda scene: scene.forcing.injection_rate == 0.5),
    ("title=a=b", lambda scene: scene.title == "a=b"),
])
def test_override(override, read, tmp_path):
    assert read(load_scene(scene_file(tmp_path, SMALLEST), [override]))


def test_all_stages_of_a_whole_scene():
    assert load_scene(TINY).stages == tuple(stage for stage in STAGES if stage != "find-step")
    assert load_scene(TINY, ["simulation.step=converged"]).stages == STAGES
    assert "find-step" not in load_scene(TINY, ["simulation.step=converged", "simulation.step_from=runs/a"]).stages


def test_without_a_learned_force_nothing_is_trained():
    scene = load_scene(TINY, ["simulation.method=none"])
    assert scene.stages == ("dns", "train-kernel", "simulate", "report")
    other = load_scene(TINY, ["simulation.method=none", "model.pairs.hidden=[4]", "training.steps=50"])
    assert stage_fingerprint(other, "simulate") == stage_fingerprint(scene, "simulate")
    bare = dataclasses.replace(scene, model=None, training=None)
    assert bare.stages == scene.stages


def test_the_form_of_a_baseline_counts_for_its_rollout_alone():
    scene, changed = (load_scene(TINY, ["simulation.method=eulerian", f"eulerian.closure={closure}"])
                      for closure in ("none", "spectral"))
    affected = [stage for stage in STAGES if stage_fingerprint(scene, stage) != stage_fingerprint(changed, stage)]
    assert affected == ["simulate", "report"]


def test_where_a_rollout_starts_counts_for_it_without_a_model_too():
    plain, others = (load_scene(TINY, ["simulation.method=none", *more])
                     for more in ([], ['training.truths=["runs/second", "runs/third"]']))
    assert plain.seen_in(plain.directory) > 0 == others.seen_in(others.directory)
    assert stage_fingerprint(plain, "simulate") != stage_fingerprint(others, "simulate")
    assert stage_fingerprint(plain, "train-kernel") == stage_fingerprint(others, "train-kernel")


def test_coarse_grid_of_the_filter():
    widths = {name: load_scene(name).tracers.filter_width for name in ("hit", "tiny")}
    assert Eulerian().cells_for(widths["hit"]) == 16  # Nyquist wavenumber 8 = pi / d
    assert Eulerian().cells_for(widths["tiny"]) == 8
    assert Eulerian(cells=24).cells_for(widths["hit"]) == 24
    with pytest.raises(SceneError, match=r"\[eulerian\] cells = 50: must be at most the 24 of the flow that it"):
        load_scene(TINY, ["simulation.method=eulerian", "eulerian.cells=50"])


def test_a_coarse_grid_that_takes_what_is_learned_needs_the_training():
    learned = ["simulation.method=eulerian", "eulerian.closure=learned"]
    assert "train" in load_scene(TINY, learned).stages
    assert "train" not in load_scene(TINY, learned[:1]).stages
    with pytest.raises(SceneError, match='closure = "learned": takes the rates of the term "damping", which'):
        load_scene(TINY, [*learned, 'model.terms=["pressure", "stress"]'])


def test_rates_of_the_horizons_fall():
    with pytest.raises(SceneError, match=r"\[training\] final_learning_rate = 0.0001: must be at most "
                                         r"\[training.horizons\] learning_rate = 1e-05"):
        load_scene(TINY, ["training.horizons.learning_rate=1e-5", "training.horizons.steps=1"])


def test_the_radius_of_interaction_is_the_models_own():
    tiny = load_scene(TINY)
    assert tiny.neighbors == tiny.kernel.neighbors == 56 and tiny.interaction_radius == tiny.kernel_support
    own = load_scene(TINY, ["model.neighbors=28"])
    assert own.interaction_radius == pytest.approx(own.kernel_support / 2 ** (1 / 3), rel=1e-12)
    alone = dataclasses.replace(load_scene("tracers-only"), kernel=None)
    assert alone.neighbors == 60 and alone.kernel_support is None and "train-kernel" not in alone.stages
    with pytest.raises(SceneError, match=r"\[model\] neighbors = 50: none of the terms .*reads pairs"):
        load_scene(TINY, ["model.preset=resolved", "model.neighbors=50"])
    with pytest.raises(SceneError, match=r"\[training\] field_weight = 0.1: this loss is .*; add \[kernel\], or"):
        dataclasses.replace(load_scene(TINY, ["training.field_weight=0.1", "training.combined_steps=2"]), kernel=None)


def test_a_section_within_a_section_is_read_and_written():
    scene = load_scene(TINY, ["training.horizons.steps=3", "training.horizons.frames=[2]"])
    assert scene.training.horizons == Horizons(steps=3, frames=(2,)) and "[training.horizons]" in scene.to_toml()
    assert load_scene(TINY).training.horizons is None and "horizons" not in load_scene(TINY).to_toml()
    with pytest.raises(SceneError, match=r"\[training.horizons\] steps = 0: must be a whole number at least 1"):
        Horizons(steps=0)


def test_derived_lengths():
    tracers = load_scene("hit-small").tracers
    assert tracers.filter_width == 2 * tracers.spacing == pytest.approx(0.3926990817)
    assert (tracers.particles, tracers.cells) == (32768, 48)
    assert load_scene(TINY).tracers.cells == 18
    assert load_scene("hit-small").kernel_support / tracers.spacing == pytest.approx(2.4287, rel=1e-4)


FINGERPRINTS = {"flow.viscosity=0.061": "dns", "seed=2": "dns", "kernel.steps=99": "train-kernel",
                "training.window=0.4": "train-kernel", "device=cuda": "train",
                "model.pairs.hidden=[4]": "train", "training.steps=59": "train", "simulation.skin=0.2": "simulate"}


@pytest.mark.parametrize("override, first_changed", FINGERPRINTS.items())
def test_fingerprint_changes_from_the_stage_that_reads_the_key(override, first_changed):
    scene, changed = load_scene(TINY), load_scene(TINY, [override])
    affected = [stage for stage in STAGES if stage_fingerprint(scene, stage) != stage_fingerprint(changed, stage)]
    assert affected == list(STAGES[STAGES.index(first_changed):])


@pytest.mark.parametrize("override, searched", [("simulation.turnovers=0.2", False), ("simulation.start=0.5", False),
                                                ("simulation.skin=0.3", True)])
def test_a_step_is_sought_anew_where_that_concerns_it(override, searched):
    """Neither by how long the rollout is nor where it starts: the short rollouts have a start and a length of their
    own."""
    given = ["simulation.step=converged"]
    scene, changed = load_scene(TINY, given), load_scene(TINY, [*given, override])
    assert (stage_fingerprint(scene, "find-step") != stage_fingerprint(changed, "find-step")) is searched
    assert stage_fingerprint(scene, "simulate") != stage_fingerprint(changed, "simulate")


def test_fingerprint_ignores_names():
    scene, renamed = load_scene(TINY), load_scene(TINY, ["name=x", "title=y"])
    assert stage_fingerprint(scene, "report") == stage_fingerprint(renamed, "report")


def test_fingerprint_changes_with_the_file_that_the_flow_starts_from(tmp_path):
    start = tmp_path / "start.h5"
    prints = set()
    for content in ("one state", "another state", "one state"):
        start.write_text(content)
        scene = load_scene("taylor-green", ["initial.kind=file", f"initial.path={start}"])
        prints.add(stage_fingerprint(scene, "dns"))
    assert len(prints) == 2


def test_fingerprint_of_training_changes_with_the_weights_that_it_starts_from(tmp_path):
    scene = load_scene(TINY, [f"model.path={tmp_path}"])
    prints = [stage_fingerprint(scene, "train")]
    for content in ("some weights", "others"):
        (tmp_path / "model.h5").write_text(content)
        prints.append(stage_fingerprint(scene, "train"))
    assert len(set(prints)) == 3
    assert stage_fingerprint(scene, "train-kernel") == stage_fingerprint(load_scene(TINY), "train-kernel")
    moved = tmp_path / "moved.h5"
    (tmp_path / "model.h5").rename(moved)
    assert stage_fingerprint(load_scene(TINY, [f"model.path={moved}"]), "train") == prints[-1]


def test_trained_weights_need_no_training_and_have_seen_nothing():
    scene = load_scene(TINY, ["model.path=runs/other"])
    alone = dataclasses.replace(scene, training=None)
    assert (scene.seen_in(scene.directory), alone.seen_in(alone.directory), alone.window) == (0.5, 0.0, 0.5)
    assert alone.stages == scene.stages
    assert str(alone.model.weights_file) == "runs/other/model.h5"
    assert str(load_scene(TINY, ["model.path=a/b.h5"]).model.weights_file) == "a/b.h5"


def test_of_a_ground_truth_that_is_not_trained_on_nothing_is_seen(tmp_path):
    own, other, linked = (tmp_path / name for name in ("own", "other", "linked"))
    for directory in (own, other, linked):
        directory.mkdir()
    (linked / "ground_truth.h5").symlink_to(own / "ground_truth.h5")  # as variants of a comparison have it
    alone, both, others = (load_scene(TINY, [f"training.truths={[str(path) for path in paths]}"])
                           for paths in ([own / "ground_truth.h5"], [other, own], [other]))
    assert [scene.seen_in(own) for scene in (load_scene(TINY), alone, both, others)] == [0.5, 0.5, 0.5, 0.0]
    assert [scene.seen_in(linked) for scene in (alone, others)] == [0.5, 0.0]
    # Then a rollout may start even though the window is the whole of what is trained on.
    assert load_scene(TINY, [f'training.truths=["{other}"]', "training.window=1"]).seen_in(own) == 0


@pytest.mark.mpi(1)
def test_fingerprint_of_training_is_that_of_the_ground_truths_too(comm, tmp_path):
    scene = load_scene(TINY, [f'training.truths=["{tmp_path}"]'])
    prints = [stage_fingerprint(scene, "train")]
    for seed in (2, 3):
        other = load_scene(TINY, [f"seed={seed}"])
        with create_product(comm, tmp_path / "ground_truth.h5", "ground_truth", stage_provenance(other, "dns")):
            pass
        prints.append(stage_fingerprint(scene, "train"))
    assert len(set(prints)) == 3
    assert stage_fingerprint(scene, "train-kernel") == stage_fingerprint(load_scene(TINY), "train-kernel")


def test_the_forcing_that_stays_on_needs_one_and_no_other(tmp_path):
    scene = load_scene(TINY, ["tracers.forced=true"])
    assert scene.injects and not load_scene(TINY).injects
    assert not load_scene(TINY, ["tracers.forced=true", "simulation.injection=none"]).injects
    dataclasses.replace(scene, spin_up=None)  # the forcing acts while tracers are followed
    with pytest.raises(SceneError, match=r"\[tracers\] forced = true: there is no \[forcing\] that could stay on"):
        dataclasses.replace(scene, forcing=None)


def test_window_without_training_is_the_default_of_training():
    scene = load_scene(TINY)
    alone = dataclasses.replace(scene, model=None, training=None, simulation=None)
    assert alone.window == scene.window == 0.5
    assert load_scene(TINY, ["training.window=0.4"]).window == 0.4
    assert stage_fingerprint(alone, "train-kernel") == stage_fingerprint(scene, "train-kernel")


@pytest.mark.parametrize("text, message", BAD_TEXTS, ids=range(len(BAD_TEXTS)))
def test_bad_text(text, message, tmp_path):
    path = scene_file(tmp_path, text)
    with pytest.raises(SceneError) as error:
        load_scene(path)
    assert str(error.value).startswith(f"{path}: ")
    assert message in str(error.value)


@pytest.mark.parametrize("override, message", BAD_OVERRIDES, ids=[override[:50] for override, _ in BAD_OVERRIDES])
def test_bad_override(override, message):
    with pytest.raises(SceneError) as error:
        load_scene(TINY, [override])
    assert message in str(error.value)


@pytest.mark.parametrize("integrator", ["rk2", "rk3", "rk4"])
def test_steps_of_a_scheme_that_tells_what_is_between_need_not_fall_on_frames(integrator):
    scene = load_scene(TINY, [f"simulation.integrator={integrator}", "simulation.step=0.07"])
    assert (scene.simulation.step, scene.simulation.frame_interval) == (0.07, 0.1)
    assert load_scene(TINY, ["simulation.integrator=verlet", "simulation.step=0.05"]).simulation.step == 0.05


def test_keys_and_sections_are_left_out_before_others_are_set():
    pairs = ["model.preset=resolved + pairs", "model.pairs.hidden=[4]"]
    scene = load_scene(TINY, pairs, ["seed", "forcing", "model", "training.window"])
    assert scene.forcing is None and scene.seed == 1 and "hidden = [4]" in scene.to_toml()
    assert scene.training.frames == 8


@pytest.mark.parametrize("removal, message", [
    ("spinup", "--unset: spinup: there is no such key or section to remove; there are: title, seed, flow"),
    ("flow.forcing", "there are: fluid, cells, viscosity, sound_speed"), ("seed.x", "there are: title"),
    ("flow.cells", r"tiny.toml, --unset: \[flow\] cells: this key is missing"),
    ("flow", r"tiny.toml, --unset: \[flow\]: this section is missing")])
def test_what_cannot_be_left_out_is_said(removal, message):
    with pytest.raises(SceneError, match=message):
        load_scene(TINY, (), [removal])


def test_override_is_named_as_the_origin():
    with pytest.raises(SceneError, match=r"tiny.toml, --set: \[flow\] cells = 3: "):
        load_scene(TINY, ["flow.cells=3"])


def test_unknown_scene_lists_those_there_are():
    with pytest.raises(SceneError, match="hit-smal: no such scene; did you mean hit-small.*tiny"):
        load_scene("hit-smal")


def test_sections_are_checked_against_each_other_without_a_file():
    with pytest.raises(SceneError, match="a compressible fluid needs"):
        Scene(flow=Flow(fluid="compressible", cells=16, viscosity=0.1), time=Time(duration=1.0))


def test_every_key_is_explained():
    scene = load_scene(TINY)
    for section in (scene, scene.flow, scene.initial, scene.forcing, scene.time, scene.spin_up, scene.tracers,
                    scene.kernel, scene.model, scene.training, scene.simulation, *scene.model.settings.values()):
        for field in dataclasses.fields(section):
            rule = rule_of(type(section), field)
            assert rule is None or rule.about


@pytest.mark.parametrize("overrides, kinds", [
    ([], ["ground_truth", "kernel", "model"]), (["simulation.method=none"], ["ground_truth", "kernel"])])
def test_a_rollout_is_made_from_what_its_scene_asks_for(overrides, kinds):
    """A model that lies beside a rollout without one is none of its business."""
    assert stage_provenance(load_scene(TINY, overrides), "simulate")["made_from"] == kinds


@pytest.mark.parametrize("equations, closures", [
    ("unfiltered", ("none", "smagorinsky", "dynamic-smagorinsky", "spectral", "learned")),
    ("filtered", ("none", "smagorinsky", "dynamic-smagorinsky", "gradient", "dynamic-mixed"))])
def test_each_closure_is_for_its_equations_alone(equations, closures):
    for closure in CLOSURES:
        if closure in closures:
            assert Eulerian(equations=equations, closure=closure).closure == closure
        else:
            with pytest.raises(SceneError, match=f"it must be one of {', '.join(closures)}; change one of the two"):
                Eulerian(equations=equations, closure=closure)


def test_a_preset_of_the_kernel_fills_what_is_not_given(tmp_path):
    preset = load_scene("hit-small", ["kernel.preset=paper"], ["kernel.learning_rate"]).kernel
    assert (preset.form, preset.positive, preset.cutoff) == ("average", False, "sigmoid")
    assert (preset.normalization_weight, preset.learning_rate, preset.final_learning_rate) == (1.0, 1e-3, 1e-6)
    assert preset.preset is None
    given = load_scene("hit-small", ["kernel.preset=paper", "kernel.cutoff=smooth"]).kernel
    assert (given.cutoff, given.learning_rate, given.final_learning_rate) == ("smooth", 5e-3, 1e-6)
    plain = load_scene("hit-small").kernel
    assert (plain.form, plain.positive, plain.final_learning_rate) == ("kriging", True, pytest.approx(2.5e-4))
    path = tmp_path / "again.toml"
    path.write_text(load_scene("hit-small", ["kernel.preset=paper"]).to_toml())
    assert load_scene(path).kernel == load_scene("hit-small", ["kernel.preset=paper"]).kernel


def test_polynomials_are_refused_a_weight_that_may_be_negative():
    with pytest.raises(SceneError, match=r'\[kernel\] form = "quadratic": its weights must be .*form = "average"'):
        load_scene("hit-small", ["kernel.positive=false", "kernel.form=quadratic"])


def test_the_form_of_reconstruction_asks_for_no_training():
    scenes = [load_scene("hit-small", [f"kernel.form={form}"]) for form in ("average", "kriging")]
    for stage in ("train-kernel", "train", "simulate"):
        assert len({stage_fingerprint(scene, stage) for scene in scenes}) == 1
    assert len({stage_fingerprint(load_scene("hit-small", [f"kernel.cutoff={word}"]), "train-kernel")
                for word in ("smooth", "sigmoid")}) == 2
