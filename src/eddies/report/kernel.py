"""Figures of the smoothing kernels: shapes (the paper's Fig. 1), reconstructed fields (Fig. 2), training."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from eddies.report.figures import (DNS, FOURTH, MODEL, SECOND, SIGNED, THIRD, TRUTH, colour_bar, largest, letter,
                                   panels, show_plane, styled)
from eddies.report.page import Metric, Section

KERNELS = {  # name in the files: label, colour, line style
    "learned": ("learned", MODEL, "-"),
    "learned_no_gradient": (r"learned without $L_g$", THIRD, "--"),
    "cubic_spline": ("cubic spline", DNS, "-."),
    "wendland": ("Wendland C$^2$", SECOND, ":"),
}

LOSSES = {"loss": DNS, "velocity": TRUTH, "gradient": FOURTH, "normalization": SECOND}


@styled
def shapes(kernels: Mapping[str, np.ndarray]) -> Figure:
    """Values h^3 W and derivatives h^4 dW/dr over r/h; columns r_over_h, value_NAME and derivative_NAME."""
    figure, axes = panels(1, 2, (4.4, 3.3))
    for axis, kind in zip(axes.flat, ("value", "derivative")):
        axis.axhline(0, color="#cccccc", linewidth=0.8)
        for name, (label, colour, style) in KERNELS.items():
            if f"{kind}_{name}" in kernels:
                axis.plot(kernels["r_over_h"], kernels[f"{kind}_{name}"], color=colour, linestyle=style,
                          label=label)
        axis.set(xlabel="$r/h$", xlim=(0, 1.02))
    axes[0, 0].set(title="Kernel", ylabel=r"$h^3\,W$")
    axes[0, 1].set(title="Derivative", ylabel=r"$h^4\,dW/dr$")
    axes[0, 0].legend()
    letter(axes.flat)
    return figure


@styled
def reconstructed_planes(slices: Mapping[str, np.ndarray], errors: Mapping[str, float]) -> Figure:
    """u_x and du_x/dx at z = pi: truth and reconstructions [y, x], one colour scale a row."""
    names = [name for name in KERNELS if f"velocity_{name}" in slices and name != "wendland"]
    figure, axes = panels(2, 1 + len(names), (2.7, 2.75), sharex=True, sharey=True)
    rows = (("velocity", "$u_x$"), ("gradient", r"$\partial u_x/\partial x$"))
    for row, (quantity, symbol) in zip(axes, rows):
        truth = slices[f"truth_{quantity}"]
        limit = largest(truth)
        image = show_plane(row[0], truth, (-limit, limit), SIGNED)
        row[0].set(title="filtered DNS", ylabel="$y$")
        for axis, name in zip(row[1:], names):
            show_plane(axis, slices[f"{quantity}_{name}"], (-limit, limit), SIGNED)
            axis.set_title(f"{KERNELS[name][0]}: {float(errors[f'{quantity}_error_{name}']):.3f}")
        colour_bar(figure, image, row, symbol)
    for axis in axes[-1]:
        axis.set_xlabel("$x$")
    letter(axes.flat)
    return figure


@styled
def training_history(history: Mapping[str, np.ndarray]) -> Figure:
    """Losses of both trained kernels over the step, on a logarithmic axis; columns LOSS_KERNEL."""
    figure, axes = panels(1, 1, (7.5, 3.2))
    for name in ("learned", "learned_no_gradient"):
        kernel, _, style = KERNELS[name]
        for loss, colour in LOSSES.items():
            values = history.get(f"{loss}_{name}")
            if values is not None and np.any(values > 0):
                axes[0, 0].semilogy(history["step"], values, color=colour, linestyle=style, linewidth=1.2,
                                    label=f"{'total' if loss == 'loss' else loss}, {kernel}")
    axes[0, 0].set(xlabel="training step", ylabel="loss")
    axes[0, 0].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


METRICS = {  # key in the report: column of the table of errors, label
    "integral": ("integral_learned", "integral of the learned kernel"),
    "velocity_error": ("velocity_error_learned", "error of the velocity field, learned kernel"),
    "gradient_error": ("gradient_error_learned", "error of the gradient field, learned kernel"),
    "no_gradient_velocity_error": ("velocity_error_learned_no_gradient",
                                   "error of the velocity field, learned without L_g"),
    "no_gradient_gradient_error": ("gradient_error_learned_no_gradient",
                                   "error of the gradient field, learned without L_g"),
    "cubic_spline_velocity_error": ("velocity_error_cubic_spline", "error of the velocity field, cubic spline"),
    "cubic_spline_gradient_error": ("gradient_error_cubic_spline", "error of the gradient field, cubic spline"),
    "wendland_velocity_error": ("velocity_error_wendland", "error of the velocity field, Wendland C²"),
    "wendland_gradient_error": ("gradient_error_wendland", "error of the gradient field, Wendland C²"),
    **{f"{form}_{what}_error": (f"{what}_error_{form}", f"error of the {what} field, {words}")
       for form, words in (("linear", "linear fits with the learned kernel as weight"),
                           ("quadratic", "quadratic fits with the learned kernel as weight"),
                           ("kriging", "kriging, without a kernel"))
       for what in ("velocity", "gradient")},
}


def section(support: float, kernels: Mapping[str, np.ndarray], slices: Mapping[str, np.ndarray],
            errors: Mapping[str, float], history: Mapping[str, np.ndarray]) -> Section:
    """The smoothing kernel: figures and errors on an unseen field, from the tables of the product."""
    metrics = [Metric("support", "support radius h", float(support))]
    for key, (column, label) in METRICS.items():
        value = float(errors[column]) if column in errors else None
        metrics.append(Metric(key, label, value, "this kernel was not compared"))
    shown = Section("kernel", "Smoothing kernel", "What kernels make of particles, beside the filtered field itself. "
                    "Errors: normalised L2 over a whole unseen field.",
                    metrics=metrics, main=("velocity_error", "gradient_error"))
    shown.add_figure(
        "figure-1-kernels", "Kernels and their derivatives (the paper's Fig. 1)", shapes(kernels),
        f"Support h = {support:.3g}; the learned kernel integrates to {errors['integral_learned']:.6f}.")
    shown.add_figure(
        "figure-2-reconstruction", "Fields reconstructed from particles (the paper's Fig. 2)",
        reconstructed_planes(slices, errors),
        "Plane z = π of an unseen frame. Numbers in titles: normalised error over the whole field; "
        f"velocity {errors['velocity_error_learned']:.3f}, gradient {errors['gradient_error_learned']:.3f} when "
        "learned.")
    shown.add_figure("kernel-training", "Training of the kernels", training_history(history),
                     f"{int(history['step'][-1])} steps.")
    return shown
