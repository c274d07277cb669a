"""The model of a scene: its terms, their settings in [model.NAME], classes of the user's, the density of the flow."""

from dataclasses import replace

import pytest

from eddies.scene.scene import Flow, Model, Scene, Simulation, Time, load_scene
from eddies.scene.terms import DEFAULT_PRESET, PRESETS, Continuity, PairNetwork, Pressure, Stress
from tests.small_scene import TINY, scene_error, scene_file

LEARNING = """
[tracers]
particles_per_side = 10
turnovers = 0.5
frame_interval = 0.02
[kernel]
neighbors = 30
steps = 3
[training]
frames = 2
batch = 9
steps = 3
"""
COMPRESSIBLE = '[flow]\nfluid = "compressible"\nsound_speed = 10\ncells = 16\nviscosity = 0.1\n' + LEARNING
INCOMPRESSIBLE = '[flow]\nfluid = "incompressible"\ncells = 16\nviscosity = 0.1\n' + LEARNING
HEAD = "from dataclasses import dataclass\nfrom eddies import Term, TermSettings\n"
OWN_TERM = HEAD + """
class Drag(Term):
    @dataclass(frozen=True)
    class Settings(TermSettings):
        constant: float = 0.1
        levels: tuple[int, ...] = (1, 2)
        strong: bool = False
        reads = ("resolved",)

    def forward(self, context):
        return None
"""


def read(tmp_path, text, *overrides):
    return load_scene(scene_file(tmp_path, text), overrides)


def refused(message, make):
    assert message in scene_error(make)


def test_without_terms_the_model_is_the_default_preset(tmp_path):
    model = read(tmp_path, COMPRESSIBLE + "[model]\n").model
    assert model == Model() == Model(preset=DEFAULT_PRESET)
    assert model.terms == tuple(PRESETS[DEFAULT_PRESET]) == tuple(model.settings)
    assert Model(preset="resolved").settings["stress"] == Stress(form="deconvolution")


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_is_a_list_of_terms_that_fit_together(tmp_path, name):
    scene = read(tmp_path, COMPRESSIBLE + f'[model]\npreset = "{name}"\n')
    assert scene.model.terms == tuple(PRESETS[name]) and scene.model.preset is None
    (tmp_path / "again.toml").write_text(scene.to_toml())
    assert load_scene(tmp_path / "again.toml") == scene
    assert scene.model.gives & {"density", "density_rate"} and scene.foreign == ()


def test_keys_of_a_term_are_written_over_those_of_the_preset(tmp_path):
    scene = read(tmp_path, COMPRESSIBLE + '[model]\npreset = "paper"\n[model.pairs]\nhidden = [4]\n',
                 "model.density-flux.hidden=[5, 5]", 'model.pairs.inputs=["distance", "density"]')
    pairs, flux = scene.model.settings["pairs"], scene.model.settings["density-flux"]
    assert (pairs.basis, pairs.hidden, pairs.inputs, flux.hidden) == ("paper", (4,), ("distance", "density"), (5, 5))
    assert Model(preset="paper", settings={"pairs": {"hidden": [4]}}).settings["pairs"].basis == "paper"
    whole = Model(preset="paper", settings={"pairs": PairNetwork(hidden=(4,))}).settings["pairs"]
    assert whole == PairNetwork(hidden=[4])


def test_inputs_and_outputs_of_terms():
    model = Model(terms=("pressure", "pairs"), settings={"pairs": PairNetwork(hidden=(8, 8)), "pressure": {}})
    assert (model.reads, model.gives) == ({"resolved", "pairs", "density"}, {"acceleration", "density"})
    alone = Model(terms=["pairs"], settings={"pairs": {"inputs": ["distance"]}})
    assert (alone.reads, alone.gives) == ({"pairs"}, {"acceleration"})
    assert Continuity(diffusion=0.1).learns_through_horizons and not Continuity().learns_through_horizons


