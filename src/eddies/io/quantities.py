"""Units, axes and descriptions of the datasets of products, stored as their attributes.

Units: L is the edge of the cube over 2 pi, T follows from lengths and velocities, M makes the mean density 1 M/L^3.
"""

from __future__ import annotations

from fnmatch import fnmatchcase
from typing import Any, NamedTuple

import h5py
import numpy as np

# The origin of the times in a product, by kind.
BEGINNING = {"ground_truth": "since the release of the tracers", "reconstruction": "since the first frame",
             "rollout": "since the start of the rollout"}
# Attributes of a file with a flow.
CONVENTIONS = {
    "units": "L: edge of the cube over 2 pi; T: follows from lengths and velocities; M: so that the mean density is "
             "1 M/L^3",
    "box": "cube with edges 2 pi L, periodic along x, y and z; 0 <= x, y, z < 2 pi; positions are wrapped into it",
}
ORIGINS = {
    "ground_truth": "of particles, filtered and unfiltered fields and `spectra`: the release of the tracers, at "
                    "released_at (attribute of reference) of the simulation; of `statistics`, `stationary` and "
                    "fields/final: the start of the simulation",
    "reconstruction": "the first frame of the tracks",
    "rollout": "the start of the rollout, at start_time (attribute of rollout) after the release of the tracers",
}


class Quantity(NamedTuple):
    """Units, names of the axes and description of a dataset."""

    units: str
    axes: str
    description: str


