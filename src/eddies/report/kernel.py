"""The report section on smoothing kernels: their shapes (the paper's Fig. 1), and reconstructed fields (Fig. 2)."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from eddies.report.figures import (BAR, DNS, MODEL, SECOND, SIGNED, THIRD, colour_bar, largest, letter, panels,
                                   show_plane, styled)
from eddies.report.page import Section

KERNELS = {  # name in the files: start of its keys in the report, name in words, label, colour, line style
    "learned": ("", "learned kernel", "learned", MODEL, "-"),
    "learned_no_gradient": ("no_gradient_", "learned without L_g", r"learned without $L_g$", THIRD, "--"),
    "cubic_spline": ("cubic_spline_", "cubic spline", "cubic spline", DNS, "-."),
    "wendland": ("wendland_", "Wendland C²", "Wendland C$^2$", SECOND, ":"),
    "kriging": ("kriging_", "kriging, without a kernel", "kriging", DNS, "-"),
}


@styled
def shapes(kernels: Mapping[str, np.ndarray]) -> Figure:
    """Draw h^3 W and h^4 dW/dr of each kernel W over r/h; h is the support radius.

    An inset shows W(r)/W(0) of the kernel that was trained without L_g, which may have a peak away from the centre. The
    columns are r_over_h, value_NAME and derivative_NAME, with a NAME in KERNELS.
    """
    figure, axes = panels(1, 2, (4.4, 3.3))
    for axis, kind in zip(axes.flat, ("value", "derivative")):
        axis.axhline(0, color="#cccccc", linewidth=0.8)
        for name, (*_, label, colour, style) in KERNELS.items():
            if f"{kind}_{name}" in kernels:
                axis.plot(kernels["r_over_h"], kernels[f"{kind}_{name}"], color=colour, linestyle=style,
                          label=label)
        axis.set(xlabel="$r/h$", xlim=(0, 1.02))
    axes[0, 0].set(title="Kernel", ylabel=r"$h^3\,W$")
    axes[0, 1].set(title="Derivative", ylabel=r"$h^4\,dW/dr$")
    axes[0, 0].legend()
    letter(axes.flat)
    if (flat := kernels.get("value_learned_no_gradient")) is not None:
        *_, label, colour, style = KERNELS["learned_no_gradient"]
        inset, inner = axes[0, 0].inset_axes((0.6, 0.3, 0.38, 0.26)), kernels["r_over_h"] <= 0.8
        inset.plot(kernels["r_over_h"][inner], flat[inner] / flat[0], color=colour, linestyle=style)
        inset.axhline(1, color="#cccccc", linewidth=0.8)
        inset.set_title(label + ": $W(r)/W(0)$", fontsize=8)
        inset.tick_params(labelsize=7.5)
    return figure


@styled
def reconstructed_planes(slices: Mapping[str, np.ndarray], errors: Mapping[str, float]) -> Figure:
    """Draw planes [y, x] of u_x, and below them of du_x/dx: first the truth, then the reconstruction by each kernel.

    A row of planes has one colour scale. The Wendland kernel is left out. The errors are written in the panels. The
    keys of `slices` are truth_QUANTITY and QUANTITY_NAME, and those of `errors` are QUANTITY_error_NAME. QUANTITY is
    velocity or gradient, and NAME is a name in KERNELS.
    """
    names = [name for name in KERNELS if f"velocity_{name}" in slices and name != "wendland"]
    figure, axes = panels(2, 1 + len(names), (2.665, 2.675), right=BAR, sharex=True, sharey=True)
    rows = (("velocity", "$u_x$"), ("gradient", r"$\partial u_x/\partial x$"))
    for row, (quantity, symbol) in zip(axes, rows):
        truth = slices[f"truth_{quantity}"]
        limit = largest(truth)
        image = show_plane(row[0], truth, (-limit, limit), SIGNED)
        row[0].set(title="filtered DNS", ylabel="$y$")
        for axis, name in zip(row[1:], names):
            show_plane(axis, slices[f"{quantity}_{name}"], (-limit, limit), SIGNED,
                       float(errors[f"{quantity}_error_{name}"]))
            axis.set_title(KERNELS[name][2])
        colour_bar(figure, image, row, symbol)
    for axis in axes[-1]:
        axis.set_xlabel("$x$")
    letter(axes.flat)
    return figure


def section(support: float, kernels: Mapping[str, np.ndarray], slices: Mapping[str, np.ndarray],
            errors: Mapping[str, float]) -> Section:
    """Return the section.

    support: support radius of the kernels. kernels, slices, errors: the tables with these names in kernel.h5. Errors
    are those on a field that the training has not used.
    """
    numbers, labels = {"support": float(support), "integral": float(errors["integral_learned"])}, {
        "support": "support radius h", "integral": "integral of the learned kernel"}
    for name, (start, words, *_) in KERNELS.items():
        for field in ("velocity", "gradient"):
            labels[f"{start}{field}_error"] = f"error of the {field} field, {words}"
            column = f"{field}_error_{name}"
            numbers[f"{start}{field}_error"] = float(errors[column]) if column in errors else None
    shown = Section("kernel", "Smoothing kernel", "Fields reconstructed from particles by each kernel, compared with "
                    "the filtered field. Errors are normalised L2 errors over a whole unseen field.", numbers, labels,
                    dict.fromkeys(numbers, "this kernel was not compared"))
    shown.add_figure(
        "figure-1-kernels", "Kernels and their derivatives (the paper's Fig. 1)", lambda: shapes(kernels),
        f"Support h = {support:.3g}. The integral of the learned kernel is {errors['integral_learned']:.6f}.")
    shown.add_figure(
        "figure-2-reconstruction", "Fields reconstructed from particles (the paper's Fig. 2)",
        lambda: reconstructed_planes(slices, errors),
        "Plane z = π of an unseen frame. Numbers in panels: normalised error over the whole field. Learned kernel: "
        f"velocity {errors['velocity_error_learned']:.3f}, gradient {errors['gradient_error_learned']:.3f}.")
    return shown
