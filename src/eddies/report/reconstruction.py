"""The report section on fields reconstructed from tracks: their errors over time, and a plane of the last frame."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from eddies.report.figures import (BAR, BLUE, DNS, MODEL, POSITIVE, SIGNED, colour_bar, largest, letter,
                                   panels, show_plane, styled)
from eddies.report.page import Section

SMALL_SCALES = {"spacing_over_eta": "mean spacing of the tracks over the Kolmogorov length",
                "dissipation_share": "expected share of the dissipation rate that the fields contain"}
ERRORS = {  # column of the table: label, colour, line style
    "validation_error": ("velocity at tracks left out", MODEL, "--"),
    "velocity_error": ("velocity field", BLUE, "-"),
    "gradient_error": ("velocity gradient", DNS, ":")}
LEFT_OUT = {  # attribute of the group left_out: words
    "least-squares": "least squares", "memory": "memory", "kriging": "kriging", "delaunay": "Delaunay interpolation",
    "floor": "noise of their velocities, which is a part of all of these"}


def section(about: Mapping[str, float | str], errors: Mapping[str, np.ndarray], of_fields: Mapping[str, np.ndarray],
            planes: Mapping[str, np.ndarray], left_out: Mapping[str, float]) -> Section:
    """Return the section on a product reconstruction.h5.

    about: attributes of the product, such as the method. errors: columns (frames,), among them the error at the tracks
    that a second reconstruction leaves out. of_fields: columns (frames,) with the errors of the fields; empty if the
    true fields are not known. planes: [y, x] at z = pi in the last frame, of u_x, and of its standard deviation, by
    label; those that are stored. left_out: errors of several methods at the tracks that are left out, if they were
    compared.
    """
    both = {**{name: (of_fields["time"], of_fields[name]) for name in of_fields if name in ERRORS},
            **{name: (errors["time"], errors[name]) for name in errors if name in ERRORS}}
    both = {name: (time, values) for name, (time, values) in both.items() if np.isfinite(values).any()}
    numbers = {"reconstruction_method": about["method"], "particles_of_a_frame": about["particles"],
               **{name: float(np.nanmean(both[name][1])) if name in both else None for name in ERRORS},
               "seconds_per_frame": float(np.median(errors["seconds"])),
               **{name: about[name] for name in SMALL_SCALES if name in about}}
    labels = {name: f"error of the {label}, mean over time (normalised L2)" for name, (label, _, _) in ERRORS.items()}
    if left_out:
        numbers |= {f"left_out_{name}": left_out.get(name) for name in LEFT_OUT}
        labels |= {f"left_out_{name}": f"error at left-out tracks: {words}" for name, words in LEFT_OUT.items()}
    labels |= SMALL_SCALES
    text = (f"Fields of {len(errors['time'])} frames from the velocities of {about['particles']:.0f} particles, by "
            f"{about['method']}, up to wavenumber {about['highest_wavenumber']}.")
    if about["holdout"]:
        text += (f" A second reconstruction leaves out {about['holdout']:.0%} of the tracks. Its error at these tracks "
                 "estimates the error of the field.")
    if "dissipation_share" in about:
        text += (f" By the spectrum of turbulence, the modes contain {about['dissipation_share']:.0%} of the "
                 "dissipation rate of the whole flow.")
    shown = Section("reconstruction", "Reconstruction", text, numbers, labels, {
        **{name: "the true field is not known" if name != "validation_error" else "no track was left out"
           for name in ERRORS}, "left_out_memory": "it needs the viscosity, and no background",
        "left_out_delaunay": "the tracks span no volume", "left_out_floor": "no noise was estimated"})
    shown.add_figure("reconstruction", "Reconstructed fields", lambda: overview(both, planes),
                     f"Normalised L2 errors over time{''.join(f', {label}' for label in planes)}"
                     + (" in the plane z = π of the last frame." if planes else "."))
    return shown


@styled
def overview(errors: Mapping[str, tuple[np.ndarray, np.ndarray]], planes: Mapping[str, np.ndarray]) -> Figure:
    """Draw errors over time and `planes` [y, x], by label.

    errors: times and values of each error, by its key in ERRORS.
    """
    figure, axes = panels(1, 1 + len(planes), (4.4, 3.3), right=BAR)
    over_time = axes[0, 0]
    for name, (label, colour, style) in ERRORS.items():
        if name in errors:
            over_time.plot(*errors[name], color=colour, linestyle=style, label=label)
    over_time.set(title="Errors", xlabel="time $t$", ylabel="normalised L2", ylim=(0, None))
    if over_time.lines:
        over_time.legend()
    for number, (label, plane) in enumerate(planes.items(), 1):
        limit, signed = largest(plane), plane.min() < 0
        image = show_plane(axes[0, number], plane, (-limit if signed else 0, limit), SIGNED if signed else POSITIVE)
        title = label.replace("u_x", "$u_x$")
        axes[0, number].set(title=title, xlabel="$x$", ylabel="$y$")
        colour_bar(figure, image, axes[0, number:number + 1], title)
    letter(axes.flat)
    return figure
