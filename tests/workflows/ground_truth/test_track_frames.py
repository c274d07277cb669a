"""Frames of measured tracks: times, gaps, short tracks, noise, and the place in the periodic cube."""

import json
import logging

import h5py
import numpy as np
import pytest

from eddies import write_tracks
from eddies.io.errors import ProductError
from eddies.scene.scene import SceneError, load_scene
from eddies.scene.sections import Columns, Tracks
from eddies.workflows.ground_truth.track_frames import read_measured, surest
from eddies.workflows.run_directory.fingerprints import stage_fingerprint

pytestmark = pytest.mark.mpi(1)

COUNT, STEP = 30, 0.01


def waves(frames, seed=1):
    """Time, track, position and velocity of particles in the unit cube that swing about their places by 0.1."""
    draw = np.random.default_rng(seed)
    start, phase = draw.uniform(0.2, 0.8, (COUNT, 3)), draw.uniform(0, 2 * np.pi, (COUNT, 3))
    frame, track = (part.ravel() for part in np.meshgrid(frames, np.arange(COUNT), indexing="ij"))
    angle = 20 * STEP * frame[:, None] + phase[track]
    return STEP * frame, track, start[track] + 0.1 * np.sin(angle), 2 * np.cos(angle)


def written(path, rows, keep=None, velocity=False):
    time, track, position, speed = rows if keep is None else (part[keep] for part in rows)
    write_tracks(path, time, track, position, speed if velocity else None, edge=1.0)


def logged(caplog, words):
    return [line for line in caplog.messages if words in line]


def test_short_gaps_are_filled_and_long_ones_divide_a_track(tmp_path, caplog):
    caplog.set_level(logging.INFO, "eddies")
    rows = waves(np.arange(20))
    frame, track = np.rint(rows[0] / STEP), rows[1]
    lost = ((track == 0) & np.isin(frame, (5, 6)) | (track == 1) & np.isin(frame, (5, 6, 7)) | (frame == 12)
            | (track == 2) & (frame > 1))
    written(tmp_path / "a.h5", rows, ~lost)
    found = read_measured(Tracks(path=str(tmp_path / "a.h5")))
    assert len(found.times) == 20 and found.complete == COUNT - 2  # not tracks 1 and 2; no track has a row in frame 12
    counts = np.bincount(found.columns["id"])
    assert counts[0] == 20 and counts[1] == 5 and counts[2] == 0 and counts[-1] == 12 and (counts > 0).sum() == COUNT
    exact = dict(zip(zip(frame, track), rows[3]))
    for number in (5, 12):
        own = found.frame(number)
        known = own["id"] < COUNT
        true = np.array([exact[number, each] for each in own["id"][known]])
        error = own["velocity"][known] * found.about["length_unit"] - true
        assert np.sqrt(np.mean(error**2) / np.mean(true**2)) < 0.02
    for words in ("1 tracks are divided", f"{COUNT - 1 + 2} rows are added", "1 tracks of fewer than three rows"):
        assert logged(caplog, words), words
    with pytest.raises(SceneError, match=r"at time 0.12 \(1 frames; 1 such gaps in all\)"):
        read_measured(Tracks(path=str(tmp_path / "a.h5"), longest_gap=0))


def test_two_recordings_are_named_by_their_gap(tmp_path):
    rows = waves(np.append(np.arange(8), 300.4 + np.arange(8)))
    for velocity in (False, True):
        written(tmp_path / "a.h5", rows, velocity=velocity)
        with pytest.raises(SceneError, match=r"at time 0.08 to 2.994 \(29[23] frames; .* or several recordings"):
            read_measured(Tracks(path=str(tmp_path / "a.h5")))


def test_a_lost_frame_of_tracks_with_velocities_has_a_remedy(tmp_path):
    rows = waves(np.append(np.arange(5), 6 + np.arange(5)))
    written(tmp_path / "a.h5", rows, velocity=True)
    with pytest.raises(SceneError, match='0.05 .*or set noise = "auto", so that splines fill the gaps'):
        read_measured(Tracks(path=str(tmp_path / "a.h5")))
    assert len(read_measured(Tracks(path=str(tmp_path / "a.h5"), noise="auto")).times) == 11