PARTICLES, FIELD, ROW = "time particle", "time component z y x", "row"
POINTS = "at the points i edge / cells of the periodic cube, i = 0, 1, ..."
# Quantities by path in the file; the first match counts.
QUANTITIES = {
    "particles/tracks/track/value": Quantity("1", PARTICLES, "number of the track of a row; -1: a row without one"),
    "particles/tracks/coordinates/value": Quantity("L", f"{PARTICLES} xyz", "in the file of the tracks"),
    "particles/tracks/*/value": Quantity("", PARTICLES, "as of the fields of this name, at the particles"),
    "particles/*/id": Quantity("1", "particle", "of the particle in each row of every frame"),
    "particles/*/step": Quantity("1", "time", "number of the time step"),
    "particles/*/box/edges/value": Quantity("L", "time i j", "edges of the periodic cube, on the diagonal"),
    "particles/*/position/value": Quantity("L", f"{PARTICLES} xyz", "wrapped into the cube, 0 <= x < edge"),
    "particles/*/image/value": Quantity("1", f"{PARTICLES} xyz", "position + edge * image goes on beyond the cube"),
    "particles/*/velocity/value": Quantity("L/T", f"{PARTICLES} xyz", "of the particles"),
    "particles/*/acceleration/value": Quantity("L/T^2", f"{PARTICLES} xyz", "of the particles"),
    "particles/*/density/value": Quantity("M/L^3", PARTICLES, "at the particles"),
    "gradients/*/velocity_gradient": Quantity("1/T", f"{PARTICLES} i j", "dv_i/dx_j through the kernel"),
    "fields/reconstructed/velocity": Quantity("L/T", FIELD, f"in the units of the tracks {POINTS}"),
    "fields/reconstructed/gradient": Quantity("1/T", FIELD, f"du_i/dx_j, row by row {POINTS}"),
    "fields/reconstructed/vorticity": Quantity("1/T", FIELD, f"components x, y, z {POINTS}"),
    "fields/reconstructed/q": Quantity("1/T^2", FIELD, f"-tr(A A)/2 of the gradient A {POINTS}"),
    "fields/reconstructed/r": Quantity("1/T^3", FIELD, f"-tr(A A A)/3 of the gradient A {POINTS}"),
    "fields/reconstructed/pressure": Quantity("L^2/T^2", FIELD, f"over the density, of mean 0 {POINTS}"),
    "fields/reconstructed/acceleration": Quantity("L/T^2", FIELD, f"along tracks {POINTS}"),
    "fields/*/velocity": Quantity("L/T", FIELD, f"components x, y, z {POINTS}"),
    "fields/*/density": Quantity("M/L^3", FIELD, POINTS),
    "spectra*/wavenumber": Quantity("1/L", "wavenumber", "shell of the modes with this |k|, rounded"),
    "spectra_of_statistics/energy": Quantity("L^2/T^2", "row wavenumber", "energy of each shell k = 0, 1, ..."),
    "spectra/energy": Quantity("L^2/T^2", "time wavenumber", "energy of each shell of the flow"),
    "spectra/filtered": Quantity("L^2/T^2", "time wavenumber", "energy of each shell of the filtered flow"),
    "spectra_of_*/energy": Quantity("L^2/T^2", "time wavenumber",
                                    "energy of each shell that least squares find in the particles' velocities"),
    "*/frame": Quantity("1", "time", "number of the frame in the ground truth"),
    "statistics/time": Quantity("T", ROW, "since the start of the simulation"),
    "statistics/time_step": Quantity("T", ROW, "length of a time step"),
    "statistics/turnovers": Quantity("1", ROW, "eddy turnovers since the start of the simulation"),
    "statistics/seconds_per_step": Quantity("s", ROW, "wall time of a step"),
    "statistics/energy_?": Quantity("L^2/T^2", ROW, "kinetic energy per mass of a component"),
    "statistics/energy": Quantity("L^2/T^2", ROW, "kinetic energy per mass"),
    "statistics/total_energy": Quantity("L^2/T^2", ROW, "kinetic energy and that of compression, per mass"),
    "statistics/compressible_fraction": Quantity("1", ROW, "share of the energy that is not solenoidal"),
    "statistics/dissipation_rate": Quantity("L^2/T^3", ROW, "energy per mass that viscosity takes in a time"),
    "statistics/injection_rate": Quantity("L^2/T^3", ROW, "energy per mass that the forcing brings in a time"),
    "statistics/velocity_rms": Quantity("L/T", ROW, "rms of a component of the velocity, u'"),
    "statistics/density_rms": Quantity("M/L^3", ROW, "rms of the density about its mean"),
    "statistics/eddy_turnover_time": Quantity("T", ROW, "integral scale over u'"),
    "statistics/kolmogorov_time": Quantity("T", ROW, "(nu / dissipation rate)^(1/2)"),
    "statistics/integral_scale": Quantity("L", ROW, "pi / (2 u'^2) sum of E(k) / k"),
    "statistics/taylor_scale": Quantity("L", ROW, "(15 nu u'^2 / dissipation rate)^(1/2)"),
    "statistics/kolmogorov_length": Quantity("L", ROW, "(nu^3 / dissipation rate)^(1/4)"),
    "statistics/kmax_eta": Quantity("1", ROW, "largest wavenumber along an axis times the Kolmogorov length"),
    "statistics/mach_turbulent": Quantity("1", ROW, "rms speed over the speed of sound"),
    "statistics/reynolds_lambda": Quantity("1", ROW, "u' times the Taylor scale over nu"),
    "statistics/skewness": Quantity("1", ROW, "of longitudinal velocity gradients"),
    "statistics/flatness": Quantity("1", ROW, "of longitudinal velocity gradients"),
    "closure/time": Quantity("T", "time", "since the start of the rollout"),
    "closure/residual": Quantity("1", "time", "largest relative residual of a solve for the resolved velocity"),
    "closure/*": Quantity("1", "time", "solves for the resolved velocity since the frame before: {name}"),
    "outside_training/time": Quantity("T", "time", "since the start of the rollout"),
    "outside_training/*": Quantity("1", "time", "share of pairs with an input of the network outside of its training"),
    "errors_over_time/seconds": Quantity("s", "time", "wall time of the frame"),
    "errors_over_time/validation_error": Quantity("1", "time", "relative L2 error of the velocity at tracks left out"),
    "errors_of_fields/*_error": Quantity("1", "time", "relative L2 error of the field: {name}"),
    "kernels/r_over_h": Quantity("1", ROW, "distance over the support"),
    "kernels/value_*": Quantity("1", ROW, "W h^3 of the kernel {name}"),
    "kernels/derivative_*": Quantity("1", ROW, "W' h^4 of the kernel {name}"),
    "errors/integral_*": Quantity("1", "", "integral over space of the kernel {name}"),
    "errors/*": Quantity("1", "", "relative L2 error on a field that was not used: {name}"),
    "slices/*velocity*": Quantity("L/T", "y x", "u_x in a plane: {name}"),
    "slices/*gradient*": Quantity("1/T", "y x", "du_x/dx in a plane: {name}"),
    "history/seconds": Quantity("s", ROW, "wall time since the start of the training"),
    "*history/*": Quantity("1", ROW, "of the training: {name}"),
    "*a_priori/delay": Quantity("T", ROW, "since the end of the training window"),
    "*a_priori/*": Quantity("1", ROW, "relative L2 error of the rates at the true state: {name}"),
    "acceleration_sample/*": Quantity("L/T^2", "particle xyz", "{name} acceleration of some particles"),
    "density_rate_sample/*": Quantity("M/L^3/T", "particle", "{name} rate of the density of some particles"),
    "*feature_range/*": Quantity("1", "input", "{name} of each input of the network in training"),
    "trials/*/seconds_per_turnover": Quantity("s", ROW, "wall time of an eddy turnover"),
    "trials/*/size": Quantity("T", ROW, "time step; on a grid the Courant number"),
    "trials/*": Quantity("1", ROW, "rms over that of the true velocity: {name}"),
    "weights/*": Quantity("1", "", "trained parameters"),
}


def conventions(kind: str) -> dict[str, str]:
    """Attributes of a product with units, box and origin of time; empty for a product without a flow."""
    return {**CONVENTIONS, "time_origin": ORIGINS[kind]} if kind in ORIGINS else {}


def python_value(value: Any) -> Any:
    """A number or text of an attribute as a Python object."""
    return value.item() if isinstance(value, np.generic) else value


def describe(dataset: h5py.Dataset) -> None:
    """Write the attributes `units`, `axes` and `description` of a known dataset; collective."""
    for name, words in words_on(dataset.file.attrs.get("kind", ""), dataset.name.strip("/")).items():
        dataset.attrs[name] = words


def words_on(kind: str, path: str) -> dict[str, str]:
    """Units, axes and description of the dataset at a path in a product of a kind; empty if it is unknown."""
    group, _, name = path.rpartition("/")
    quantity = next((each for pattern, each in QUANTITIES.items() if fnmatchcase(path, pattern)), None)
    if quantity is None and name == "time":
        beginning = "since the start of the simulation" if group == "fields/final" else BEGINNING.get(kind, "")
        quantity = Quantity("T", "time", beginning)
    return {} if quantity is None else {"units": quantity.units, "axes": quantity.axes,
                                        "description": quantity.description.format(name=name.replace("_", " "))}
