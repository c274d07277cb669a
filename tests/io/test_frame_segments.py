"""Segments of frames."""

import numpy as np
import pytest

from eddies.io.frame_segments import FrameLayout, FrameSegments
from eddies.io.hdf5 import ProductError


@pytest.mark.mpi(1, 2, timeout=30)
def test_a_directory_that_cannot_be_made_is_told_by_all(comm, tmp_path):
    segments = FrameSegments(comm, tmp_path / "nowhere/checkpoints", FrameLayout(8, 1.0, {}, np.float64, 4, {}))
    with pytest.raises(ProductError, match="nowhere/checkpoints: No such file or directory; check the file"):
        segments.open(0)
