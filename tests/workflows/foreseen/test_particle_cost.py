"""Cost of the particle step on any number of ranks and threads: what must hold whatever the machine."""

from dataclasses import replace

import pytest

from eddies.scene.scene import load_scene
from eddies.workflows.foreseen.network import NODE_CORES
from eddies.workflows.foreseen.particle_cost import (MOST_CORES, TRANSFORM_GROWTH, growth, particle_bytes,
                                                     particle_cost, particle_costs)
from eddies.workflows.foreseen.particle_probe import PARTS, THREADED, ParticleSpeed, Rate
from eddies.workflows.foreseen.particle_work import particle_work

SPEED = ParticleSpeed(dict.fromkeys(PARTS, Rate(1e-4, 1e-8)), {"splines": 4, "transforms": 8},
                      {"splines": 13, "transforms": 31}, (24, 24, 8, 24))


def work_of(side, preset="resolved + pairs"):
    return particle_work(load_scene("hit-small", [f"tracers.particles_per_side={side}", f"model.preset={preset}"]))


def cost_of(work, ranks, threads=1, speed=SPEED):
    return particle_cost(work, speed, ranks, threads, 2e9)


@pytest.mark.parametrize("preset", ["resolved", "resolved + pairs", "paper"])
def test_one_rank_sends_nothing_and_more_do(preset):
    work = work_of(64, preset)
    assert cost_of(work, 1).parts["messages"] == 0 < cost_of(work, 2).parts["messages"]


@pytest.mark.parametrize("preset", ["resolved", "resolved + pairs", "paper"])
def test_more_ranks_never_need_more_memory_nor_work(preset):
    work = work_of(64, preset)
    rows = [cost_of(work, ranks) for ranks in range(1, 25)]
    for few, many in zip(rows, rows[1:]):
        assert many.memory <= few.memory
        assert all(many.parts[part] <= few.parts[part] for part in PARTS if part != "settling")


def test_threads_are_never_slower_and_share_the_loops_alone():
    work = work_of(64)
    for ranks in (1, 2, 16):
        rows = [cost_of(work, ranks, threads) for threads in (1, 2, 4, 64)]
        for few, many in zip(rows, rows[1:]):
            assert all(many.parts[part] <= few.parts[part] for part in THREADED)
            assert all(many.parts[part] == few.parts[part] for part in PARTS if part not in THREADED)
            assert many.memory == few.memory
    assert cost_of(work, 1, 64).seconds < cost_of(work, 1, 1).seconds


@pytest.mark.parametrize("side, most", [(16, 5), (64, 22), (512, 179)])
def test_rows_are_the_fastest_splits_into_ranks_and_threads(side, most):
    work, cores = work_of(side), []
    rows = particle_costs(work, SPEED, most, 2e9)
    for row in rows:
        cores.append(row.cores)
        assert row.ranks <= most and row.threads <= NODE_CORES
        for ranks in (2**m for m in range(13)):
            if ranks <= min(most, row.cores) and row.cores // ranks <= NODE_CORES:
                assert row.seconds <= cost_of(work, ranks, row.cores // ranks).seconds
    assert cores == [2**m for m in range(len(cores))] and len(rows) <= 14 and cores[-1] <= MOST_CORES
    assert min(row.seconds for row in rows) == rows[-1].seconds


def test_a_part_that_a_model_does_not_have_takes_nothing():
    nothing = replace(SPEED, calls={"splines": 0, "transforms": 0}, components={"splines": 0, "transforms": 0})
    pairs = cost_of(work_of(32, "paper"), 2, speed=nothing).parts
    assert pairs["transforms"] == pairs["splines"] == pairs["modes"] == 0 < pairs["pairs"]
    alone = replace(SPEED, ghost_columns=(), rates={**SPEED.rates, "pairs": Rate(0.0, 1e-8)})
    resolved = cost_of(work_of(32, "resolved"), 1, speed=alone).parts
    assert resolved["pairs"] == 0 < resolved["transforms"]


def test_only_listed_pairs_are_kept():
    work = work_of(64)
    listed = replace(SPEED, listed=True, block_bytes=1e6)
    apart = particle_bytes(work, listed, 1) - particle_bytes(work, SPEED, 1)
    assert apart >= 1e6 + 8 * work.particles * work.neighbors
    wider = replace(work, skin=work.radius)
    assert particle_bytes(wider, listed, 1) - particle_bytes(wider, SPEED, 1) > 4 * apart
    assert particle_bytes(replace(work, neighbors=1e4), SPEED, 1) == particle_bytes(work, SPEED, 1)


def test_what_neighbours_tell_is_kept_with_their_list():
    """Of each neighbour ten weights, a distance and three components, and three indices, at the least."""
    work, listed = work_of(64, "local"), replace(SPEED, listed=True)
    told = replace(listed, kriging=True)
    apart = particle_bytes(work, told, 1) - particle_bytes(work, listed, 1)
    assert apart >= (4 * 14 + 8 * 3) * work.particles * work.neighbors


def test_growth_is_what_was_measured():
    assert [growth(TRANSFORM_GROWTH, cells) for cells in TRANSFORM_GROWTH] == list(TRANSFORM_GROWTH.values())
    assert growth(TRANSFORM_GROWTH, 20) == 1.0 < growth(TRANSFORM_GROWTH, 600) < growth(TRANSFORM_GROWTH, 2000)
