"""Units, axes and descriptions of the datasets of products, stored as their attributes.

Units: L is the edge of the cube divided by 2 pi. T follows from lengths and velocities. M is such that the mean density
is 1 M/L^3.
"""

from __future__ import annotations

from fnmatch import fnmatchcase
from typing import Any, NamedTuple

import h5py
import numpy as np

# The origin of the times in a product, by kind.
BEGINNING = {"ground_truth": "since the release of the tracers", "reconstruction": "since the first frame",
             "rollout": "since the start of the rollout", "measures": "since the start of the rollout"}
# Attributes of a file with a flow.
CONVENTIONS = {
    "units": "L: edge of the cube over 2 pi; T: follows from lengths and velocities; M: so that the mean density is "
             "1 M/L^3",
    "box": "cube with edges 2 pi L, periodic along x, y and z; 0 <= x, y, z < 2 pi; positions are wrapped into it",
}
ORIGINS = {
    "ground_truth": "for particles, filtered and unfiltered fields and `spectra`: the release of the tracers, which is "
                    "at time released_at (attribute of reference) of the simulation; for `statistics`, `stationary` "
                    "and fields/final: the start of the simulation",
    "reconstruction": "the first frame of the tracks",
    "rollout": "the start of the rollout, start_time (attribute of rollout) after the release of the tracers",
}


class Quantity(NamedTuple):
    """Units, names of the axes and description of a dataset."""

    units: str
    axes: str
    description: str


