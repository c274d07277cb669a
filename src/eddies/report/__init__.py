"""The report: figures, sections and the page."""

import contextlib
import os
import sys

# The report needs no backend, and an unknown value of MPLBACKEND would end the import of matplotlib.
if "matplotlib" not in sys.modules and (backend := os.environ.pop("MPLBACKEND", None)):
    try:
        import matplotlib
    finally:
        os.environ["MPLBACKEND"] = backend
    with contextlib.suppress(ValueError):
        matplotlib.rcParams["backend"] = backend
