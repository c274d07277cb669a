"""Memory that stages are said to take, against what is allocated; disk is held against products in test_pipeline.py."""

import tracemalloc

import numpy as np
import pytest
import torch

from eddies.clock import Clock
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.particle_field import ParticleField
from eddies.particles.smoothing_kernels import KernelNetwork
from eddies.scene.scene import BOX_LENGTH, load_scene
from eddies.time_stepping import ETDRK4
from eddies.workflows.foreseen.storage import (FLOW_PROCESS, TABLE_BYTES, TORCH_PROCESS, flow_memory, memory, most_disk,
                                               scratch)


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("fluid", ["compressible", "incompressible"])
def test_memory_of_a_step_is_as_expected(comm, fluid):
    # Arrays that a state, its operators and buffers hold, counted by the allocator, at a size where they are most.
    from eddies.workflows.ground_truth.scene_flow import build_fluid, build_step_limit, initial_state
    changes = ["flow.cells=48", f"flow.fluid={fluid}", "initial.kind=taylor-green"]
    scene = load_scene("taylor-green", changes + (["flow.sound_speed=10"] if fluid == "compressible" else []))
    tracemalloc.start()
    equation = build_fluid(scene, comm)
    stepper, state = ETDRK4(equation), initial_state(scene, equation)
    stepper(state, build_step_limit(scene, equation.grid)(state, Clock()))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    expected = flow_memory(scene, comm.size) - FLOW_PROCESS
    assert 0.4 * expected < peak < 1.1 * expected


@pytest.mark.mpi(1, 2)
def test_tables_of_the_kernel_take_the_bytes_that_are_expected(comm):
    """The largest part of the memory of the training of the kernel: entries of the table for each particle."""
    slab = SlabDecomposition(comm, BOX_LENGTH, 18)
    position = np.random.default_rng(3).uniform(0, BOX_LENGTH, (1000, 3))
    own = torch.from_numpy(position[slab.owner_of(position[:, 2]) == comm.rank])
    field = ParticleField(slab, 1.0, own, own)
    with torch.no_grad():
        field.volumes_by_table(KernelNetwork(1.0, [4]).to(torch.float32).table())
    assert 0.9 * TABLE_BYTES * len(own) < field._entries.nbytes <= TABLE_BYTES * len(own)


def test_memory_falls_with_the_ranks_and_grows_with_the_frames():
    scene = load_scene("hit-small")
    for stage in ("dns", "train-kernel", "train", "simulate"):
        sizes = [memory(scene, stage, ranks) for ranks in (1, 2, 4, 12)]
        assert sizes == sorted(sizes, reverse=True) and sizes[-1] > FLOW_PROCESS
    few, many = (memory(load_scene("hit-small", [f"training.frames={frames}"]), "train", 1) - TORCH_PROCESS
                 for frames in (16, 34))
    assert many == pytest.approx(2 * few)


def test_the_worst_moment_of_the_disk_is_the_end_of_all_or_of_the_flow():
    assert most_disk(load_scene("hit-small")) > scratch(load_scene("hit-small"))
    scene = load_scene("taylor-green", ["flow.cells=256"])
    assert most_disk(scene) > scratch(scene) > 256**3
