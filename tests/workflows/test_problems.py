"""Problems that are known before any work: each where it is due, with its key, its value and a remedy that helps; and
what only the flow tells."""

import dataclasses
import logging
import re

import numpy as np
import pytest

from eddies import write_tracks
from eddies.io.hdf5 import Table, create_product, write_table
from eddies.io.new_files import set_attributes
from eddies.scene.integrators import SCHEMES
from eddies.scene.scene import SceneError, builtin_scenes, load_scene
from eddies.scene.terms import FilteredEquations, StepUnits
from eddies.workflows.estimates import storage
from eddies.workflows.learned.source import ModelDefinition
from eddies.workflows.problems import check_ground_truth, convenient, memory_of_node, problems
from eddies.workflows.tracks import with_tracks
from eddies.workflows.variants import steps
from tests.commands import first_rank, run_cli, set_all
from tests.bad_scenes import INFEASIBLE
from tests.changed_product import changed
from tests.small_scene import TINY, one_model, problems_of, scene_file
from tests.workflows.synthetic_run import write_ground_truth


# ---- warnings


@pytest.fixture
def warned(comm):
    """A function that gives the warnings of a scene with changes."""
    return lambda *overrides, scene=TINY: problems_of(load_scene(scene, list(overrides)), comm)[1]


@pytest.mark.mpi(1)
@pytest.mark.parametrize("name", [name for name, _ in builtin_scenes()])
def test_built_in_scenes_have_no_problem_but_missing_runs(comm, name):
    refused, warnings = problems_of(load_scene(name), comm)
    others = [line for line in warnings if "of memory here" not in line and "of disk" not in line]
    if name == "cbc":  # its truth is an experiment
        others = [line for line in others if "cannot be compared" not in line]
    assert all("no such file" in line for line in refused) and all("path" in line or "train" in line for line in others)
    assert not any("this very flow" in line for line in others), "rollouts start outside the training"


@pytest.mark.mpi(1)
@pytest.mark.parametrize("name, changes, variants", [
    ("tiny", ["simulation.start=0.2"], "paper, resolved, local"),
    ("tiny", ["realisations=[5]", "initial.kind=taylor-green", "initial.peak_wavenumber=3.0"],
     "paper, resolved, local"),
    ("tiny", ["seed=99", "realisations=[1]", "variant.resolved.model.path=eddies:tiny"], "resolved")])
def test_a_rollout_within_the_training_of_its_model_is_named(comm, name, changes, variants):
    """Also on a realisation that is the flow of the training, with weights of this job or of the package. Coarse grids
    learn nothing."""
    found = [line for line in problems_of(load_scene(name, changes), comm)[1] if "this very flow" in line]
    assert len(found) == 1 and found[0].startswith(f"variant {variants}: "), found


@pytest.mark.mpi(1)
@pytest.mark.parametrize("given, words, remedy", [
    ("flow.viscosity=0.05", "k_max eta is about 0.88", "flow.viscosity={viscosity to}"),
    ("flow.viscosity=0.05", "[flow] cells = 24", "flow.cells={raise cells to}"),
    ("flow.viscosity=0", "the flow has no stationary state, and k_max eta", "flow.viscosity={raise viscosity to}"),
    ("flow.cells=120", "k_max eta is about 5.6", "flow.cells={lower cells to}"),
    ("flow.sound_speed=4", "Mach number is about 0.47: above 0.3", "flow.sound_speed={raise sound_speed to}"),
    ("flow.sound_speed=1.5", "supersonic", "flow.sound_speed={raise sound_speed to}"),
    ("time.step=0.06", "unstable by advection, step x k_max x max(|u| + |v| + |w|) = 3.17, stable up to 2.83",
     "time.step=0.05"),
    ("time.courant=2.5", "[time] courant = 2.5: is unstable by advection", None),
    ("tracers.filter_width=2", "wider than the integral scale, 1.25", "tracers.filter_width={lower it to}"),
    ("tracers.filter_width=0.1", "narrower than a cell", "tracers.filter_width={raise it to}"),
    ("simulation.turnovers=5", "ends 0.3 turnovers after the start", "simulation.turnovers={lower it to}"),
    ("simulation.turnovers=5", "[simulation] turnovers = 5", "tracers.turnovers={raise .tracers. turnovers to}"),
    ("simulation.start=0.9", "[simulation] turnovers = 0.3: the ground truth ends 0.06 turnovers", None),
])
def test_a_warning_names_key_and_value_and_its_remedy_helps(warned, given, words, remedy):
    changes = [given, "time.max_step=1"] if "courant" in given else [given]
    line, = warned(*changes)
    assert words in line and "\n" not in line
    assert re.match(r"\[\w+\] \w+ = [\d.e-]+: ", line)
    if remedy:
        key, value = remedy.split("=")
        if value.startswith("{"):
            value = re.search(value[1:-1] + r" ([\d.e-]*\d)", line).group(1)
        assert warned(*changes, f"{key}={float(value) if 'cells' not in key else int(value)}") == []


