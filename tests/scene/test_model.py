"""The model of a scene: its terms, their settings in [model.NAME], classes of the user's, what the flow must have."""

import subprocess
import sys
from dataclasses import fields, replace

import pytest

from eddies.pipeline import STAGES as TABLE
from eddies.scene.model import settings_class
from eddies.scene.scene import Flow, Initial, Model, Scene, SceneError, Simulation, Time, load_scene
from eddies.scene.terms import DEFAULT_PRESET, PRESETS, TERMS, Continuity, PairNetwork, Pressure, Stress
from eddies.workflows.run_directory.fingerprints import stage_fingerprint, stage_provenance
from tests.small_scene import TINY

STAGES = tuple(TABLE)
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

SETTINGS = """
from dataclasses import dataclass
from eddies import Term, TermSettings
"""
OWN_TERM = SETTINGS + """
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
    path = tmp_path / "case.toml"
    path.write_text(text)
    return load_scene(path, overrides)


def refused(message, make):
    with pytest.raises(SceneError) as error:
        make()
    assert message in str(error.value), str(error.value)


def test_without_anything_the_model_is_the_default_preset(tmp_path):
    model = read(tmp_path, COMPRESSIBLE + "[model]\n").model
    assert model == Model() == Model(preset=DEFAULT_PRESET)
    assert model.terms == tuple(PRESETS[DEFAULT_PRESET]) == tuple(model.settings)
    resolved = Model(preset="resolved").settings["stress"]
    assert resolved == Stress() and resolved.form == "deconvolution"


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_is_a_list_of_terms_that_fit_together(tmp_path, name):
    scene = read(tmp_path, COMPRESSIBLE + f'[model]\npreset = "{name}"\n')
    assert scene.model.terms == tuple(PRESETS[name]) and scene.model.preset is None
    (tmp_path / "again.toml").write_text(scene.to_toml())
    assert load_scene(tmp_path / "again.toml") == scene
    assert scene.model.gives & {"density", "density_rate"}
    assert scene.foreign == ()


@pytest.mark.parametrize("word", TERMS)
def test_every_term_has_settings_that_are_explained(word):
    kind = settings_class(word)
    assert kind is TERMS[word] and kind.word == word
    assert kind.__doc__ and all(field.metadata["rule"].about for field in fields(kind))


def test_keys_of_a_term_are_written_over_those_of_the_preset(tmp_path):
    scene = read(tmp_path, COMPRESSIBLE + '[model]\npreset = "paper"\n[model.pairs]\nhidden = [4]\n',
                 "model.density-flux.hidden=[5, 5]", 'model.pairs.inputs=["distance", "density"]')
    pairs, flux = scene.model.settings["pairs"], scene.model.settings["density-flux"]
    assert (pairs.basis, pairs.hidden, pairs.inputs, flux.hidden) == ("paper", (4,), ("distance", "density"), (5, 5))
    assert Model(preset="paper", settings={"pairs": {"hidden": [4]}}).settings["pairs"].basis == "paper"
    whole = Model(preset="paper", settings={"pairs": PairNetwork(hidden=(4,))}).settings["pairs"]
    assert whole == PairNetwork(hidden=(4,))


def test_what_terms_read_and_give():
    model = Model(terms=("pressure", "pairs"), settings={"pairs": PairNetwork(hidden=(8, 8)), "pressure": {}})
    assert (model.reads, model.gives) == ({"resolved", "pairs", "density"}, {"acceleration", "density"})
    alone = Model(terms=["pairs"], settings={"pairs": {"inputs": ["distance"]}})
    assert (alone.reads, alone.gives) == ({"pairs"}, {"acceleration"})
    assert PairNetwork(hidden=(8, 8)).numbers_per_pair == 5 + 16 + 3
    assert PairNetwork(hidden=(8,), inputs=("distance", "speed")).numbers_per_pair == 2 + 8 + 3


@pytest.mark.parametrize("changes, message", [
    (dict(terms=("pressure", "pressure")), 'terms = ["pressure", "pressure"]: must be one or more terms, each once'),
    (dict(terms=()), "[model] terms = []: must be one or more terms"),
    (dict(terms=("presure",)), '"filtered-equations", or the import path "module:name" of your own (what accelerates'),
    (dict(terms=("presure",)), "did you mean pressure?"),
    (dict(terms="pressure"), '[model] terms = "pressure": must be a list of any of "pairs", "eddy-viscosity"'),
    (dict(terms=("pressure",), preset="wcsph"), "the list is given twice; remove one of the two"),
    (dict(terms=("pressure",), settings={"pairs": {}}), "[model.pairs]: no such term; the terms are pressure; remove"),
    (dict(terms=("pairs",), settings={"pairs": Pressure()}),
     "[model.pairs]: must be settings of the class PairNetwork, or a dict"),
    (dict(terms=("pairs",), settings={"pairs": 3}), "model.pairs = 3: must be a section"),
    (dict(terms=("own_nowhere:Term",)), '[model] terms: "own_nowhere:Term": there is no module "own_nowhere"'),
    (dict(terms=("eddies.scene.scene:load_scene",)), "must be a class derived from eddies.Term"),
])
def test_bad_model(changes, message):
    refused(message, lambda: Model(**changes))


@pytest.mark.parametrize("make, message", [
    (lambda: Flow(fluid="plasma", cells=-3, viscosity=1),
     '[flow] fluid = "plasma": must be one of "incompressible", "compressible", or the import path'),
    (lambda: Flow(fluid="incompressible", cells=-3, viscosity=1), "[flow] cells = -3: must be a whole number at"),
    (lambda: Flow(fluid="incompressible", cells=None, viscosity=1), "[flow] cells = None: must be a whole number"),
    (lambda: PairNetwork(hidden=(0,)), "[PairNetwork] hidden = [0]: must be a list such as [16, 16]"),
    (lambda: PairNetwork(symmetry="antisymmetric"), "the forces of a pair are not opposite"),
    (lambda: Model(terms=("pairs",), settings={"pairs": {"hidden": 3}}), "[model.pairs] hidden = 3: must be a list"),
    (lambda: Scene(flow=3, time=Time(duration=1)), "flow = 3: must be a Flow"),
    (lambda: Scene(seed=-1, flow=Flow(fluid="incompressible", cells=8, viscosity=1)), "seed = -1: must be a whole"),
    (lambda: replace(load_scene(TINY).flow, viscosity="thin"), '[flow] viscosity = "thin": must be a number'),
])
def test_what_a_program_makes_is_checked_as_what_a_file_holds(make, message):
    refused(message, make)


def test_values_are_held_in_one_form():
    flow = Flow(fluid="incompressible", cells=16, viscosity=1)
    assert (flow.viscosity, type(flow.viscosity)) == (1.0, float)
    assert PairNetwork(hidden=[8, 8]) == PairNetwork(hidden=(8, 8))
    assert replace(flow, cells=32) == Flow(fluid="incompressible", cells=32, viscosity=1.0)
    assert replace(Model(), path="runs/hit").terms == Model().terms


def test_an_own_term_has_keys_of_its_own(tmp_path, own):
    own("own_drag", OWN_TERM)
    text = COMPRESSIBLE + '[model]\nterms = ["pressure", "own_drag:Drag"]\n[model.Drag]\nconstant = 2\n'
    scene = read(tmp_path, text, "model.Drag.strong=true")
    drag = scene.model.settings["Drag"]
    assert (drag.constant, drag.levels, drag.strong, drag.numbers_per_pair) == (2.0, (1, 2), True, 0)
    assert scene.model.reads == {"resolved"} and scene.foreign == scene.model.foreign == ("own_drag:Drag",)
    (tmp_path / "again.toml").write_text(scene.to_toml())
    assert load_scene(tmp_path / "again.toml").to_toml() == scene.to_toml()
    for change, message in [("model.Drag.constant=thin", '[model.Drag] constant = "thin": must be a number'),
                            ("model.Drag.levels=[]", "[model.Drag] levels = []: must be a list such as [16, 16] of "
                             "whole numbers"),
                            ("model.Drag.strong=1", "[model.Drag] strong = 1: must be true or false"),
                            ("model.Drag.konstant=1", "[model.Drag] konstant: no such key; did you mean constant?"),
                            ('model.terms=["pairs", "own_drag:Drag"]', '"pairs" reads the density, which no')]:
        refused(message, lambda: read(tmp_path, text, change))


@pytest.mark.parametrize("body, message", [
    ("class Bad(Term):\n    def forward(self): pass\n    class Settings: pass\n", "its Settings must be a class of"),
    ("class Bad(Term):\n    def forward(self): pass\n    class Settings(TermSettings):\n        a: float = 1\n",
     "write @dataclass(frozen=True) and below it class Settings(eddies.TermSettings)"),
    ("class Bad(Term):\n    def forward(self): pass\n    @dataclass(frozen=True)\n    class Settings(TermSettings):\n"
     "        a: complex = 1j\n", "Bad.Settings.a: complex: a key is declared by number, integer"),
    ("class Bad(Term):\n    def forward(self): pass\n    @dataclass(frozen=True)\n    class Settings(TermSettings):\n"
     "        reads = ('vorticity',)\n", 'reads = ["vorticity"]: must be a tuple of any of "pairs", "resolved", '),
    ("class Bad: pass\n", "must be a class derived from eddies.Term"),
    ("Bad = 3\n", "must be a class derived from eddies.Term"),
])
def test_bad_own_term(own, body, message):
    own("own_bad", SETTINGS + body)
    refused(message, lambda: Model(terms=("own_bad:Bad",)))


def test_classes_beside_the_scene_are_found(tmp_path, own):
    own("unused", "")  # restores where modules are looked for
    folder = tmp_path / "apart"
    folder.mkdir()
    (folder / "own_neighbour.py").write_text(
        "from eddies import Term\n\nclass Quiet(Term):\n    def forward(self, context):\n        return None\n")
    (folder / "case.toml").write_text(COMPRESSIBLE + '[model]\nterms = ["own_neighbour:Quiet"]\n')
    scene = load_scene(folder / "case.toml")
    assert scene.model.settings["Quiet"].reads == () and not scene.model.gives & {"density"}
    refused("[model.Quiet] key: no such key; valid here: no key",
            lambda: load_scene(folder / "case.toml", ["model.Quiet.key=3"]))


@pytest.mark.parametrize("overrides, first", [
    (['model.terms=["pressure", "own_edited:Drag"]'], "train"), (["initial.kind=own_edited:swirl"], "dns"),
    (["simulation.method=own_edited:Run"], "simulate"), (["flow.fluid=own_edited:Honey", "flow.sound_speed=9"], "dns"),
    (['model.terms=["pressure", "pairs"]', "model.pairs.network=own_edited:Drag"], "train")])
def test_an_edited_class_is_another(tmp_path, own, overrides, first):
    path = own("own_edited", OWN_TERM + """
