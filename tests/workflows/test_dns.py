"""Direct simulations: what they store, starts from stored flows, fluids and starts of the user."""

from types import SimpleNamespace

import numpy as np
import pytest

from eddies.io.fields import FieldSeries
from eddies.io.hdf5 import open_product, read_attributes, read_table
from eddies.io.provenance import read_provenance
from eddies.io.trajectories import Trajectory
from eddies.scene.scene import SceneError, load_scene
from eddies.scene.sections import SpinUp
from eddies.workflows import dns
from eddies.workflows.ground_truth.scene_flow import build_fluid, initial_state
from eddies.workflows.ground_truth.truth import GroundTruth
from tests.small_scene import TINY

SMALL = ["flow.cells=16", "tracers.particles_per_side=6", "tracers.field_cells=8"]
SMALL_TINY = [*SMALL, "kernel.neighbors=20", "training.batch=9"]


@pytest.fixture
def followed(comm, tmp_path):
    """A function that runs a scene in a new directory; returns the path of its product, the same on all ranks."""
    def run(name, scene, ranks=comm):
        (tmp_path / name).mkdir(exist_ok=True)
        ranks.Barrier()
        dns.run(scene, ranks, tmp_path / name)
        return tmp_path / name / "ground_truth.h5"

    return run


def table_of(comm, path, name="statistics"):
    with open_product(comm, path, "ground_truth") as file:
        return read_table(file, name)


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("interval", [1e-9, 1e-3])
def test_short_intervals_after_a_long_spin_up_are_stored_at_their_times(comm, followed, interval):
    scene = load_scene("tracers-only", [*SMALL, "spin_up.turnovers=0.02", f"tracers.turnovers={interval}",
                                        f"tracers.frame_interval={interval}"])
    with open_product(comm, followed("run", scene), "ground_truth") as file:
        times = Trajectory(file, "tracers").times
        assert len(times) > 1 and np.diff(times) == pytest.approx(interval, rel=1e-12)
        assert read_table(file, "statistics")["time_step"][-1] == pytest.approx(interval, rel=1e-3)


@pytest.mark.mpi(1)
def test_an_interval_that_the_rounding_of_the_time_hides_is_refused(comm, followed):
    scene = load_scene("tracers-only", [*SMALL, "spin_up.turnovers=0.02", "tracers.turnovers=1e-14",
                                        "tracers.frame_interval=1e-14"])
    with pytest.raises(SceneError, match="frame_interval = 1e-14: is lost in the rounding of the time"):
        followed("run", scene)


@pytest.mark.mpi(3)
def test_tracers_are_stored_by_id_and_do_not_depend_on_ranks(comm, followed):
    scene, alone = load_scene("tracers-only", [*SMALL, "tracers.turnovers=0.05"]), comm.Split(comm.rank)
    paths = [followed("together", scene)]
    if comm.rank == 0:
        paths.append(followed("alone", scene, alone))
        positions = []
        for path in paths:
            with open_product(alone, path, "ground_truth") as file:
                trajectory = Trajectory(file, "tracers")
                assert trajectory.total == 216 and len(trajectory.times) == 2
                positions.append(trajectory.read(-1, "position"))
                # An incompressible fluid has no density to store.
                assert set(trajectory.columns) == {"position", "image", "velocity"}
                assert FieldSeries(file, "filtered").variables == ("velocity",)
                assert "density_rms" not in read_attributes(file, "reference")
        assert np.abs(positions[0] - positions[1]).max() < 1e-12
    comm.Barrier()


@pytest.mark.mpi(2)
def test_a_start_with_another_speed_of_sound_makes_no_sound(comm, followed):
    """The final state of a run is the start of the next. The compressible part of the energy stays that of the pressure
    that follows the flow, of order M_t^4."""
    scene, tables = ["flow.cells=16", "flow.fluid=compressible", "time.step=0.01", "time.duration=0.3"], []
    for name, speed in (("first", 20.0), ("second", 10.0)):
        path = followed(name, load_scene("taylor-green", [*scene, f"flow.sound_speed={speed}"]))
        tables.append(table_of(comm, path))
        scene += ["initial.kind=file", f"initial.path={path}"]
    # Fields are stored in single precision.
    assert tables[1]["energy"][0] == pytest.approx(tables[0]["energy"][-1], rel=1e-6)
    # At twice the Mach number the share is 16 times larger. Sound of a pressure that is wrong by a factor of 4 would
    # have hundreds of times that.
    first, second = (table["compressible_fraction"].max() for table in tables)
    assert 0 < second < 40 * first


