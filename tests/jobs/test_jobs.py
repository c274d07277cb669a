"""The job scripts, run in a made-up checkout where `mpirun` and `eddies` only say what they were asked; those of Slurm
run on one (test_slurm.py)."""

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
    """A copy of jobs/ and of the launcher beside stand-ins for the set-up, mpirun and eddies."""
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


@pytest.mark.parametrize("asked, ranks", [("1", 1), ("1000", local_cores()), (None, min(8, local_cores()))])
def test_local_runs_on_the_cores_or_fewer(checkout, asked, ranks):
    result = run(checkout, "local.sh", **({"EDDIES_RANKS": asked} if asked else {}))
    assert result.returncode == 0, result.stderr
    assert f"mpirun -n {ranks} " in result.stdout
    assert "eddies run hit-small; threads 1\n" in result.stdout


def test_local_starts_no_more_ranks_than_the_scene_can_use(checkout):
    result = run(checkout, "local.sh", "tiny", CHECKED='{"most_ranks": 1}')
    assert "mpirun -n 1 " in result.stdout and "eddies run tiny" in result.stdout


def test_local_ends_with_what_is_wrong_with_the_scene(checkout):
    result = run(checkout, "local.sh", "tiny", CHECKED="", CHECK_ENDS_WITH="2")
    assert result.returncode == 2 and "Traceback" not in result.stderr and "mpirun" not in result.stdout


def test_local_passes_scene_and_options_on(checkout):
    for given, scene in ((["abc.toml"], "abc.toml"), ([], "hit-small")):
        result = run(checkout, "local.sh", *given, "--set", "seed=2")
        assert f"eddies run {scene} --set seed=2; " in result.stdout


@pytest.mark.parametrize("asked", ["0", "-2", "two"])
def test_local_refuses_a_wrong_number_of_ranks(checkout, asked):
    result = run(checkout, "local.sh", EDDIES_RANKS=asked)
    assert result.returncode == 2
    assert f'EDDIES_RANKS = "{asked}"' in result.stderr


def asked_of_slurm(script):
    """What the header of a job script asks for."""
    return dict(re.findall(r"^#SBATCH --([a-z-]+)=(\S+)", (CHECKOUT / "jobs" / script).read_text(), re.MULTILINE))


def test_large_job_fits_the_scene():
    # Ranks that all work on planes of their own, ghost planes included, in the memory of a node; those of the stages
    # that follow, of which the comment speaks, are no more than they can use.
    from eddies.scene.scene import load_scene
    from eddies.workflows.foreseen.ranks import ground_truth_alone, most_ranks
    from eddies.workflows.foreseen.storage import flow_memory
    scene, asked = load_scene("hit-paper"), asked_of_slurm("hit-paper.slurm.sh")
    on_node = int(asked["ntasks-per-node"])
    ranks = int(asked["nodes"]) * on_node
    assert scene.flow.cells % ranks == 0
    assert ranks <= min(most_ranks(ground_truth_alone(scene)).values())
    assert 1.1 * on_node * flow_memory(scene, ranks) < 1e9 * int(asked["mem"].removesuffix("G"))
    text = (CHECKOUT / "jobs/hit-paper.slurm.sh").read_text()
    most = min(most_ranks(scene).values())
    assert f"at most {most} ranks" in text
    assert int(re.search(r"--ntasks-per-node=(\d+) jobs/slurm.sh", text)[1]) <= most