@pytest.mark.mpi(1)
def test_viscosity_that_leaves_no_turbulence(warned):
    for viscosity, words in ((2, "below 5"), (60, "laminar")):
        line, = (line for line in warned(f"flow.viscosity={viscosity}") if "Re_lambda is" in line)
        remedy = re.search(r"lower viscosity to ([\d.]+)", line).group(1)
        assert words in line
        assert not any("Re_lambda is" in line for line in warned(f"flow.viscosity={0.99 * float(remedy):.3g}"))


@pytest.mark.mpi(1)
def test_explicit_steps_have_the_limits_of_sound_and_viscosity_too(comm, warned):
    line, = warned("time.stepper=rk4", "time.step=0.05")
    assert "[time] step = 0.05: is unstable by sound" in line and 'stepper = "etdrk4"' in line
    free = load_scene("taylor-green", ["time.stepper=rk4", "flow.viscosity=1", "flow.cells=32"])
    free = dataclasses.replace(free, time=dataclasses.replace(free.time, step=None, max_step=0.05))
    (line,), = problems_of(free, comm)[1:]
    assert "[time] max_step = 0.05: is unstable by viscosity, step x 3 viscosity k_max^2 = 15" in line


@pytest.mark.mpi(1)
def test_steps_that_are_too_long_for_a_forced_rollout_or_for_a_term(comm, warned):
    """Runs of `hit` with C_r = 2 end in noise with velocity Verlet and steps of 0.05."""
    forced = ["simulation.injection=dissipation", "simulation.step=0.3", "simulation.frame_interval=0.3"]
    line, = warned(*forced)
    step = re.search(r"of about ([\d.]+)", line).group(1)
    assert line.startswith("[simulation] step = 0.3") and warned(*forced, f"simulation.step={step}") == []
    changes = ["model.preset=local", "model.filtered-equations.relaxation=2"]
    for integrator, step, expected in (("verlet", 0.05, True), ("rk3", 0.025, False)):
        given = [*changes, f"simulation.integrator={integrator}", f"simulation.step={step}"]
        lines = problems_of(one_model("hit", given), comm)[1]
        assert any("the noise of the particles, which" in line for line in lines) is expected
    # The limits of docs/methods.md, in units of d/u', for C_r = 1.
    for integrator, limit in (("corrected-verlet", 0.125), ("rk3", 0.157)):
        units = StepUnits(radius=1.5, filter_width=1.0, sound_speed=None, velocity=1.0, scheme=SCHEMES[integrator])
        assert FilteredEquations().longest_step(units) == pytest.approx(limit, rel=0.01)
    sound = ["model.preset=wcsph", "training.horizons.steps=5", "model.wcsph.speed=0.8"]
    line, = (line for line in warned(*sound) if "sound" in line)
    scene = load_scene(TINY, sound)
    # Monaghan (1992), with an alpha of 0.05 and a speed of 0.8.
    longest = 0.4 * ModelDefinition.of(scene).radius / 2 / (0.8 * scene.flow.sound_speed * 1.03)
    assert float(line.partition("at most ")[2].split()[0]) == pytest.approx(longest, rel=0.1)
    assert warned(*sound, "simulation.step=0.001") == []


