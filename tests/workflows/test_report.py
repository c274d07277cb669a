import html
import json
import math
import os
import re
from dataclasses import replace

import pytest
from mpi4py import MPI

from eddies import cli
from eddies.io.errors import ProductError, WriteError
from eddies.io.hdf5 import create_product, write_table
from eddies.measures import MEASURES
from eddies.parallel.stop import Stopped
from eddies.report import steps
from eddies.scene.scene import SceneError, load_scene
from eddies.workflows import dns, measure, report
from eddies.workflows.diff import numbers_of
from eddies.workflows.run_directory.fingerprints import stage_provenance
from eddies.workflows.status import status_lines
from tests.changed_product import changed
from tests.commands import python
from tests.small_scene import one_model
from tests.workflows.stopping import StopAtStep
from tests.workflows.synthetic_run import write_ground_truth, write_kernel, write_model, write_rollout, write_run
from tests.workflows.test_variant_rows import scene_of

pytestmark = [pytest.mark.mpi(1), pytest.mark.usefixtures("quick_spectra")]

FIGURES = {
    "statistics", "spectra", "fields", "stationary", "tracers", "figure-1-kernels", "figure-2-reconstruction",
    "figure-3-a-priori", "model-training", "figure-4-velocity", "figure-5-vorticity-energy", "figure-6-pdfs",
    "figure-7-invariants", "figure-8-spectra", "figure-9-errors", "lagrangian", "particle-disorder",
}
NUMBERS = {
    "ground_truth": {"reynolds_lambda", "kmax_eta", "mach_turbulent", "energy_budget_error", "skewness"},
    "stationary": {"turnovers", "skewness", "dissipation_constant", "energy_imbalance", "mach_turbulent"},
    "tracers": {"tracer_energy_ratio_first", "tracer_energy_ratio_last", "acceleration_kurtosis",
                "structure_function_exponent", "ballistic_exponent"},
    "kernel": {"integral", "velocity_error", "gradient_error", "cubic_spline_velocity_error",
               "cubic_spline_gradient_error"},
    "models": {"acceleration_error", "filtered_pressure_gradient_error", "true_density_acceleration_error", "delay"},
    "rollouts": {"turnovers", "stable", "energy_ratio", "velocity_error", "spectrum_error", "velocity_kl",
                 "acceleration_kl", "qr_kl", "outside_training", "nearest_distance_kl", "momentum_drift",
                 "count_variance", "acceleration_rms_ratio", "velocity_kl_floor", "acceleration_kl_floor",
                 "qr_kl_floor", "spectrum_error_floor", "band_energy_ratios", "band_energy_ratios_floor",
                 "flatness_error", "acceleration_correlation_error", "acceleration_variance_error",
                 "pair_dispersion_error", "tetrad_size_error", "tetrad_shape_error", "seconds_per_step", "particles",
                 "ranks", "stage_seconds"},
    "cost": {"dns_seconds_per_step", "dns_seconds_per_turnover", "stage_seconds"},
}


def written(directory):
    """Numbers of the only variant, and page; the file with the former must be strict JSON."""
    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    text = (directory / "report" / "metrics.json").read_text(encoding="utf-8")
    page = (directory / "report" / "index.html").read_text(encoding="utf-8")
    json.loads(text, parse_constant=refuse)
    return numbers_of(directory, None), page


def figures(directory):
    return {path.stem for path in (directory / "report" / "figures").glob("*.png")}


def numbers(values):
    return [value for value in values if isinstance(value, float)]


