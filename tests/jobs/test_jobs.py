"""The job scripts, run in a made-up checkout where `mpirun` and `eddies` only print their arguments.

test_slurm.py runs those of Slurm on a Slurm."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from mpi_tools.launch import local_cores

CHECKOUT = Path(__file__).parents[2]
SCRIPTS = sorted([*CHECKOUT.glob("jobs/*.sh"), *CHECKOUT.glob("mpi_tools/*.sh"), CHECKOUT / ".ci/run"])
SCHEDULERS = {"slurm": "#SBATCH --signal=USR1@", "pbs": "--signal=USR1 ", "lsf": "#BSUB -wa USR1",
              "flux": "--signal=USR1@"}


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.name)
def test_syntax(script):
    subprocess.run(["bash", "-n", script], check=True)


def test_schedulers_differ_in_header_and_launcher_only():
    def body(name):
        lines = (CHECKOUT / f"jobs/{name}.sh").read_text().splitlines()
        return [line for line in lines if line and not re.match(r"#|launcher=|resubmit=", line)]
    assert len(body("slurm")) == 5
    for name, warning in SCHEDULERS.items():
        assert body(name) == body("slurm"), name
        assert warning in (CHECKOUT / f"jobs/{name}.sh").read_text()
    assert body("hit-paper.slurm")[-5:] == body("slurm")


@pytest.fixture
def checkout(tmp_path):
    """A copy of jobs/ and of the launcher, with stand-ins for the set-up, mpirun and eddies."""
    shutil.copytree(CHECKOUT / "jobs", tmp_path / "jobs")
    (tmp_path / "mpi_tools").mkdir()
    shutil.copy(CHECKOUT / "mpi_tools/launch.py", tmp_path / "mpi_tools")
    for name, text in {"mpi_tools/bootstrap.sh": "true", "bin/mpirun": 'echo "mpirun $*"; shift 2; "$@"',
                       ".venv/bin/eddies": '[ "$1" != check ] || { echo "$CHECKED"; exit ${CHECK_ENDS_WITH:-0}; }\n'
                                           'echo "eddies $*; threads $OMP_NUM_THREADS"',
                       ".venv/bin/python": f'exec {sys.executable} "$@"'}.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"#!/bin/sh\n{text}\n")
        path.chmod(0o755)
    return tmp_path


def run(checkout, script, *arguments, **variables):
    ours = {name: value for name, value in os.environ.items() if not re.match("EDDIES_|OMP_|PBS_|SLURM_", name)}
    path = f"{checkout / 'bin'}:{os.environ['PATH']}"
    return subprocess.run(["bash", checkout / "jobs" / script, *arguments], cwd=checkout, text=True,
                          capture_output=True, timeout=60,
                          env=ours | {"PATH": path, "CHECKED": '{"most_ranks": 8}'} | variables)


@pytest.mark.parametrize("scene, variables, ranks", [
    (["abc.toml"], {"EDDIES_RANKS": "1000"}, local_cores()), ([], {}, min(8, local_cores())),
    ([], {"CHECKED": '{"most_ranks": 1}'}, 1)])
def test_local_runs_on_the_cores_or_as_many_ranks_as_the_scene_can_use(checkout, scene, variables, ranks):
    result = run(checkout, "local.sh", *scene, "--set", "seed=2", **variables)
    assert result.returncode == 0, result.stderr
    assert f"mpirun -n {ranks} " in result.stdout
    assert f"eddies run {(scene or ['hit-small'])[0]} --set seed=2; threads 1\n" in result.stdout


@pytest.mark.parametrize("variables, error", [
    ({"CHECKED": "", "CHECK_ENDS_WITH": "2"}, ""), ({"EDDIES_RANKS": "0"}, "EDDIES_RANKS"),
    ({"EDDIES_RANKS": "two"}, "two")])
def test_local_refuses_a_wrong_scene_or_number_of_ranks(checkout, variables, error):
    result = run(checkout, "local.sh", "abc.toml", **variables)
    assert result.returncode == 2 and error in result.stderr
    assert "Traceback" not in result.stderr and "mpirun" not in result.stdout


def test_large_job_fits_the_scene():
    # Every rank has planes, and the ranks of a node fit its memory. The comment names the most ranks of later stages.
    from eddies.scene.scene import load_scene
    from eddies.workflows.estimates import flow_memory, most_ranks
    text = (CHECKOUT / "jobs/hit-paper.slurm.sh").read_text()
    scene, asked = load_scene("hit-paper"), dict(re.findall(r"^#SBATCH --([a-z-]+)=(\S+)", text, re.MULTILINE))
    on_node = int(asked["ntasks-per-node"])
    ranks = int(asked["nodes"]) * on_node
    assert scene.flow.cells % ranks == 0
    assert ranks <= min(most_ranks(scene.ground_truth_alone).values())
    assert 1.1 * on_node * flow_memory(scene.flow, scene.tracers, ranks) < 1e9 * int(asked["mem"].removesuffix("G"))
    most = min(most_ranks(scene).values())
    assert f"at most {most} ranks" in text
    assert int(re.search(r"--ntasks-per-node=(\d+) jobs/slurm.sh", text)[1]) <= most
