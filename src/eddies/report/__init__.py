"""The report: figures, sections and the page."""

import contextlib
import os
import sys

# The report needs no backend, and the import of matplotlib would fail with an unknown value of MPLBACKEND.
if "matplotlib" not in sys.modules and (backend := os.environ.pop("MPLBACKEND", None)):
    try:
        import matplotlib
    finally:
        os.environ["MPLBACKEND"] = backend
    with contextlib.suppress(ValueError):
        matplotlib.rcParams["backend"] = backend
