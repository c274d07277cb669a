"""Leaving out figures in tests of the numbers and words of a report: they take most of its time."""

import importlib
import pkgutil

from matplotlib.figure import Figure

import eddies.report


def leave_out_figures(patch, but=()):
    """Do not make figures, but those of the functions with these names, with the `setattr` of a MonkeyPatch."""
    # All are imported first: one that is imported later would keep what it takes from another as it is now.
    modules = [importlib.import_module(found.name)
               for found in pkgutil.iter_modules(eddies.report.__path__, "eddies.report.")]
    for module in modules:
        for name, function in list(vars(module).items()):
            if name not in but and getattr(function, "__annotations__", {}).get("return") in (Figure, "Figure"):
                patch.setattr(module, name, lambda *given, **named: None)