@pytest.mark.usefixtures("undrawn")
def test_a_complete_run_shows_everything(comm, tmp_path):
    write_run(comm, tmp_path, {"stationary": True})
    report.run(tmp_path, comm)
    metrics, page = written(tmp_path)
    assert figures(tmp_path) == FIGURES
    assert page.count("data:image/png;base64,") == len(FIGURES)
    assert not re.search(r'(src|href)="(?!#|data:)', page), "the page needs no other file"
    for section, keys in NUMBERS.items():
        assert keys <= metrics[section].keys()
        assert all(math.isfinite(value) for value in numbers(metrics[section].values()))
        assert all(metrics[section][key] is not None for key in keys)
    assert "the model, terms pressure, pairs" in page
    assert "not available: not defined for the terms of this model in this flow" in page
    assert page.index('id="rollouts"') < page.index('id="models"') < page.index('id="ground_truth"')
    check_stationary(metrics["stationary"], page)


@pytest.mark.usefixtures("no_figures")
def test_a_run_without_density_shows_everything_else(comm, tmp_path):
    write_run(comm, tmp_path, {"stationary": True}, density=False)
    report.run(tmp_path, comm)
    metrics, page = written(tmp_path)
    assert figures(tmp_path) == FIGURES
    assert NUMBERS["rollouts"] <= metrics["rollouts"].keys() and None not in metrics["rollouts"].values()
    assert "density_rms" not in metrics["ground_truth"] and "density_drift" not in metrics["rollouts"]
    assert "an incompressible fluid has none" in page


@pytest.mark.usefixtures("no_figures")
@pytest.mark.mpi(2, timeout=60)
def test_a_report_that_cannot_be_written_ends_all_ranks_with_exit_code_2(comm, tmp_path, capfd):
    """There is a file in the place of a directory."""
    write_ground_truth(comm, tmp_path)
    if comm.rank == 0:
        (tmp_path / "report").mkdir()
        (tmp_path / "report" / "figures").write_text("precious")
    comm.Barrier()
    assert cli.main(["report", str(tmp_path)]) == 2
    assert comm.rank > 0 or "report/figures: File exists" in capfd.readouterr().err


def check_stationary(shown, page):
    """The statistics are constants times 1 + 0.1 sin 3t, averaged from t = 1 to 3."""
    mean = 1 + 0.1 * (math.cos(3) - math.cos(9)) / 6
    assert shown["skewness"]["this run"] == pytest.approx(-0.5 * mean, rel=1e-3)
    assert shown["skewness"]["literature"] == pytest.approx(-0.32 * (45 * mean) ** 0.11, rel=1e-3)
    assert shown["turnovers"]["this run"] == pytest.approx(2 / 1.2)
    assert "Ishihara et al. 2007" in page


@pytest.mark.usefixtures("no_figures")
def test_a_span_too_short_to_average_has_a_notice_and_the_rest_is_shown(comm, tmp_path):
    write_ground_truth(comm, tmp_path, stationary=True)
    with changed(tmp_path / "ground_truth.h5") as file:
        file["stationary"].attrs["end"] = file["stationary"].attrs["start"]
    report.run(tmp_path, comm)
    metrics, page = written(tmp_path)
    assert "raise [spin_up] stationary" in page
    assert "stationary" not in figures(tmp_path) and metrics["ground_truth"]["reynolds_lambda"] > 0


@pytest.mark.usefixtures("no_figures")
def test_forced_rollouts_are_compared_with_the_stationary_state_if_there_is_one(comm, tmp_path):
    write_run(comm, tmp_path, {"stationary": True, "forced": True}, injection_rate=0.5, truth_injection_rate=0.5)
    report.run(tmp_path, comm)
    metrics, page = written(tmp_path)
    assert "It stays forced with a power of 0.5 per mass" in page and "forced" in figures(tmp_path)
    assert all(math.isfinite(value) for value in numbers(metrics["forced"].values()))
    write_run(comm, tmp_path, injection_rate=0.5)
    report.run(tmp_path, comm)
    metrics, page = written(tmp_path)
    assert "two different flows" in page and not metrics["forced"] and "forced" not in figures(tmp_path)


