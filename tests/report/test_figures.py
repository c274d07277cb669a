import matplotlib
import numpy as np
import pytest
from matplotlib.text import Text

from eddies.report.figures import (BAR, LOOKS, POSITIVE, WIDEST, colour_bar, letter, looks, panels, png, show_plane,
                                   styled)


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
    """Panels with wide and narrow tick labels, a legend, a plane with a colour bar, and values that need a factor."""
    figure, axes = panels(2, 2, (3.8, 2.6), right=BAR)
    for axis, factor in zip(axes.flat, (1, 1e-9, 12345)):
        axis.plot([0, 1], [0, factor], label="a curve")
        axis.set(title="A title", xlabel="time", ylabel="value")
    axes[1, 0].legend()
    colour_bar(figure, show_plane(axes[1, 1], np.eye(4), (0, 1), POSITIVE), [axes[1, 1]], "value")
    letter(axes.flat)
    return figure


def test_nothing_covers_anything_else_or_leaves_the_figure():
    """Titles, labels of axes, and the factors above the second and the third panel."""
    figure = curves()
    png(figure)
    texts = [text for axis in figure.axes for text in (
        axis.xaxis.label, axis.yaxis.label, axis.yaxis.get_offset_text(),
        *(child for child in axis.get_children() if isinstance(child, Text))) if text.get_text()]
    assert {"1e−9", "1e4"} <= {text.get_text() for text in texts} and len(texts) == 13
    boxes = [text.get_window_extent(figure.canvas.get_renderer()) for text in texts]
    for index, box in enumerate(boxes):
        assert figure.bbox.x0 <= box.x0 and box.x1 <= figure.bbox.x1
        assert figure.bbox.y0 <= box.y0 and box.y1 <= figure.bbox.y1
        assert not any(box.overlaps(other) for other in boxes[:index])
        assert not any(box.overlaps(axis.bbox) for axis in figure.axes)


@pytest.mark.parametrize("draw, values", [("plot", [0.9905, 1.0095]), ("plot", [-12000.0, 12000.0]),
                                          ("semilogy", [1e-12, 1e-3]), ("semilogy", [0.02, 0.06])])
def test_wide_tick_labels_leave_room_for_the_label(draw, values):
    @styled
    def drawn():
        figure, axes = panels(2, 2, (3.6, 2.6))
        getattr(axes[0, 0], draw)([0, 1], values)
        axes[0, 0].set_ylabel("ratio")
        return figure, axes

    figure, axes = drawn()
    png(figure)
    assert axes[0, 0].yaxis.label.get_window_extent(figure.canvas.get_renderer()).x0 >= 0


def test_each_method_has_one_colour_and_one_marker():
    methods = {"paper": ["paper"], "forced": ["forced", "paper"], "mine": ["mine"], "free": ["free", "none"],
               "grid-16": ["grid-16"], "grid-32": ["grid-32"]}
    found = looks(methods, {"grid-16": 16, "grid-32": 32})
    assert found["paper"] == LOOKS["paper"] and found["free"] == LOOKS["none"]
    assert len(set(found.values())) == len(found)
    assert found["grid-16"][1] == found["grid-32"][1] and found["grid-32"][0] == "#0072b2"
    assert sum(int(found["grid-16"][0][at:at + 2], 16) for at in (1, 3, 5)) > 0x72 + 0xb2  # lighter
    assert looks({"other": ["other", "paper"]}, {})["other"] == LOOKS["paper"]
    assert looks({"mine": ["mine"]}, {})["mine"] == found["mine"]  # in other company
    many = looks({f"own-{number}": [] for number in range(12)}, {})
    assert len(set(many.values())) == 12 and not {*many.values()} & {*LOOKS.values()}


@pytest.mark.parametrize("columns, width", [(2, 6.0), (5, WIDEST), (6, 18.0)])
def test_up_to_five_panels_fit_into_a_column_of_text(columns, width):
    figure, _ = panels(2, columns, (3.0, 2.0))
    assert figure.get_size_inches() == pytest.approx([width, 4.0 * width / (3.0 * columns)])


def test_a_plane_has_its_error_in_a_corner_and_colours_by_a_power():
    _, ((axis,),) = panels(1, 1, (3.0, 3.0))
    image = show_plane(axis, np.array([[0.0, 1.0], [4.0, 4.0]]), (0, 4), POSITIVE, 0.123, power=0.5)
    assert [text.get_text() for text in axis.texts] == ["0.12"]
    assert image.norm(np.array([0.0, 1.0, 4.0])).tolist() == pytest.approx([0.0, 0.5, 1.0])
