"""What moves the particles of a rollout."""

from __future__ import annotations

from typing import Any, Protocol

import torch

from eddies.io.checkpoint import Checkpoint
from eddies.particles.particle_set import ParticleSet


class Method(Protocol):
    """What moves the particles of a rollout, made as Class(scene, truth, start, directory, device) where `start` is the
    frame of the ground truth that it starts from. All methods are collective.

    `state_dict` and `load_state_dict` may be missing: a rollout that is stopped then begins anew.
    """

    has_density: bool  # of the particles of its frames

    time: float  # of its particles, since the start

    def advance(self, until: float, number: int) -> str | None:
        """Take a step, the `number`-th of the run, that ends at a time or before it, or beyond it where `frame` can
        look back; what is wrong with the state after it, on all ranks, or None."""

    def frame(self, time: float) -> tuple[ParticleSet, torch.Tensor]:
        """The particles at a time that the last step reached, in any order, and their acceleration (n, 3)."""

    def status(self) -> str:
        """What the progress line shows of it beside time and energy."""

    def series(self) -> dict[str, dict[str, list[float]]]:
        """Tables for the product, with a value in each column for each call of `frame`."""

    def description(self) -> dict[str, float | str]:
        """The settings of what moves the particles, for the attributes of the product."""

    def state_dict(self) -> dict[str, Any]:
        """All that goes on after the frames of the steps so far, as `CheckpointDirectory.write` takes it; no name
        begins with "rollout"."""

    def load_state_dict(self, saved: Checkpoint) -> None:
        """Go on from a checkpoint, made on any number of ranks; on the same number bit for bit."""
