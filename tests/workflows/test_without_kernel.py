"""A scene without [kernel]: nothing averages over neighbours, and what only that could tell is left out and said."""

import json

import pytest

from eddies.io.hdf5 import open_product
from eddies.parallel.stop import StopRequest
from eddies.scene.scene import load_scene
from eddies.stages import run_stages

SCENE = """
[flow]
fluid = "incompressible"
cells = 12
viscosity = 0.1
[tracers]
particles_per_side = 6
turnovers = 0.14
frame_interval = 0.02
field_every = 1
field_cells = 8
[model]
preset = "resolved"
[training]
window = 1
frames = 2
batch = 60
steps = 2
[simulation]
step = 0.02
turnovers = 0.05
frame_interval = 0.04
start = 0.3
"""


@pytest.mark.usefixtures("undrawn", "quick_spectra")
@pytest.mark.mpi(1, 2)
def test_a_model_is_trained_run_and_reported(comm, tmp_path):
    if comm.rank == 0:
        (tmp_path / "own.toml").write_text(SCENE)
    comm.Barrier()
    scene = load_scene(tmp_path / "own.toml")
    assert scene.stages == ("dns", "train", "simulate", "report")
    run_stages(scene.stages, scene, comm, tmp_path, StopRequest(comm))
    assert not (tmp_path / "kernel.h5").exists()
    with open_product(comm, tmp_path / "rollout.h5", "rollout") as file:
        assert "fields" not in file and set(file["particles"]) == {"model"}
    metrics = json.loads((tmp_path / "report" / "metrics.json").read_text())["rollout"]
    assert 0 < metrics["velocity_error"] < 1
    assert metrics["qr_kl"] is metrics["qr_kl_floor"] is None and metrics["spectrum_error"] > 0
    page = (tmp_path / "report" / "index.html").read_text()
    assert "there is no kernel.h5" in page and "Fig. 6" in page and "Fig. 7" not in page
