"""A flow in another unit of time has the same numbers without dimension, from the direct simulation to the report."""

import math

import pytest

from eddies import run
from eddies.particles.resolved_velocity import ResolvedVelocity
from eddies.scene.scene import load_scene
from eddies.workflows.diff import numbers_of
from tests.workflows.small_rollout import scene_text

# Powers of the unit of time in the numbers of a report. All others have no dimension.
POWERS = {**dict.fromkeys(("energy", "energy_x", "energy_y", "energy_z", "total_energy", "acceleration_rms"), -2),
          "dissipation_rate": -3, "injection_rate": -3,
          **dict.fromkeys(("eddy_turnover_time", "kolmogorov_time", "released_at", "delay", "time_step"), 1),
          **dict.fromkeys(("velocity_rms", "density_rate_rms", "sound_speed", "viscosity"), -1)}
# Warnings name the time of a product, and the summary that of a turnover.
OF_THE_COMPUTER = ("second", "storing", "busy", "surplus_load", "switches", "date", "warnings", "summary")


def numbers(values, place=()):
    """The entries of nested dicts, by their path."""
    for key, value in values.items():
        if isinstance(value, dict):
            yield from numbers(value, (*place, key))
        elif not any(word in " ".join((*place, key)) for word in OF_THE_COMPUTER):
            yield (*place, key), value


def metrics_of(comm, folder, unit):
    """The numbers of the report of a small scene whose times are multiplied by `unit`."""
    own = ["flow.viscosity=%r" % (0.1 / unit), "flow.sound_speed=%r" % (15 / unit), "initial.amplitude=%r" % (1 / unit),
           "time.max_step=%r" % (0.05 * unit), "tracers.frame_interval=%r" % (0.02 * unit),
           "simulation.step=%r" % (0.02 * unit), "simulation.frame_interval=%r" % (0.04 * unit)]
    folder.mkdir()
    (folder / "own.toml").write_text(scene_text())
    run(load_scene(folder / "own.toml", own), output=folder / "run", comm=comm)
    return dict(numbers(numbers_of(folder / "run", None)))


@pytest.mark.mpi(1)
def test_numbers_without_dimension_do_not_depend_on_the_unit_of_time(comm, tmp_path, monkeypatch, no_figures,
                                                                     quick_spectra):
    """Units that are powers of two change no digit, so that numbers are equal. Solves end early, by their tolerance."""
    for name in ("tolerance", "tolerance_predicted", "tolerance_adjoint"):
        monkeypatch.setattr(ResolvedVelocity, name, 0.1)
    short, long = (metrics_of(comm, tmp_path / str(power), 2.0**power) for power in (-20, 20))
    assert len(short) > 50
    for place, value in short.items():
        change = POWERS.get(place[-1], 0) if isinstance(value, (int, float)) else 0
        assert long[place] == (math.ldexp(value, 40 * change) if change else value), place
