"""What keeps a scene from its end is told before any work, by `check` and by `run` alike."""

import dataclasses

import numpy as np
import pytest

from eddies.scene.scene import SceneError, builtin_scenes, load_scene
from tests.bad_scenes import INFEASIBLE
from tests.changed_product import changed
from tests.small_scene import TINY
from tests.workflows.synthetic_run import write_ground_truth


def eddies(*arguments):
    """Exit code of a command."""
    from eddies.cli import main
    return main([str(argument) for argument in arguments])


@pytest.mark.mpi(1)
@pytest.mark.parametrize("command", ["check", "run"])
@pytest.mark.parametrize("override, message", INFEASIBLE, ids=[override for override, _ in INFEASIBLE])
def test_what_cannot_end_is_refused_before_it_begins(comm, tmp_path, monkeypatch, capfd, command, override, message):
    monkeypatch.chdir(tmp_path)
    assert eddies(command, TINY, "--set", override) == 2
    output, errors = capfd.readouterr()
    assert output == "" and errors.startswith("eddies: error: tiny: ") and errors.count("\n") == 1
    assert message in errors
    assert list(tmp_path.iterdir()) == []


@pytest.mark.mpi(2)
def test_it_is_said_once(comm, tmp_path, capfd):
    assert eddies("run", TINY, "--set", "time.step=1e-12", "--output", tmp_path / "run") == 2
    errors = capfd.readouterr().err
    assert errors.count("\n") == (comm.rank == 0) and not (tmp_path / "run").exists()


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("overrides, message", [
    (["initial.amplitude=1e-15"], "of 0.05, limited by [time] max_step, for a time of"),
    (["initial.kind=tests.workflows.test_feasibility:at_rest"],
     "at rest, so that it never turns over; start from another"),
    (["tracers.turnovers=1e13"], "limited by the flow, for a time of"),
    (["tracers.frame_interval=1e-11"], "[tracers] frame_interval = 1e-11: "),
    (["spin_up.turnovers=1e10"], "of 0.05, limited by [time] max_step"),
], ids=lambda value: value[0] if isinstance(value, list) else "")
def test_a_flow_that_is_not_known_before_is_refused_once_it_is_there(comm, tmp_path, capfd, overrides, message):
    """As one from a file; without viscosity nothing is foreseen of a random one either."""
    options = [word for each in ("flow.viscosity=0", "flow.cells=16", "tracers.particles_per_side=4", *overrides)
               for word in ("--set", each)]
    assert eddies("dns", "tracers-only", *options, "--output", tmp_path) == 2
    errors = capfd.readouterr().err
    assert comm.rank > 0 or errors.startswith("eddies: error: tracers-only: ") and errors.count("\n") == 1
    assert comm.rank > 0 or message in errors
    comm.Barrier()
    assert not (tmp_path / "ground_truth.h5").exists()


@pytest.mark.mpi(1)
def test_a_run_of_given_time_has_a_limit_of_steps(comm, tmp_path, capfd):
    fast = ["--set", "initial.kind=tests.workflows.test_feasibility:fast", "--set", "time.duration=1e9", "--unset",
            "time.step"]
    assert eddies("dns", "abc", *fast, "--output", tmp_path) == 2
    assert "limited by the flow, for a time of 1e+09, and 1e+09 are the most" in capfd.readouterr().err


def fast(grid, initial, seed):
    """A flow of the user's, of which no speed is known."""
    from eddies.flow.initial_fields import INITIAL_FLOWS
    return 1e4 * INITIAL_FLOWS["random"](grid, initial, seed)


def at_rest(grid, initial, seed):
    """A flow of the user's that does not move."""
    return 0 * fast(grid, initial, seed)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("name", [name for name, _ in builtin_scenes()])
def test_built_in_scenes_are_feasible(comm, name):
    from eddies.workflows.feasibility import check_feasible
    scene = load_scene(name)
    check_feasible(scene.stages, scene, comm)


@pytest.mark.mpi(1)
def test_only_the_stages_that_are_asked_for_count(comm):
    from eddies.workflows.feasibility import check_feasible
    scene = load_scene(TINY, ["simulation.step=1e-12"])
    check_feasible(["dns", "train-kernel", "train"], scene, comm)
    with pytest.raises(SceneError, match="simulation. step = 1e-12"):
        check_feasible(["simulate"], scene, comm)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("command", ["check", "run"])
def test_a_gpu_that_is_not_there(comm, tmp_path, monkeypatch, capfd, command):
    import torch
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.chdir(tmp_path)
    assert eddies(command, TINY, "--set", "device=cuda") == 2
    assert capfd.readouterr().err == (
        'eddies: error: device = "cuda": torch finds no GPU here; set device = "cpu"\n')
    assert list(tmp_path.iterdir()) == []


@pytest.mark.mpi(1, 2)
def test_a_ground_truth_with_too_few_frames_or_without_motion(comm, tmp_path):
    from eddies.io.hdf5 import ProductError
    from eddies.workflows.feasibility import check_ground_truth
    scene = load_scene(TINY, ["tracers.field_every=5"])
    with pytest.raises(ProductError, match="ground_truth.h5: no such file; run"):
        check_ground_truth(["train"], scene, comm, tmp_path)
    write_ground_truth(comm, tmp_path, frames=30)
    check_ground_truth(["train", "simulate"], scene, comm, tmp_path)
    with pytest.raises(SceneError, match="after frame 14 of 30 no filtered field is followed .*, 0.5 later; lower"):
        coarse = dataclasses.replace(scene.simulation, frame_interval=0.5)
        check_ground_truth(["simulate"], dataclasses.replace(scene, simulation=coarse), comm, tmp_path)
    comm.Barrier()
    if comm.rank == 0:
        with changed(tmp_path / "ground_truth.h5") as file:
            file["reference"].attrs["eddy_turnover_time"] = 1e12
    comm.Barrier()
    check_ground_truth(["train"], scene, comm, tmp_path)
    with pytest.raises(SceneError, match="tiny: .simulation. step = 0.08: 3.8e.12 steps for a time of 3e.11,"):
        check_ground_truth(["train", "simulate"], scene, comm, tmp_path)
    short = dataclasses.replace(scene, training=dataclasses.replace(scene.training, window=0.1))
    with pytest.raises(SceneError, match="window = 0.1: holds 2 frames of the ground truth, too few"):
        check_ground_truth(["train"], short, comm, tmp_path)
    comm.Barrier()
    if comm.rank == 0:
        with changed(tmp_path / "ground_truth.h5") as file:
            file["reference"].attrs["acceleration_rms"] = 0.0
    comm.Barrier()
    with pytest.raises(SceneError, match="ground_truth.h5: reference scale acceleration = 0.0: must be .*start from"):
        check_ground_truth(["train"], scene, comm, tmp_path)


@pytest.mark.parametrize("frames, every", np.random.default_rng(5).integers((2, 1), (90, 12), (20, 2)).tolist())
def test_frames_that_are_enough_are_found(frames, every):
    """The first usable frame has the field and the truth that it needs, and there is one if any has."""
    from eddies.workflows.ground_truth.frame_counts import rollout_start
    tiny = load_scene(TINY)
    at_fields = range(0, frames, every)
    usable = [frame for frame in at_fields if frame >= max(int(0.5 * (frames - 1)), 1) and frame + 5 <= frames - 2]
    if usable:
        assert rollout_start(tiny, 0.5, frames, at_fields) == usable[0]
    else:
        with pytest.raises(SceneError, match="start: after frame"):
            rollout_start(tiny, 0.5, frames, at_fields)
