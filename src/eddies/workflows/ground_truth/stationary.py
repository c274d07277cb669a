"""The stationary state of a ground truth."""

import tomllib

from eddies.analysis.isotropic_turbulence import StationarySpan
from eddies.io.hdf5 import File, ProductError, read_attributes, read_table
from eddies.io.provenance import read_provenance


def read_stationary_span(file: File) -> StationarySpan:
    """Return the span of an open ground_truth.h5 over which its stationary state is averaged.

    Raises ProductError if the span holds fewer than three samples.
    """
    span, scene = read_attributes(file, "stationary"), tomllib.loads(read_provenance(file)["scene"])
    forced_below = scene["forcing"]["wavenumber"] if "forcing" in scene else 0.0
    try:
        return StationarySpan(read_table(file, "statistics"), read_table(file, "spectra_of_statistics")["energy"],
                              read_attributes(file, "reference")["viscosity"], span["start"], span["end"], forced_below)
    except ValueError as error:
        raise ProductError(f"{file.filename}: {error}; raise [spin_up] stationary and run `eddies dns` again") from None
