"""What products state about their units, their box and their times.

Units: L is the edge of the cube divided by 2 pi. T follows from lengths and velocities. M is such that the mean density
is 1 M/L^3. A dataset of a pure number has no units.
"""

#: Units of quantities at particles and on grids, by name of the column or variable.
UNITS = {"position": "L", "coordinates": "L", "velocity": "L/T", "acceleration": "L/T^2", "density": "M/L^3",
         "gradient": "1/T", "vorticity": "1/T", "strain": "1/T", "dissipation": "L^2/T^3", "q": "1/T^2", "r": "1/T^3",
         "pressure": "L^2/T^2"}
#: End of the name of a standard deviation, after the name of the quantity.
DEVIATION = "_deviation"
# Attributes of a file with a flow.
CONVENTIONS = {
    "units": "L: edge of the cube over 2 pi; T: follows from lengths and velocities; M: so that the mean density is "
             "1 M/L^3",
    "box": "cube with edges 2 pi L, periodic along x, y and z; 0 <= x, y, z < 2 pi; positions are wrapped into it",
}
OF_TRACKS = {
    "units": "L, T: those of the file with the tracks; without such a file those of the ground truth",
    "box": "cube with edges 2 pi length_unit; the origin of coordinates is at `corner` in it (attributes of about)",
}
ORIGINS = {
    "ground_truth": "for particles, filtered and unfiltered fields and `spectra`: the release of the tracers, which is "
                    "at time released_at (attribute of reference) of the simulation; for `statistics`, `stationary` "
                    "and fields/final: the start of the simulation",
    "reconstruction": "the first frame of the tracks",
    "measures": "the start of the rollout, start_time after the release of the tracers",
    "rollout": "the start of the rollout, start_time (attribute of rollout) after the release of the tracers",
}


def unit_of(name: str) -> str:
    """Return the units of a quantity or of its standard deviation; empty for a pure number."""
    return UNITS.get(name.removesuffix(DEVIATION), "")


def conventions(kind: str) -> dict[str, str]:
    """Return attributes that state the units, the box and the origin of time of a product; empty for a product without
    a flow."""
    stated = OF_TRACKS if kind == "reconstruction" else CONVENTIONS
    return {**stated, "time_origin": ORIGINS[kind]} if kind in ORIGINS else {}


def component_axis(name: str, count: int, of_vectors: str) -> str:
    """Return the name of the axis of `count` components of the quantity `name`."""
    return {1: "component", 3: of_vectors}.get(count, f"{name}_component")
