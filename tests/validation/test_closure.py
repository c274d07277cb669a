"""The program that measures the closure, on a small flow."""

import pytest
from closure import figure, measure
from flows import WITH_TRACERS
from matplotlib.figure import Figure

from eddies.scene.scene import load_scene
from eddies.workflows import dns


@pytest.mark.mpi(1)
def test_errors_over_wavenumbers_and_iterations(comm, tmp_path):
    (tmp_path / "scene.toml").write_text(WITH_TRACERS)
    dns.run(load_scene(tmp_path / "scene.toml"), comm, tmp_path)
    found = measure(tmp_path, shares=(0.75, 1.25), iterations=(2, 20))
    coarse, fine = (error for error, _ in found["by_weight"]["100"])
    # The coarse one has most of this flow of few scales already.
    assert fine < 0.7 * coarse < 0.5 and found["by_iterations"][1] < found["by_iterations"][0]
    assert all(len(rows) == 2 for rows in (found["gradient"], *found["by_weight"].values()))
    assert isinstance(figure({"a run": found}), Figure)