@pytest.mark.usefixtures("no_figures")
def test_models_are_shown_with_their_source_and_the_flows_of_their_training(comm, tmp_path):
    def models(**own):
        write_model(comm, tmp_path, **own)
        report.run(tmp_path, comm)
        return written(tmp_path)[0]["models"]

    alone = models(terms=("pairs", "density-flux"))
    assert (alone["density_rate_error"], alone["delay"]) == pytest.approx((0.63, 0.6))
    # Errors 0.24 + 0.03 t of this flow, at t = 0.1 to 0.6; the source's are 0.9 of them, and so are its times.
    found = models(source={"path": "runs/other", "mach_turbulent": 0.08})
    assert (found["unseen_acceleration_error"], found["source_acceleration_error"]) == pytest.approx(
        (0.2505, 0.9 * 0.2505))
    assert (found["source_mach_turbulent"], found["mach_turbulent"]) == (0.08, 0.16)
    assert models(source={"path": "runs/other", "mach_turbulent": None})["source_mach_turbulent"] is None
    models(source={"path": "runs/other", "truths": {"runs/a/ground_truth.h5": 0.04, "runs/b/ground_truth.h5": None}})
    assert ("trained on runs/a/ground_truth.h5 (M_t = 0.040), runs/b/ground_truth.h5, and not on the flow of "
            "runs/other") in written(tmp_path)[1]


@pytest.mark.usefixtures("no_figures")
def test_a_dns_alone(comm, tmp_path):
    write_ground_truth(comm, tmp_path, tracers=False)
    report.run(tmp_path, comm)
    metrics, page = written(tmp_path)
    assert figures(tmp_path) == {"statistics", "spectra", "fields"}
    assert metrics.keys() == {"warnings", "ground_truth", "cost", "row"} and metrics["warnings"] == []
    assert metrics["cost"]["dns_seconds_per_step"] > 0 and metrics["cost"]["stage_seconds"] is None
    (tmp_path / "stage_seconds.json").write_text('{"dns": 12.5}')
    with changed(tmp_path / "ground_truth.h5") as file:  # the first sample is the start
        file["statistics/seconds_per_step"][:] = [9.0, *40 * [1.0], *40 * [2.0]]
    report.run(tmp_path, comm)
    cost = written(tmp_path)[0]["cost"]
    assert cost["stage_seconds"] == {"dns": 12.5} and cost["dns_seconds_per_step"] == 1.5
    before = (tmp_path / "report" / "index.html").read_bytes()
    report.run(tmp_path, comm, output=tmp_path / "elsewhere" / "page")
    assert (tmp_path / "elsewhere" / "page" / "index.html").read_text().count("<img") == 3
    assert (tmp_path / "report" / "index.html").read_bytes() == before


def test_a_flow_at_rest(comm, tmp_path, own):
    own("rest", "import numpy as np\ndef flow(grid, initial, seed):\n"
        "    return np.zeros((3, *grid.spectral_shape), grid.complex)\n")
    dns.run(load_scene("abc", ["initial.kind=rest:flow", "time.duration=0.1", "flow.cells=8"]), comm, tmp_path)
    report.run(tmp_path, comm)
    assert "The flow is at rest" in written(tmp_path)[1]


@pytest.mark.usefixtures("no_figures")
@pytest.mark.parametrize("section, words", [
    ("tracers", "Tracers follow the whole flow. It is not forced."), ("tracks", "Tracers follow the whole flow.")])
def test_tracers_of_the_whole_flow_are_described_as_such(comm, tmp_path, section, words):
    """The forcing of measured tracks is unknown, so nothing is said of it."""
    write_ground_truth(comm, tmp_path, frames=3)
    with changed(tmp_path / "ground_truth.h5") as file:
        origin = json.loads(file.attrs["provenance"])
        file.attrs["provenance"] = json.dumps(origin | {"scene": f"[{section}]\nfiltered = false\n"})
        if section == "tracks":
            file.create_group("tracks").attrs.update(in_file=9, file="tracks.h5", mean_count=8.0, complete=7)
    report.run(tmp_path, comm)
    assert f"<p>{words}</p>" in written(tmp_path)[1]