@pytest.mark.mpi(3)
def test_a_flow_with_tracers_is_a_start_on_any_grid(comm, followed):
    flow = ["time.step=0.01", "flow.fluid=compressible", "flow.sound_speed=22.5", "flow.viscosity=0.06"]
    path = followed("first", load_scene(TINY, [*SMALL_TINY, *flow, "spin_up.turnovers=0.1", "tracers.turnovers=0.3"]))
    with open_product(comm, path, "ground_truth") as file:
        # Times of fields count from the release.
        began = read_attributes(file, "reference")["released_at"] + FieldSeries(file, "unfiltered").times[0]
    tables = [table_of(comm, path)]
    for cells in (16, 24):
        tables.append(table_of(comm, followed(f"on-{cells}", load_scene("taylor-green", [
            *flow, f"flow.cells={cells}", f"time.duration={tables[0]['time'][-1] - began}", "initial.kind=file",
            f"initial.path={path}"]))))
    whole, same, finer = (table["energy"] for table in tables)
    # Fields are stored in single precision.
    assert same[-1] == pytest.approx(whole[-1], rel=1e-6)
    assert finer[0] == pytest.approx(same[0], rel=1e-6)
    # Modes that the first grid does not hold take energy on the finer one.
    assert 1e-6 < abs(finer[-1] / same[-1] - 1) < 0.05


@pytest.mark.mpi(2)
def test_statistics_are_sampled_every_few_steps_at_the_release_and_at_the_end(comm, followed):
    path = followed("run", load_scene(TINY, [*SMALL_TINY, "spin_up.turnovers=0.1", "spin_up.stationary=0.04",
                                             "tracers.turnovers=0.3", "time.step=0.01"]))
    with open_product(comm, path, "ground_truth") as file:
        statistics, reference = read_table(file, "statistics"), read_attributes(file, "reference")
        spectra, stationary = read_table(file, "spectra_of_statistics"), read_attributes(file, "stationary")
        end, last_frame = statistics["time"][-1], Trajectory(file, "tracers").times[-1]
    assert np.all(np.diff(statistics["time"]) > 0) and "density_rate_rms" in reference
    row = int(np.argmin(np.abs(statistics["time"] - reference["released_at"])))
    assert statistics["time"][row] == reference["released_at"]
    # Each sample has a spectrum, and the stationary state is the end of the spin-up.
    assert spectra["energy"].sum(axis=1) == pytest.approx(statistics["energy"], rel=1e-12)
    assert spectra["wavenumber"].tolist() == list(range(spectra["energy"].shape[1]))
    assert sum(statistics[f"energy_{axis}"] for axis in "xyz") == pytest.approx(statistics["energy"], rel=1e-12)
    turned = np.interp([stationary["start"], stationary["end"]], statistics["time"], statistics["turnovers"])
    assert stationary["end"] == reference["released_at"]
    assert turned[1] - turned[0] == pytest.approx(0.04, abs=np.diff(statistics["turnovers"]).max())
    assert reference["dissipation_rate"] == statistics["dissipation_rate"][row]
    assert end == pytest.approx(reference["released_at"] + last_frame)
    assert len(statistics["time"]) <= round(end / 0.01) // 4 + 3


def test_the_stationary_span_is_the_last_turnovers_of_the_spin_up():
    """A turnover takes a time of 2 and has four samples. The turnovers from 4 to 9 are averaged."""
    rows = [{"turnovers": sample / 4, "time": sample / 2} for sample in range(50)]
    span = dns.stationary_span(SpinUp(turnovers=9, stationary=5), SimpleNamespace(rows=rows))
    assert span == {"start": 8.0, "end": 18.0}