@pytest.mark.parametrize("rate", [240, 300, 350, 444])
@pytest.mark.parametrize("frames, first", [(8, 0.0), (40, 12.3456)])
def test_times_rounded_to_milliseconds_are_equal_frames(tmp_path, caplog, rate, frames, first):
    caplog.set_level(logging.INFO, "eddies")
    rows = waves(np.arange(frames))
    rounded = (first + rows[0] / STEP / rate).round(3)
    written(tmp_path / "a.h5", (rounded, *rows[1:]))
    found = read_measured(Tracks(path=str(tmp_path / "a.h5")))
    # Errors of up to half a millisecond change the slope of a line by up to 1.5 ms / frames.
    np.testing.assert_allclose(found.times, np.arange(frames) / rate, rtol=1.5e-3 / frames * rate)
    assert logged(caplog, "times are rounded to 0.001")


@pytest.mark.parametrize("frame", [1, 10, 18])
def test_a_frame_that_is_late_is_not_taken_for_rounding(tmp_path, frame):
    rows = waves(np.arange(20))
    late = rows[0] + np.where(np.rint(rows[0] / STEP) == frame, 0.004, 0)
    written(tmp_path / "a.h5", (late, *rows[1:]))
    with pytest.raises(SceneError, match="frames at equal intervals are needed"):
        read_measured(Tracks(path=str(tmp_path / "a.h5")))


@pytest.mark.parametrize("noise", [0.0, 2e-3])
def test_noise_of_positions_is_estimated_and_said(tmp_path, caplog, noise):
    caplog.set_level(logging.INFO, "eddies")
    time, track, position, velocity = waves(np.arange(40))
    position = position + noise * np.random.default_rng(2).standard_normal(position.shape)
    rows = time, track, position, velocity
    written(tmp_path / "a.h5", rows)
    found = read_measured(Tracks(path=str(tmp_path / "a.h5")))
    assert found.about["noise"] == pytest.approx(noise, rel=0.1)
    assert (found.about["velocity_noise"] > 0) == (noise > 0)
    errors, middle = found.velocity_errors, len(found.times) // 2
    assert errors.shape == (len(found.times), 2) and (errors > 0).all() == errors.any() == (noise > 0)
    if noise:  # all tracks begin and end together
        assert (errors[[0, -1]] > 2 * errors[middle]).all() and 0 < surest(errors) < len(errors) - 1
    assert logged(caplog, "noise of a coordinate is about 0.00" if noise else "too small to be estimated")
    written(tmp_path / "a.h5", rows, velocity=True)  # velocities that were measured are taken
    taken = read_measured(Tracks(path=str(tmp_path / "a.h5")))
    assert "noise" not in taken.about and not taken.velocity_errors.any() and surest(taken.velocity_errors) == 0
    assert read_measured(Tracks(path=str(tmp_path / "a.h5"), noise="auto")).about["noise"] == found.about["noise"]


def test_the_volume_is_that_of_the_data_and_rows_beyond_by_the_noise_are_kept(tmp_path, caplog):
    caplog.set_level(logging.INFO, "eddies")
    noise = 2e-3
    time, track, position, velocity = waves(np.arange(40))
    position += noise * np.random.default_rng(2).standard_normal(position.shape)
    written(tmp_path / "a.h5", (time, track, position, velocity))
    lower, upper = position.min(0), position.max(0)
    bounds = np.ravel([lower, upper], "F")
    found = read_measured(Tracks(path=str(tmp_path / "a.h5"), volume="auto", margin=0.5))
    assert 2 * np.pi * found.about["length_unit"] == pytest.approx((upper - lower).max() + 0.5)
    assert logged(caplog, f"volume = [{lower[0]:.6g}, {upper[0]:.6g}, {lower[1]:.6g}")
    inner = bounds + noise * np.tile([1, -1], 3)
    assert len(read_measured(Tracks(path=str(tmp_path / "a.h5"), volume=tuple(inner))).throughout) == len(time)
    inner = bounds + 20 * noise * np.tile([1, -1], 3)
    with pytest.raises(ProductError, match="outside the volume"):
        read_measured(Tracks(path=str(tmp_path / "a.h5"), volume=tuple(inner)))
    written(tmp_path / "a.h5", (time, track, position * [1, 1, 0], velocity))
    with pytest.raises(SceneError, match='volume = "auto": .* has the same z in all rows'):
        read_measured(Tracks(path=str(tmp_path / "a.h5"), volume="auto"))