@pytest.mark.parametrize("changes, message", [
    (dict(terms=("pressure", "pressure")), 'terms = ["pressure", "pressure"]: must be one or more terms with'),
    (dict(terms=("presure",)), "did you mean pressure?"),
    (dict(terms=("pressure",), preset="wcsph"), "both keys give the terms; remove one of the two"),
    (dict(terms=("pressure",), settings={"pairs": {}}), "[model.pairs]: no such term; the terms are pressure; remove"),
    (dict(terms=("pairs",), settings={"pairs": Pressure()}), "[model.pairs]: must be settings of the class"),
    (dict(terms=("pairs",), settings={"pairs": 3}), "model.pairs = 3: must be a section"),
    (dict(terms=("pressure",), neighbors=50), "[model] neighbors = 50.0: none of the terms"),
    (dict(path="eddies:nothing"), '[model] path = "eddies:nothing": must be a run directory'),
    (dict(terms=("own_nowhere:Term",)), '[model] terms: "own_nowhere:Term": there is no module "own_nowhere"'),
    (dict(terms=("eddies.scene.scene:load_scene",)), "must be a class derived from eddies.Term"),
])
def test_bad_model(changes, message):
    refused(message, lambda: Model(**changes))


@pytest.mark.parametrize("make, message", [
    (lambda: Flow(fluid="plasma", cells=-3, viscosity=1), '[flow] fluid = "plasma": must be one of "incompressible"'),
    (lambda: Flow(fluid="incompressible", cells=None, viscosity=1), "[flow] cells = None: must be a whole number"),
    (lambda: PairNetwork(hidden=(0,)), "[PairNetwork] hidden = [0]: must be a list such as [16, 16]"),
    (lambda: Scene(flow=3, time=Time(duration=1)), "flow = 3: must be a Flow"),
    (lambda: replace(load_scene(TINY).flow, viscosity="thin"), '[flow] viscosity = "thin": must be a number'),
    (lambda: Scene(flow=Flow(fluid="compressible", cells=16, viscosity=1), time=Time(duration=1)), "a compressible"),
    (lambda: replace(load_scene(TINY, ["training.field_weight=0.1", "training.combined_steps=2"]), kernel=None),
     "[training] field_weight = 0.1: this loss"),
])
def test_objects_of_a_program_are_checked_as_files_are(make, message):
    refused(message, make)


def test_an_own_term_has_keys_of_its_own(tmp_path, own):
    own("own_drag", OWN_TERM)
    text = COMPRESSIBLE + '[model]\nterms = ["pressure", "own_drag:Drag"]\n[model.Drag]\nconstant = 2\n'
    scene = read(tmp_path, text, "model.Drag.strong=true")
    drag = scene.model.settings["Drag"]
    assert (drag.constant, drag.levels, drag.strong) == (2.0, (1, 2), True)
    assert scene.model.reads == {"resolved"} and scene.foreign == ("own_drag:Drag",)
    (tmp_path / "again.toml").write_text(scene.to_toml())
    assert load_scene(tmp_path / "again.toml").to_toml() == scene.to_toml()
    for change, message in [("model.Drag.constant=thin", '[model.Drag] constant = "thin": must be a number'),
                            ("model.Drag.levels=[]", "[model.Drag] levels = []: must be a list such as [16, 16]"),
                            ("model.Drag.strong=1", "[model.Drag] strong = 1: must be true or false"),
                            ("model.Drag.konstant=1", "[model.Drag] konstant: no such key; did you mean constant?"),
                            ('model.terms=["pairs", "own_drag:Drag"]', '"pairs" reads the density, which no')]:
        refused(message, lambda: read(tmp_path, text, change))


@pytest.mark.parametrize("body, message", [
    ("class Bad(Term):\n    class Settings: pass\n", "its Settings must be a dataclass derived"),
    ("class Bad(Term):\n    class Settings(TermSettings):\n        a: float = 1\n", "write @dataclass(frozen=True)"),
    ("class Bad(Term):\n    @dataclass(frozen=True)\n    class Settings(TermSettings):\n        a: complex = 1j\n",
     "Bad.Settings.a: complex: declare the key by a function"),
    ("class Bad(Term):\n    @dataclass(frozen=True)\n    class Settings(TermSettings):\n"
     "        reads = ('vorticity',)\n", 'reads = ["vorticity"]: must be a tuple of any of "pairs", "resolved", '),
    ("class Bad: pass\n", "must be a class derived from eddies.Term"),
])
def test_bad_own_term(own, body, message):
    own("own_bad", HEAD + body)
    refused(message, lambda: Model(terms=("own_bad:Bad",)))


