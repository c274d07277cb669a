"""Bad files, paths and streams: one line that names what is wrong and what to do, exit code 2, and no traceback."""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from tests.changed_product import changed
from tests.small_scene import TINY
from tests.test_cli import LAUNCHER, run_cli
from tests.workflows.synthetic_run import write_ground_truth, write_kernel

TEXT = (Path(__file__).parents[1] / "src/eddies/scenes/tiny.toml").read_text()
NOBODY = 65534


def refused(capfd, comm, *command):
    """The one line with which rank 0, and no other, refuses a command."""
    assert run_cli(*command) == 2
    errors = capfd.readouterr().err
    if comm.rank > 0:
        assert errors == ""
        return ""
    assert errors.startswith("eddies: error: ") and errors.count("\n") == 1
    return errors


def program(*arguments, **options):
    """The ended program, on one rank."""
    line = [sys.executable, "-m", "eddies", *map(str, arguments)]
    return subprocess.run(line, stdin=subprocess.DEVNULL, text=True, timeout=60, stderr=subprocess.PIPE, **options)


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("value", ["nonsense {", "[1]", "3", '"text"', "{}", "null", 3.5, b"\xff"], ids=repr)
def test_provenance_that_is_none(comm, tmp_path, capfd, value):
    write_ground_truth(comm, tmp_path, frames=2)
    comm.Barrier()
    if comm.rank == 0:
        with changed(tmp_path / "ground_truth.h5") as file:
            file.attrs["provenance"] = value
    comm.Barrier()
    told = (f"{tmp_path / 'ground_truth.h5'}: its attribute provenance is not what was written, the file is damaged; "
            "delete it and make it again\n")
    for command in (["report", tmp_path], ["export", tmp_path], ["simulate", TINY, "--output", tmp_path]):
        assert refused(capfd, comm, *command).endswith(told) or comm.rank > 0


@pytest.mark.mpi(1)
@pytest.mark.parametrize("name, value, told", [
    ("kind", 3, "is of kind 3, expected ground_truth: run `eddies dns SCENE` first"),
    ("kind", [1, 2], "is of kind [1 2], expected ground_truth: run `eddies dns SCENE` first"),
    ("complete", [True, True], "damaged, its attributes cannot be read"), ("complete", "", "unfinished, its writer"),
    ("format", [3, 3], "whose ground truth this version does not read; remove it and run `eddies dns` again"),
    ("format", "three", "whose ground truth this version does not read; remove it and run `eddies dns`")], ids=repr)
def test_attributes_of_another_type(comm, tmp_path, capfd, name, value, told):
    write_ground_truth(comm, tmp_path)
    with changed(tmp_path / "ground_truth.h5") as file:
        file.attrs[name] = value
    assert told in refused(capfd, comm, "report", tmp_path)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("value", [None, "nonsense {", "[1]", 3])
def test_weights_without_a_description(comm, tmp_path, value):
    from eddies.io.hdf5 import ProductError
    from eddies.io.weights import load_weights
    write_kernel(comm, tmp_path)
    with changed(tmp_path / "kernel.h5") as file:
        del file.attrs["description"]
        if value is not None:
            file.attrs["description"] = value
    with pytest.raises(ProductError, match="kernel.h5: its attribute description is not what was written.*delete it"):
        load_weights(comm, tmp_path / "kernel.h5", "kernel")


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("name, stage", [("ground_truth.h5", "dns"), ("kernel.h5", "train-kernel"),
                                         ("model.h5", "train"), ("rollout.h5", "simulate")])
def test_a_directory_in_place_of_a_product(comm, tmp_path, capfd, name, stage):
    if comm.rank == 0:
        (tmp_path / name).mkdir()
    comm.Barrier()
    for command in ("run", stage):
        told = refused(capfd, comm, command, TINY, "--output", tmp_path)
        assert comm.rank > 0 or f"{tmp_path / name}: is a directory, and `eddies {stage}` writes a file" in told
    told = refused(capfd, comm, "report", tmp_path)
    again = f"{tmp_path / name}: is a directory, not a file; move it away, then run `eddies {stage} SCENE` first"
    assert comm.rank > 0 or again in told
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("name, stage", [("checkpoints", "dns"), ("checkpoints-train", "train"), ("report", "report")])
def test_a_file_in_place_of_a_directory(comm, tmp_path, capfd, name, stage):
    if comm.rank == 0:
        (tmp_path / name).write_text("")
    comm.Barrier()
    told = refused(capfd, comm, "run", TINY, "--output", tmp_path)
    assert comm.rank > 0 or f"{tmp_path / name}: is a file, and `eddies {stage}` makes a directory of this name" in told
    if stage == "report":
        told = refused(capfd, comm, "report", tmp_path)
        assert comm.rank > 0 or "report: is a file, and `eddies report` makes a directory" in told
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("content", ["nonsense {", "[1]", "3", '{"dns": "long"}', '{"dns": null}'])
def test_seconds_that_are_none(comm, tmp_path, capfd, content):
    write_ground_truth(comm, tmp_path)
    if comm.rank == 0:
        (tmp_path / "stage_seconds.json").write_text(content)
    comm.Barrier()
    told = refused(capfd, comm, "report", tmp_path)
    assert comm.rank > 0 or "stage_seconds.json: is not what the stages wrote; delete it, the report does" in told


