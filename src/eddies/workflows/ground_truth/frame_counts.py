"""Choose the frames of a ground truth that each stage uses, and check that there are enough.

In all functions, `frames` is the number of frames of the ground truth, and `field_frames` are the numbers of the frames
with a filtered field. The training window is the first part of the ground truth; `seen` is the share of the ground
truth that it covers.
"""

import math
from collections.abc import Sequence

from eddies.scene.scene import Scene, SceneError, Simulation, Tracers, Training

HELD_OUT = 0.1               # share of the training window, at its end, that is for validation
KERNEL_FIELDS = 4            # filtered fields that the kernel is trained on
TESTED_FRAMES, TESTED_PARTICLES = 9, 20_000  # frames of the a-priori test; particles whose rates it stores


def check_frames(stages: Sequence[str], scene: Scene, seen: float, frames: int) -> None:
    """Raise SceneError if there are too few frames for one of the `stages` of a scene."""
    field_frames = range(0, frames, scene.tracers.field_every)
    if "train" in stages:
        if scene.own_training is not None and seen > 0:
            trained_frames(scene.own_training, frames, field_frames)
        between_frames(frames, field_frames)
    if "simulate" in stages:
        rollout_start(scene.simulation, scene.tracers, seen, frames, field_frames)


def last_seen(window: float, frames: int) -> int:
    """Return the last frame of the training window; 0 if there is none. `window` is the share of the ground truth that
    the window covers."""
    return max(int(window * (frames - 1)), 1) if window > 0 else 0


def last_trained_on(settings: Training, frames: int) -> int:
    """Return the last frame that a model is trained on. The later frames of the window are for validation.

    Raises SceneError if too few frames remain for training.
    """
    last = last_seen(settings.window, frames)
    longest = settings.longest_horizon
    held_out = max(math.ceil(HELD_OUT * last), longest, 2)  # rates need a frame on both sides
    if last - held_out - longest < 2:
        raise SceneError(
            f"[training] window = {settings.window:g}: holds {last + 1} frames; too few remain for training, "
            f"because {held_out} are for validation, and the longest horizon takes {longest}; raise window or "
            "[tracers] turnovers, or lower [tracers] frame_interval or [training.horizons] frames")
    return last - held_out


def trained_frames(settings: Training, frames: int, field_frames: Sequence[int]) -> tuple[list[int], int]:
    """Return the frames for training, and the last frame for validation.

    If the field loss compares with the flow (`Training.wants_fields`), there is a filtered field one frame after each
    of these frames. Raises SceneError if no frame remains for training or for validation.
    """
    learned, last = last_trained_on(settings, frames), last_seen(settings.window, frames)
    fields = set(field_frames)
    usable = [frame for frame in range(1, last) if not settings.wants_fields or frame + 1 in fields]
    trained, held_out = ([frame for frame in usable if (frame <= learned) == seen] for seen in (True, False))
    if not trained or not held_out:
        raise SceneError('[training] field_target = "flow": this needs a filtered field one frame later, but no frame '
                         f"for {'validation' if trained else 'training'} has one; lower [tracers] field_every, or set "
                         'field_target = "tracers"')
    return trained, held_out[-1]


def between_frames(frames: int, field_frames: Sequence[int]) -> list[int]:
    """Return the frames that have a filtered field, without the first and the last frame of the ground truth.

    Raises SceneError if there is none.
    """
    usable = [frame for frame in field_frames if 0 < frame < frames - 1]
    if not usable:
        raise SceneError("[tracers] field_every: no filtered field is stored between the first and the last frame; "
                         "lower it, or raise [tracers] turnovers")
    return usable


def rollout_start(settings: Simulation, tracers: Tracers, seen: float, frames: int, field_frames: Sequence[int]) -> int:
    """Return the frame at which a rollout starts: the first one with a filtered field at or after [simulation] start.

    Without this key, it is the first one at or after the end of the training window. Raises SceneError if the ground
    truth ends before the next frame of the rollout.
    """
    wanted = _frame_at(settings.start, seen, frames)
    last = frames - 2 - round(settings.frame_interval / tracers.frame_interval)
    usable = [frame for frame in field_frames if wanted <= frame <= last]
    if not usable:
        raise SceneError(f"[simulation] start: the rollout needs a frame with a filtered field and one more frame "
                         f"interval ({settings.frame_interval:g}) after it, but there is none from frame {wanted} of "
                         f"{frames} on; lower start, frame_interval, [training] window or [tracers] field_every, or "
                         "raise [tracers] turnovers")
    return usable[0]


def unfiltered_frames(settings: Simulation | None, training: Training | None, every: int, frames: int) -> set[int]:
    """Return the frames that store the unfiltered flow, from which rollouts on coarse grids start.

    They are the frame at [simulation] start, and frame 1. Rollouts start at frame 1 if no model is trained on this
    ground truth. Both are rounded up to a frame with a filtered field, that is, to a multiple of `every`.
    """
    starts, seen = (0.0, settings.start) if settings else (), training.window if training else 0.0
    return {math.ceil(_frame_at(start, seen, frames) / every) * every for start in starts}


def whole_cells(cutoff: int) -> int:
    """Return the smallest even number of cells along a side with which a grid holds all modes up to `cutoff`."""
    return 2 * cutoff + 2


def _frame_at(fraction: float | None, seen: float, frames: int) -> int:
    """Return the frame at this `fraction` of the ground truth, at least frame 1. None means the end of the training
    window."""
    return max(last_seen(seen if fraction is None else fraction, frames), 1)
