import numpy as np
import pytest

from eddies.parallel.migration import IdOrder, Migration, ParticleLossError, Redistribution, census, migrate, wrap
from eddies.parallel.slab import SlabDecomposition

LENGTH = 2 * np.pi


def scattered(comm, total, seed=3):
    """Particles on arbitrary ranks, some of them outside the box."""
    random = np.random.default_rng(seed)
    position = random.uniform(-LENGTH, 2 * LENGTH, (total, 3))
    own = np.arange(total) % comm.size == comm.rank
    return {"id": np.arange(total)[own], "position": position[own], "tensor": (position[own, :, None] * [1.0, 2.0]),
            "flag": position[own, 0].astype(np.float32)}, position


@pytest.mark.mpi(1, 2, 3)
@pytest.mark.parametrize("total", [100, 1])
def test_every_particle_arrives_where_it_is_with_all_its_columns(comm, total):
    columns, position = scattered(comm, total)
    slab = SlabDecomposition(comm, LENGTH, 7)
    moved = migrate(slab, columns)
    assert np.all((moved["position"][:, 2] >= slab.lower) & (moved["position"][:, 2] < slab.upper))
    assert np.array_equal(moved["position"], wrap(position[moved["id"]], LENGTH))
    assert np.array_equal(moved["tensor"], position[moved["id"]][:, :, None] * [1.0, 2.0])
    assert moved["flag"].dtype == np.float32
    assert census(comm, moved["id"])[0] == total


@pytest.mark.mpi(1, 3)
def test_the_adjoint_sends_each_row_back(comm):
    columns, _ = scattered(comm, 50)
    for order in (Migration(SlabDecomposition(comm, LENGTH, 7), columns["id"], wrap(columns["position"], LENGTH)),
                  IdOrder(comm, columns["id"], 50)):
        for name, column in columns.items():
            back = order.adjoint(order.apply(column))
            assert back.dtype == column.dtype and np.array_equal(back, column), name


@pytest.mark.mpi(1, 3)
def test_order_by_id_restores_the_ids_from_any_distribution(comm):
    columns, position = scattered(comm, 50)
    order = IdOrder(comm, columns["id"], 50)
    assert np.array_equal(order.apply(columns["position"]), position[order.start : order.stop])


@pytest.mark.mpi(1, 2)
def test_a_missing_id_is_noticed(comm):
    ids = np.arange(10)[np.arange(10) % comm.size == comm.rank]
    # On two ranks each loses an id of its block, so that both raise and neither waits.
    wrong = np.where(ids == 4, 3, ids) if comm.size == 1 else np.where(ids == 2 + comm.rank, 7 - comm.rank, ids)
    with pytest.raises(ParticleLossError):
        IdOrder(comm, wrong, 10)


@pytest.mark.mpi(3)
@pytest.mark.parametrize("spoil", [
    lambda ids: ids[ids != 4],
    lambda ids: np.where(ids == 4, 5, ids),
    lambda ids: np.where(ids == 1, 2, np.where(ids == 4, 3, ids)),
], ids=["lost", "replaced", "two replaced by two of the same sum"])
def test_what_happens_to_a_particle_on_its_way_is_noticed_by_all_ranks(comm, monkeypatch, spoil):
    sound = Redistribution.apply

    def spoiled(self, column):
        moved = sound(self, column)
        return spoil(moved) if moved.dtype == np.int64 else moved

    monkeypatch.setattr(Redistribution, "apply", spoiled)
    columns, _ = scattered(comm, 40)
    with pytest.raises(ParticleLossError, match="exclusive-or of ids"):
        migrate(SlabDecomposition(comm, LENGTH, 7), columns)


def test_wrapping_never_returns_the_upper_bound():
    assert wrap(np.array([-1e-20, LENGTH, -LENGTH]), LENGTH).tolist() == [0.0, 0.0, 0.0]
