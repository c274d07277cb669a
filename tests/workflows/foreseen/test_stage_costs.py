"""Costs of stages: what must hold whatever the machine, and memory against what is kept."""

import logging
from dataclasses import replace

import numpy as np
import pytest
import torch

from eddies.flow.subgrid import DynamicStress
from eddies.scene.scene import load_scene
from eddies.workflows.foreseen import cost_model
from eddies.workflows.foreseen.coarse_probe import probe_coarse
from eddies.workflows.foreseen.cost_model import Speed
from eddies.workflows.foreseen.learning_cost import SAMPLES, kernel_cost, rollout_cost, training_cost
from eddies.workflows.foreseen.particle_probe import PARTS, ParticleSpeed, Rate
from eddies.workflows.foreseen.stage_cost import Speeds, flow_cost
from eddies.workflows.foreseen.stage_costs import stage_costs
from eddies.workflows.foreseen.training_probe import Line, TrainingSpeed, cube_rows, probe_training
from eddies.workflows.ground_truth.scene_flow import build_fluid

PARTICLES = ParticleSpeed(dict.fromkeys(PARTS, Rate(1e-4, 1e-8)), {"splines": 4, "transforms": 8},
                          {"splines": 13, "transforms": 31}, (24, 24, 8, 24))
SPEEDS = Speeds(Speed(1e-6, 1e9, 2e-7, 1e-7), PARTICLES, TrainingSpeed(*[Line(1e-3, 1e-6)] * 6), {},
                Speed(5e-7, 1e9, 0.0, 1e-6))

begin_step = DynamicStress.begin_step


def cost_of(stage, *overrides, scene="hit-small", ranks=1):
    found = {cost.stage: cost for cost in stage_costs(load_scene(scene, list(overrides)), ranks, SPEEDS)}
    return found[stage]


@pytest.mark.parametrize("stage", ["dns", "train-kernel", "train", "simulate", "report"])
def test_more_ranks_take_less_time_and_memory_and_leave_as_much(stage):
    rows = [cost_of(stage, ranks=ranks) for ranks in (1, 2, 4, 12)]
    for few, many in zip(rows, rows[1:]):
        assert many.seconds < few.seconds and many.memory <= few.memory and many.disk == few.disk


@pytest.mark.parametrize("stage, part, override, factor", [
    ("dns", "tracers", "tracers.turnovers=4.8", 2), ("train-kernel", "steps", "kernel.steps=400", 2),
    ("train", "frames", "training.frames=33", 2),
    ("simulate", "steps", "simulation.step=0.0348", 2), ("simulate", "frames", "simulation.turnovers=0.5", 0.54)])
def test_time_goes_with_the_work(stage, part, override, factor):
    once, twice = cost_of(stage), cost_of(stage, override)
    assert twice.parts[part] == pytest.approx(factor * once.parts[part], rel=0.1)


def test_samples_are_those_of_the_training_of_the_kernel():
    from eddies.workflows.train_kernel import TRAINING_SAMPLES
    assert SAMPLES == TRAINING_SAMPLES


def test_horizons_come_on_top_and_grow_with_their_frames():
    alone = cost_of("train")
    found = [cost_of("train", "training.horizons.steps=10", f"training.horizons.frames={frames}")
             for frames in ([1], [2], [1, 2])]
    seconds = [cost.parts["horizons"] for cost in found]
    assert "horizons" not in alone.parts and seconds[1:] == pytest.approx([2 * seconds[0], 3 * seconds[0]])


def test_a_scene_that_takes_weights_is_tested_and_not_trained():
    parts = cost_of("train", "model.path=somewhere").parts
    assert "test" in parts and "steps" not in parts and "frames" not in parts


@pytest.mark.mpi(1, 2)
def test_tables_of_the_kernel_take_the_bytes_that_are_foreseen(comm):
    """The largest part of the memory of the training of the kernel: entries of the table for each particle."""
    from eddies.parallel.slab import SlabDecomposition
    from eddies.particles.particle_field import ParticleField
    from eddies.particles.smoothing_kernels import KNOTS, KernelNetwork
    from eddies.scene.scene import BOX_LENGTH
    slab = SlabDecomposition(comm, BOX_LENGTH, 18)
    position = np.random.default_rng(3).uniform(0, BOX_LENGTH, (1000, 3))
    own = torch.from_numpy(position[slab.owner_of(position[:, 2]) == comm.rank])
    field = ParticleField(slab, 1.0, own, own)
    with torch.no_grad():
        field.volumes_by_table(KernelNetwork(1.0, [4]).to(torch.float32).table())
    assert field._entries.nbytes == 8 * KNOTS * len(own)


@pytest.mark.parametrize("changes, rows", [(["kernel.neighbors=30"], None), (["kernel.neighbors=400"], 12**3)])
def test_particles_in_and_around_a_cube_are_those_that_a_step_takes(changes, rows):
    scene = load_scene("tiny", changes)
    position = np.random.default_rng(2).uniform(0, 2 * np.pi, (12**3 * 100, 3))
    side = min(2 * np.pi / 4 + 2 * scene.kernel_support, 2 * np.pi)
    assert cube_rows(scene, 12) == pytest.approx((position < side).all(1).sum() / 100, rel=0.02)
    assert rows is None or cube_rows(scene, 12) == pytest.approx(rows)


