"""Whether the frames of a ground truth are enough for what a scene makes of them: counting alone, known before a run.

`frames` is the number of frames, `at_fields` are those at whose time a filtered field is stored.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from eddies.scene.scene import Scene, SceneError, Training

# The share of the training window, at its end, that is held out for validation; no less than the longest horizon.
HELD_OUT = 0.1
# Filtered fields that the kernel is trained on; frames of the a-priori test, and particles of which it keeps the rates.
KERNEL_FIELDS, TESTED_FRAMES, TESTED_PARTICLES = 4, 9, 20_000


def check_frames(stages: Sequence[str], scene: Scene, seen: float, frames: int) -> None:
    """Refuse a scene of which one of these stages finds too few frames; `seen` is the fraction that the model is
    trained on."""
    at_fields = range(0, frames, scene.tracers.field_every)
    if "train" in stages:
        if scene.model.path is None and seen > 0:
            trained_frames(scene.training, frames, at_fields)
        between_frames(frames, at_fields)
    if "simulate" in stages:
        rollout_start(scene, seen, frames, at_fields)


def last_seen(window: float, frames: int) -> int:
    """The last frame of the training window, a fraction of the ground truth."""
    return max(int(window * (frames - 1)), 1)


def last_trained_on(settings: Training, frames: int) -> int:
    """The last frame that a model is trained on: those behind it in the window are for validation.

    Raises SceneError where too few are left.
    """
    last = last_seen(settings.window, frames)
    longest = max(settings.horizons.frames) if settings.horizons else 0
    held_out = max(math.ceil(HELD_OUT * last), longest, 2)  # rates need a frame on both sides
    if last - held_out - longest < 2:
        raise SceneError(
            f"[training] window = {settings.window:g}: holds {last} frames of the ground truth, too few "
            f"with {held_out} held out for validation and horizons of {longest}; raise it or [tracers] "
            "turnovers, or lower [tracers] frame_interval or [training.horizons] frames")
    return last - held_out


def trained_frames(settings: Training, frames: int, at_fields: Sequence[int]) -> tuple[list[int], int]:
    """The frames that can be trained on, and the last of those held out: all up to `last_trained_on` and the last but
    one of the window; of them, where the field loss compares with the flow, those with a filtered field one frame
    later.

    Raises SceneError where too few are left.
    """
    learned, last = last_trained_on(settings, frames), last_seen(settings.window, frames)
    fields = set(at_fields)
    usable = [frame for frame in range(1, last) if not settings.wants_fields or frame + 1 in fields]
    trained, held_out = ([frame for frame in usable if (frame <= learned) == seen] for seen in (True, False))
    if not trained or not held_out:
        raise SceneError('[training] field_target = "flow": no filtered field is stored one frame after any that is '
                         f"{'held out' if trained else 'trained on'}; lower [tracers] field_every, or set "
                         'field_target = "tracers"')
    return trained, held_out[-1]


def between_frames(frames: int, at_fields: Sequence[int]) -> list[int]:
    """The frames at times of filtered fields that have frames on both sides. Raises SceneError if there is none."""
    usable = [frame for frame in at_fields if 0 < frame < frames - 1]
    if not usable:
        raise SceneError("[tracers] field_every: no filtered field is stored between the first and the last frame; "
                         "lower it, or raise [tracers] turnovers")
    return usable


def rollout_start(scene: Scene, seen: float, frames: int, at_fields: Sequence[int]) -> int:
    """The first frame with a filtered field at or after the moment that the scene asks for, or else after what the
    model has `seen`, a fraction of them.

    Raises SceneError if none follows that leaves a frame of the ground truth to compare with.
    """
    wanted = _frame_at(scene.simulation.start, seen, frames)
    last = frames - 2 - round(scene.simulation.frame_interval / scene.tracers.frame_interval)
    usable = [frame for frame in at_fields if wanted <= frame <= last]
    if not usable:
        raise SceneError(f"[simulation] start: after frame {wanted} of {frames} no filtered field is followed by "
                         f"ground truth to compare with, {scene.simulation.frame_interval:g} later; lower start, "
                         "frame_interval, [training] window or [tracers] field_every, or raise [tracers] turnovers")
    return usable[0]


def whole_frames(scene: Scene, frames: int) -> set[int]:
    """The frames at which the unfiltered state is stored, for coarse grids to start from: with filtered fields, where
    its rollouts start, and where they start earliest."""
    fractions = () if scene.simulation is None else (0.0, scene.simulation.start)
    # Where nothing of it is trained on, rollouts start earliest.
    every, seen = scene.tracers.field_every, scene.training.window if scene.training else 0.0
    return {math.ceil(_frame_at(fraction, seen, frames) / every) * every for fraction in fractions}


def whole_cells(cutoff: int) -> int:
    """Cells along each side, an even number, of the smallest grid that holds all modes of a flow up to a wavenumber."""
    return 2 * cutoff + 2


def _frame_at(fraction: float | None, seen: float, frames: int) -> int:
    """The frame, not the first, at a fraction of the ground truth; the end of what is trained on, another fraction, for
    None."""
    return max(last_seen(seen, frames) if fraction is None else int(fraction * (frames - 1)), 1)
