import json
import os

import numpy as np
import pytest

from eddies.cli import main
from eddies.errors import UserError
from eddies.io.checkpoint import CheckpointDirectory
from eddies.io.hdf5 import create_product
from eddies.scene.scene import load_scene
from eddies.workflows.diff import diff_lines
from eddies.workflows.status import status_lines


def write_scene(directory, *changes):
    directory.mkdir(parents=True, exist_ok=True)
    scene = load_scene("tiny", changes)
    (directory / "scene.toml").write_text(scene.to_toml())
    return scene


@pytest.mark.mpi(1)
def test_what_there_is_of_every_stage_is_told(comm, tmp_path, capfd):
    scene = write_scene(tmp_path / "one")
    checkpoints = CheckpointDirectory(comm, tmp_path / "one/checkpoints-train", scene.fingerprint("train"))
    checkpoints.write(40, {"weights": np.ones(3)})
    with create_product(comm, tmp_path / "one/ground_truth.h5", "ground_truth", scene.provenance("dns")):
        pass
    before = load_scene("tiny", ["kernel.steps=7"])
    with create_product(comm, tmp_path / "one/kernel.h5", "kernel", before.provenance("train-kernel")):
        pass
    (tmp_path / "one/stage_seconds.json").write_text('{"dns": 75.0}')
    write_scene(tmp_path / "more/two")
    assert main(["status", str(tmp_path)]) == 0
    first, second = capfd.readouterr().out.split(str(tmp_path / "one"))
    assert "more/two" in first and first.count("to do") == 5
    lines = {line.split()[0]: line for line in second.splitlines()[1:]}
    assert "complete" in lines["dns"] and "1 min 15 s" in lines["dns"]
    assert "made with other settings (kernel.steps = 7, now 100)" in lines["train-kernel"]
    assert lines["train"].endswith("stopped at step 40, goes on") and lines["simulate"].endswith("to do")
    (tmp_path / "one/scene.toml").write_text("[flow]\n")
    assert "[flow]" in next(status_lines(tmp_path / "one"))


@pytest.mark.mpi(1)
def test_a_directory_without_a_run_is_told(tmp_path):
    with pytest.raises(UserError, match="holds no run; make one with `eddies run SCENE`"):
        list(status_lines(tmp_path / "nowhere"))


@pytest.mark.mpi(1)
def test_settings_and_numbers_that_differ(tmp_path):
    one, other = tmp_path / "one", tmp_path / "other"
    write_scene(one)
    write_scene(other, "training.steps=90", "simulation.step=0.05")
    told = "\n".join(diff_lines(one, other))
    assert "no numbers to compare: `eddies report" in told and "flow.cells" not in told
    assert ["training.steps", "60", "90"] in [line.split() for line in told.splitlines()]
    for path, error in ((one, 0.2), (other, 0.1)):
        (path / "report").mkdir()
        numbers = {"warnings": [], "rollout": {"error": error, "same": 1.0}}
        (path / "report/metrics.json").write_text(json.dumps(numbers))
    lines = [line.split() for line in diff_lines(one, other)]
    assert ["rollout.error", "0.2", "0.1", "0.5"] in lines and not any("rollout.same" in line for line in lines)
    assert list(diff_lines(one, one)) == ["no setting differs", "", "no number differs"]


@pytest.mark.mpi(1)
def test_variants_of_one_run_are_told_apart(comm, tmp_path, capfd):
    (tmp_path / "scene.toml").write_text('base = "tiny"\n[variant.a]\n[variant.b]\nsimulation.step = 0.05\n')
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        scene = load_scene(tmp_path / "scene.toml").variant[name]
        (tmp_path / name / "scene.toml").write_text(scene.to_toml())
    assert main(["diff", str(tmp_path), "--variant", "a", "--variant", "b"]) == 0
    assert ["simulation.step", "0.08", "0.05"] in [line.split() for line in capfd.readouterr().out.splitlines()]
    assert main(["diff", str(tmp_path)]) == 2
    assert "give two runs, or one run and --variant twice" in capfd.readouterr().err
    assert main(["status", str(tmp_path)]) == 0
    lines = [line.split() for line in capfd.readouterr().out.splitlines()]
    assert ["b:", "simulate", "to", "do"] in lines and ["dns", "to", "do"] in lines and len(lines) == 7
    (tmp_path / "report").mkdir()
    for name, made in (("report/index.html", 1000), ("b/rollout.h5", 2000)):
        (tmp_path / name).touch()
        os.utime(tmp_path / name, (made, made))
    assert "older than the products" in list(status_lines(tmp_path))[-1]