@pytest.mark.mpi(1)
def test_the_step_of_another_run_is_one_of_the_same_kind_of_method(comm, tmp_path):
    def refusals(*overrides):
        given = ["simulation.step=converged", f"simulation.step_from={tmp_path}", *overrides]
        return [line for line in problems_of(load_scene(TINY, given), comm)[0] if "step" in line]

    grid = "simulation.method=eulerian", "eulerian.cells=16"
    assert all("no such file; run `eddies find-step" in line for line in refusals()) and refusals()
    for integrator, fits, other in (("etdrk4", grid, ()), ("rk2", (), grid)):
        with create_product(comm, tmp_path / "step.h5", "step", {}) as file:
            set_attributes(file.create_group("found"), {"integrator": integrator})
            write_table(file, f"trials/{integrator}", Table({"size": np.ones(1)}))
        assert refusals(*fits) == []
        (line,) = refusals(*other)
        assert f"({integrator})" in line and line.endswith("name a run of the same method, or remove step_from")


@pytest.mark.mpi(1)
def test_terms_and_weights_that_nothing_trains(warned, tmp_path):
    lines = warned("model.preset=transport-velocity")
    assert any('only [training.horizons] trains the term "transport-velocity"' in line for line in lines)
    assert warned("model.preset=transport-velocity", "training.horizons.steps=5", "simulation.step=0.001") == []
    line, = warned(f"model.path={tmp_path}")
    assert f"{tmp_path / 'model.h5'}, which does not exist yet" in line


@pytest.mark.mpi(1)
def test_the_pressure_of_filtered_tracks_is_not_found_among_neighbours(comm):
    def lines(method, filtered="true"):
        scene = load_scene(TINY, [f"reconstruction.method={method}", f"tracers.filtered={filtered}",
                                  'reconstruction.fields=["pressure"]'],
                           ["kernel", "model", "training", "simulation"])
        return [line for line in problems_of(scene, comm)[1] if "the pressure will be useless" in line]

    assert len(lines("kriging")) == 1 and lines("kriging", "false") == lines("memory") == []


@pytest.mark.mpi(1)
def test_the_pressure_and_the_acceleration_depend_on_what_lies_beyond_a_volume(comm, tmp_path):
    draw = np.random.default_rng(1)
    position = np.tile(draw.uniform(0.1, 0.9, (30, 3)), (3, 1)) + np.repeat([0, 0.01, 0.02], 30)[:, None]
    write_tracks(tmp_path / "a.h5", np.repeat([0, 1, 2], 30), np.tile(np.arange(30), 3), position, edge=1.0)

    def lines(fields, place="volume = [0, 1, 0, 1, 0, 1]"):
        path = scene_file(tmp_path, f'[tracks]\npath = "a.h5"\nviscosity = 1e-3\n{place}\n[reconstruction]\n'
                                    f'method = "least-squares"\nfields = ["{fields}"]\n')
        scene = with_tracks(load_scene(path), comm)
        return [line for line in problems_of(scene, comm)[1] if "volume" in line]

    assert len(lines("acceleration")) == len(lines("pressure")) == 1
    assert "acceleration will be inaccurate" in lines("acceleration")[0]
    assert lines("velocity") == lines("acceleration", "box = 1.0") == []


