"""Warnings: each where it is due, with its key, its value and the remedy, after which it is gone; none of built-in
scenes."""

import logging
import re
from dataclasses import replace

import numpy as np
import pytest

from eddies.scene.scene import builtin_scenes, load_scene
from eddies.workflows.foreseen.numbers import expected_turbulence, mach, rms_speed
from eddies.workflows.foreseen.problems import stage_warnings, warnings
from tests.small_scene import TINY, one_model


def told(*overrides, scene=TINY):
    return list(warnings(load_scene(scene, list(overrides)), 1))


@pytest.mark.parametrize("name", [name for name, _ in builtin_scenes()])
def test_built_in_scenes_give_no_reason(name):
    # Those that take the weights of another run want that run first.
    assert [line for line in told(scene=name) if "path" not in line] == []


@pytest.mark.parametrize("given, words, remedy", [
    ("flow.viscosity=0.05", "k_max eta is about 0.88, below 1", "flow.viscosity={viscosity to}"),
    ("flow.viscosity=0.05", "[flow] cells = 24", "flow.cells={raise cells to}"),
    ("flow.cells=120", "k_max eta is about 5.6, and 1 to 2 resolve", "flow.cells={lower cells to}"),
    ("flow.sound_speed=4", "[flow] sound_speed = 4: the turbulent Mach number is about 0.47, above 0.3",
     "flow.sound_speed={raise sound_speed to}"),
    ("flow.sound_speed=1.5", "supersonic, with a turbulent Mach number of about 1.2",
     "flow.sound_speed={raise sound_speed to}"),
    ("time.step=0.06", "[time] step = 0.06: is unstable by advection, step x k_max x max(|u| + |v| + |w|) = 3.17, "
     "stable up to 2.83", "time.step=0.05"),
    ("time.courant=2.5", "[time] courant = 2.5: is unstable by advection", None),
    ("tracers.filter_width=2", "[tracers] filter_width = 2: passes wavenumbers up to 1.6, less than the 2 of the "
     "scales that are forced", "tracers.filter_width={lower it to}"),
    ("simulation.turnovers=5", "[simulation] turnovers = 5: the ground truth ends 0.3 turnovers after its start",
     "simulation.turnovers={lower it to}"),
    ("simulation.turnovers=5", "compared with nothing", "tracers.turnovers={raise .tracers. turnovers to}"),
    ("simulation.start=0.9", "[simulation] turnovers = 0.3: the ground truth ends 0.06 turnovers after its", None),
    ("tracers.filter_width=0.1", "narrower than a cell", "tracers.filter_width=0.3"),
])
def test_a_warning_names_key_and_value_and_its_remedy_helps(given, words, remedy):
    changes = [given, "time.max_step=1"] if "courant" in given else [given]
    line, = told(*changes)
    assert words in line and "\n" not in line
    assert re.match(r"\[\w+\] \w+ = [\d.e-]+: ", line)
    if remedy:
        key, value = remedy.split("=")
        if value.startswith("{"):
            value = re.search(value[1:-1] + r" ([\d.e-]*\d)", line).group(1)
        assert told(*changes, f"{key}={float(value) if 'cells' not in key else int(value)}") == []


def test_a_flow_that_is_not_turbulent_is_told():
    for viscosity, words in ((2, "below 5 eddies decay"), (60, "nothing is turbulent")):
        line, = (line for line in told(f"flow.viscosity={viscosity}") if "Re_lambda" in line)
        assert words in line
        remedy = re.search(r"lower viscosity to ([\d.]+)", line).group(1)
        assert not any("Re_lambda" in line for line in told(f"flow.viscosity={0.99 * float(remedy):.3g}"))


def test_steps_that_relax_too_far_are_told():
    """Runs of `hit` with C_r = 2 end in noise with velocity Verlet and steps of 0.05, those of `hit-256` with 100
    neighbours in steps of 0.1; none is told within limits."""
    def told(*overrides, scene):
        return list(warnings(one_model(scene, list(overrides)), 1))

    changes = ["model.preset=local", "model.filtered-equations.relaxation=2"]
    for integrator, step, expected in (("verlet", 0.05, True), ("verlet", 0.01, False), ("rk3", 0.04, False)):
        lines = told(*changes, f"simulation.integrator={integrator}", f"simulation.step={step}", scene="hit")
        assert any("relaxes so fast" in line for line in lines) is expected
    for step, expected in ((0.1, True), (0.08, False)):
        lines = told("model.preset=local", "simulation.integrator=corrected-verlet", f"simulation.step={step}",
                     scene="hit-256")
        assert any("relaxes so fast" in line for line in lines) is expected
    given = [*changes, "simulation.step=0.1"]
    line, = (line for line in told(*given, scene="hit") if "relaxes so fast" in line)
    remedy = re.search(r"more than about ([\d.]+);", line).group(1)
    assert not any("relaxes so fast" in line for line in told(*changes, f"simulation.step={remedy}", scene="hit"))


def test_explicit_steps_have_the_limits_of_sound_and_viscosity_too():
    found = told("time.stepper=rk4", "time.step=0.05")
    assert len(found) == 1 and "[time] step = 0.05: is unstable by sound" in found[0]
    assert 'stepper = "etdrk4"' in found[0]
    free = load_scene("taylor-green", ["time.stepper=rk4", "flow.viscosity=1", "flow.cells=32"])
    viscous, = warnings(replace(free, time=replace(free.time, step=None, max_step=0.05)), 1)
    assert "[time] max_step = 0.05: is unstable by viscosity, step x 3 viscosity k_max^2 = 15" in viscous


