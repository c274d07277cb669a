"""Direct simulations: what they store, starts from stored flows, fluids and starts of the user; stopped, or on a full
disk, and continued as if never stopped."""

import shutil
from types import SimpleNamespace

import numpy as np
import pytest

from eddies.io import new_files
from eddies.io.checkpoint import Checkpoint
from eddies.io.errors import WriteError
from eddies.io.fields import FieldSeries
from eddies.io.hdf5 import open_product, read_attributes, read_table
from eddies.io.provenance import product_provenance, read_provenance
from eddies.io.trajectories import Trajectory
from eddies.parallel.stop import StopRequest, Stopped
from eddies.scene.scene import SceneError, load_scene
from eddies.scene.sections import SpinUp
from eddies.workflows import dns
from eddies.workflows.ground_truth.scene_flow import build_fluid, initial_state
from eddies.workflows.ground_truth.truth import GroundTruth
from tests.commands import first_rank
from tests.full_disk import largest_file
from tests.small_scene import TINY
from tests.workflows.contents import assert_same, numbers_in
from tests.workflows.stopping import StopAtStep

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


@pytest.mark.mpi(1)
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


@pytest.mark.mpi(1)
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


@pytest.mark.mpi(1)
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


@pytest.mark.mpi(1)
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
    assert scales[0].keys().isdisjoint({"time", "seconds_per_step", "surplus_load"})
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


@pytest.mark.mpi(2)
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


# Eight steps of spin-up, twelve with tracers in four frame intervals.
SPLIT = ["flow.cells=12", "tracers.particles_per_side=5", "tracers.field_cells=8", "spin_up.turnovers=0.08",
         "spin_up.stationary=0.04", "tracers.turnovers=0.15", "tracers.frame_interval=0.06",
         "simulation.frame_interval=0.06", "tracers.field_every=2", "time.max_step=0.025", "kernel.neighbors=20",
         "training.batch=9"]
STEPS = 20
# The first step, the first with tracers, one between two frames, and the last.
SPLITS = (0, 8, 10, 19)
FRAMES = "particles/tracers/position/time"


def product(comm, directory):
    return numbers_in(comm, directory / "ground_truth.h5")


@pytest.fixture(scope="module")
def whole(comm, shared_folder):
    """A folder with a run that was never stopped, and with the checkpoints of all its steps."""
    folder = shared_folder()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("eddies.io.checkpoint.KEPT", 100)
        # Keep the checkpoints that a finished run removes.
        patch.setattr("eddies.io.checkpoint.CheckpointDirectory.remove", lambda self: None)
        dns.run(load_scene(TINY, SPLIT), comm, folder, StopAtStep(comm, every_step=True))
    comm.Barrier()
    return folder


@pytest.fixture
def last(monkeypatch):
    """A list with the last run and its guard."""
    seen = [None, None]

    class SeeingGuard(dns.Guard):
        def __call__(self, run, segments=None):
            seen[:] = run, self
            super().__call__(run, segments)

    monkeypatch.setattr(dns, "Guard", SeeingGuard)
    return seen


@pytest.mark.mpi(2)
def test_a_split_of_a_run_is_the_whole_run(comm, tmp_path, whole):
    truth = product(comm, whole)
    assert len(truth[FRAMES]) == 5 and len(list((whole / "checkpoints").glob("step-*"))) == STEPS + 1
    for split in SPLITS:
        directory = tmp_path / f"split-{split}"
        if comm.rank == 0:
            (directory / "checkpoints").mkdir(parents=True)
            for path in (whole / "checkpoints" / f"step-{split:08d}.h5", *(whole / "checkpoints").glob("frames-*")):
                shutil.copy(path, directory / "checkpoints")
        comm.Barrier()
        dns.run(load_scene(TINY, SPLIT), comm, directory)
        assert_same(product(comm, directory), truth, split)


@pytest.mark.mpi(2)
def test_a_stopped_run_continues_with_its_forcing_and_leaves_nothing_else(comm, tmp_path, caplog):
    scene, (whole, run) = load_scene(TINY, [*SPLIT, "tracers.forced=true"]), (tmp_path / "whole", tmp_path / "run")
    for path in (whole, run):
        path.mkdir(exist_ok=True)
    dns.run(scene, comm, whole)
    with pytest.raises(Stopped):
        dns.run(load_scene(TINY, [*SPLIT, "seed=5"]), comm, run, StopAtStep(comm, 5))
    for _ in range(2):  # in spin-up, then with tracers: the second stop is the resumed run's
        with pytest.raises(Stopped, match="from step"):
            dns.run(scene, comm, run, StopAtStep(comm, 7))
    assert comm.rank > 0 or "step-00000005" in caplog.text and "other settings" in caplog.text
    comm.Barrier()
    assert not list(run.glob("ground_truth.h5*"))
    comm.Barrier()
    dns.run(scene, comm, run)
    assert_same(product(comm, run), product(comm, whole))
    assert sorted(path.name for path in run.iterdir()) == ["checkpoints", "ground_truth.h5"]
    assert [path.name for path in (run / "checkpoints").iterdir()] == ["step-00000020.h5"]