@pytest.mark.mpi(2)
def test_a_volume_whose_cube_does_not_fit_is_refused(comm, tmp_path):
    """Tracks in a slab need the cells of the cube around it."""
    folder, draw = comm.bcast(tmp_path), np.random.default_rng(1)
    position = np.tile(draw.uniform(0.1, 0.9, (300, 3)) * [1, 1, 0.2], (3, 1))
    position += np.repeat([0, 0.01, 0.02], 300)[:, None]
    if comm.rank == 0:
        write_tracks(folder / "a.h5", np.repeat([0, 1, 2], 300), np.tile(np.arange(300), 3), position)
        scene_file(folder, '[tracks]\npath = "a.h5"\nvolume = [0, 1, 0, 1, 0, 0.2]\n')
    comm.Barrier()
    scene = with_tracks(load_scene(folder / "case.toml"), comm)
    planned, needed = steps(scene, ["dns"], folder), comm.size * storage(scene, "dns", comm.size).memory
    assert problems(scene, planned, comm, 1.1 * needed) == ([], [])
    (line,), _ = problems(scene, planned, comm, 0.9 * needed)
    assert line.startswith("[tracks] volume: the cube around it is too large in the stage dns") and "margin" in line


@pytest.mark.mpi(1)
def test_a_table_of_points_is_read_before_the_run(comm, tmp_path):
    scene = load_scene(TINY, ["reconstruction.method=least-squares", f"reconstruction.points={tmp_path / 'p.csv'}"])
    for text, words in ((None, "p.csv: cannot be read: No such file"), ("x,y\n1,2,3\n", "cannot be read as a table"),
                        ("x,y,z\n1,2,3\n1,inf,3\n", "row 2 has no number in the column of y"),
                        ("x,y,z\n1,2,3\n1,-1e8,3\n", "(1, -1e+08, 3) is outside the 1e+06 edges around the cube")):
        if text:
            (tmp_path / "p.csv").write_text(text)
        (line,), _ = problems_of(scene, comm)
        assert words in line and "\n" not in line
    (tmp_path / "p.csv").write_text("x,y,z\n1,2,3\n")
    assert not problems_of(scene, comm)[0]


@pytest.mark.mpi(1)
def test_a_warning_names_the_variants_that_it_concerns(comm):
    scene = load_scene("tiny", ["variant.paper.simulation.step=0.3", "variant.no-force.simulation.step=0.3",
                                "simulation.injection=dissipation", "simulation.frame_interval=0.3"])
    assert [line.partition(":")[0] for line in problems_of(scene, comm)[1] if "0.3: is too long" in line] == [
        "variant paper"]
    line, = (line for line in problems_of(load_scene("tiny", ["simulation.turnovers=5"]), comm)[1])
    assert line.startswith("variant paper, resolved, local, grid-16, grid-20, no-force: [simulation] turnovers = 5")


