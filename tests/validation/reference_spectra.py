"""Mean spectra of stationary flows beside that of the isotropic data set of Johns Hopkins. A script.

    python tests/validation/reference_spectra.py "hit=runs/hit,runs/hit-2" hit-256=runs/paper-256

Reads the ground_truth.h5 of runs whose scenes have [spin_up] stationary. Runs of one name are averaged, with the
standard deviation over them. Prints eps^(-2/3) k^(5/3) E(k) at several k eta as a Markdown table. Spectra of different
Reynolds numbers collapse in the dissipation range, from k eta = 0.1 on.
"""

import sys
from pathlib import Path

import numpy as np
from mpi4py import MPI

from eddies.analysis.isotropic_turbulence import StationarySpan
from eddies.io.hdf5 import open_product
from eddies.workflows.ground_truth.stationary import read_stationary_span

# Johns Hopkins Turbulence Databases, isotropic1024coarse, Re_lambda 417 to 433 (Li et al., J. Turbulence 9, N31, 2008;
# Perlman et al. 2007): k eta and the compensated spectrum, with nu = 1.85e-4, eps = 0.1031 and eta = 0.0028.
JOHNS_HOPKINS = {0.02: 1.59, 0.05: 1.77, 0.1: 2.08, 0.126: 2.17, 0.2: 1.90, 0.5: 0.522, 1.0: 0.0533}


def span_of(directory: Path) -> StationarySpan:
    """The stationary state of a run."""
    with open_product(MPI.COMM_SELF, directory / "ground_truth.h5", "ground_truth") as file:
        return read_stationary_span(file)


def compensated_at(span: StationarySpan, wavenumbers: np.ndarray) -> np.ndarray:
    """The compensated spectrum at some k eta, interpolated in logarithms; NaN outside the unforced shells."""
    k_eta, values = span.unforced()
    return np.exp(np.interp(np.log(wavenumbers), np.log(k_eta), np.log(values), left=np.nan, right=np.nan))


def cell(values: np.ndarray) -> str:
    """Mean with the standard deviation over runs; empty without values."""
    if np.isnan(values).any():
        return ""
    return f"{values.mean():.3g}" + (f" ± {values.std(ddof=1):.1g}" if len(values) > 1 else "")


def table(groups: dict[str, list[StationarySpan]]) -> str:
    """The rows of all k eta, and of the Reynolds numbers, as Markdown."""
    wavenumbers = np.array([*JOHNS_HOPKINS])
    found = {name: np.array([compensated_at(span, wavenumbers) for span in spans]) for name, spans in groups.items()}
    reynolds = [cell(np.array([span.mean("reynolds_lambda") for span in spans])) for spans in groups.values()]
    lines = [f"| kη | Johns Hopkins | {' | '.join(groups)} |", "|---|---|" + "---|" * len(groups),
             f"| Re_λ | 417 to 433 | {' | '.join(reynolds)} |"]
    for row, (k_eta, reference) in enumerate(JOHNS_HOPKINS.items()):
        cells = " | ".join(cell(each[:, row]) for each in found.values())
        lines.append(f"| {k_eta:g} | {reference:g} | {cells} |")
    return "\n".join(lines)


if __name__ == "__main__":
    given = dict(argument.split("=", 1) for argument in sys.argv[1:])
    print(table({name: [span_of(Path(path)) for path in paths.split(",")] for name, paths in given.items()}))