PARTICLES, FIELD, ROW = "time particle", "time component z y x", "row"
POINTS = "at the points i edge / cells of the periodic cube, i = 0, 1, ..."
# Quantities by pattern of the path in the file; the first pattern that matches counts.
QUANTITIES = {
    "particles/tracks/track/value": Quantity("1", PARTICLES, "number of the track in each row; -1: no track"),
    "particles/tracks/coordinates/value": Quantity("L", f"{PARTICLES} xyz", "position in the file of the tracks"),
    "particles/tracks/*/value": Quantity("", PARTICLES, "values at the particles, as in the fields of this name"),
    "particles/*/id": Quantity("1", "particle", "id of the particle in each row, the same in all frames"),
    "particles/*/step": Quantity("1", "time", "number of the time step"),
    "particles/*/box/edges/value": Quantity("L", "time i j", "edges of the periodic cube, on the diagonal"),
    "particles/*/position/value": Quantity("L", f"{PARTICLES} xyz", "wrapped into the cube, 0 <= x < edge"),
    "particles/*/image/value": Quantity("1", f"{PARTICLES} xyz", "position + edge * image is a continuous path"),
    "particles/*/velocity/value": Quantity("L/T", f"{PARTICLES} xyz", "velocity of the particles"),
    "particles/*/acceleration/value": Quantity("L/T^2", f"{PARTICLES} xyz", "acceleration of the particles"),
    "particles/*/density/value": Quantity("M/L^3", PARTICLES, "density at the particles"),
    "gradients/*/velocity_gradient": Quantity("1/T", f"{PARTICLES} i j", "dv_i/dx_j, reconstructed with the kernel"),
    "fields/reconstructed/velocity": Quantity("L/T", FIELD, f"in the units of the tracks, {POINTS}"),
    "fields/reconstructed/gradient": Quantity("1/T", FIELD, f"du_i/dx_j, row by row, {POINTS}"),
    "fields/reconstructed/vorticity": Quantity("1/T", FIELD, f"components x, y, z, {POINTS}"),
    "fields/reconstructed/q": Quantity("1/T^2", FIELD, f"-tr(A A)/2 of the gradient A, {POINTS}"),
    "fields/reconstructed/r": Quantity("1/T^3", FIELD, f"-tr(A A A)/3 of the gradient A, {POINTS}"),
    "fields/reconstructed/pressure": Quantity("L^2/T^2", FIELD, f"divided by the density, with mean 0, {POINTS}"),
    "fields/reconstructed/acceleration": Quantity("L/T^2", FIELD, f"acceleration of fluid particles, {POINTS}"),
    "fields/*/velocity": Quantity("L/T", FIELD, f"components x, y, z, {POINTS}"),
    "fields/*/density": Quantity("M/L^3", FIELD, POINTS),
    "spectra*/wavenumber": Quantity("1/L", "wavenumber", "shell of the modes whose |k| rounds to this number"),
    "spectra_of_statistics/energy": Quantity("L^2/T^2", "row wavenumber", "energy of each shell k = 0, 1, ..."),
    "spectra/energy": Quantity("L^2/T^2", "time wavenumber", "energy of each shell of the flow"),
    "spectra/filtered": Quantity("L^2/T^2", "time wavenumber", "energy of each shell of the filtered flow"),
    "spectra_of_*/energy": Quantity("L^2/T^2", "time wavenumber",
                                    "energy of each shell, by least squares from the velocities of the particles"),
    "*/frame": Quantity("1", "time", "number of the frame in the ground truth"),
    "statistics/time": Quantity("T", ROW, "since the start of the simulation"),
    "statistics/time_step": Quantity("T", ROW, "length of a time step"),
    "statistics/turnovers": Quantity("1", ROW, "eddy turnovers since the start of the simulation"),
    "statistics/seconds_per_step": Quantity("s", ROW, "wall time of a step"),
    "statistics/energy_?": Quantity("L^2/T^2", ROW, "kinetic energy per mass of a velocity component"),
    "statistics/energy": Quantity("L^2/T^2", ROW, "kinetic energy per mass"),
    "statistics/total_energy": Quantity("L^2/T^2", ROW, "kinetic energy plus energy of compression, per mass"),
    "statistics/compressible_fraction": Quantity("1", ROW, "share of the kinetic energy that is not solenoidal"),
    "statistics/dissipation_rate": Quantity("L^2/T^3", ROW, "energy per mass and time that viscosity dissipates"),
    "statistics/injection_rate": Quantity("L^2/T^3", ROW, "energy per mass and time that the forcing injects"),
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
    "statistics/skewness": Quantity("1", ROW, "skewness of longitudinal velocity gradients"),
    "statistics/flatness": Quantity("1", ROW, "flatness of longitudinal velocity gradients"),
    "closure/time": Quantity("T", "time", "since the start of the rollout"),
    "closure/residual": Quantity("1", "time", "largest relative residual of the solves for the resolved velocity"),
    "closure/*": Quantity("1", "time", "solves for the resolved velocity since the previous frame: {name}"),
    "outside_training/time": Quantity("T", "time", "since the start of the rollout"),
    "outside_training/*": Quantity("1", "time", "share of pairs with a network input outside its range in training"),
    "errors_over_time/seconds": Quantity("s", "time", "wall time of the frame"),
    "errors_over_time/validation_error": Quantity("1", "time", "relative L2 error of the velocity at tracks left out"),
    "errors_of_fields/*_error": Quantity("1", "time", "relative L2 error of the field: {name}"),
    "kernels/r_over_h": Quantity("1", ROW, "distance divided by the support"),
    "kernels/value_*": Quantity("1", ROW, "W h^3 of the kernel {name}"),
    "kernels/derivative_*": Quantity("1", ROW, "W' h^4 of the kernel {name}"),
    "errors/integral_*": Quantity("1", "", "integral over space of the kernel {name}"),
    "errors/*": Quantity("1", "", "relative L2 error on a field that the training did not use: {name}"),
    "slices/*velocity*": Quantity("L/T", "y x", "u_x in the plane z = pi: {name}"),
    "slices/*gradient*": Quantity("1/T", "y x", "du_x/dx in the plane z = pi: {name}"),
    "history/seconds": Quantity("s", ROW, "wall time since the start of the training"),
    "*history/*": Quantity("1", ROW, "in the training: {name}"),
    "*a_priori/delay": Quantity("T", ROW, "since the end of the training window"),
    "*a_priori/*": Quantity("1", ROW, "relative L2 error of the rates at the true state: {name}"),
    "acceleration_sample/*": Quantity("L/T^2", "particle xyz", "{name} acceleration of some particles"),
    "density_rate_sample/*": Quantity("M/L^3/T", "particle", "{name} rate of the density of some particles"),
    "*feature_range/*": Quantity("1", "input", "{name} of each input of the network in training"),
    "trials/*/seconds_per_turnover": Quantity("s", ROW, "wall time per eddy turnover"),
    "trials/*/size": Quantity("T", ROW, "time step; on a grid, the Courant number"),
    "trials/*": Quantity("1", ROW, "{name} of the velocity: rms, divided by the rms of the true velocity"),
    "weights/*": Quantity("1", "", "trained parameters"),
}
# Quantities in measures.h5, likewise.
OF_MEASURES = {
    "paths_*/times": Quantity("T", "time", "since the first common frame"),
    "paths_*/lags": Quantity("T", "lag", "interval of time"),
    "paths_*/structure": Quantity("L^2/T^2", "lag", "mean square of the increments of a velocity component"),
    "paths_*/flatness": Quantity("1", "lag", "flatness of the increments of a velocity component"),
    "paths_*/acceleration_correlation": Quantity("1", "lag", "autocorrelation of the acceleration"),
    "paths_*/acceleration_variance": Quantity("L^2/T^4", "time", "variance of an acceleration component"),
    "paths_*/tetrad_shape": Quantity("1", "time eigenvalue", "eigenvalues of the moments of tetrads over their sum"),
    "paths_*/*": Quantity("1", "time", "{name}, see eddies.analysis.lagrangian"),
    "*/wavenumber": Quantity("1/L", "wavenumber", "shell of the modes whose |k| rounds to this number"),
    "forced_spectra/*": Quantity("L^2/T^2", "wavenumber", "mean spectrum of the {name}"),
    "*spectra/[!t]*": Quantity("L^2/T^2", "time wavenumber", "energy of each shell: {name}"),
    "spectra/truth": Quantity("L^2/T^2", "time wavenumber", "energy of each shell: {name}"),
    "planes/velocity_*": Quantity("L/T", "time component y x", "{name} in the plane z = pi"),
    "planes/vorticity_*": Quantity("1/T", "time y x", "magnitude in the plane z = pi: {name}"),
    "pdfs/*_kl": Quantity("1", "time", "KL divergence of the PDF of the {name}"),
    "pdfs/*_[mt][or]*": Quantity("1", "time bin", "share of the values in each bin: {name}"),
    "errors/[!t]*": Quantity("1", "time", "{name}, see eddies.analysis.against_truth"),
    "*/energy": Quantity("L^2/T^2", "time", "kinetic energy per mass of the particles"),
    "*/density_rms": Quantity("M/L^3", "time", "standard deviation of the density"),
    "*/count_variance": Quantity("1", "time", "variance of counts in cells over that of random points"),
    "invariant*/second": Quantity("1", "edge", "edges of the bins of Q / <Q_w>"),
    "invariant*/third": Quantity("1", "edge", "edges of the bins of R / <Q_w>^(3/2)"),
    "invariants/*": Quantity("1", "second third", "share of the particles in each bin: {name}"),
    "invariant_rates/*": Quantity("1", "second third", "sum over the particles in each bin: {name}"),
    "distances/*": Quantity("1", "bin", "share of the distances to the nearest particle in each bin: {name}"),
    "forced_accelerations/*": Quantity("1", "bin", "share of the accelerations in each bin: {name}"),
}