LONG = 300 * "o"


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("command, told", [
    (["run", TINY, "--output", ""], "an empty text is no directory"),
    (["report", ""], "an empty text is no directory"),
    (["dns", TINY, "--output", LONG], "cannot be used as a directory: File name too long; choose another"),
    (["export", "", "--output", "x"], "an empty text is no directory"),
    (["export", "runs", "--output", LONG], "cannot be used as a directory: File name too long"),
    (["run", "compare-small", "--output", LONG], "cannot be used as a directory: File name too long"),
    (["run", "compare-small", "--output", ""], "an empty text is no directory"),
    (["report", LONG], "cannot be used as a directory: File name too long"),
    (["check", LONG], "(300 characters): cannot be read: File name too long; give the path of a TOML file"),
    (["check", "."], ".: is a directory, not a scene; give the path of a TOML file in it"),
    (["check", ""], "give the path of a TOML file"), (["scenes", "tin"], "tin: no such scene; did you mean tiny?"),
    (["export", "."], ".: holds no fields or particles"), (["report", "."], ".: holds none of ground_truth.h5"),
], ids=lambda value: " ".join(value)[:30] if isinstance(value, list) else "")
def test_paths(comm, tmp_path, monkeypatch, capfd, command, told):
    monkeypatch.chdir(tmp_path)
    assert told in refused(capfd, comm, *command) or comm.rank > 0
    assert list(tmp_path.iterdir()) == []


@pytest.mark.mpi(1)
def test_a_run_directory_of_a_program_that_is_too_long(comm, tmp_path):
    import eddies
    with pytest.raises(eddies.SceneError, match="cannot be used .File name too long.; choose another --output"):
        eddies.run("abc", output=tmp_path / LONG, comm=comm)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("content, told", [
    (b"\xff\xfe\x00", "cannot be read: 'utf-8' codec can't decode byte 0xff"),
    (b"\x00", "not TOML: "), (b"", "[flow]: this section is missing"),
    (b"\x89HDF\r\n\x1a\n", "cannot be read: 'utf-8'")])
def test_files_that_are_no_scenes(comm, tmp_path, capfd, content, told):
    (tmp_path / "case.toml").write_bytes(content)
    assert f"{tmp_path / 'case.toml'}: {told}" in refused(capfd, comm, "check", tmp_path / "case.toml")


def test_a_mark_of_the_encoding_is_no_part_of_a_scene(tmp_path):
    from eddies.scene.scene import load_scene
    (tmp_path / "tiny.toml").write_text("\ufeff" + TEXT, encoding="utf-8")
    assert load_scene(tmp_path / "tiny.toml") == load_scene("tiny")


@pytest.mark.parametrize("key", ["tracers.filter_width", "tracers.field_cells", "time.step", "model.path",
                                 "model.neighbors", "simulation.start", "time.duration"])
def test_none_is_a_key_that_is_left_out(key):
    """As the reference of the keys in the docs calls it."""
    from eddies.scene.scene import load_scene
    assert load_scene(TINY, [f"{key}=none"]) == load_scene(TINY)


def test_the_filter_of_few_particles_is_read_back(tmp_path):
    from eddies.scene.scene import load_scene
    scene = load_scene("tracers-only", ["tracers.particles_per_side=2"])
    (tmp_path / "tracers-only.toml").write_text(scene.to_toml())
    assert load_scene(tmp_path / "tracers-only.toml") == scene


@pytest.mark.mpi(3)
def test_a_rank_may_have_a_particle_or_none(comm, tmp_path):
    few = ["tracers.particles_per_side=2", "tracers.turnovers=0.05", "flow.cells=16"]
    options = [word for override in few for word in ("--set", override)]
    assert run_cli("dns", "tracers-only", *options, "--output", tmp_path) == 0