@pytest.mark.usefixtures("no_figures")
def test_a_flow_without_dissipation_has_no_resolution(comm, tmp_path):
    """Its Kolmogorov length is stored as 0, which is no measure of the grid."""
    write_ground_truth(comm, tmp_path)
    with changed(tmp_path / "ground_truth.h5") as file:
        file["statistics/kmax_eta"][...] = 0.0
        file["reference"].attrs.update(kolmogorov_length=0.0, kmax_eta=0.0)
    report.run(tmp_path, comm)
    metrics, page = written(tmp_path)
    assert metrics["ground_truth"]["kmax_eta"] is None and "there is no smallest scale to resolve" in page
    assert "η = 0" not in page and metrics["ground_truth"]["reynolds_lambda"] > 0


@pytest.mark.usefixtures("no_figures")
def test_a_rollout_without_its_ground_truth(comm, tmp_path):
    write_rollout(comm, tmp_path)
    report.run(tmp_path, comm)
    metrics, page = written(tmp_path)
    assert metrics["rollouts"]["velocity_error"] is metrics["rollouts"]["spectrum_error"] is None
    assert "not compared with the truth: ground_truth.h5 is not here" in page
    assert metrics["rollouts"]["turnovers"] > 0 and not figures(tmp_path)
    with changed(tmp_path / "rollout.h5") as file:
        del file["rollout"].attrs["seconds_per_step"], file["rollout"].attrs["time_step"]
    (tmp_path / "measures.h5").unlink()
    report.run(tmp_path, comm)
    metrics, page = written(tmp_path)
    assert metrics["rollouts"]["seconds_per_step"] is None and metrics["rollouts"]["particles"] == 600
    assert "not available: too few steps to time" in page


@pytest.mark.usefixtures("no_figures")
@pytest.mark.parametrize("overrides, removals", [([], ["simulation"]), (["tracers.a.particles_per_side=6"], [])],
                         ids=["no rollout", "sets"])
def test_a_rollout_of_an_earlier_scene_is_shown_if_the_scene_asks_for_none(comm, tmp_path, overrides, removals):
    (tmp_path / "scene.toml").write_text(one_model("tiny", overrides, removals).to_toml())
    write_rollout(comm, tmp_path)
    report.run(tmp_path, comm)
    metrics = written(tmp_path)[0]
    assert metrics["rollouts"]["turnovers"] > 0 and not metrics["row"]


@pytest.mark.usefixtures("no_figures")
def test_a_report_elsewhere_needs_no_place_for_measures(comm, tmp_path, monkeypatch):
    """As of a run of an earlier version in a directory that cannot be written."""
    def refused(*_):
        raise WriteError("measures.h5: no place")

    write_rollout(MPI.COMM_SELF, tmp_path)
    monkeypatch.setattr(measure, "create_product", refused)
    with pytest.raises(WriteError, match="no place"):
        report.run(tmp_path, comm)
    report.run(tmp_path, comm, output=tmp_path / "elsewhere")
    found = json.loads((tmp_path / "elsewhere/metrics.json").read_text())["rollouts"]
    assert found[tmp_path.name]["turnovers"] == pytest.approx(0.8 / 1.2) and not (tmp_path / "measures.h5").exists()


@pytest.mark.usefixtures("no_figures")
def test_the_search_for_a_step_is_that_of_the_variant_whose_realisations_use_it(comm, tmp_path):
    (tmp_path / "scene.toml").write_text(scene_of(tmp_path, head="realisations = [5]\n").to_toml())
    (tmp_path / "plain/realisation-5").mkdir(parents=True)
    write_kernel(comm, tmp_path)
    columns = dict.fromkeys(("size", "error", "difference", "seconds_per_turnover"), [0.1, 0.05])
    with create_product(comm, tmp_path / "plain/step.h5", "step", {}) as file:
        file.create_group("found").attrs.update(dict.fromkeys(steps.CHOSEN, 0.05) | {
            "integrator": "verlet", "turnovers": 0.2, "tolerance": 0.02, "difference": 0.01})
        write_table(file, "trials/verlet", columns)
    report.run(tmp_path, comm)
    assert json.loads((tmp_path / "report/metrics.json").read_text())["steps"]["plain"]["size"] == 0.05


