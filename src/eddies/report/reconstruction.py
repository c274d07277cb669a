"""The report section on fields reconstructed from tracks: their errors over time, and a plane of the last frame."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from eddies.report.figures import (BAR, BLUE, DNS, MODEL, SIGNED, colour_bar, largest, letter, panels, show_plane,
                                   styled)
from eddies.report.page import Section

ERRORS = {  # column of the table: label, colour, line style
    "validation_error": ("velocity at tracks left out", MODEL, "--"),
    "velocity_error": ("velocity field", BLUE, "-"),
    "gradient_error": ("velocity gradient", DNS, ":")}


def section(about: Mapping[str, float | str], errors: Mapping[str, np.ndarray], of_fields: Mapping[str, np.ndarray],
            plane: np.ndarray | None) -> Section:
    """Return the section on a product reconstruction.h5.

    about: attributes of the product, such as the method. errors: columns (frames,), among them the error at the tracks
    that a second reconstruction leaves out. of_fields: columns (frames,) with the errors of the fields; empty if the
    true fields are not known. plane: u_x [y, x] at z = pi in the last frame; None if the velocity is not stored.
    """
    both = {**{name: (of_fields["time"], of_fields[name]) for name in of_fields if name in ERRORS},
            **{name: (errors["time"], errors[name]) for name in errors if name in ERRORS}}
    both = {name: (time, values) for name, (time, values) in both.items() if np.isfinite(values).any()}
    numbers = {"reconstruction_method": about["method"], "particles_of_a_frame": about["particles"],
               **{name: float(np.nanmean(both[name][1])) if name in both else None for name in ERRORS},
               "seconds_per_frame": float(np.median(errors["seconds"]))}
    labels = {name: f"error of the {label}, mean over time (normalised L2)" for name, (label, _, _) in ERRORS.items()}
    text = (f"Fields of {len(errors['time'])} frames from the velocities of {about['particles']:.0f} particles, by "
            f"{about['method']}, up to wavenumber {about['highest_wavenumber']}.")
    if about["holdout"]:
        text += (f" A second reconstruction leaves out {about['holdout']:.0%} of the tracks. Its error at these tracks "
                 "estimates the error of the field.")
    shown = Section("reconstruction", "Reconstruction", text, numbers, labels, {
        name: "the true field is not known" if name != "validation_error" else "no track was left out"
        for name in ERRORS})
    shown.add_figure("reconstruction", "Reconstructed fields", lambda: overview(both, plane),
                     "Normalised L2 errors over time" + (", and u_x in the plane z = π of the last frame." if plane
                                                         is not None else "."))
    return shown


@styled
def overview(errors: Mapping[str, tuple[np.ndarray, np.ndarray]], plane: np.ndarray | None) -> Figure:
    """Draw errors over time and, if `plane` is given, a plane [y, x] of u_x.

    errors: times and values of each error, by its key in ERRORS.
    """
    figure, axes = panels(1, 1 if plane is None else 2, (4.4, 3.3), right=BAR)
    over_time = axes[0, 0]
    for name, (label, colour, style) in ERRORS.items():
        if name in errors:
            over_time.plot(*errors[name], color=colour, linestyle=style, label=label)
    over_time.set(title="Errors", xlabel="time $t$", ylabel="normalised L2", ylim=(0, None))
    if over_time.lines:
        over_time.legend()
    if plane is not None:
        limit = largest(plane)
        image = show_plane(axes[0, 1], plane, (-limit, limit), SIGNED)
        axes[0, 1].set(title="$u_x$", xlabel="$x$", ylabel="$y$")
        colour_bar(figure, image, axes[0, 1:], "$u_x$")
    letter(axes.flat)
    return figure
