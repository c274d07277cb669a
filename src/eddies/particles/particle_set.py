"""The particles a rank owns."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True)
class ParticleSet:
    """Columns of the particles owned by this rank, one row a particle; ghosts are never part of it.

    Parameters
    ----------
    id : int64 (n,), unique over all ranks.
    position : (n, 3), x, y, z; in double precision.
    velocity : (n, 3).
    density : (n,); None where nothing reads it.

    Raises ValueError if the columns differ in length or a shape is wrong.
    """

    id: Tensor
    position: Tensor
    velocity: Tensor
    density: Tensor | None = None

    def __post_init__(self) -> None:
        count = len(self.id)
        expected = {"id": (count,), "position": (count, 3), "velocity": (count, 3), "density": (count,)}
        for name, column in self.columns().items():
            shape, needed = tuple(column.shape), expected[name]
            if shape != needed:
                raise ValueError(f"particle {name} of shape {shape}: {needed} is needed")

    def __len__(self) -> int:
        return len(self.id)

    def columns(self) -> dict[str, Tensor]:
        """The columns that there are, by name."""
        return {name: column for name, column in vars(self).items() if column is not None}

    def to_numpy(self) -> dict[str, np.ndarray]:
        """The same, detached, as arrays of the host."""
        return {name: as_numpy(column) for name, column in self.columns().items()}

    @classmethod
    def from_numpy(cls, columns: dict[str, np.ndarray], device: torch.device | str = "cpu") -> ParticleSet:
        """Inverse of `to_numpy`; columns that are no part of a particle set are left out."""
        return cls(**{field.name: torch.as_tensor(columns[field.name]).to(device) for field in fields(cls)
                      if field.name in columns})


def as_numpy(tensor: Tensor) -> np.ndarray:
    """The values of a tensor as an array of the host, without its history."""
    return tensor.detach().cpu().numpy()