@pytest.mark.usefixtures("quick_probes")
@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("preset", ["resolved + pairs", "paper"])
def test_the_probe_of_training_leaves_nothing_behind(comm, preset):
    scene, state = load_scene("tiny", [f"model.preset={preset}"]), torch.random.get_rng_state()
    speed = probe_training(scene, comm, True)
    assert torch.equal(torch.random.get_rng_state(), state) and torch.is_grad_enabled()
    for line in vars(speed).values():
        assert line.call >= 0 and line.unit >= 0 and line.at(1000) > 0
    alone = probe_training(scene, comm, False)
    assert alone.batch_step is alone.combined_step is None and alone.kernel_step.at(1728) > 0


def test_lines_pass_through_both_sizes_and_are_never_negative():
    assert Line.through((10, 3.0), (30, 5.0)) == Line(2.0, 0.1)
    assert Line.through((10, 3.0), (30, 2.0)) == Line(3.0, 0.0)
    assert Line.through((10, 1.0), (30, 5.0)).call == 0.0
    assert Line.through((10, 3.0), (10, 4.0)) == Line(3.0, 0.0)


@pytest.mark.parametrize("changes", [["simulation.method=none"], ["simulation.method=eulerian"]])
def test_rollouts_without_a_model_are_foreseen_too(changes):
    scene = load_scene("hit-small", changes)
    bare = replace(SPEEDS, particles=None)
    found = rollout_cost(scene, 2, bare)
    assert 0 < found.seconds < 100 and (found.parts["steps"] > 0) == ("eulerian" in changes[0])
    # Steps at the speed of the coarse grid, whatever that of the direct simulation.
    once, flow = bare.coarse, replace(bare.flow, work=1.0, tracers=1.0)
    twice = replace(bare, flow=flow, coarse=replace(once, work=2 * once.work, tracers=2 * once.tracers))
    slower, found = (rollout_cost(scene, 1, speeds).parts["steps"] for speeds in (twice, bare))
    assert slower == pytest.approx(2 * found)


@pytest.mark.mpi(1, 2)
def test_a_coarse_grid_is_probed_as_it_runs(comm, monkeypatch):
    """Its own fluid and precision, with the closure that it has."""
    built, steps = [], []
    for name in ("incompressible", "compressible"):
        scene = load_scene("tiny", ["simulation.method=eulerian", "eulerian.cells=16", f"eulerian.fluid={name}",
                                    "eulerian.equations=filtered", "eulerian.closure=dynamic-mixed"])
        monkeypatch.setattr(cost_model, "build_fluid", lambda *given: built.append(build_fluid(*given)) or built[-1])
        monkeypatch.setattr(DynamicStress, "begin_step", lambda *given: steps.append(begin_step(*given)))
        speed = probe_coarse(scene, comm)
        assert speed.work > 0 and speed.tracers > 0
    for fluid, compressible in zip(built, (False, True)):
        assert (fluid.compressible, fluid.grid.cells, fluid.grid.precision) == (compressible, 16, "float32")
        assert fluid.closure.squared_width > 0
    assert len(steps) == 2 * 6
    # What is learned is not there before it is.
    assert probe_coarse(load_scene("tiny", ["simulation.method=eulerian", "eulerian.closure=learned"]), comm).work > 0


@pytest.mark.mpi(1)
def test_a_run_tells_the_warnings_of_its_stages_when_it_starts(comm, tmp_path, monkeypatch, caplog):
    from eddies.parallel.stop import StopRequest
    from eddies.stages import run_stages
    from eddies.workflows import dns
    from eddies.workflows.foreseen.warnings import stage_warnings
    monkeypatch.setattr(logging.getLogger("eddies"), "propagate", True)
    monkeypatch.setattr(dns, "run", lambda *given: None)
    scene = load_scene("tiny", ["flow.sound_speed=4", "model.preset=paper"])
    with caplog.at_level(logging.WARNING, logger="eddies"):
        run_stages(["dns"], scene, comm, tmp_path, StopRequest(comm))
    shown = [record.getMessage() for record in caplog.records]
    assert shown == list(stage_warnings(scene, ["dns"])) and len(shown) == 1


def test_frames_of_a_training_are_most_of_its_memory_and_steps_of_the_flow_most_of_its_time():
    few, many = (training_cost(load_scene("hit-small", [f"training.frames={frames}"]), 1, SPEEDS).memory
                 for frames in (16, 33))
    assert many / few == pytest.approx(2, rel=0.2)
    flow = flow_cost(load_scene("hit"), 2, SPEEDS)
    assert flow.parts["steps"] > 0.5 * flow.seconds
    one, two = (kernel_cost(load_scene("hit-small"), ranks, SPEEDS).memory for ranks in (1, 2))
    assert two < one
