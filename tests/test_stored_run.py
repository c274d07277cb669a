import os
import pickle
import sys
import warnings

import numpy as np
import pytest

import eddies
from eddies.io.damage import open_to_read
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
@pytest.mark.usefixtures("quick_spectra")
def test_all_groups_can_be_pickled(directory, monkeypatch):
    """Also for a process with another working directory."""
    monkeypatch.chdir(directory)
    run = eddies.open_run(".")
    stored = {name: pickle.dumps(run[name]) for name in run.groups}
    monkeypatch.chdir("/")
    for name, group in stored.items():
        assert pickle.loads(group).identical(eddies.open_run(directory)[name]), name


@pytest.mark.mpi(1)
def test_without_xarray_an_error_names_it(directory, monkeypatch):
    monkeypatch.setitem(sys.modules, "xarray", None)
    monkeypatch.delitem(sys.modules, "eddies.io.datasets", raising=False)
    with pytest.raises(eddies.UserError, match=r"need xarray: .* the extra \[xarray\]"):
        eddies.open_run(directory).trajectories()


@pytest.mark.mpi(1)
def test_trajectories_fields_and_spectra(directory):
    run = eddies.open_run(directory)
    ids, all_of_them = [7, 3], run.trajectories(of="truth")
    some = run.trajectories(ids, of="truth", unwrapped=True)
    position, whole = some["position"].values, all_of_them["position"].values
    assert np.array_equal(some["particle"], ids) and some["position"].attrs == {"units": "L"}
    # Unwrapped positions start in the cube, differ by whole edges, and are continuous.
    assert np.array_equal(position[0], whole[0, ids])
    turns = (position - whole[:, ids]) / LENGTH
    assert np.abs(turns - np.rint(turns)).max() < 1e-6 and np.abs(np.diff(position, axis=0)).max() < LENGTH / 2
    field, first = run.field(of="model"), run.field(of="model", time=0.0)
    assert field.dims == ("component", "z", "y", "x") and not np.array_equal(field, first)
    assert float(field["x"][1]) == pytest.approx(LENGTH / field.sizes["x"])
    energy = run.spectrum("filtered")
    assert float(energy.sum()) > 0 and energy.attrs == {"units": "L^2/T^2"}
    assert run.spectrum("truth", time=0.0).dims == ("wavenumber",)


@pytest.mark.mpi(1)
def test_a_scalar_field_has_no_components(comm, tmp_path):
    fields = {"velocity": np.random.default_rng(1).random((3, 4, 4, 4)), "density": np.full((1, 4, 4, 4), 1.5)}
    with create_product(comm, tmp_path / "ground_truth.h5", "ground_truth", {}) as file:
        FieldWriter(file, "filtered", 4, {"velocity": 3, "density": 1}).append(0.5, 0, fields)
    run = eddies.open_run(tmp_path)
    assert run.field("density").dims == ("z", "y", "x") and float(run.field("density")[1, 2, 3]) == 1.5
    assert np.array_equal(run.field("velocity", time=0.4), fields["velocity"].astype(np.float32))


@pytest.mark.mpi(1)
@pytest.mark.usefixtures("undrawn", "quick_spectra")
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
    for ask, words in ((lambda: run["rollout/forces"], "rollout.h5: holds no forces.*particles/model"),
                       (lambda: run["rollout"], "rollout.h5: holds no such group.*particles/model"),
                       (lambda: run["rollout/particles/model/velocity"], "holds no particles/model/velocity"),
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
