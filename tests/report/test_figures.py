import matplotlib
import numpy as np
import pytest

from eddies.report import figures
from eddies.report.figures import colour_bar, letter, panels, png, show_plane, styled


def test_drawing_leaves_the_settings_of_the_user(monkeypatch):
    monkeypatch.setitem(matplotlib.rcParams, "backend", "svg")
    monkeypatch.setitem(matplotlib.rcParams, "font.size", 20.0)

    @styled
    def draw():
        figure, axes = panels(1, 1, (2, 2))
        assert matplotlib.rcParams["font.size"] == 10.5
        return figure

    assert png(draw()).startswith(b"\x89PNG")
    assert matplotlib.rcParams["backend"] == "svg" and matplotlib.rcParams["font.size"] == 20


@styled
def curves():
    """Panels with wide and narrow tick labels, a legend that makes them smaller, and values that need a factor."""
    figure, axes = panels(2, 2, (3, 2.6))
    for axis, factor in zip(axes.flat, (1, 1e-9, 12345, 1e-3)):
        axis.plot([0, 1], [0, factor], label="a curve")
        axis.set(title="A title", xlabel="time", ylabel="value")
    axes[1, 0].legend(loc="upper center", bbox_to_anchor=(0.5, 0), borderaxespad=3.8)
    axes[1, 1].set(yscale="log", ylim=(1e-7, 2))
    letter(axes.flat)
    return figure


def extents(figure, texts):
    return [text.get_window_extent(figure.canvas.get_renderer()) for text in texts if text.get_text()]


def test_labels_stand_beside_tick_labels_and_titles_beside_factors():
    """At a distance of 4 points; there is a factor above the second panel alone."""
    figure = curves()
    png(figure)
    for axis in figure.axes:
        low, high = axis.get_ylim()
        ticks = [label for label, place in zip(axis.get_yticklabels(), axis.get_yticks()) if low <= place <= high]
        (name,), numbers = extents(figure, [axis.yaxis.label]), extents(figure, ticks)
        assert min(box.x0 for box in numbers) - name.x1 == pytest.approx(4 * 150 / 72, abs=0.1) and name.x0 > 0
        (name,), numbers = extents(figure, [axis.xaxis.label]), extents(figure, axis.get_xticklabels())
        assert min(box.y0 for box in numbers) - name.y1 == pytest.approx(4 * 150 / 72, abs=0.1) and name.y0 > 0
    factors = [axis.yaxis.get_offset_text() for axis in figure.axes]
    assert [bool(text.get_text()) for text in factors] == [False, True, False, False]
    factor, = extents(figure, factors)
    titles = [text for axis in figure.axes for text in axis.get_children() if "A title" in getattr(text, "_text", "")]
    assert len(titles) == 4 and not any(factor.overlaps(title) for title in extents(figure, titles))
    assert figure.axes[0].bbox.x1 < factor.x0


def test_powers_of_ten_are_characters():
    figure = curves()
    png(figure)
    labels = [label.get_text() for label in figure.axes[3].get_yticklabels()]
    assert {"10⁰", "10⁻⁶"} <= set(labels) and not any("$" in label for label in labels)
    powers = figures.Powers()
    assert [powers(value) for value in (1e-12, 2e3, 0.6)] == ["10⁻¹²", "2\u2009×\u200910³", "6\u2009×\u200910⁻¹"]


@styled
def planes():
    figure, axes = panels(2, 2, (2, 2), sharex=True, sharey=True)
    for row, limit in zip(axes, (1, 1000)):
        for axis in row:
            image = show_plane(axis, np.eye(4), (0, limit), figures.POSITIVE)
        colour_bar(figure, image, row, "value")
    return figure


def test_colour_bars_are_measured_once_a_place_and_stand_as_if_always(monkeypatch):
    counted, measure = [], matplotlib.axes.Axes.get_tightbbox

    def count(self, *arguments, **options):
        counted.append(isinstance(self, figures.Panel))
        return measure(self, *arguments, **options)

    monkeypatch.setattr(matplotlib.axes.Axes, "get_tightbbox", count)
    image = png(planes())
    once = counted.count(False)
    monkeypatch.setattr(figures, "_once_a_place", lambda axes: axes.get_tightbbox)
    assert png(planes()) == image and counted.count(False) == 4 * once