from eddies.flow.navier_stokes import CompressibleFluid as Honey0

class Honey(Honey0): pass
def swirl(grid, initial, seed): pass
class Run:
    needs = ("model",)
    def advance(self, until, number): pass
    frame = status = series = description = has_density = advance
""")
    text = load_scene(TINY).to_toml().partition("[model]")
    bare = text[0] + "[model]\n[training]" + text[2].partition("[training]")[2]
    scene = read(tmp_path, bare, *overrides)
    before = [stage_fingerprint(scene, stage) for stage in STAGES]
    path.write_text(path.read_text() + "\n# tried another way\n")
    changed = [stage for stage, old in zip(STAGES, before) if stage_fingerprint(scene, stage) != old]
    assert changed == list(STAGES[STAGES.index(first):])
    (name,) = scene.foreign
    assert stage_provenance(scene, "dns")["foreign"][name]["sha256"]


def test_provenance_names_no_classes_where_there_are_none():
    scene = load_scene(TINY)
    assert stage_provenance(scene, "train") == {"scene": scene.to_toml(), "fingerprint": stage_fingerprint(scene, "train"),
                                         "made_from": ["ground_truth", "kernel"]}


def test_who_reads_no_density_needs_none(tmp_path):
    simulation = "[simulation]\nstep = 0.02\nframe_interval = 0.1\nturnovers = 0.2\n"
    free = INCOMPRESSIBLE + '[model]\npreset = "resolved + pairs"\n' + simulation
    assert read(tmp_path, free).stages == ("dns", "train-kernel", "train", "simulate", "report")
    assert "density" not in read(tmp_path, free).model.reads
    bare = INCOMPRESSIBLE.replace("[training]\nframes = 2\nbatch = 9\nsteps = 3\n", "") + simulation
    assert read(tmp_path, bare, "simulation.method=none").stages == ("dns", "train-kernel", "simulate", "report")
    refused('[model.pairs]: reads the density, which an incompressible flow does not have; leave "density" out of '
            '[model.pairs] inputs, or set [flow] fluid = "compressible"', lambda: read(
                tmp_path, free, 'model.pairs.inputs=["distance", "density"]'))
    refused('"density-flux" gives the density alone, which no term reads; remove it', lambda: read(
        tmp_path, free, 'model.terms=["pairs", "density-flux"]', 'model.pairs.inputs=["speed"]',
        'model.density-flux.inputs=["speed"]'))


def test_a_density_is_given_once(tmp_path):
    refused('"pressure" gives the density and "continuity" its rate, which are two densities', lambda: read(
        tmp_path, COMPRESSIBLE + '[model]\nterms = ["pressure", "continuity"]\n'))
    refused('"pairs" reads the density, which no term gives; add a term that does, such as "pressure" or '
            '"continuity", or leave "density" out of [model.pairs] inputs', lambda: read(
                tmp_path, COMPRESSIBLE + '[model]\nterms = ["pairs"]\n'))
    assert Continuity(diffusion=0.1).learns_through_horizons


@pytest.mark.parametrize("key, path, message", [
    ("flow.fluid", "eddies.scene.scene:load_scene",
     '[flow] fluid: "eddies.scene.scene:load_scene": cannot be used here, it has no '
     "nonlinear, linear, linear_function, combine, compressible"),
    ("initial.kind", "eddies.scene.scene:BUILT_IN", "cannot be used here, it has no __call__"),
    ("simulation.method", "eddies.scene.scene:Scene", "cannot be used here, it has no advance, frame, status, "
     "series, description, has_density"),
    ("model.pairs.network", "eddies.scene.scene:Scene",
     "[model.pairs] network: \"eddies.scene.scene:Scene\": cannot be used here, "
     "it has no forward"),
])
def test_a_wrong_class_is_told_before_any_work(key, path, message):
    refused(message, lambda: load_scene(TINY, [f"{key}={path}"]))


def test_keys_of_an_own_initial_flow():
    initial = Initial(kind="own:swirl", amplitude=2, peak_wavenumber=4.5, wavenumber=3)
    assert (initial.amplitude, initial.wavenumber) == (2.0, 3)


def test_what_methods_need():
    assert Simulation(step=1, turnovers=1, frame_interval=1).needs == ("model",)
    needs = {method: Simulation(method=method, step=1, turnovers=1, frame_interval=1).needs
             for method in ("none", "eulerian")}
    assert needs["none"] == needs["eulerian"] == ()


def test_a_scene_with_a_model_loads_no_torch():
    code = ("import sys, eddies; scene = eddies.load_scene('tiny'); stage_fingerprint(scene, 'train'); scene.to_toml();"
            "eddies.Model(preset='wcsph'); dir(eddies);"
            "sys.exit(bool({'torch', 'mpi4py', 'numpy', 'h5py', 'pyfftw'} & set(sys.modules)))")
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 0


def test_another_list_on_the_command_line_takes_the_place_of_the_file_s(tmp_path):
    """Of a preset, of terms, and of a written scene, which has settings of all its terms."""
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
    refused("with terms = ", lambda: read(tmp_path, written, "model.preset=resolved", 'model.terms=["pressure"]'))