@pytest.mark.mpi(1)
def test_weights_that_the_same_job_makes_are_not_read(comm, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scene = load_scene("tiny", ["realisations=[2]"])
    assert problems_of(scene, comm) == ([], [])
    (tmp_path / "runs/tiny/paper").mkdir(parents=True)
    (tmp_path / "runs/tiny/paper/model.h5").write_text("of other settings")
    assert problems_of(scene, comm) == ([], [])


@pytest.mark.mpi(2)
def test_a_machine_that_is_too_small(comm, tmp_path):
    scene = load_scene(TINY)
    planned, memory = steps(scene, scene.stages, tmp_path), memory_of_node(comm)
    assert problems(scene, planned, comm, memory, 1e9) == ([], [])
    too_little = (comm.size - 0.5) * storage(scene, "dns", comm.size).memory
    (small,) = problems(scene, steps(scene, ["dns"], tmp_path), comm, too_little, 1e9)[1]
    (full,) = problems(scene, planned, comm, memory, 1e6)[1]
    assert "of memory here" in small and "of disk" in full


@pytest.mark.mpi(2)
def test_the_node_with_the_least_memory_counts(comm, monkeypatch):
    monkeypatch.setattr("os.sysconf", {"SC_PHYS_PAGES": 9 - comm.rank, "SC_PAGE_SIZE": 10**9}.__getitem__)
    assert memory_of_node(comm) == (10 - comm.size) * 1e9


@pytest.mark.mpi(1)
def test_a_run_logs_the_warnings_of_its_stages_when_it_starts(comm, tmp_path, monkeypatch, caplog):
    from eddies.parallel.stop import StopRequest
    from eddies.stages import run_stages
    from eddies.workflows import dns
    monkeypatch.setattr(dns, "run", lambda *given: None)
    scene = load_scene(TINY, ["flow.sound_speed=4", "model.preset=transport-velocity"])
    with caplog.at_level(logging.WARNING, logger="eddies"):
        run_stages(["dns"], scene, comm, tmp_path, StopRequest(comm))
    shown = [record.getMessage() for record in caplog.records]
    assert len(shown) == 1 and "sound_speed" in shown[0] and len(problems_of(scene, comm)[1]) > 1


# ---- what is refused


@pytest.mark.mpi(1)
@pytest.mark.parametrize("override, message", INFEASIBLE, ids=[override for override, _ in INFEASIBLE])
def test_what_cannot_end_is_refused_before_it_begins(comm, tmp_path, monkeypatch, capfd, override, message):
    monkeypatch.chdir(tmp_path)
    for command in ("check", "run") if override.startswith("initial") else ("run",):
        assert run_cli(command, TINY, "--set", override) == 2
        output, errors = capfd.readouterr()
        assert errors.startswith("eddies: error: tiny: ") and errors.count("\n") == 1 and message in errors
        assert (output == "") == (command == "run") and list(tmp_path.iterdir()) == []


@pytest.mark.mpi(1)
def test_only_the_stages_that_are_asked_for_are_refused(comm, tmp_path):
    scene = load_scene(TINY, ["simulation.step=1e-12", "tracers.turnovers=0.01"])
    for stages, text in ((["dns", "train-kernel"], None), (["dns", "train"], "window"), (["train"], None),
                         (["simulate"], "step = 1e-12")):
        refused, _ = problems(scene, steps(scene, stages, tmp_path), comm)
        assert len(refused) == (text is not None) and (text is None or text in refused[0])


@pytest.mark.mpi(1)
def test_a_gpu_that_is_not_there(comm, tmp_path, monkeypatch, capfd):
    import torch
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.chdir(tmp_path)
    assert run_cli("run", TINY, "--set", "device=cuda") == 2
    assert capfd.readouterr().err == (
        'eddies: error: device = "cuda": torch finds no GPU here; set device = "cpu"\n')
    assert list(tmp_path.iterdir()) == []


@pytest.mark.mpi(2)
def test_files_that_do_not_fit(comm, tmp_path):
    path = comm.bcast(str(tmp_path))
    (line,), _ = problems_of(load_scene("taylor-green", ["initial.kind=file", f"initial.path={path}/start.h5"]), comm)
    assert f"{path}/start.h5" in line
    start = ["initial.kind=file", f"initial.path={path}/start.h5", "realisations=[7]"]
    own, other = problems_of(load_scene(TINY, start, ["initial.peak_wavenumber"]), comm)[0]
    assert f"{path}/start.h5" in own and f"{path}/realisation-7/start.h5" in other
    first_rank(comm, (tmp_path / "model.h5").write_text, "nothing")
    (line,), _ = problems_of(load_scene("hit-mt008", [f"model.path={path}"], ["variant"]), comm)
    assert f"{path}/model.h5" in line


@pytest.mark.mpi(1)
def test_names_that_are_taken_in_the_run_directory(comm, tmp_path, capfd):
    """The report has a directory and no product."""
    (tmp_path / "ground_truth.h5").mkdir()
    for name in ("checkpoints", "report"):
        (tmp_path / name).touch()
    scene = load_scene(TINY)
    first, second = problems(scene, steps(scene, ["dns"], tmp_path), comm)[0]
    assert "ground_truth.h5: is a directory, and `eddies dns` writes a file" in first
    assert "checkpoints: is a file, and `eddies dns` makes a directory" in second
    (tmp_path / "ground_truth.h5").rmdir()
    (tmp_path / "checkpoints").unlink()
    assert run_cli("run", TINY, "--output", tmp_path) == 2
    assert "report: is a file, and `eddies report` makes a directory" in capfd.readouterr().err


# ---- what only the flow tells


@pytest.mark.mpi(2)
@pytest.mark.parametrize("overrides, message", [
    (["initial.amplitude=1e-15"], "[time] max_step = 0.05: "),
    (["initial.kind=tests.workflows.test_problems:at_rest"], "set another [initial] kind"),
    (["tracers.turnovers=1e13"], "[time] courant = "),
    (["tracers.frame_interval=1e-11"], "[tracers] frame_interval = 1e-11: "),
    (["spin_up.turnovers=1e10"], "[time] max_step = 0.05: "),
], ids=lambda value: value[0] if isinstance(value, list) else "")
def test_a_flow_of_unknown_turnover_time_is_refused_once_it_is_there(comm, tmp_path, capfd, overrides, message):
    options = set_all(["flow.viscosity=0", "flow.cells=16", "tracers.particles_per_side=4", *overrides])
    assert run_cli("dns", "tracers-only", *options, "--output", tmp_path) == 2
    errors = capfd.readouterr().err
    assert comm.rank > 0 or errors.startswith("eddies: error: ") and errors.count("\n") == 1
    assert comm.rank > 0 or message in errors
    comm.Barrier()
    assert not (tmp_path / "ground_truth.h5").exists()


def test_advised_grids_are_transformed_fast():
    assert [convenient(cells) for cells in (9, 32, 33, 77, 241)] == [10, 32, 36, 80, 250]
    assert 10**15 < convenient(10**15) < 1.05 * 10**15


@pytest.mark.mpi(1)
def test_a_run_of_given_time_has_a_limit_of_steps(comm, tmp_path, capfd):
    fast = ["--set", "initial.kind=tests.workflows.test_problems:fast", "--set", "time.duration=1e9", "--unset",
            "time.step"]
    assert run_cli("dns", "abc", *fast, "--output", tmp_path) == 2
    errors = capfd.readouterr().err
    assert "[time] courant = " in errors and "for a time of 1e+09, more than" in errors


def fast(grid, initial, seed):
    """A flow of the user's with an unknown speed."""
    from eddies.flow.initial_fields import INITIAL_FLOWS
    return 1e4 * INITIAL_FLOWS["random"](grid, initial, seed)


def at_rest(grid, initial, seed):
    """A flow of the user's that does not move."""
    return 0 * fast(grid, initial, seed)


@pytest.mark.mpi(2)
def test_a_ground_truth_with_too_few_frames_or_without_motion(comm, tmp_path):
    scene = load_scene(TINY, ["tracers.field_every=5"])
    write_ground_truth(comm, tmp_path, frames=30)

    def check(stages, simulation=scene.simulation):
        given = dataclasses.replace(scene, simulation=simulation)
        check_ground_truth(tmp_path / "ground_truth.h5", stages, given, comm)

    check(["train", "simulate"])
    with pytest.raises(SceneError, match="but there is none from frame 14 of 30 on"):
        check(["simulate"], dataclasses.replace(scene.simulation, frame_interval=0.5))
    for group, value, stages, message in (("eddy_turnover_time", 1e12, ["simulate"], "3.8e.12 steps of 0.08"),
                                          ("acceleration_rms", 0.0, ["train"], "scale acceleration = 0.0: must be")):
        comm.Barrier()
        if comm.rank == 0:
            with changed(tmp_path / "ground_truth.h5") as file:
                file["reference"].attrs[group] = value
        comm.Barrier()
        with pytest.raises(SceneError, match=message):
            check(stages)
