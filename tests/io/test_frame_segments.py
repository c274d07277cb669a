"""Segments of frames."""

import numpy as np
import pytest

from eddies.io.fields import FieldSeries
from eddies.io.frame_segments import FieldLayout, FrameLayout, FrameSegments, TrajectoryLayout
from eddies.io.hdf5 import create_product, open_product
from eddies.io.trajectories import Trajectory
from eddies.parallel.migration import id_block
from eddies.parallel.slab import SlabDecomposition

LAYOUT = FrameLayout(1.0, {"all": TrajectoryLayout(5, {"velocity": (3,), "density": ()}),
                           "some": TrajectoryLayout(4, {"density": ()})}, np.float32,
                     {"flow": FieldLayout(3, {"velocity": 2}), "finer": FieldLayout(4, {"density": 1})})


@pytest.mark.mpi(1, 3)
def test_images_are_counted_over_all_segments(comm, tmp_path):
    """A particle goes far out of the box and back, segment by segment, on whichever rank its row is; another stays."""
    layout = FrameLayout(2.0, {"model": TrajectoryLayout(2, {"position": (3,)})}, np.float64, {})
    paths = np.stack([np.outer([0, 1, 2, 3, 4, 3, 2, 1], [0.7, -0.9, 0.3]), np.zeros((8, 3))], axis=1) + 1.0
    start, stop = id_block(comm, 2)
    with FrameSegments(comm, tmp_path, layout) as segments:
        for step, frame in enumerate(paths):
            segments.open(step)
            segments.trajectories["model"].append(step, step / 4, start, {"position": frame[start:stop] % 2.0})
            if step % 2:
                segments.close()
    with create_product(comm, tmp_path / "all.h5", "rollout", {}) as file:
        segments.assemble(file)
    with open_product(comm, tmp_path / "all.h5", "rollout") as file:
        found = Trajectory(file, "model")
        for step, frame in enumerate(paths):
            assert np.allclose(found.read(step, "position") + 2.0 * found.read(step, "image"), frame)


@pytest.mark.mpi(1, 3)
def test_frames_of_all_segments_are_put_together_in_order(comm, tmp_path):
    """Also those of a trajectory, or of fields, of which a segment has none; all series, or some under other names."""
    (start, stop), (first, last) = id_block(comm, 5), id_block(comm, 4)
    slab, finer = SlabDecomposition(comm, 1.0, 3), SlabDecomposition(comm, 1.0, 4)
    frames = np.random.default_rng(2).random((4, 5, 3)).astype(np.float32)
    planes = np.random.default_rng(3).random((2, 2, 3, 3, 3)).astype(np.float32)
    with FrameSegments(comm, tmp_path, LAYOUT) as segments:
        for step, frame in enumerate(frames):
            segments.open(step)
            block = frame[start:stop]
            segments.trajectories["all"].append(step, step / 4, start, {"velocity": block, "density": block[:, 0]})
            if step >= 2:
                segments.trajectories["some"].append(step, step / 4, first, {"density": frame[first:last, 1]})
                segments.fields["flow"].append(step / 4, slab.start, {
                    "velocity": planes[step - 2][:, slab.start:slab.stop]})
            if step == 3:
                points = np.arange(64.0).reshape(1, 4, 4, 4)
                segments.fields["finer"].append(0.75, finer.start, {"density": points[:, finer.start:finer.stop]})
            if step in (0, 1):
                segments.close()
                segments.close()
    # As a run finds them that goes on; the last is not yet closed.
    assert segments.names == ["frames-00000000.h5", "frames-00000001.h5"]
    again = FrameSegments(comm, tmp_path, LAYOUT, [*segments.names, "frames-00000002.h5"])
    for (time, columns), step in zip(again.first_frames("all", 2), range(2)):
        assert time == step / 4 and np.array_equal(columns["velocity"], frames[step][start:stop])
    with create_product(comm, tmp_path / "all.h5", "rollout", {}) as file:
        again.assemble(file)
    with open_product(comm, tmp_path / "all.h5", "rollout") as file:
        whole, some, flow = Trajectory(file, "all"), Trajectory(file, "some"), FieldSeries(file, "flow")
        assert whole.steps.tolist() == [0, 1, 2, 3] and some.times.tolist() == flow.times.tolist() == [0.5, 0.75]
        for frame in range(4):
            assert np.array_equal(whole.read(frame, "velocity"), frames[frame])
        assert np.array_equal(some.read(1, "density"), frames[3][:4, 1])
        assert np.array_equal(flow.read(1, "velocity"), planes[1])
        assert np.array_equal(FieldSeries(file, "finer").read(0, "density"), points)
    with create_product(comm, tmp_path / "part.h5", "rollout", {}) as file:
        again.assemble(file, {"some": "few", "flow": "flow"})
    with open_product(comm, tmp_path / "part.h5", "rollout") as file:
        assert [*file["particles"]] == ["few"] and [*file["fields"]] == ["flow"]
        assert np.array_equal(Trajectory(file, "few").read(1, "density"), frames[3][:4, 1])
