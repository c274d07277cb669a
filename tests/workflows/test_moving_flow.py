"""Training, rollouts and their errors in a ground truth that moves: a mean velocity changes no number."""

import shutil

import numpy as np
import pytest

from eddies.flow.initial_fields import random_velocity
from eddies.io.hdf5 import open_product, read_attributes
from eddies.io.weights import load_weights
from eddies.scene.scene import load_scene
from eddies.workflows import measure, simulate, train
from tests.commands import first_rank
from tests.changed_product import changed
from tests.workflows.small_rollout import prepared

LENGTH, CELLS, INTERVAL = 2 * np.pi, 12, 0.02
# The wind crosses a cell of the stored fields between two frames: about 100 rms velocities.
CELLS_A_FRAME = np.array([1, -2, 1])
WIND = CELLS_A_FRAME * (LENGTH / 8 / INTERVAL)
OVERRIDES = ["training.precision=float64", "simulation.precision=float64", "simulation.turnovers=0.09"]
ERRORS = "velocity_error_end", "acceleration_error", "energy_ratio"


def boost(comm, path):
    """Let the ground truth of a file move with the wind."""
    if comm.rank == 0:
        with changed(path) as file:
            tracers, time = file["particles/tracers"], file["fields/filtered/time"][:]
            position = tracers["position/value"][:] + WIND * time[:, None, None]
            tracers["position/value"][:] = position % LENGTH
            tracers["image/value"][:] += np.floor(position / LENGTH).astype(np.int16)
            tracers["velocity/value"][:] += WIND
            for name in ("filtered", "unfiltered"):
                for frame, at in enumerate(file[f"fields/{name}/time"][:]):
                    cells = tuple((CELLS_A_FRAME * round(at / INTERVAL))[::-1])
                    for variable in ("velocity", "density"):
                        data = file[f"fields/{name}/{variable}"]
                        wind = WIND[:, None, None, None] if variable == "velocity" else 0
                        data[frame] = np.roll(data[frame], cells, axis=(1, 2, 3)) + wind
    comm.Barrier()


@pytest.fixture(scope="module")
def truths(comm, shared_folder):
    """Two directories with the same ground truth, at rest and moving. The first has the scene."""
    folder = shared_folder()
    prepared(comm, folder / "still", overrides=OVERRIDES, model='[model]\npreset = "resolved"')
    first_rank(comm, shutil.copytree, folder / "still", folder / "moving")
    boost(comm, folder / "moving/ground_truth.h5")
    return [folder / "still", folder / "moving"]


@pytest.mark.usefixtures("quick_spectra", "quick_solves", "no_figures")
@pytest.mark.mpi(1)
@pytest.mark.parametrize("preset, where", [("paper", "flow"), ("local", "flow"), ("resolved", "flow"),
                                           ("resolved", "particles")])
def test_a_mean_velocity_changes_neither_training_nor_errors(comm, truths, preset, where):
    """All losses, also through a frame of the simulation. Fields and rollouts are stored in single precision, which
    leaves 1e-5 of the fluctuation beside such a wind. A grid on which the flow crosses a cell in two steps is off by
    a hundredth."""
    grid = ["simulation.method=eulerian", "eulerian.cells=8", "eulerian.start=particles"] * (where == "particles")
    weights, errors = [], []
    for directory in truths:
        scene = load_scene(truths[0] / "own.toml", [*OVERRIDES, f"model.preset={preset}", *grid])
        if not grid:
            train.run(scene, comm, directory)
            weights.append(load_weights(comm, directory / "model.h5", "model").weights)
        simulate.run(scene, comm, directory)
        numbers, _ = measure.read(directory, comm)
        assert numbers["rollout"]["status"] == "complete"
        errors.append([numbers["accuracy"][name] for name in ERRORS])
    if not grid:
        still, moving = (np.concatenate([values.ravel() for values in each.values()]) for each in weights)
        # Adam moves also those few weights whose gradient is round-off.
        assert np.linalg.norm(moving - still) < 5e-3 * np.linalg.norm(still)
    np.testing.assert_allclose(errors[1], errors[0], rtol=0.02, atol=1e-4)


def random_and_wind(grid, initial, seed):
    """The random flow with a mean velocity of forty times its rms."""
    modes = random_velocity(grid, seed, initial.amplitude, initial.peak_wavenumber)
    wind = np.array([20.0, -30.0, 10.0])[:, None, None, None] * (grid.index_squared == 0)
    return modes + wind.astype(modes.dtype)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("fluid", ["compressible", "incompressible"])
def test_scales_of_a_flow_do_not_contain_its_mean_velocity(comm, tmp_path, fluid):
    """Particles in the flow that moves have other velocities by the error of the splines alone, which depends on their
    places in the cells: 12 cells for waves up to 3. Their rates differ more, because it changes as they move."""
    found = []
    for kind in ("random", f"{__name__}:random_and_wind"):
        directory = tmp_path / kind[:6]
        prepared(comm, directory, fluid, model='[model]\npreset = "resolved"',
                 overrides=[f"initial.kind={kind}", "initial.amplitude=0.7"])
        with open_product(comm, directory / "ground_truth.h5", "ground_truth") as file:
            found.append(read_attributes(file, "reference"))
    still, moving = found
    for name in ("reynolds_lambda", "eddy_turnover_time", "integral_scale", "kolmogorov_length", "energy", "energy_x",
                 "mach_turbulent", "skewness", "density_rms"):
        if name in still:
            assert moving[name] == pytest.approx(still[name], rel=1e-9), name
    assert moving["velocity_rms"] == pytest.approx(still["velocity_rms"], rel=1e-9)
    assert moving["acceleration_rms"] == pytest.approx(still["acceleration_rms"], rel=0.1)