def test_particles_of_a_forced_rollout_are_told_of_shorter_steps():
    forced = ["simulation.injection=dissipation", "simulation.step=0.3", "simulation.frame_interval=0.3"]
    line, = told(*forced)
    step = re.search(r"of about ([\d.]+)", line).group(1)
    assert line.startswith("[simulation] step = 0.3") and told(*forced, f"simulation.step={step}") == []


def test_stages_tell_what_concerns_them():
    scene = load_scene(TINY, ["flow.sound_speed=4", 'model.terms=["pairs", "density-flux", "continuity"]',
                              "model.continuity.diffusion=0.1"])
    by_stage = {stage: list(stage_warnings(scene, [stage])) for stage in scene.stages}
    assert [stage for stage, lines in by_stage.items() if lines] == ["dns", "train"]
    assert sum(by_stage.values(), []) == list(warnings(scene, 1))


@pytest.mark.mpi(1, 2)
def test_speeds_and_mach_numbers_are_those_of_the_flow(comm):
    from eddies.flow.statistics import component_energies
    from eddies.workflows.ground_truth.scene_flow import build_fluid, initial_state
    sound = ["flow.fluid=compressible", "flow.sound_speed=10", "flow.cells=16"]
    for name, changes in (("taylor-green", []), ("abc", ["initial.wavenumber=2"]), ("shear-wave", []),
                          ("tracers-only", ["tracers.particles_per_side=8"])):
        scene = load_scene(name, [*sound, *changes])
        fluid = build_fluid(scene, comm)
        energy = sum(component_energies(fluid.grid, initial_state(scene, fluid)[:3]).values())
        assert rms_speed(scene) == pytest.approx(np.sqrt(2 * energy), rel=1e-6)
        assert mach(scene) == pytest.approx(np.sqrt(2 * energy) / 10, rel=1e-6)
    turbulence = expected_turbulence(load_scene(TINY))
    assert mach(load_scene(TINY)) == pytest.approx(np.sqrt(3) * turbulence.velocity_rms / 22.5)


def test_a_term_of_the_users_says_which_steps_are_too_long(tmp_path):
    (tmp_path / "own_stiff.py").write_text("""
from dataclasses import dataclass

import eddies


@dataclass(frozen=True)
class Stiff(eddies.TermSettings):
    too_long = 'the term "{name}" wants at most {longest}'

    def longest_step(self, units):
        return 0.08 * units.filter_width / units.velocity


class Spring(eddies.Term):
    Settings = Stiff
""")
    own = tmp_path / "own.toml"
    own.write_text(load_scene(TINY).to_toml())
    terms = 'model={terms=["viscosity", "own_stiff:Spring"]}'
    line, = told(terms, "simulation.step=0.1", scene=own)
    longest = float(line.rpartition(" ")[2])
    assert line == f'[simulation] step = 0.1: the term "Spring" wants at most {longest:g}' and longest < 0.1
    assert told(terms, f"simulation.step={longest}", scene=own) == []


def test_steps_that_sound_outruns_are_told():
    """Of terms of SPH."""
    found = {changes: [line for line in told(*changes) if "resolve sound" in line]
             for changes in (("model.preset=wcsph",), ("model.preset=wcsph", "simulation.step=0.001"), ())}
    (line,) = found.pop(("model.preset=wcsph",))
    assert line.startswith('[simulation] step = 0.08: the term "wcsph" has to resolve sound, with a step of at most')
    scene = load_scene(TINY, ["model.preset=wcsph"])
    # Of Monaghan (1992), with an alpha of 0.05.
    longest = 0.4 * scene.interaction_radius / 2 / (scene.flow.sound_speed * 1.03)
    assert float(line.partition("at most ")[2].split()[0]) == pytest.approx(longest, rel=0.1)
    assert list(found.values()) == [[], []]


def test_terms_that_nothing_trains_are_told():
    fast = ["training.horizons.steps=5", "training.horizons.frames=[12]"]
    for preset in ("resolved + pairs", "resolved", "transport-velocity"):
        lines = [line for line in told(f"model.preset={preset}") if "horizons" in line]
        assert lines == ([] if "resolved" in preset else [
            '[model] terms: "transport-velocity" is trained through horizons alone, and stays as it starts without '
            "them: add [training.horizons]"])
        assert not any("horizons" in line for line in told(f"model.preset={preset}", *fast))


def test_weights_that_are_not_there_yet_are_told(tmp_path):
    (line,) = told(f"model.path={tmp_path}")
    assert f"there is no {tmp_path / 'model.h5'} yet" in line
    (tmp_path / "model.h5").touch()
    assert told(f"model.path={tmp_path}") == []


def test_job_with_too_many_ranks_is_told():
    assert any("this job has 100 ranks" in line for line in warnings(load_scene(TINY), 100))
    assert list(warnings(load_scene("hit-small"), 2)) == []


@pytest.mark.mpi(1)
def test_a_run_tells_the_warnings_of_its_stages_when_it_starts(comm, tmp_path, monkeypatch, caplog):
    from eddies.parallel.stop import StopRequest
    from eddies.stages import run_stages
    from eddies.workflows import dns
    monkeypatch.setattr(dns, "run", lambda *given: None)
    scene = load_scene(TINY, ["flow.sound_speed=4", "model.preset=paper"])
    with caplog.at_level(logging.WARNING, logger="eddies"):
        run_stages(["dns"], scene, comm, tmp_path, StopRequest(comm))
    shown = [record.getMessage() for record in caplog.records]
    assert shown == list(stage_warnings(scene, ["dns"])) and len(shown) == 1