@pytest.mark.usefixtures("no_figures")
def test_only_a_grid_as_fine_as_that_of_the_simulation_repeats_it(comm, tmp_path):
    """The direct simulation has 24 cells. A coarser grid is faster."""
    grid, seconds = 'simulation.method = "eulerian"', {"plain": 1.0, "coarse": 2.0, "fine": 5.0}
    scene = scene_of(tmp_path, ("coarse", grid), ("fine", grid, "eulerian.cells = 24"))
    variants = {name: [tmp_path / name] for name in seconds}
    measures = {tmp_path / name: ({
        "ranks": 1, "accuracy": dict.fromkeys([*MEASURES, "end"], 0.5), "attributes": {
            "status": "complete", "time_step": 1.0, "eddy_turnover_time": 1.0,
            **{f"seconds_per_step{end}": time for end in ("", "_low", "_high")}}}, {})
        for name, time in seconds.items()}
    for where, in variants.values():
        where.mkdir()
        (where / "rollout.h5").touch()
    made = report.Report(tmp_path, scene, variants)
    report._compare(made, measures, 7.0, 1, comm)
    assert made.numbers["simulation_seconds"] == 5.0


@pytest.mark.usefixtures("no_figures")
def test_figures_of_an_earlier_report_are_removed(comm, tmp_path):
    write_kernel(comm, tmp_path)
    report.run(tmp_path, comm)
    (tmp_path / "kernel.h5").unlink()
    write_ground_truth(comm, tmp_path)
    report.run(tmp_path, comm)
    assert figures(tmp_path) == {"statistics", "spectra", "fields"}


def warnings_of(directory, output):
    """The warnings of `eddies report`, which are the same in metrics.json, at the top of the page, and in the log."""
    assert cli.main(["report", str(directory)]) == 0
    metrics, page = written(directory)
    said = metrics["warnings"]
    shown = [html.unescape(text) for text in re.findall('<div class="notice">(.*?)</div>', top_of(page))]
    logged = [line for line in output.readouterr().out.splitlines() if line.startswith("warning: ")]
    assert shown == said and logged == [f"warning: report: {sentence}" for sentence in said]
    return said


def top_of(page):
    """The page before its first section."""
    return page[page.index("<main>"):page.index("<section><details")]


@pytest.mark.usefixtures("no_figures")
def test_products_that_were_made_from_another_ground_truth_are_named_at_the_top(comm, tmp_path, capfd):
    """The other one has another seed, so it is another flow."""
    write_run(comm, tmp_path)
    assert warnings_of(tmp_path, capfd) == [] and "Warnings" not in top_of(written(tmp_path)[1])
    write_ground_truth(comm, tmp_path, seed=2)
    said = warnings_of(tmp_path, capfd)
    assert [sentence.partition(" ")[0] for sentence in said] == ["kernel.h5", "model.h5", "rollout.h5"]
    assert all("was made from another ground_truth.h5 than the one here" in sentence
               and "with other settings (seed = 1, now 2): remove " in sentence for sentence in said)
    metrics, page = written(tmp_path)
    assert metrics["rollouts"]["velocity_error"] is None
    assert "not compared with the truth: rollout.h5 was made from another ground_truth.h5 than the one here" in page
    write_run(comm, tmp_path)
    assert warnings_of(tmp_path, capfd) == []


