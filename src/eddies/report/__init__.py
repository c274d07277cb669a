"""The report: figures, sections, the page."""

import contextlib
import os
import sys

# Figures here need no backend, and a value of MPLBACKEND that is none would end the import of matplotlib.
if "matplotlib" not in sys.modules and (backend := os.environ.pop("MPLBACKEND", None)):
    try:
        import matplotlib
    finally:
        os.environ["MPLBACKEND"] = backend
    with contextlib.suppress(ValueError):
        matplotlib.rcParams["backend"] = backend
