"""The programs of tests/benchmarks run."""

from pathlib import Path

import numpy as np
import pytest
import torch

from eddies.scene.terms import PRESETS


@pytest.mark.mpi(1)
@pytest.mark.parametrize("preset", PRESETS)
def test_a_step_of_each_preset_can_be_timed(comm, monkeypatch, preset):
    """The table of performance has a row for each system, above all for the published one."""
    monkeypatch.syspath_prepend(Path(__file__).parent / "benchmarks")
    from particle_step import Run
    with torch.no_grad():
        run = Run(comm, 8, preset, "float32")
        before = run.particles.position.clone()
        run.advance()
    assert 0 < run.step < np.inf and not torch.equal(run.particles.position, before)
    assert torch.isfinite(run.particles.velocity).all()