@pytest.mark.usefixtures("no_figures")
def test_times_of_a_busy_machine_are_named_at_the_top(comm, tmp_path, capfd):
    """A load of three more processes than cores in the rollout, and steps of the simulation that differ."""
    write_run(comm, tmp_path)
    scene = scene_of(tmp_path).variant["plain"]
    (tmp_path / "scene.toml").write_text(scene.to_toml())
    with changed(tmp_path / "rollout.h5") as file:
        origin = json.loads(file.attrs["provenance"]) | stage_provenance(scene, "simulate") | {"made_from": {}}
        file.attrs["provenance"] = json.dumps(origin)
        file["rollout"].attrs.update(seconds_per_step_low=0.03, seconds_per_step_high=0.04, surplus_load=3.0)
    with changed(tmp_path / "ground_truth.h5") as file:
        file["statistics/seconds_per_step"][::2] *= 2
    said = [sentence for sentence in warnings_of(tmp_path, capfd) if "times are not comparable" in sentence]
    words = "times are not comparable: the machine was busy"
    assert said == [f"rollouts of {scene.name}: {words}", f"direct simulation: {words}"]
    metrics, page = written(tmp_path)
    assert metrics["cost"]["busy"] is True and "(busy)</td>" in page


@pytest.mark.usefixtures("no_figures")
def test_a_rollout_of_other_settings_is_left_out_of_the_comparison(comm, tmp_path, capfd):
    """`eddies status` knows the same. The main page is on a variant that can be compared."""
    scene = scene_of(tmp_path, ("free", 'simulation.method = "none"'))
    (tmp_path / "scene.toml").write_text(scene.to_toml())
    write_ground_truth(comm, tmp_path)
    before = replace(scene.variant["plain"], simulation=replace(scene.variant["plain"].simulation, start=0.1))
    for name, own in (("plain", before), ("free", scene.variant["free"])):
        write_run(comm, tmp_path / name)
        with changed(tmp_path / name / "rollout.h5") as file:
            origin = json.loads(file.attrs["provenance"]) | stage_provenance(own, "simulate") | {"made_from": {}}
            file.attrs["provenance"] = json.dumps(origin)
            file["rollout"].attrs.update(seconds_per_step_low=0.03, seconds_per_step_high=0.04)
    said, = [sentence for sentence in warnings_of(tmp_path, capfd) if sentence.startswith("plain: ")]
    words = "made with other settings (simulation.start = 0.1, now absent)"
    assert said.startswith("plain: rollout.h5 (made 20") and words in said
    found = json.loads((tmp_path / "report/metrics.json").read_text())
    rows = {row["name"]: row for row in found["rows"]}
    assert rows["plain"]["status"] == f"left out, because its rollout was {words}"
    assert rows["plain"]["velocity_error_end"] is rows["plain"]["wall_seconds"] is None
    assert rows["free"]["status"] == "complete" and rows["free"]["velocity_error_end"] > 0
    assert found["rollouts"].keys() == found["models"].keys() == {"plain", "free"}
    page = written(tmp_path)[1]
    assert f"left out, because its rollout was {words}" in page
    # The one that can be compared comes first.
    assert page.index("<th>free</th>") < page.index("<th>plain</th>")
    report.run(tmp_path, comm, ["plain"])
    assert "<th>free</th>" not in written(tmp_path)[1] and "1 more variants are in metrics.json" in written(tmp_path)[1]
    with pytest.raises(SceneError, match="there is no variant \"other\""):
        report.run(tmp_path, comm, ["other"])
    assert any(line.strip().startswith("plain: simulate") and words in line for line in status_lines(tmp_path))


@pytest.mark.usefixtures("no_figures")
def test_a_rollout_within_the_training_of_its_model_is_named_at_the_top(comm, tmp_path, capfd):
    write_run(comm, tmp_path)
    scene = one_model("tiny", ["simulation.start=0.1"])
    for kind in ("model", "rollout"):
        with changed(tmp_path / f"{kind}.h5") as file:
            origin = json.loads(file.attrs["provenance"])
            file.attrs["provenance"] = json.dumps(origin | {"scene": scene.to_toml()})
    said, = warnings_of(tmp_path, capfd)
    assert said.startswith("rollout.h5 (made 20") and "trained on this very flow up to 0.3 turnovers" in said


