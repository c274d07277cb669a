"""Bad files, paths and streams: one line with the problem and a remedy, exit code 2, and no traceback."""

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

import eddies
from eddies.scene.scene import load_scene
from tests.changed_product import changed
from tests.commands import a_simulation, python, refused, run_cli, set_all
from tests.small_scene import TINY
from tests.workflows.synthetic_run import write_ground_truth

TEXT = (Path(__file__).parents[1] / "src/eddies/scenes/tiny.toml").read_text()
NOBODY = 65534
LONG = 300 * "o"


@pytest.mark.mpi(2)
def test_damaged_provenance(comm, tmp_path, capfd):
    write_ground_truth(comm, tmp_path, frames=2)
    for value in ("nonsense {", "{}", 3.5):
        comm.Barrier()
        if comm.rank == 0:
            with changed(tmp_path / "ground_truth.h5") as file:
                file.attrs["provenance"] = value
        comm.Barrier()
        for command in (["report", tmp_path], ["simulate", TINY, "--output", tmp_path]):
            refused(comm, capfd, command, f"{tmp_path / 'ground_truth.h5'}: its attribute provenance")


@pytest.mark.mpi(1)
def test_attributes_of_another_type(comm, tmp_path, capfd):
    write_ground_truth(comm, tmp_path)
    for name, value, message in (("format", "three", "does not read; remove it"),
                                 ("complete", "", "unfinished, its writer"),
                                 ("complete", [True, True], "attributes cannot be read"),
                                 ("kind", [1, 2], "is of kind [1 2], expected ground_truth")):
        with changed(tmp_path / "ground_truth.h5") as file:
            before = file.attrs[name]
            file.attrs[name] = value
        refused(comm, capfd, ["report", tmp_path], message)
        with changed(tmp_path / "ground_truth.h5") as file:
            file.attrs[name] = before


@pytest.mark.mpi(2)
def test_another_kind_of_file_in_place_of_a_product(comm, tmp_path, capfd):
    for name, stage, made in (("ground_truth.h5", "dns", Path.mkdir), ("rollout.h5", "simulate", Path.mkdir),
                              ("checkpoints", "dns", Path.touch), ("report", "report", Path.touch)):
        folder = tmp_path / f"with {name}"
        if comm.rank == 0:
            folder.mkdir()
            made(folder / name)
        comm.Barrier()
        refused(comm, capfd, ["run", TINY, "--output", folder], f"{folder / name}: is a ", f"`eddies {stage}`")
        assert [path.name for path in folder.iterdir()] == [name]


@pytest.mark.mpi(1)
def test_damaged_seconds(comm, tmp_path, capfd):
    write_ground_truth(comm, tmp_path)
    for content in ("nonsense {", '{"dns": "long"}'):
        (tmp_path / "stage_seconds.json").write_text(content)
        refused(comm, capfd, ["report", tmp_path], "stage_seconds.json: ")


PATHS = [
    (["run", TINY, "--output", ""], "an empty text is not a directory"), (["export", ""], "an empty text"),
    (["run", "compare-small", "--output", LONG], "File name too long"), (["report", LONG], "File name too long"),
    (["check", LONG], "(300 characters): cannot be read: File name too long; give the path of a TOML file"),
    (["check", "."], ".: is a directory, not a scene"), (["scenes", "tin"], "tin: no such scene; did you mean tiny?"),
    (["export", "."], ".: has no fields or particles"), (["report", "."], ".: holds none of ground_truth.h5")]