@pytest.mark.parametrize("shift", [0, -0.5])
def test_positions_that_leave_the_box_are_wrapped(tmp_path, shift):
    """Tracks go on outside of the box, at any place of the file's origin in it."""
    time, track, position, velocity = waves(np.arange(10))
    drift = np.array([3.0, -4.0, 0.0])
    position = position + shift + 5 * time[:, None] * drift
    written(tmp_path / "a.h5", (time, track, position, velocity))
    found = read_measured(Tracks(path=str(tmp_path / "a.h5"), noise=0))
    off = found.columns["position"] * found.about["length_unit"] - position
    np.testing.assert_allclose(off, np.rint(off), atol=1e-4)
    assert np.abs(np.rint(off)).max() >= 2
    written(tmp_path / "a.h5", (time, track, 1.3 * (position % 1), velocity))  # wrapped into another box
    with pytest.raises(ProductError, match="outside the box"):
        read_measured(Tracks(path=str(tmp_path / "a.h5"), noise=0))


def test_the_box_of_the_file_is_kept(tmp_path):
    rows = waves(np.arange(10))
    written(tmp_path / "a.h5", (rows[0], rows[1], (rows[2] + 5 * rows[0][:, None]) % 1, rows[3]))
    path = str(tmp_path / "a.h5")
    assert read_measured(Tracks(path=path, box=1 + 1e-9)).about["corner"].tolist() == [0, 0, 0]
    with pytest.raises(SceneError, match="box = 1.01: .*a.h5 has a periodic box of the edge 1; remove box"):
        read_measured(Tracks(path=path, box=1.01))
    with pytest.raises(SceneError, match="volume: tracks of .*a.h5 jump from face to face .*; remove volume"):
        read_measured(Tracks(path=path, volume="auto"))


def test_the_origin_of_lagrangebench_is_kept(tmp_path):
    position = waves(np.arange(10))[2].reshape(10, COUNT, 3) - 3
    (tmp_path / "metadata.json").write_text(json.dumps({"dt": STEP, "bounds": [[-3, -2]] * 3}))
    with h5py.File(tmp_path / "test.h5", "w") as file:
        file["00000/position"] = position
    found = read_measured(Tracks(path=str(tmp_path / "test.h5"), noise=0))
    np.testing.assert_allclose(found.about["corner"], 3)
    np.testing.assert_allclose(found.frame(9)["position"] * found.about["length_unit"] - 3, position[9], atol=1e-9)


def test_a_series_of_files_beside_the_scene(tmp_path):
    """Each file is a frame; the content of each of them counts, and their number."""
    time, track, position, _ = waves(np.arange(4))
    (tmp_path / "data").mkdir()
    for frame in range(4):
        own = time == STEP * frame
        np.savetxt(tmp_path / f"data/f{frame + 9}.txt", np.column_stack([track[own], position[own]]))
    (tmp_path / "a.toml").write_text('[tracks]\npath = "data/f*.txt"\nbox = 1\nframe_rate = 100\n'
                                     'columns = {track = 1, x = 2, y = 3, z = 4}\n')
    scene = load_scene(tmp_path / "a.toml")
    assert scene.tracks.columns == Columns(track=1, x=2, y=3, z=4) and load_scene(tmp_path / "a.toml") == scene
    found = read_measured(scene.tracks)
    np.testing.assert_allclose(found.times, STEP * np.arange(4))
    assert found.complete == COUNT
    before = stage_fingerprint(scene, "dns")
    assert stage_fingerprint(load_scene(tmp_path / "a.toml"), "dns") == before
    (tmp_path / "data/f12.txt").rename(tmp_path / "data/f13.txt")
    assert stage_fingerprint(scene, "dns") != before
    with pytest.raises(SceneError, match="at time 0.12"):
        read_measured(load_scene(tmp_path / "a.toml", ["tracks.longest_gap=0"]).tracks)
