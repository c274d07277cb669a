"""Where torch computes."""

import pytest
import torch

from eddies.errors import UserError
from eddies.particles.devices import prepare_torch


@pytest.mark.mpi(1)
def test_a_gpu_that_is_not_there_is_the_user_s_to_do_without(comm, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(UserError, match='device = "cuda": torch finds no GPU here; set device = "cpu"'):
        prepare_torch("cuda", comm)
