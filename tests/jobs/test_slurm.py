"""The job scripts of Slurm, on a Slurm that is started for these tests."""

import re
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.jobs.slurm import Slurm, missing

CHECKOUT = Path(__file__).parents[2]
STEPS, STEP = 40, 0.001
pytestmark = pytest.mark.skipif(bool(missing()), reason=missing())


@pytest.fixture(scope="module")
def slurm(tmp_path_factory):
    with Slurm(tmp_path_factory.mktemp("slurm")) as slurm:
        yield slurm


def end(slurm, job):
    """The record and the output of a job, after its end."""
    slurm.wait(lambda: slurm.job(job)["JobState"] not in ("PENDING", "RUNNING", "COMPLETING"), f"job {job}")
    return slurm.job(job), slurm.output(job)


def test_job_is_stopped_queued_again_and_goes_on(slurm, tmp_path):
    run = tmp_path / "a run"
    job = slurm.submit("--ntasks-per-node=2", CHECKOUT / "jobs/slurm.sh", "--verbose", "--set", "flow.cells=32",
                       "--set", f"time.step={STEP}", "--set", f"time.duration={STEPS * STEP}", EDDIES_SCENE="abc",
                       EDDIES_OUTPUT=str(run), EDDIES_CHECKOUT=str(CHECKOUT), OMPI_MCA_mpi_yield_when_idle="1")
    slurm.wait(lambda: "step 3 " in slurm.output(job), "the third step")
    slurm.ask("scancel", "--signal=USR1", str(job))  # what --signal does, but for the time
    known, output = end(slurm, job)
    assert (known["JobState"], known["Restarts"]) == ("COMPLETED", "1"), output
    before, after = output.split("stopped by SIGUSR1; the same command continues from ")
    reached = int(re.match(r"step (\d+)\n", after)[1])
    assert "dns: starts on 2 ranks" in before and f"dns: continues from step {reached}, " in after
    assert [int(step) for step in re.findall(r"dns  step (\d+) ", after)] == list(range(reached + 1, STEPS + 1))
    with h5py.File(run / "ground_truth.h5") as file:
        time, energy = file["statistics/time"][:], file["statistics/energy"][:]
    assert time[0] == 0 and np.isclose(time[-1], STEPS * STEP) and np.all(np.diff(time) > 0)
    assert np.allclose(energy, 1.5 * np.exp(-0.2 * time), rtol=1e-8)


@pytest.fixture
def checkout(tmp_path):
    """A copy of jobs/ with an eddies that prints its arguments, in a folder whose name has a space."""
    folder = tmp_path / "check out"
    shutil.copytree(CHECKOUT / "jobs", folder / "jobs")
    eddies = folder / ".venv/bin/eddies"
    eddies.parent.mkdir(parents=True)
    eddies.write_text('#!/bin/sh\necho "eddies $*; threads $OMP_NUM_THREADS"\neval "$ENDS_WITH"\n')
    eddies.chmod(0o755)
    return folder


def test_job_is_queued_again_after_a_stop_alone(slurm, checkout):
    # The ranks get the environment of the script even if --export names single variables. SIGUSR1 ends ranks that are
    # still starting.
    def submit(script, ends_with, *arguments):
        return slurm.submit("--nodes=1", "--ntasks-per-node=1", "--cpus-per-task=2", "--mem=0",
                            "--export=EDDIES_CHECKOUT,EDDIES_SCENE,ENDS_WITH", checkout / "jobs" / script, *arguments,
                            EDDIES_CHECKOUT=str(checkout), EDDIES_SCENE="hit", ENDS_WITH=ends_with)

    jobs = {(script, ends_with): submit(script, ends_with, "--set", "seed=2")
            for script in ("slurm.sh", "hit-paper.slurm.sh") for ends_with in ("exit 2", "exit 75", "kill -USR1 $$")}
    for (script, ends_with), job in jobs.items():
        slurm.wait(lambda: "eddies" in slurm.output(job) and slurm.job(job)["JobState"] in ("FAILED", "PENDING"),
                   f"{script} {ends_with}")
        known, command = slurm.job(job), "run hit" if script == "slurm.sh" else "dns hit-paper"
        assert f"eddies {command} --set seed=2; threads 2\n" in slurm.output(job)
        if ends_with == "exit 2":
            assert (known["JobState"], known["ExitCode"]) == ("FAILED", "2:0")
        else:
            assert (known["JobState"], known["Restarts"]) == ("PENDING", "1"), slurm.output(job)
            slurm.ask("scancel", str(job))


def test_job_that_is_submitted_elsewhere_names_the_remedy(slurm):
    job = slurm.submit("--ntasks-per-node=1", CHECKOUT / "jobs/slurm.sh")
    known, output = end(slurm, job)
    assert known["ExitCode"] == "2:0"
    assert f"{slurm.folder}/jobs/run.sh" in output and "EDDIES_CHECKOUT" in output