@pytest.mark.usefixtures("no_figures")
def test_numbers_that_are_not_finite_are_named_at_the_top(comm, tmp_path, capfd):
    write_run(comm, tmp_path)
    places = {"kernel": {"errors/integral_learned": ()},
              "model": {"a_priori/acceleration_error": 12, "history/seconds": 3},
              "rollout": {"closure/not_converged": 2, "particles/model/velocity/value": (8, 0, 0)}}
    for kind, own in places.items():
        with changed(tmp_path / f"{kind}.h5") as file:
            for place, index in own.items():
                file[place][index] = math.nan
    for said, (kind, own) in zip(warnings_of(tmp_path, capfd), places.items(), strict=True):
        assert said.startswith(f"{kind}.h5 holds numbers that are not finite (") and all(place in said for place in own)


def test_a_figure_of_such_numbers_is_left_out(comm, tmp_path, caplog):
    """There is no PDF of numbers that are not finite."""
    write_kernel(comm, tmp_path)
    write_model(comm, tmp_path)
    with changed(tmp_path / "model.h5") as file:
        file["acceleration_sample/truth"][5, 1] = math.nan
    report.run(tmp_path, comm)
    assert "a figure is left out, because drawing figure-3-a-priori fails (ValueError" in caplog.text
    assert figures(tmp_path) == {"model-training", "figure-1-kernels", "figure-2-reconstruction"}
    assert written(tmp_path)[0]["models"]["acceleration_error"] > 0


def test_a_ground_truth_that_is_not_finite_is_refused(comm, tmp_path):
    write_ground_truth(comm, tmp_path)
    with changed(tmp_path / "ground_truth.h5") as file:
        file["fields/filtered/velocity"][0, 0, 0, 0, 0] = math.nan
    with pytest.raises(ProductError, match="ground_truth.h5: /fields/filtered/velocity, frame 0: .*not finite"):
        report.run(tmp_path, comm)


@pytest.mark.usefixtures("no_figures")
@pytest.mark.mpi(2)
def test_a_report_can_be_stopped_before_it_is_written(comm, tmp_path):
    if comm.rank == 0:
        write_ground_truth(MPI.COMM_SELF, tmp_path, tracers=False)
    comm.Barrier()
    with pytest.raises(Stopped):
        report.run(tmp_path, comm, stop=StopAtStep(comm, 0))
    comm.Barrier()
    assert not (tmp_path / "report").exists()
    report.run(tmp_path, comm, stop=StopAtStep(comm, 1))
    comm.Barrier()
    assert (tmp_path / "report/index.html").exists()


@pytest.mark.mpi(2)
def test_numbers_and_other_figures_do_not_depend_on_a_figure(comm, tmp_path, monkeypatch, caplog):
    from eddies.report import figures as module
    write_ground_truth(comm, tmp_path, tracers=False)
    draw, left = module.png, [1]

    def png(figure):
        left[0] -= 1
        return draw(figure) if left[0] != 0 else 1 / 0

    monkeypatch.setattr(module, "png", png)
    report.run(tmp_path, comm)
    told = [record.getMessage() for record in caplog.records if "a figure is left out" in record.getMessage()]
    assert len(told) == (comm.rank == 0) and all("ZeroDivisionError: division by zero" in text for text in told)
    comm.Barrier()
    assert len(figures(tmp_path)) == 2 and "ground_truth" in written(tmp_path)[0]


def test_an_unknown_backend_does_not_matter():
    code = "import eddies.report.figures, matplotlib; matplotlib.figure.Figure().savefig('/dev/null', format='png')"
    assert python("-c", code, env={**os.environ, "MPLBACKEND": "nonsense"}).returncode == 0