def test_classes_beside_the_scene_are_found(tmp_path, own):
    own("unused", "")  # restores where modules are looked for
    folder = tmp_path / "apart"
    folder.mkdir()
    (folder / "own_neighbour.py").write_text("from eddies import Term\n\nclass Quiet(Term):\n    pass\n")
    (folder / "case.toml").write_text(COMPRESSIBLE + '[model]\nterms = ["own_neighbour:Quiet"]\n')
    assert load_scene(folder / "case.toml").model.settings["Quiet"].reads == ()
    refused("[model.Quiet] key: no such key; valid here: no key",
            lambda: load_scene(folder / "case.toml", ["model.Quiet.key=3"]))


def test_a_density_that_no_term_reads_is_not_needed(tmp_path):
    simulation = "[simulation]\nstep = 0.02\nframe_interval = 0.1\nturnovers = 0.2\n"
    free = INCOMPRESSIBLE + '[model]\npreset = "resolved + pairs"\n' + simulation
    assert "density" not in read(tmp_path, free).model.reads
    refused('[model.pairs]: reads the density, which an incompressible flow does not have; leave "density" out of '
            '[model.pairs] inputs, or set [flow] fluid = "compressible"', lambda: read(
                tmp_path, free, 'model.pairs.inputs=["distance", "density"]'))
    refused('"density-flux" gives only the density, which no term reads', lambda: read(
        tmp_path, free, 'model.terms=["pairs", "density-flux"]', 'model.pairs.inputs=["speed"]',
        'model.density-flux.inputs=["speed"]'))
    refused('[model.continuity]: reads the density, which an incompressible flow does not have; remove "continuity"',
            lambda: read(tmp_path, free, 'model.terms=["eddy-viscosity", "continuity"]'))


@pytest.mark.parametrize("key, path, message", [
    ("flow.fluid", "eddies.scene.scene:load_scene",
     '[flow] fluid = "eddies.scene.scene:load_scene": cannot be used here, because it has no nonlinear, linear'),
    ("initial.kind", "eddies.scene.scene:BUILT_IN", "cannot be used here, because it has no __call__"),
    ("simulation.method", "eddies.scene.scene:Scene", "it has no advance, frame, status"),
    ("model.pairs.network", "eddies.scene.scene:Scene", "[model.pairs] network"),
])
def test_a_wrong_class_is_told_before_any_work(key, path, message):
    refused(message, lambda: load_scene(TINY, [f"{key}={path}"]))


def test_needs_of_methods(own):
    own("own_method", "class Run:\n    needs = ('charge',)\n")
    rollout = dict(step=1, turnovers=1, frame_interval=1)
    assert Simulation(**rollout).form.needs == ("model",)
    assert Simulation(method="none", **rollout).form.needs == Simulation(method="eulerian", **rollout).form.needs == ()
    refused('needs = ["charge"]: must be a tuple', lambda: Simulation(method="own_method:Run", **rollout).form.needs)


def test_another_list_on_the_command_line_replaces_that_of_the_file(tmp_path):
    """A preset, terms, and a written scene, which has settings of all its terms."""
    written = load_scene("hit-small", ["model.preset=resolved + pairs", "model.pairs.hidden=[8, 8]"],
                         ["variant"]).to_toml()
    other = load_scene("hit-small", ['model.terms=["pressure", "pairs"]'], ["variant"])
    assert other.model.terms == ("pressure", "pairs")
    found = read(tmp_path, written, "model.preset=resolved").model
    assert found.terms == tuple(PRESETS["resolved"]) == tuple(found.settings)
    kept = read(tmp_path, written, 'model.terms=["pressure", "pairs"]').model
    assert kept.settings["pairs"].hidden == (8, 8)
    refused("[model.pairs]: no such term",
            lambda: read(tmp_path, written, "model.preset=resolved", "model.pairs.hidden=[4]"))
    refused("both keys give the terms",
            lambda: read(tmp_path, written, "model.preset=resolved", 'model.terms=["pressure"]'))
