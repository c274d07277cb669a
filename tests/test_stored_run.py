import os
import warnings

import numpy as np
import pytest

import eddies
from eddies.io import datasets
from eddies.io.checksums import open_to_read
from eddies.io.fields import FieldWriter
from eddies.io.hdf5 import create_product
from tests.left_out import leave_out_figures
from tests.workflows.synthetic_run import LENGTH, write_run


@pytest.fixture
def directory(comm, tmp_path):
    """The products of a synthetic run."""
    write_run(comm, tmp_path)
    return tmp_path


@pytest.mark.mpi(1)
def test_groups_are_datasets_that_are_read_on_access(directory):
    run = eddies.open_run(directory)
    assert run.products == ("ground_truth", "kernel", "model", "rollout")
    assert {"rollout/particles/model", "ground_truth/statistics", "kernel/errors"} <= set(run.groups)
    model = run["rollout/particles/model"]
    assert model["velocity"].dims == ("time", "particle", "xyz") and model["velocity"].attrs["units"] == "L/T"
    assert list(model["xyz"].values) == ["x", "y", "z"] and model["time"].attrs["units"] == "T"
    # Values are those of the file for any order of indices, and nothing is read before.
    assert not model["velocity"].variable._in_memory
    with open_to_read(directory / "rollout.h5") as file:
        whole = file["particles/model/velocity/value"][()]
    chosen = model["velocity"].isel(time=-1, particle=[5, 2, 2])
    assert np.array_equal(chosen, whole[-1, [5, 2, 2]])
    assert np.array_equal(model["velocity"].sel(xyz="y")[:, 3], whole[:, 3, 1])


@pytest.mark.mpi(1)
@pytest.mark.parametrize("with_xarray", [True, False])
def test_trajectories_fields_and_spectra(directory, monkeypatch, with_xarray):
    if not with_xarray:
        monkeypatch.setattr(datasets, "xarray", None)
    run = eddies.open_run(directory)
    ids, all_of_them = [7, 3], run.trajectories(of="truth")
    some = run.trajectories(ids, of="truth", unwrapped=True)
    position, whole = (np.asarray(found["position"]) for found in (some, all_of_them))
    assert np.array_equal(some["id"] if isinstance(some, dict) else some["particle"], ids)
    # Unwrapped positions start in the cube, differ by whole edges, and are continuous.
    assert np.array_equal(position[0], whole[0, ids])
    turns = (position - whole[:, ids]) / LENGTH
    assert np.abs(turns - np.rint(turns)).max() < 1e-6 and np.abs(np.diff(position, axis=0)).max() < LENGTH / 2
    field, first = run.field(of="model"), run.field(of="model", time=0.0)
    assert field.shape[0] == 3 and field.ndim == 4 and not np.array_equal(field, first)
    if with_xarray:
        assert field.dims == ("component", "z", "y", "x")
        assert float(field["x"][1]) == pytest.approx(LENGTH / field.sizes["x"])
    energy = run.spectrum("filtered")
    assert float(np.asarray(energy).sum()) > 0 and run.spectrum("truth", time=0.0).ndim == 1


@pytest.mark.mpi(1)
def test_a_scalar_field_has_no_components(comm, tmp_path):
    fields = {"velocity": np.random.default_rng(1).random((3, 4, 4, 4)), "density": np.full((1, 4, 4, 4), 1.5)}
    with create_product(comm, tmp_path / "ground_truth.h5", "ground_truth", {}) as file:
        FieldWriter(file, "filtered", 4, {"velocity": 3, "density": 1}).append(0.5, 0, fields)
    run = eddies.open_run(tmp_path)
    assert run.field("density").dims == ("z", "y", "x") and float(run.field("density")[1, 2, 3]) == 1.5
    assert np.array_equal(run.field("velocity", time=0.4), fields["velocity"].astype(np.float32))


@pytest.mark.mpi(1)
@pytest.mark.usefixtures("undrawn")
def test_figures_are_those_of_the_report(comm, directory, monkeypatch):
    from eddies.workflows import report
    with monkeypatch.context() as patch:
        leave_out_figures(patch)
        report.run(directory, comm)
    run = eddies.open_run(directory)
    assert {f"{name}.png" for name in run.figures} == {path.name for path in (directory / "report/figures").iterdir()}
    assert all(figure.axes for figure in run.figures.values())
    assert run.metrics["rollouts"][directory.name]["energy_ratio"] > 0


@pytest.mark.mpi(1)
def test_missing_parts_are_errors(directory, tmp_path):
    with pytest.raises(eddies.UserError, match="holds none of ground_truth.h5"):
        eddies.open_run(tmp_path / "nowhere")
    run = eddies.open_run(directory)
    last = run.trajectories().sizes["particle"] - 1
    for ask, words in ((lambda: run["rollout/forces"], "no forces.*particles/model"),
                       (lambda: run["movie"], "no movie.*ground_truth, kernel, model, rollout"),
                       (lambda: run.field(of="tracers"), 'of = "tracers": .*filtered, unfiltered'),
                       (lambda: run.spectrum("truth", time=1e9), r"time = 1e\+09: must be between 0 and"),
                       (lambda: run.field("pressure"), '"pressure": no such variable; there are .*velocity'),
                       (lambda: run.trajectories([3, last + 1]), rf"ids = \[3, {last + 1}\]: .* 0 to {last},"),
                       (lambda: run.trajectories([0.5]), "must be integers"),
                       (lambda: run.metrics, "metrics.json: no such file")):
        with pytest.raises(eddies.UserError, match=words):
            ask()
    (directory / "report").mkdir()
    (directory / "report" / "metrics.json").write_text("[1, 2]")
    with pytest.raises(eddies.UserError, match="metrics.json: is damaged; run `eddies report"):
        run.metrics  # noqa: B018


@pytest.mark.mpi(1)
def test_metrics_older_than_a_product_are_named(directory):
    run, metrics = eddies.open_run(directory), directory / "report" / "metrics.json"
    metrics.parent.mkdir()
    metrics.write_text('{"cost": {"ranks": 1}}')
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert run.metrics == {"cost": {"ranks": 1}}
    os.utime(directory / "rollout.h5", (metrics.stat().st_mtime + 9,) * 2)
    with pytest.warns(UserWarning, match="metrics.json: is older than rollout.h5; run `eddies report"):
        assert run.metrics == {"cost": {"ranks": 1}}
