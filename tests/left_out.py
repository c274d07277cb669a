"""Leaving out figures in tests of the numbers and words of a report: they take most of its time."""

from eddies.report import learning
from eddies.report.page import Section


def leave_out_figures(patch, but=()):
    """Do not make figures, but those with these file names, with the `setattr` of a MonkeyPatch."""
    add = Section.add_figure

    def added(self, name, title, make, caption):
        add(self, name, title, make if name in but else lambda: None, caption)

    patch.setattr(Section, "add_figure", added)
    patch.setattr(learning, "curves", lambda history: None)