def as_nobody(commands, built_in):
    """Exit codes and the error output of commands that are run by a user without rights of root, who need not be
    allowed to read this checkout: all modules and the compiled library are loaded before, and the folder of the
    built-in scenes is another."""
    code = ("import encodings.utf_8_sig, importlib, json, os, pathlib, pkgutil, sys, numpy.random, eddies.cli\n"
            "names = [found.name for found in pkgutil.walk_packages(eddies.__path__, 'eddies.')]\n"
            "others = '__main__', 'avx2', 'avx512', 'plain'  # a command, and libraries that are no modules\n"
            "[importlib.import_module(name) for name in names if name.split('.')[-1] not in others]\n"
            "eddies.kernels.library.library()\n"
            "for module in eddies.scene.scene, eddies.scene.layers:\n"
            "    module.BUILT_IN = pathlib.Path(sys.argv[2])\n"
            f"os.getuid() or (os.setgroups([]), os.setgid({NOBODY}), os.setuid({NOBODY}))\n"
            "print([eddies.cli.main(command) for command in json.loads(sys.argv[1])])")
    ended = subprocess.run([sys.executable, "-c", code, json.dumps(commands), built_in], stdin=subprocess.DEVNULL,
                           text=True, timeout=60, capture_output=True)
    return json.loads(ended.stdout), ended.stderr.splitlines()


@pytest.fixture
def open_to_all():
    """A folder that every user can enter; those of pytest are the owner's."""
    folder = Path(tempfile.mkdtemp())
    folder.chmod(0o755)
    yield folder
    shutil.rmtree(folder)


def test_files_that_may_not_be_read_or_written(open_to_all):
    from eddies.scene.scene import load_scene
    assert program("dns", "abc", "--set", "time.duration=0.1", "--output", open_to_all).returncode == 0
    (open_to_all / "abc.toml").write_text(load_scene("abc").to_toml())  # in place of the built-in one
    (open_to_all / "case.toml").write_text(TEXT)
    for name in ("ground_truth.h5", "case.toml"):
        (open_to_all / name).chmod(0o600)
    folder = str(open_to_all)
    cases = [
        (["report", folder], f"{folder}: cannot be written; change its permissions, or choose another directory"),
        (["export", folder], "ground_truth.h5: cannot be read: Permission denied; check its permissions"),
        (["check", f"{folder}/case.toml"], "case.toml: cannot be read: Permission denied; give the path"),
        (["dns", "abc", "--output", folder], f"{folder}: cannot be written; change its permissions"),
        (["dns", "abc", "--output", f"{folder}/new"], "new: cannot be written (Permission denied); choose another")]
    codes, errors = as_nobody([command for command, _ in cases], open_to_all)
    assert codes == [2] * len(cases) == [2] * len(errors)
    for line, (_, told) in zip(errors, cases):
        assert line.startswith("eddies: error: ") and told in line


@pytest.mark.parametrize("unbuffered", ["1", ""])
@pytest.mark.parametrize("command", [["scenes"], ["scenes", "tiny"], ["--help"], ["--version"]], ids=" ".join)
def test_standard_output_that_takes_nothing(command, unbuffered):
    with open("/dev/full", "w") as full:
        ended = program(*command, stdout=full, env={**os.environ, "PYTHONUNBUFFERED": unbuffered})
    assert ended.returncode == 2
    assert ended.stderr == ("eddies: error: cannot write to standard output: No space left on device; make room, or "
                            "send it elsewhere\n")


def test_a_run_goes_on_where_its_lines_cannot_be_written(tmp_path):
    with open("/dev/full", "w") as full:
        ended = program("dns", "abc", "--set", "time.duration=0.1", "--output", tmp_path, stdout=full)
    assert ended.returncode == 2 and ended.stderr.startswith("eddies: error: cannot write to standard output: ")
    assert ended.stderr.count("\n") == 1 and (tmp_path / "ground_truth.h5").exists()


@pytest.mark.parametrize("encoding", ["ascii", "latin-1"])
def test_an_encoding_without_the_letters(encoding, tmp_path):
    (tmp_path / "case.toml").write_text(TEXT.replace('title = "', 'title = "λ ≤ η '), encoding="utf-8")
    environment = {**os.environ, "PYTHONIOENCODING": encoding}
    ended = program("scenes", tmp_path / "case.toml", stdout=subprocess.PIPE, env=environment)
    assert (ended.returncode, ended.stderr) == (0, "") and 'title = "\\u03bb \\u2264 \\u03b7 ' in ended.stdout


