import json
import os

import h5py
import numpy as np
import pytest

from eddies.cli import main
from eddies.errors import UserError
from eddies.io.checkpoint import CheckpointDirectory
from eddies.io.hdf5 import create_product
from eddies.scene.scene import load_scene
from eddies.workflows.diff import diff_lines
from eddies.workflows.run_directory.fingerprints import stage_fingerprint, stage_provenance
from eddies.workflows.status import status_lines
from tests.commands import run_cli
from tests.small_scene import TINY
from tests.workflows.synthetic_run import write_ground_truth, write_kernel, write_rollout


def write_scene(directory, *changes):
    directory.mkdir(parents=True, exist_ok=True)
    scene = load_scene(TINY, changes)
    (directory / "scene.toml").write_text(scene.to_toml())
    return scene


@pytest.mark.mpi(1)
def test_the_state_of_every_stage(comm, tmp_path, capfd):
    scene = write_scene(tmp_path / "one")
    checkpoints = CheckpointDirectory(comm, tmp_path / "one/checkpoints-train", stage_fingerprint(scene, "train"))
    checkpoints.write(20, {"weights": np.ones(3)})
    checkpoints.write(40, {"weights": np.ones(3)})
    with create_product(comm, tmp_path / "one/ground_truth.h5", "ground_truth", stage_provenance(scene, "dns")):
        pass
    before = load_scene(TINY, ["kernel.steps=7"])
    with create_product(comm, tmp_path / "one/kernel.h5", "kernel", stage_provenance(before, "train-kernel")):
        pass
    (tmp_path / "one/stage_seconds.json").write_text('{"dns": 75.0}')
    write_scene(tmp_path / "more/two")
    assert main(["status", str(tmp_path)]) == 0
    first, second = capfd.readouterr().out.split(str(tmp_path / "one"))
    assert "more/two" in first and first.count("to do") == 5
    lines = {line.split()[0]: line for line in second.splitlines()[1:]}
    assert "complete" in lines["dns"] and "1 min 15 s" in lines["dns"]
    assert "made with other settings (kernel.steps = 7, now 100)" in lines["train-kernel"]
    assert "stopped at step 40, can continue" in lines["train"] and lines["simulate"].endswith("to do")
    (tmp_path / "one/scene.toml").write_text("[flow]\n")
    assert "[flow]" in next(status_lines(tmp_path / "one"))
    with pytest.raises(UserError, match="holds no run"):
        list(status_lines(tmp_path / "nowhere"))


def test_settings_and_numbers_that_differ(tmp_path):
    one, other = tmp_path / "one", tmp_path / "other"
    write_scene(one)
    write_scene(other, "training.steps=90", "simulation.step=0.05")
    lines = [line.split() for line in diff_lines((one, None), (other, None))]
    assert "`eddies" in lines[-1] and ["training.steps", "60", "90"] in lines
    assert not any("flow.cells" in line for line in lines)
    for path, error in ((one, 0.2), (other, 0.1)):
        (path / "report").mkdir()
        numbers = {"warnings": [], "rollouts": {path.name: {"error": error, "same": 1.0}},
                   "rows": [{"name": path.name, "energy": error}]}
        (path / "report/metrics.json").write_text(json.dumps(numbers))
    lines = [line.split() for line in diff_lines((one, None), (other, None))]
    assert ["rollouts.error", "0.2", "0.1", "0.5"] in lines and ["row.energy", "0.2", "0.1", "0.5"] in lines
    assert not any("rollouts.same" in line for line in lines)
    assert diff_lines((one, None), (one, None)) == ["no setting differs", "", "no number differs"]
    (one / "a").mkdir()
    (one / "a/rollout.h5").touch()
    os.utime(one / "a/rollout.h5", ((one / "report/metrics.json").stat().st_mtime + 9,) * 2)
    assert [line for line in diff_lines((one, None), (other, None)) if "is older than the products" in line] == [
        f"{one / 'report/metrics.json'}: is older than the products; run `eddies report {one}`"]


