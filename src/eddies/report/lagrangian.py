"""Lagrangian statistics of a rollout beside those of the true tracers: one figure and its numbers."""

from matplotlib.figure import Figure

from eddies.analysis.lagrangian import PathStatistics, differences
from eddies.measures import MEASURES
from eddies.report.figures import GUIDE, letter, number_wavenumbers, panels, styled
from eddies.report.page import Metric, Section
from eddies.report.rollout_figures import LINES

TOO_FEW = "there is one frame alone, or nothing that changes"


def add(shown: Section, model: PathStatistics, truth: PathStatistics, turnover: float) -> None:
    """Put the figure and its numbers, over all common frames, into the section of the rollout."""
    errors = differences(model, truth)
    shown.metrics += [Metric(key, MEASURES[key], value, TOO_FEW) for key, value in errors.items()]
    last = truth.times[-1] / turnover
    shown.add_figure(
        "lagrangian", "Lagrangian statistics", draw(model, truth, turnover),
        f"Over {last:.2f} T. A, C: correlations; D: variance of a component; B, E: second moment and flatness of the "
        "increments of a velocity component over a lag, 3 if normal. F: nearest neighbours, in units of their "
        "mean-square separation. G, H: a particle with its three nearest neighbours: R² in units of its first value, "
        "and the eigenvalues of the moments over R², 1/3 each of a regular tetrahedron. Rms of ln(model / truth): "
        + ", ".join(f"{name} {errors[key]:.2g}" for name, key in (
            ("flatness", "flatness_error"), ("pairs", "pair_dispersion_error"), ("tetrads", "tetrad_size_error"),
            ("their shape", "tetrad_shape_error"))) + ".")


@styled
def draw(model: PathStatistics, truth: PathStatistics, turnover: float) -> Figure:
    """Memory and increments of velocities, accelerations, and the spreading of pairs and tetrads."""
    figure, axes = panels(3, 3, (3.5, 2.8))
    (memory, structure, accelerations), (variance, flatness, pairs), (sizes, shapes, unused) = axes
    for run, name in ((truth, "truth"), (model, "model")):
        line, time, lags = LINES[name], run.times / turnover, run.lags / turnover
        memory.plot(time, run.velocity_correlation, **line)
        structure.loglog(lags, run.structure, marker="o", markersize=3, **line)
        accelerations.plot(lags, run.acceleration_correlation, marker="o", markersize=3, **line)
        variance.plot(time, run.acceleration_variance, **line)
        flatness.semilogx(lags, run.flatness, marker="o", markersize=3, **line)
        pairs.loglog(time[1:], run.pair_dispersion[1:], **line)
        sizes.plot(time, run.tetrad_size, **line)
        for eigenvalue in run.tetrad_shape.T:
            shapes.plot(time, eigenvalue, **line)
    memory.set(title="Velocity correlation", ylabel=r"$\rho_v(t)$")
    structure.set(title="Structure function", ylabel=r"$\langle(\Delta_\tau v_i)^2\rangle$")
    accelerations.set(title="Acceleration correlation", ylabel=r"$\rho_a(\tau)$")
    accelerations.axhline(0, color=GUIDE, linewidth=0.8)
    variance.set(title="Acceleration variance", ylabel=r"$\langle a_i^2\rangle$", ylim=(0, None))
    flatness.set(title="Flatness of increments", ylabel=r"$\langle\Delta v^4\rangle/\langle\Delta v^2\rangle^2$")
    flatness.axhline(3, color=GUIDE, linestyle=":")
    pairs.set(title="Pair dispersion", ylabel=r"$\langle|r-r_0|^2\rangle/\langle r_0^2\rangle$")
    sizes.set(title="Size of tetrads", ylabel=r"$\langle R^2\rangle/\langle R_0^2\rangle$", ylim=(0, None))
    shapes.set(title="Shape of tetrads", ylabel=r"$\langle\lambda_i/R^2\rangle$", ylim=(0, 1))
    shapes.axhline(1 / 3, color=GUIDE, linestyle=":")
    for axis in (memory, variance, pairs, sizes, shapes):
        axis.set_xlabel("time $t/T$")
    for axis in (structure, accelerations, flatness):
        axis.set_xlabel(r"lag $\tau/T$")
    for axis in (structure, flatness, pairs):
        number_wavenumbers(axis)
    unused.axis("off")
    unused.legend(*memory.get_legend_handles_labels(), loc="center")
    letter(axes.flat[:-1])
    return figure