@contextlib.contextmanager
def a_simulation(directory, *before):
    """A direct simulation that is on its way."""
    line = [*before, sys.executable, "-u", "-m", "eddies", "dns", "hit-small", "--output", directory]
    # A shell's background job ignores the interrupt, and hands that down.
    job = subprocess.Popen(list(map(str, line)), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
                           stderr=subprocess.PIPE, text=True, start_new_session=True,
                           preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL))
    try:
        while "dns: starts" not in job.stdout.readline():
            pass
        yield job
    finally:
        if job.poll() is None:
            job.kill()
        job.communicate()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_an_interrupt_stops_at_the_next_step(tmp_path, number):
    with a_simulation(tmp_path) as job:
        job.send_signal(number)
        errors = job.communicate(timeout=30)[1].splitlines()
    assert job.returncode == 75 and errors[-1].startswith(f"eddies: stopped by {number.name}; the same command goes on")
    assert errors[:-1] == ["eddies: stops after this step; a second interrupt ends it at once"] * (
        number == signal.SIGINT)
    assert not list(tmp_path.rglob("*.partial"))


def test_a_second_interrupt_ends_at_once():
    code = ("import signal, time\nfrom eddies import cli\ncli.catch_signals()\nsignal.raise_signal(signal.SIGINT)\n"
            "print('goes on', flush=True)\nsignal.raise_signal(signal.SIGINT)\ntime.sleep(30)\n")
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=20)
    assert (ended.returncode, ended.stdout) == (-signal.SIGINT, "goes on\n")


@pytest.mark.parametrize("number", [signal.SIGUSR1, signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_a_signal_at_the_very_end_changes_nothing(number):
    """As one that another rank was given a moment before; this one comes once Python has taken its handlers back."""
    code = ("import ctypes, sys\nfrom eddies import cli\ncli.catch_signals()\n"
            "send = getattr(ctypes.CDLL(None), 'raise')\nclass Last:\n"
            f"    def __del__(self, send=send): send({int(number)})\nsys.last = Last()\nsys.exit(75)\n")
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=20)
    assert (ended.returncode, ended.stderr) == (75, "")


@pytest.mark.parametrize("where", ["a pipe without a reader", "closed"])
def test_an_interrupt_that_cannot_be_answered_is_noted(tmp_path, where):
    """Where standard error is closed, another file has its number."""
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


def test_a_signal_that_is_ignored_stays_ignored():
    """As by nohup, and by a shell that starts a job in the background."""
    code = ("import signal\nfrom eddies import cli\nsignal.signal(signal.SIGHUP, signal.SIG_IGN)\n"
            "received = cli.catch_signals()\nsignal.raise_signal(signal.SIGHUP)\nprint(received)\n")
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (ended.returncode, ended.stdout) == (0, "[]\n")


def test_an_interrupt_within_code_of_a_string_is_one_like_others(tmp_path):
    (tmp_path / "job.py").write_text("from eddies import cli\n"
                                     "cli.run = lambda arguments: exec('raise KeyboardInterrupt')\n"
                                     "raise SystemExit(cli.main([]))\n")
    ended = subprocess.run([sys.executable, "-m", "job"], cwd=tmp_path, capture_output=True, text=True)
    assert (ended.returncode, ended.stderr) == (130, "eddies: interrupted\n")


def test_an_interrupted_job_of_two_ranks_ends(tmp_path):
    with a_simulation(tmp_path, sys.executable, LAUNCHER, "-n", 2, "--") as job:
        os.killpg(job.pid, signal.SIGINT)  # as the keyboard does
        errors = job.communicate(timeout=30)[1]
    assert job.returncode == 130 and errors.endswith("interrupted\n") and "Traceback" not in errors


@pytest.mark.mpi(1)
def test_a_flow_that_overflows_is_told_without_the_warnings_of_numpy(comm, tmp_path, capfd):
    assert "the flow is not finite. Correct what it starts from: amplitude or path" in refused(
        capfd, comm, "dns", TINY, "--set", "initial.amplitude=1e6", "--set", "forcing.injection_rate=0",
        "--set", "spin_up.turnovers=1e-4", "--output", tmp_path)


@pytest.mark.mpi(1)
def test_a_supersonic_flow_is_told_as_such(comm, tmp_path, capfd):
    told = refused(capfd, comm, "dns", TINY, "--set", "flow.sound_speed=0.5", "--output", tmp_path)
    assert "The flow is supersonic, its turbulent Mach number was 4.3, and shocks are not resolved: raise" in told
    assert not list(tmp_path.rglob("*.partial"))


@pytest.mark.mpi(1)
def test_warnings_of_libraries_are_a_line(comm, capfd):
    import warnings

    from eddies.logs import show_warnings
    show_warnings()
    warnings.warn("of a kind\n that has lines", stacklevel=1)
    assert capfd.readouterr().err.startswith("eddies: warning: of a kind that has lines (test_bad_input.py, line ")


def test_years_are_told_as_such():
    from eddies.clock import duration
    assert duration(86400 * 365.25 * 1.2e30) == "1.2e+30 years" and duration(7500) == "2 h 05 min"
    assert json.dumps(duration(1e300)) == '"3.2e+292 years"'