@pytest.mark.mpi(1)
def test_variants_of_one_run_are_compared(comm, tmp_path, capfd):
    (tmp_path / "scene.toml").write_text(f'base = "{TINY}"\n[variant.a]\n[variant.b]\nsimulation.step = 0.05\n')
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        scene = load_scene(tmp_path / "scene.toml").variant[name]
        (tmp_path / name / "scene.toml").write_text(scene.to_toml())
    assert main(["diff", str(tmp_path), "--variant", "a", "--variant", "b"]) == 0
    assert ["simulation.step", "0.08", "0.05"] in [line.split() for line in capfd.readouterr().out.splitlines()]
    assert main(["diff", str(tmp_path)]) == 2
    assert "give two runs" in capfd.readouterr().err
    assert main(["diff", str(tmp_path), str(tmp_path / "nowhere")]) == 2
    assert f"{tmp_path / 'nowhere'}: is not a run" in capfd.readouterr().err
    assert main(["status", str(tmp_path)]) == 0
    lines = [line.split() for line in capfd.readouterr().out.splitlines()]
    assert ["b:", "simulate", "to", "do"] in lines and ["dns", "to", "do"] in lines and len(lines) == 7
    (tmp_path / "report").mkdir()
    for name, made in (("report/index.html", 1000), ("b/rollout.h5", 2000)):
        (tmp_path / name).touch()
        os.utime(tmp_path / name, (made, made))
    assert "older than the products" in list(status_lines(tmp_path))[-1]


@pytest.mark.mpi(2)
def test_damaged_products_are_found(comm, tmp_path, capfd):
    """Also of variants. A link is not another product, and a product of an older version has no checksums."""
    if comm.rank == 0:
        alone = comm.Create_group(comm.group.Incl([0]))
        write_scene(tmp_path)
        (tmp_path / "a").mkdir()
        write_ground_truth(alone, tmp_path, frames=3)
        (tmp_path / "a/ground_truth.h5").symlink_to("../ground_truth.h5")
        write_kernel(alone, tmp_path)
        with h5py.File(tmp_path / "kernel.h5", "r+") as file:
            file["of an older version"] = np.ones(3)
        write_rollout(alone, tmp_path / "a")
    comm.Barrier()

    def verified(code):
        assert run_cli("status", tmp_path, "--verify") == code
        output, errors = capfd.readouterr()
        return [line for line in output.splitlines() if line.startswith(f"{tmp_path}/")], errors

    rest = [f"{tmp_path / 'ground_truth.h5'}: not damaged",
            f"{tmp_path / 'kernel.h5'}: has no checksums, because an earlier version made it"]
    lines, _ = verified(0)
    assert lines == ([f"{tmp_path / 'a/rollout.h5'}: not damaged", *rest] if comm.rank == 0 else [])
    comm.Barrier()
    if comm.rank == 0:
        with h5py.File(tmp_path / "a/rollout.h5") as file:
            place = file["particles/model/velocity/value"].id.get_chunk_info_by_coord((4, 0, 0)).byte_offset
        with open(tmp_path / "a/rollout.h5", "r+b") as file:
            file.seek(place + 5000)
            file.write(b"other bytes")
    comm.Barrier()
    lines, errors = verified(2)
    if comm.rank == 0:
        assert lines[0].startswith(f"{tmp_path / 'a/rollout.h5'}: the file is damaged: ")
        assert "particles/model/velocity/value, frame 4" in lines[0]
        assert "damaged" in lines[0] and "`eddies simulate`" in lines[0]
        assert lines[1:] == rest and "1 of 3 products are damaged" in errors
    for command in ("report", "export"):
        assert run_cli(command, tmp_path / "a") == 2
        errors = capfd.readouterr().err
        assert comm.rank > 0 or "particles/model/velocity/value, frame 4" in errors.splitlines()[-1]
