"""Segments of frames."""

import pytest

from eddies.io.hdf5 import ProductError
from eddies.scene.scene import load_scene
from eddies.workflows.ground_truth.frame_segments import FrameSegments


@pytest.mark.mpi(1, 2, timeout=30)
def test_a_directory_that_cannot_be_made_is_told_by_all(comm, tmp_path):
    segments = FrameSegments(comm, tmp_path / "nowhere/checkpoints", load_scene("tiny").tracers, compressible=False)
    with pytest.raises(ProductError, match="nowhere/checkpoints: No such file or directory; check the file"):
        segments.open(0)
