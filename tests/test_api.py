"""The Python functions: names, and runs from a program."""

import logging
from dataclasses import replace

import pytest

import eddies
from tests.commands import on_ranks


def test_names():
    assert {"load_scene", "Scene", "check", "run", "train", "simulate", "Term", "PairTerm", "TermSettings",
            "Rates", "LagrangianModel", "number", "boolean", "__version__"} <= set(dir(eddies))
    with pytest.raises(AttributeError, match="module 'eddies' has no attribute 'simulte'"):
        eddies.simulte


def test_every_public_name_has_a_docstring():
    assert all(getattr(eddies, name).__doc__ for name in eddies.__all__)


@pytest.mark.usefixtures("no_figures")
@pytest.mark.mpi(2)
def test_a_flow_from_a_program(comm, tmp_path):
    scene = eddies.load_scene("abc", ["time.duration=0.1"])
    assert eddies.run(scene, output=tmp_path, comm=comm) == tmp_path
    assert (tmp_path / "ground_truth.h5").exists() and (tmp_path / "report/index.html").exists()
    before = (tmp_path / "ground_truth.h5").stat().st_mtime_ns
    comm.Barrier()
    eddies.run(replace(scene, title="another"), output=tmp_path, comm=comm)
    assert (tmp_path / "ground_truth.h5").stat().st_mtime_ns == before
    other = eddies.load_scene("abc", ["time.duration=0.05"])  # a longer one would continue
    with pytest.raises(eddies.SceneError.__mro__[1], match="--overwrite"):
        eddies.run(other, output=tmp_path, comm=comm)
    eddies.run(other, output=tmp_path, overwrite=True, comm=comm)
    assert (tmp_path / "ground_truth.h5").stat().st_mtime_ns > before


@pytest.mark.usefixtures("no_figures")
@pytest.mark.mpi(2)
def test_classes_of_the_user_are_logged_once(comm, tmp_path, own, caplog, monkeypatch):
    own("own_start", "from eddies.flow.initial_fields import abc\n"
        "def twice(grid, initial, seed):\n    return abc(grid, 2 * initial.amplitude, 1)\n")
    scene = eddies.load_scene("abc", ["time.duration=0.1", "initial.kind=own_start:twice"])
    with caplog.at_level(logging.INFO, logger="eddies"):
        eddies.run(scene, output=tmp_path, comm=comm)
    assert ["own_start:twice" in record.getMessage() for record in caplog.records
            if "own_start" in record.getMessage()] == [True]


@pytest.mark.mpi(1)
def test_some_stages_and_mistakes(comm, tmp_path):
    scene = eddies.load_scene("abc", ["time.duration=0.1"])
    eddies.run(scene, stages=["dns"], output=tmp_path, comm=comm)
    assert (tmp_path / "ground_truth.h5").exists() and not (tmp_path / "report").exists()
    with pytest.raises(eddies.UserError, match='"dsn"'):
        eddies.run(scene, stages=["dsn"], output=tmp_path, comm=comm)
    with pytest.raises(eddies.SceneError, match=r"needs the section \[model\]"):
        eddies.train("abc", output=tmp_path, comm=comm)


@pytest.mark.usefixtures("no_figures")
@pytest.mark.mpi(1)
def test_a_scene_that_a_program_makes_and_names_a_run_directory(comm, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scene = eddies.Scene(name="made", flow=eddies.Flow(fluid="incompressible", cells=8, viscosity=0.1),
                         initial=eddies.Initial(kind="abc"), time=eddies.Time(duration=0.1))
    assert str(eddies.run(scene)) == "runs/made" and (tmp_path / "runs/made/scene.toml").exists()


def test_an_error_that_one_rank_meets_ends_the_job(tmp_path):
    program = tmp_path / "program.py"
    program.write_text("import eddies, eddies.api, eddies.parallel.broadcast\nfrom mpi4py import MPI\n"
                       "eddies.parallel.broadcast.PATIENCE = 0.5\n"
                       "def fail(scene, comm):\n    if comm.rank == 1:\n        raise RuntimeError('lost')\n"
                       "    comm.Barrier()\n"
                       "import eddies.workflows.check\neddies.workflows.check.run = fail\neddies.check('abc')\n")
    ended = on_ranks(2, program)
    assert ended.returncode != 0 and "RuntimeError: lost" in ended.stderr


def test_a_file_that_hdf5_could_not_write_ends_the_job_of_several_ranks(tmp_path):
    """All ranks meet the error; one rank goes on."""
    program = tmp_path / "program.py"
    program.write_text("import eddies, eddies.io.new_files, eddies.workflows.check\n"
                       "def fail(scene, comm):\n    raise eddies.UserError('full')\n"
                       "eddies.workflows.check.run, eddies.io.new_files.writing_failed = fail, lambda: True\n"
                       "try:\n    eddies.check('abc')\nexcept eddies.UserError:\n    print('goes on')\n")
    for ranks in (1, 2):
        ended = on_ranks(ranks, program)
        assert (ended.returncode == 0) == ("goes on" in ended.stdout) == (ranks == 1), ended