@pytest.mark.mpi(2)
@pytest.mark.parametrize("name", [TINY, "tracers-only"], ids=["compressible", "incompressible"])
def test_scales_are_those_of_the_release_however_long_the_flow_is_followed(comm, followed, name):
    overrides, scales = SMALL if name != TINY else [*SMALL_TINY, "spin_up.turnovers=0.05"], []
    for turnovers in (0.02, 0.2):
        path = followed(str(turnovers), load_scene(name, [*overrides, f"tracers.turnovers={turnovers}"]))
        with open_product(comm, path, "ground_truth") as file:
            scales.append(read_attributes(file, "reference"))
            scales[-1].pop("energy_budget_error")  # of the whole run
            trajectory = Trajectory(file, "tracers")
            columns = {column: np.stack([trajectory.read(frame, column) for frame in (0, 1)])
                       for column in trajectory.columns if column not in ("position", "image")}
            interval = trajectory.times[1] - trajectory.times[0]
            truth = GroundTruth(file, comm)
            release = truth.scales
    assert truth.has_density == (name == TINY) == (release.sound_speed is not None)
    assert len(trajectory.times) > 2 and scales[0] == scales[1]
    rates = {"velocity": ("acceleration", columns["velocity"][0].mean(axis=0)), "density": ("density_rate", 1.0)}
    for column, values in columns.items():
        rate, mean = rates[column]
        expected = [np.sqrt(np.mean(part**2)) for part in (values[0] - mean, (values[1] - values[0]) / interval)]
        assert [scales[0][f"{key}_rms"] for key in (column, rate)] == pytest.approx(expected, rel=1e-13)


OWN_FLOW = """
import numpy as np
from eddies.flow.navier_stokes import IncompressibleFluid


class Sticky(IncompressibleFluid):
    def nonlinear(self, state):
        return super().nonlinear(state) - 0.5 * state


def jet(grid, initial, seed):
    x, y, z = grid.coordinates()
    u = initial.amplitude * np.sin(initial.wavenumber * y) + 0 * x + 0 * z
    return grid.forward(np.stack([u, 0 * u, 0 * u]).astype(grid.real))


def flat(grid, initial, seed):
    return np.zeros((3, 4, 4, 3))
"""
OWN = ["flow.cells=16", "time.duration=0.5", "time.step=0.05", "flow.fluid=own_flow:Sticky",
       "initial.kind=own_flow:jet", "initial.wavenumber=2"]


@pytest.mark.mpi(1, 2)
def test_a_fluid_and_a_start_of_the_users(comm, followed, own):
    own("own_flow", OWN_FLOW)
    scene = load_scene("taylor-green", OWN)
    path = followed("run", scene)
    with open_product(comm, path, "ground_truth") as file:
        energy, provenance = read_table(file, "statistics")["energy"], read_provenance(file)
    assert provenance["foreign"].keys() == {"own_flow:Sticky", "own_flow:jet"}
    assert energy[0] == pytest.approx(0.25)
    decay = 2 * (0.5 + scene.flow.viscosity * scene.initial.wavenumber**2) * 0.5
    assert energy[-1] == pytest.approx(0.25 * np.exp(-decay), rel=1e-6)


@pytest.mark.mpi(1)
def test_a_start_of_the_users_that_is_no_velocity_and_one_that_makes_no_sound(comm, own):
    own("own_flow", OWN_FLOW)

    def started(*overrides):
        scene = load_scene("taylor-green", overrides)
        fluid = build_fluid(scene.flow, scene.forcing, comm)
        return fluid.grid, initial_state(scene.initial, scene.seed, fluid)

    with pytest.raises(SceneError, match=r"returned an array \(3, 4, 4, 3\)"):
        started(*OWN, "initial.kind=own_flow:flat")
    sound = ["flow.fluid=compressible", "flow.sound_speed=10"]
    grid, state = started("flow.cells=16", *sound, "initial.kind=own_flow:jet")
    assert state.shape == (4, *grid.spectral_shape) and np.abs(state[3]).max() < 1e-16  # a jet has no pressure


class SilentComm:
    """One rank that cannot send."""

    rank, size = 0, 1

    def Barrier(self):
        """There is no other rank."""


def test_one_rank_sends_nothing(tmp_path):
    scene = load_scene(TINY, [*SMALL_TINY, "spin_up.turnovers=0.05", "tracers.turnovers=0.05"])
    # A reduction, exchange or transpose would raise AttributeError.
    dns.run(scene, SilentComm(), tmp_path)
    assert (tmp_path / "ground_truth.h5").exists()
