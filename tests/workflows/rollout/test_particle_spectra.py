"""Spectra that are found in the velocities of particles against those of the field that they sample."""

import logging
from types import SimpleNamespace

import numpy as np
import pytest

from eddies.io.hdf5 import create_product, open_product, read_table
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.flow_units import ReferenceScales
from eddies.particles.resolved_velocity import ResolvedVelocity
from eddies.spectral.spectral_grid import SpectralGrid
from eddies.workflows.rollout.particle_spectra import ParticleSpectra
from tests.particles.configurations import positions
from tests.validation import filtered_fields

SIDE, PLANES, LENGTH = 12, 22, 2 * np.pi
SPACING = LENGTH / SIDE
HIGHEST = 4


def known_field():
    """Modes of a random solenoidal velocity that was filtered as wide as two spacings, and its spectrum."""
    k = np.sqrt(np.maximum(filtered_fields.SQUARED, 1))
    modes = filtered_fields.Filtered(filtered_fields.random_velocity(7, HIGHEST) * k ** (-11 / 6), 2 * SPACING).velocity
    shell = np.rint(np.sqrt(filtered_fields.SQUARED)).astype(int)
    return modes, np.bincount(shell.ravel(), 0.5 * (np.abs(modes) ** 2).sum(0).ravel())


def spectra_on(slab):
    scales = ReferenceScales(filter_width=2 * SPACING, spacing=SPACING, velocity=1.0, density_mean=1.0,
                             acceleration=2.0, viscosity=0.02)
    return ParticleSpectra(SimpleNamespace(decomposition=slab, scales=scales))


def on_grid(comm, modes):
    """A velocity on a grid of its own, of 16 planes."""
    slab = SlabDecomposition(comm, LENGTH, 16)
    grid = SpectralGrid(slab, "float64", cutoff=5)
    points = np.stack(np.broadcast_arrays(*grid.coordinates()), axis=-1)
    values = filtered_fields.at(modes, points.reshape(-1, 3)).T.reshape(3, *grid.physical_shape)
    return grid, grid.forward(values)


def sampled(comm, modes, kind="even"):
    """Slabs, and the columns of particles in a field, dealt out to the ranks wherever they are."""
    own = np.arange(SIDE**3) % comm.size == comm.rank
    position = positions(kind, SIDE**3).numpy()[own]
    return SlabDecomposition(comm, LENGTH, PLANES), {
        "id": np.flatnonzero(own), "position": position, "velocity": filtered_fields.at(modes, position)}


@pytest.mark.mpi(1, 2, 3)
def test_the_spectrum_of_a_known_field_is_found_on_any_number_of_ranks(comm, tmp_path):
    """Each shell up to k_d = pi/d = 3 within half a per cent: 3 x 1728 numbers tell the 122 modes of these shells
    nearly without the prior. In the shell 4, the last with any energy, regularisation takes and its neighbours without
    energy give: 5 %. A uniform motion has no part in it."""
    modes, energy = known_field()
    slab, columns = sampled(comm, modes)
    spectra = spectra_on(slab)
    spectra.add("model", 0.5, columns)
    spectra.add("model", 0.75, {**columns, "velocity": columns["velocity"] + 3.0})
    spectra.add("truth", 0.5, {**columns, "velocity": 2 * columns["velocity"]})
    with create_product(comm, tmp_path / "rollout.h5", "rollout", {}) as file:
        spectra.write(file)
    with open_product(comm, tmp_path / "rollout.h5", "rollout") as file:
        model, truth = (read_table(file, f"spectra_of_{name}") for name in ("model", "truth"))
    assert model["time"].tolist() == [0.5, 0.75] and truth["time"].tolist() == [0.5]
    assert model["wavenumber"].tolist() == list(range(9))  # k_c is 9, whose shell is not complete
    found = model["energy"][0]
    assert found[1:4] == pytest.approx(energy[1:4], rel=0.005)
    assert found[4] == pytest.approx(energy[4], rel=0.05)
    assert found[0] == 0 and found[5:].sum() < 1e-3 * energy.sum()
    # To the tolerance of a solve, 2e-4 of the velocities, and in single precision.
    for other in (model["energy"][1], truth["energy"][0] / 4):
        assert other[:5] == pytest.approx(found[:5], rel=1e-3)


@pytest.mark.mpi(1, 2, 3)
def test_a_velocity_that_is_near_saves_iterations_and_changes_no_spectrum(comm, monkeypatch):
    """The solve ends where one from nothing does, also from half the velocity, to what the tolerance of both leaves in
    the weakest shell, an eightieth of the energy. The velocity is on a grid of its own and cut otherwise."""
    modes, _ = known_field()
    slab, columns = sampled(comm, modes)
    spectra, taken = spectra_on(slab), []
    solved = ResolvedVelocity.of
    monkeypatch.setattr(ResolvedVelocity, "of", lambda *given, **named: (
        found := solved(*given, **named), taken.append(found.iterations))[0])
    grid, near = on_grid(comm, modes)
    for start in (None, (grid, near), (grid, near / 2)):
        spectra.add("model", 0.0, columns, start)
    unknown, known, half = (np.array(energy[:5]) for energy in spectra.state_dict()["model"]["energy"])
    assert taken[1] < 0.5 * taken[0]
    for found in (known, half):
        assert found[1:] == pytest.approx(unknown[1:], rel=0.015)


@pytest.mark.mpi(1)
def test_particles_in_a_few_clusters_do_not_hold_a_rollout_up_and_are_told_once(comm, monkeypatch, caplog):
    monkeypatch.setattr(logging.getLogger("eddies"), "propagate", True)
    modes, energy = known_field()
    spectra = spectra_on(SlabDecomposition(comm, LENGTH, PLANES))
    with caplog.at_level(logging.INFO, logger="eddies"):
        spectra.add("truth", 0.0, sampled(comm, modes)[1])
        assert caplog.messages == []
        for time in (0.5, 0.75):
            spectra.add("model", time, sampled(comm, modes, "cluster across a corner")[1])
    (said,) = caplog.messages
    assert said.startswith("rollout: at time 0.5 particles of the model have gathered and left voids: the solve for "
                           "their spectrum did not converge in 100 iterations and left ")
    assert all(0 < sum(found) < 3 * energy.sum() for found in spectra.state_dict()["model"]["energy"])


@pytest.mark.mpi(1)
def test_a_rollout_goes_on_with_the_spectra_so_far(comm, tmp_path):
    slab, columns = sampled(comm, known_field()[0])
    first, later = spectra_on(slab), spectra_on(slab)
    first.add("model", 0.0, columns)
    later.load_state_dict(first.state_dict())
    later.add("model", 1.0, columns)
    rows = later.state_dict()["model"]
    assert rows["time"] == [0, 1] and rows["energy"][0] == rows["energy"][1]
    with create_product(comm, tmp_path / "rollout.h5", "rollout", {}) as file:
        later.write(file)
    with open_product(comm, tmp_path / "rollout.h5", "rollout") as file:
        assert read_table(file, "spectra_of_truth")["energy"].shape == (0, 9)