@pytest.mark.mpi(1)
def test_a_run_without_tracers_continues(comm, tmp_path, last):
    """After two stops, and after its end for longer, but not for less."""
    keys = ["flow.cells=12", "time.step=0.02"]  # ten steps of 0.02 are not exactly 0.2
    scene = load_scene("taylor-green", [*keys, "time.duration=0.2"])
    for split in (0, 4):
        with pytest.raises(Stopped):
            dns.run(scene, comm, tmp_path, StopAtStep(comm, split))
    dns.run(scene, comm, tmp_path)
    assert last[0].clock.steps == 10 and last[0].clock.time == pytest.approx(0.2)
    dns.run(load_scene("taylor-green", [*keys, "time.duration=0.3"]), comm, tmp_path)
    assert last[0].clock.steps == 15 and last[0].clock.time == pytest.approx(0.3)
    with pytest.raises(SceneError, match="duration = 0.2: the checkpoint in .* is later than .*; raise the key, or"):
        dns.run(scene, comm, tmp_path)


@pytest.mark.mpi(2)
def test_a_finished_run_goes_on_for_longer(comm, tmp_path, whole, caplog):
    run, expected = tmp_path, product(comm, whole)
    scene, short = (load_scene(TINY, [*SPLIT, *changes]) for changes in ([], ["tracers.turnovers=0.09"]))
    dns.run(short, comm, run)
    found, made = product(comm, run), product_provenance(run / "ground_truth.h5")
    assert len(found[FRAMES]) < len(expected[FRAMES])
    caplog.set_level("INFO", "eddies")
    caplog.clear()
    with pytest.raises(Stopped):
        dns.run(scene, comm, run, StopAtStep(comm, 2))
    dns.run(scene, comm, run)
    assert caplog.text.count("continues from step") == 2
    assert product_provenance(run / "ground_truth.h5")["id"] == made["id"]
    found = product(comm, run)
    # A state of the whole flow, from which coarse grids start, is stored where either length asks for it, if it is not
    # too late: the first of both is the same.
    for numbers in (found, expected):
        numbers |= {name: values[:1] for name, values in numbers.items()
                    if name.startswith("fields/unfiltered/") and np.ndim(values)}
    assert_same(found, expected)
    with pytest.raises(SceneError, match="turnovers = 0.09: the checkpoint in"):
        dns.run(short, comm, run)
    first_rank(comm, (run / "ground_truth.h5").unlink)
    dns.run(short, comm, run)  # without its frames the checkpoint is worth nothing
    assert comm.rank > 0 or "lacks the frames before the checkpoint" in caplog.text
    assert len(product(comm, run)[FRAMES]) < len(expected[FRAMES])


@pytest.mark.mpi(3)
@pytest.mark.parametrize("before, after", [(2, 3), (3, 1)])
def test_another_number_of_ranks(comm, tmp_path, last, before, after):
    """Stopped at step 10, within a frame interval. The checkpoint that the other ranks write at once is the same."""
    scene, run, same = load_scene(TINY, SPLIT), tmp_path / "run", tmp_path / "same"
    groups = {size: comm.Split(int(comm.rank < size)) for size in (before, after)}
    run.mkdir(exist_ok=True)
    if comm.rank < before:
        with pytest.raises(Stopped):
            dns.run(scene, groups[before], run, StopAtStep(groups[before], 10))
        groups[before].Barrier()
        if comm.rank == 0:
            shutil.copytree(run, same)
        groups[before].Barrier()
        dns.run(scene, groups[before], same)
    comm.Barrier()
    if comm.rank < after:
        with pytest.raises(Stopped):
            dns.run(scene, groups[after], run, StopAtStep(groups[after], 0))
        name, (flow, guard) = "step-00000010.h5", last
        if comm.rank == 0:
            (run / "checkpoints" / name).rename(tmp_path / name)
        groups[after].Barrier()
        guard.save(flow, flow.tracers.segments)
        saved = [Checkpoint(path / name) for path in (run / "checkpoints", tmp_path)]
        for name in ("modes", "position", "velocity", "history_time", "spectra_of_history"):
            assert np.array_equal(*(checkpoint.read(name) for checkpoint in saved)), name
        dns.run(scene, groups[after], run)
        expected, found = (product(groups[after], path) for path in (same, run))
        for name, values in expected.items():
            # Fields are in single precision.
            tolerance = 1e-6 if name.startswith("fields/") else 1e-12
            if np.asarray(values).dtype.kind in "fi":
                assert np.abs(found[name] - values).max() <= tolerance * max(np.abs(values).max(), 1), name
    comm.Barrier()


@pytest.mark.mpi(2, timeout=60)
def test_a_simulation_without_room_keeps_its_checkpoint_and_goes_on(comm, tmp_path, whole, monkeypatch):
    """In place of a full disk the last rank may write so many bytes to a file."""
    monkeypatch.setattr(new_files, "MARGIN_BYTES", 2**12)
    scene, run, files = load_scene(TINY, SPLIT), tmp_path, []
    with pytest.raises(Stopped):
        dns.run(scene, comm, run, StopAtStep(comm, 11))
    comm.Barrier()
    before = {path: path.read_bytes() for path in run.rglob("step-*")}
    assert before
    comm.Barrier()
    for kilobytes in (1, 100, 400):
        with largest_file(comm, kilobytes * 1024, comm.size - 1), pytest.raises(WriteError, match="make room") as error:
            dns.run(scene, comm, run, StopRequest(comm))
        files.append(str(error.value).split(":")[0].split("/")[-1])
        comm.Barrier()
        assert all(path.read_bytes() == content for path, content in before.items())
        assert not list(run.rglob("*.partial")) and not (run / "ground_truth.h5").exists()
        comm.Barrier()
    assert files == ["ground_truth.h5.partial", "frames-00000014.h5.partial", "ground_truth.h5.partial"]
    dns.run(scene, comm, run)
    assert_same(product(comm, run), product(comm, whole))
