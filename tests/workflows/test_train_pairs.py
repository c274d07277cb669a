"""Training of the published system in the scene `hit-small` on several ranks: evaluated pairs, also those with ghosts,
and sums of network gradients over the ranks are counted."""

import numpy as np
import pytest

from eddies.kernels.pairs import CompiledPairs, Summand
from eddies.kernels.reconstruction import kernel_numbers
from eddies.learning import training
from eddies.particles import pairs
from eddies.scene.scene import load_scene
from eddies.workflows import dns, train

SMALL = ["flow.cells=16", "flow.viscosity=0.1", "spin_up.turnovers=0.05", "tracers.turnovers=0.9",
         "tracers.particles_per_side=10", "tracers.field_cells=16", "tracers.frame_interval=0.1",
         "tracers.field_every=1", "kernel.neighbors=20", "training.frames=2", "training.batch=64", "training.steps=3",
         "training.combined_steps=0", "training.field_weight=0", "training.velocity_kl_weight=0",
         "training.acceleration_kl_weight=0"]


def neighbours(space, receivers, particles):
    """How many pairs of receivers with other particles there are within the radius, in the periodic box."""
    away = np.abs(receivers[:, None] - particles[None]) % space.length
    square = (np.minimum(away, space.length - away) ** 2).sum(2)
    return int(np.count_nonzero(square < space.radius**2)) - len(receivers)  # without each with itself


@pytest.mark.mpi(1, 3)
def test_training_evaluates_pairs_with_ghosts_and_sums_gradients(comm, tmp_path, monkeypatch):
    assert load_scene("hit-small").variant["paper"].model == load_scene("hit-small").model  # what is trained here
    scene = load_scene("hit-small", SMALL, ["variant"])
    evaluated, summed = [], []

    class Counted(CompiledPairs):
        def __init__(self, space, position, velocity, scalars, wanted, kind):
            super().__init__(space, position, velocity, scalars, wanted, kind)
            self.given = space, position, wanted

        def gradients(self, summands, parameters, by_sums, columns):
            space, position, wanted = self.given
            # A kernel that is 1 within the radius counts them.
            one = Summand("kernel-sum", kernel_numbers(space.radius, np.ones((1, 1))), (1.0,))
            found = self.sums([one], [np.empty(0)])[0]
            evaluated.append(([each.kind for each in summands], space, position, wanted, float(found[0, wanted].sum())))
            return super().gradients(summands, parameters, by_sums, columns)

    def sum_flat(where, arrays):
        own = [array.copy() for array in arrays]
        added(where, arrays)
        summed.append((own, [array.copy() for array in arrays]))

    added = training.sum_flat
    monkeypatch.setattr(pairs, "CompiledPairs", Counted)
    monkeypatch.setattr(training, "sum_flat", sum_flat)
    dns.run(scene, comm, tmp_path)
    train.run(scene, comm, tmp_path)

    assert len(evaluated) == len(summed) == 3
    total, thickness = scene.tracers.particles, 2 * np.pi / comm.size
    for kinds, space, position, wanted, counted in evaluated:
        assert kinds.count("pair-network") == 2 and "eddy-viscosity" in kinds  # of force and density, and Pi
        ghosts = int(np.count_nonzero((position[:, 2] < comm.rank * thickness)
                                      | (position[:, 2] >= (comm.rank + 1) * thickness)))
        assert (ghosts > 0) == (comm.size > 1)
        own = comm.allgather(position[(position[:, 2] // thickness).astype(int) == comm.rank])
        particles = np.concatenate(own)
        assert len(particles) == total
        receivers = np.concatenate(comm.allgather(position[wanted]))
        assert len(receivers) == scene.training.batch
        assert comm.allreduce(counted) == neighbours(space, receivers, particles) > 0
        if comm.size > 1:  # without ghosts some pairs are missing
            assert comm.allreduce(neighbours(space, position[wanted], own[comm.rank])) < comm.allreduce(counted)
    for own, after in summed:
        assert sum(map(np.size, own)) > 2500  # the weights of both networks, and four coefficients
        everywhere = comm.allgather(own)
        for number, values in enumerate(after):
            np.testing.assert_allclose(values, sum(each[number] for each in everywhere), rtol=1e-5, atol=1e-7)
        assert all(np.abs(each[0]).max() > 0 for each in everywhere)  # every rank has a part in the first layer
