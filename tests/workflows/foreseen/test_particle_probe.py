"""The probe of the particle step: it runs with any terms, counts what they ask for, and leaves nothing behind."""

import sys
from pathlib import Path

import pytest
import torch

from eddies.scene.scene import load_scene
from eddies.scene.terms import PRESETS
from eddies.workflows.foreseen.particle_probe import PARTS, ProbeError, probe_particles

EXAMPLES = Path(__file__).parents[3] / "docs/examples"
OWN_PAIRS = """
from eddies.particles.terms.pair_network import PairNetwork

class Unknown(PairNetwork):
    pass
"""


def scene_of(*changes):
    return load_scene("tiny", list(changes))


@pytest.mark.usefixtures("quick_probes")
@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_is_probed(comm, preset):
    scene = scene_of(f"model.preset={preset}")
    speed, pairs = probe_particles(scene, comm), "pairs" in scene.model.reads
    assert set(speed.rates) == set(PARTS)
    assert all(rate.call >= 0 and rate.unit >= 0 for rate in speed.rates.values())
    # What is told by kriging wants the pairs themselves.
    assert speed.listed is (preset == "local")
    assert speed.kriging is (preset == "local")
    # The residual that a solve starts from and the products are two transforms each, the stress two, the force one.
    expected = (7, 27) if "pressure" in PRESETS[preset] else (0, 0)
    assert (speed.calls["transforms"], speed.components["transforms"]) == expected
    assert bool(speed.ghost_columns) == pairs


@pytest.mark.usefixtures("quick_probes")
@pytest.mark.mpi(1, 2)
def test_pairs_that_are_told_the_densities_want_the_pressure_at_particles_and_ghosts(comm):
    preset = "model.preset=resolved + pairs"
    told = probe_particles(scene_of(preset, 'model.pairs.inputs=["density", "distance", "speed", "approach"]'), comm)
    without = probe_particles(scene_of(preset), comm)
    assert (told.calls["transforms"], told.components["transforms"]) == (7, 28)
    assert sorted(told.ghost_columns) == sorted([*without.ghost_columns, 8])


@pytest.mark.usefixtures("quick_probes")
@pytest.mark.mpi(1, 2)
def test_terms_of_the_users_are_probed(comm, own, monkeypatch):
    monkeypatch.setattr(sys, "path", [*sys.path, str(EXAMPLES)])
    stress = probe_particles(scene_of('model.terms=["pressure", "own_term:SmagorinskyStress", "pairs"]'), comm)
    # It transforms nine slopes and six products in the place of three velocities and six products.
    assert stress.components["transforms"] == 28 - 3 + 9
    own("own_pairs", OWN_PAIRS)
    unknown = probe_particles(scene_of('model.terms=["pressure", "own_pairs:Unknown"]'), comm)
    assert unknown.listed and unknown.block_bytes > 0


@pytest.mark.usefixtures("quick_probes")
@pytest.mark.mpi(1, 2)
def test_a_term_that_fails_is_told(comm, own):
    own("own_fault", OWN_PAIRS.replace("pass", "compiled = None\n    def pair_values(self, pairs): return 1 / 0"))
    with pytest.raises(ProbeError, match="ZeroDivisionError: division by zero"):
        probe_particles(scene_of('model.terms=["pressure", "own_fault:Unknown"]'), comm)


@pytest.mark.mpi(1)
def test_a_flow_of_a_single_resolved_shell_is_probed(comm):
    speed = probe_particles(scene_of("flow.viscosity=1.0", "flow.cells=36", "tracers.particles_per_side=24"), comm)
    assert speed.rates["modes"].unit == 0 < speed.rates["transforms"].unit


@pytest.mark.usefixtures("quick_probes")
@pytest.mark.mpi(1)
def test_forcing_is_probed_too(comm):
    forced = probe_particles(scene_of("simulation.injection=0.5"), comm)
    assert forced.components["transforms"] == 27


@pytest.mark.usefixtures("quick_probes")
@pytest.mark.mpi(1, 2)
def test_nothing_is_left_behind(comm, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    threads, state, grad = torch.get_num_threads(), torch.random.get_rng_state(), torch.is_grad_enabled()
    probe_particles(scene_of(), comm)
    assert (torch.get_num_threads(), torch.is_grad_enabled()) == (threads, grad)
    assert torch.equal(torch.random.get_rng_state(), state)