@pytest.mark.mpi(2)
def test_paths(comm, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    for command, message in PATHS:
        refused(comm, capfd, command, message)
        assert list(tmp_path.iterdir()) == []
    with pytest.raises(eddies.SceneError, match="File name too long"):
        eddies.run("abc", output=tmp_path / LONG, comm=comm)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("content, message", [(b"\xff\xfe\x00", "cannot be read: 'utf-8'"), (b"\x00", "not TOML: ")])
def test_files_that_are_not_scenes(comm, tmp_path, capfd, content, message):
    (tmp_path / "case.toml").write_bytes(content)
    refused(comm, capfd, ["check", tmp_path / "case.toml"], f"{tmp_path / 'case.toml'}: {message}")


def test_a_byte_order_mark_is_not_part_of_a_scene(tmp_path):
    (tmp_path / "tiny.toml").write_text("\ufeff" + TEXT, encoding="utf-8")
    assert load_scene(tmp_path / "tiny.toml") == load_scene("tiny")


@pytest.mark.mpi(3)
def test_a_rank_may_have_one_particle_or_none(comm, tmp_path):
    few = ["tracers.particles_per_side=2", "tracers.turnovers=0.01", "flow.cells=16"]
    assert run_cli("dns", "tracers-only", *set_all(few), "--output", tmp_path) == 0


def as_nobody(commands, built_in):
    """Exit codes and errors of commands of a user without rights of root, who may not read this checkout: their modules
    are loaded before, and the folder of the built-in scenes is another."""
    code = ("import encodings.utf_8_sig, importlib, json, os, pathlib, sys, numpy.random\n"
            "import eddies.cli, eddies.stages, eddies.stored_run\n"
            "[importlib.import_module(f'eddies.workflows.{command[0]}') for command in json.loads(sys.argv[1])]\n"
            "eddies.kernels.library.library()\n"
            "eddies.scene.layers.BUILT_IN = pathlib.Path(sys.argv[2])\n"
            f"os.getuid() or (os.setgroups([]), os.setgid({NOBODY}), os.setuid({NOBODY}))\n"
            "print([eddies.cli.main(command) for command in json.loads(sys.argv[1])])")
    ended = python("-c", code, json.dumps(commands), built_in)
    return json.loads(ended.stdout), ended.stderr.splitlines()


def test_files_that_may_not_be_read_or_written():
    folder = Path(tempfile.mkdtemp())  # those of pytest are closed to other users
    try:
        folder.chmod(0o755)
        (folder / "abc.toml").write_text(load_scene("abc").to_toml())  # in place of the built-in one
        for name in ("ground_truth.h5", "case.toml"):
            (folder / name).write_text(TEXT)
            (folder / name).chmod(0o600)
        cases = [(["report", f"{folder}"], f"{folder}: cannot be written"),
                 (["export", f"{folder}"], "ground_truth.h5: cannot be read: Permission denied"),
                 (["check", f"{folder}/case.toml"], "case.toml: cannot be read: Permission denied"),
                 (["dns", "abc", "--output", f"{folder}/new"], "new: cannot be written (Permission denied)")]
        codes, errors = as_nobody([command for command, _ in cases], folder)
    finally:
        shutil.rmtree(folder)
    assert codes == [2] * len(cases) == [2] * len(errors)
    for line, (_, message) in zip(errors, cases):
        assert line.startswith("eddies: error: ") and message in line


@pytest.mark.parametrize("scene, errors", [
    ("abc", "standard output cannot be written"), ("abc", None), ("nothing", None)])
def test_output_on_a_full_disk(tmp_path, scene, errors):
    """A run goes on where its lines cannot be written; its error may be lost, too."""
    with open("/dev/full", "w") as full:
        ended = python("-m", "eddies", "dns", scene, "--set", "time.duration=0.1", "--output", "run", stdout=full,
                       cwd=tmp_path, env={**os.environ, "PYTHONUNBUFFERED": ""}, **({} if errors else {"stderr": full}))
    assert ended.returncode == 2 and (tmp_path / "run/ground_truth.h5").exists() == (scene == "abc")
    assert not errors or ended.stderr.startswith(f"eddies: error: {errors}") and ended.stderr.count("\n") == 1


def test_a_reader_that_leaves_and_a_working_directory_that_is_gone(tmp_path):
    """`eddies scenes | head -1` ends quietly, also with a write before the end, and a run goes on."""
    reading, writing = os.pipe()
    os.close(reading)
    for command in (["scenes"], ["--help"], ["dns", "abc", "--set", "time.duration=0.1", "--output", tmp_path / "run"],
                    ["status", tmp_path]):
        ended = python("-m", "eddies", *command, stdout=writing)
        assert (ended.returncode, ended.stderr) == (0, "")
    assert (tmp_path / "run/ground_truth.h5").exists()
    gone = tmp_path / "gone"
    gone.mkdir()
    ended = python("-m", "eddies", "scenes", stdout=writing, cwd=gone, preexec_fn=gone.rmdir)
    assert ended.returncode == 2 and ended.stderr.count("\n") == 1
    assert ended.stderr.startswith("eddies: error: the working directory no longer exists")


def test_an_encoding_without_the_letters(tmp_path):
    (tmp_path / "case.toml").write_text(TEXT.replace('title = "', 'title = "λ ≤ η '), encoding="utf-8")
    ended = python("-m", "eddies", "scenes", tmp_path / "case.toml", env={**os.environ, "PYTHONIOENCODING": "ascii"})
    assert (ended.returncode, ended.stderr) == (0, "") and 'title = "\\u03bb \\u2264 \\u03b7 ' in ended.stdout


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_an_interrupt_stops_at_the_next_step(tmp_path, number):
    with a_simulation(tmp_path) as job:
        job.send_signal(number)
        errors = job.communicate(timeout=30)[1].splitlines()
    assert job.returncode == 75 and f"stopped by {number.name}" in errors[-1]
    assert len(errors) == 1 + (number == signal.SIGINT) and not list(tmp_path.rglob("*.partial"))


@pytest.mark.parametrize("where", ["a pipe without a reader", "closed"])
def test_an_interrupt_with_no_standard_error_is_noted(tmp_path, where):
    """If standard error is closed, another file has its number."""
    code = ("import os, signal\nfrom eddies import cli\nreceived = cli.catch_signals()\n"
            "other = os.open('other', os.O_WRONLY | os.O_CREAT)\nsignal.raise_signal(signal.SIGINT)\n"
            "print(received, other)\n")
    line = ["sh", "-c", '"$@" 2>&-' if where == "closed" else '"$@"', "sh", sys.executable, "-c", code]
    reader, writer = os.pipe()
    os.close(reader)
    ended = subprocess.run(line, stdout=subprocess.PIPE, stderr=writer, text=True, cwd=tmp_path, timeout=20)
    os.close(writer)
    assert ended.returncode == 0 and ended.stdout == f"[2] {2 if where == 'closed' else 3}\n"
    assert (tmp_path / "other").read_bytes() == b""


def test_an_ignored_signal_stays_ignored():
    """As with nohup, or in a background job of a shell."""
    ended = python("-c", "import signal\nfrom eddies import cli\nsignal.signal(signal.SIGHUP, signal.SIG_IGN)\n"
                   "received = cli.catch_signals()\nsignal.raise_signal(signal.SIGHUP)\nprint(received)\n")
    assert (ended.returncode, ended.stdout) == (0, "[]\n")


def test_an_interrupted_job_of_two_ranks_ends(tmp_path):
    with a_simulation(tmp_path, ranks=2) as job:
        os.killpg(job.pid, signal.SIGINT)  # as the keyboard does
        errors = job.communicate(timeout=30)[1]
    assert job.returncode == 130 and errors.endswith("interrupted\n") and "Traceback" not in errors


@pytest.mark.mpi(1)
def test_warnings_of_libraries_are_one_line(comm, capfd):
    import warnings

    from eddies.logs import show_warnings
    show_warnings()
    warnings.warn("of a kind\n that has lines", stacklevel=1)
    assert capfd.readouterr().err.startswith("eddies: warning: of a kind that has lines (test_bad_input.py, line ")
