"""The spectra of an open rollout.h5. Without torch: the report reads them too."""

from collections.abc import Mapping

import numpy as np

from eddies.analysis.rollout_spectra import RolloutSpectra
from eddies.io.hdf5 import File, ProductError, make_again, read_attributes, read_table

TABLES = "spectra_of_model", "spectra_of_truth"


def read_spectra(file: File, flow: Mapping[str, np.ndarray] | None) -> RolloutSpectra:
    """With the table `spectra` of the ground truth, or None. ProductError where a rollout has no spectra, as one of an
    earlier version."""
    missing = [name for name in TABLES if name not in file]
    if missing:
        raise ProductError(f"{file.filename}: holds no {' and '.join(missing)}, as made by an earlier version; "
                           f"{make_again('rollout')}")
    return RolloutSpectra(*(read_table(file, name) for name in TABLES), flow,
                          float(read_attributes(file, "rollout")["start_time"]))
