"""Tracers in frozen turbulence keep the energy of the filtered field; pairs of them separate ballistically."""

import numpy as np
import pytest
from flows import make_grid

from eddies.analysis.tracer_statistics import tracer_statistics
from eddies.flow import initial_fields
from eddies.flow.statistics import energy_spectrum
from eddies.flow.tracers import FilteredField, TracerParticles, release

LENGTH, PER_SIDE, STEP, FRAMES = 2 * np.pi, 14, 0.02, 17


class FrozenTurbulence:
    """Frames of tracers in a steady, random, solenoidal, filtered velocity of rms 1; one rank."""

    length, total = LENGTH, PER_SIDE**3

    def __init__(self, comm):
        grid = make_grid(comm, 24)
        state = initial_fields.random_velocity(grid, 5, 1.0, 2.5)
        field = FilteredField(grid, 2 * LENGTH / PER_SIDE, "cubic")
        self.filtered = energy_spectrum(grid, field.transfer * state)[1]
        self.times = STEP * np.arange(FRAMES)
        tracers = TracerParticles(field, release(grid.decomposition, 3, PER_SIDE**3, "random"), state)
        self.frames = []
        for _ in self.times:
            order = np.argsort(tracers.columns["id"])
            self.frames.append({name: values[order] for name, values in tracers.columns.items()})
            tracers.advance(state, STEP)

    def read(self, frame, column, start=0, stop=None):
        return self.frames[frame][column][start:stop]


@pytest.mark.mpi(1)
def test_statistics_of_tracers_in_a_frozen_flow(comm):
    flow = FrozenTurbulence(comm)
    spectra = {"time": flow.times[::4], "filtered": np.tile(flow.filtered, (len(flow.times[::4]), 1))}
    found = tracer_statistics(flow, spectra, LENGTH / PER_SIDE)
    # Tracers of a solenoidal flow stay uniformly random, so they sample its energy at all times: to three deviations.
    assert np.all(np.abs(found.energy_ratio - 1) < 3 * found.energy_error)
    assert 0.005 < found.energy_error[0] < 0.025
    # Their velocity changes along the path alone; over a step it is smooth.
    assert found.structure_exponent == pytest.approx(2, abs=0.01)
    # The deviation from 2 and 1 is of the order of the step over the time in which relative velocities change.
    assert found.ballistic_exponent == pytest.approx(2, abs=0.01)
    assert found.ballistic_prefactor == pytest.approx(1, abs=0.01)
    assert len(found.dispersion) == 4
