"""The particles of a rank."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True)
class ParticleSet:
    """Columns of the particles that this rank owns, one row per particle, without ghosts.

    Parameters
    ----------
    id : int64 (n,), unique over all ranks.
    position : (n, 3), x, y, z, in double precision.
    velocity : (n, 3).
    density : (n,); None if no term reads it.

    Raises ValueError if a column has another shape.
    """

    id: Tensor
    position: Tensor
    velocity: Tensor
    density: Tensor | None = None

    def __post_init__(self) -> None:
        count = len(self.id)
        expected = {"id": (count,), "position": (count, 3), "velocity": (count, 3), "density": (count,)}
        for name, column in self.columns().items():
            if tuple(column.shape) != expected[name]:
                raise ValueError(f"particle {name} of shape {tuple(column.shape)}: must be {expected[name]}")

    def __len__(self) -> int:
        return len(self.id)

    def columns(self) -> dict[str, Tensor]:
        return {name: column for name, column in vars(self).items() if column is not None}

    def to_numpy(self) -> dict[str, np.ndarray]:
        """The existing columns as arrays on the host, without gradients."""
        return {name: as_numpy(column) for name, column in self.columns().items()}

    @classmethod
    def from_numpy(cls, columns: dict[str, np.ndarray], device: torch.device | str = "cpu") -> ParticleSet:
        """Inverse of `to_numpy`; further columns are ignored."""
        return cls(**{field.name: torch.as_tensor(columns[field.name]).to(device) for field in fields(cls)
                      if field.name in columns})


def as_numpy(tensor: Tensor) -> np.ndarray:
    """Values of a tensor as an array on the host, without gradients."""
    return tensor.detach().cpu().numpy()