def conventions(kind: str) -> dict[str, str]:
    """Return attributes that state the units, the box and the origin of time of a product; empty for a product without
    a flow."""
    return {**CONVENTIONS, "time_origin": ORIGINS[kind]} if kind in ORIGINS else {}


def python_value(value: Any) -> Any:
    """Return a number or text of an attribute as a Python object."""
    return value.item() if isinstance(value, np.generic) else value


def describe(dataset: h5py.Dataset) -> None:
    """Write the attributes `units`, `axes` and `description` of a dataset, if its path is known; collective."""
    for name, words in dataset_attributes(dataset.file.attrs.get("kind", ""), dataset.name.strip("/")).items():
        dataset.attrs[name] = words


def dataset_attributes(kind: str, path: str) -> dict[str, str]:
    """Return `units`, `axes` and `description` of the dataset at `path` in a product of this `kind`; empty if the path
    is unknown."""
    group, _, name = path.rpartition("/")
    known = OF_MEASURES if kind == "measures" else QUANTITIES
    quantity = next((each for pattern, each in known.items() if fnmatchcase(path, pattern)), None)
    if quantity is None and name == "time":
        beginning = "since the start of the simulation" if group == "fields/final" else BEGINNING.get(kind, "")
        quantity = Quantity("T", "time", beginning)
    return {} if quantity is None else {"units": quantity.units, "axes": quantity.axes,
                                        "description": quantity.description.format(name=name.replace("_", " "))}
