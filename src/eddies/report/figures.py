"""What all figures share: colours, fonts, panels, slices with one colour scale, guide lines."""

from __future__ import annotations

import functools
import io
import logging
import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import TICKDOWN, TICKLEFT, Line2D
from matplotlib.spines import Spine
from matplotlib.ticker import LogFormatterSciNotation, LogLocator, NullLocator, StrMethodFormatter
from matplotlib.transforms import Bbox, ScaledTranslation

from eddies.report.page import Section

if TYPE_CHECKING:
    from eddies.parallel.communicator import Comm

log = logging.getLogger("eddies")

# Colour-blind safe (Okabe and Ito), the same quantity in the same colour in every figure.
DNS, FILTERED, TRUTH, MODEL = "#000000", "#7f7f7f", "#0072B2", "#D55E00"
SECOND, THIRD, FOURTH = "#009E73", "#CC79A7", "#E69F00"
GUIDE = "#9a9a9a"
LEAST = (0, -0.1, 0, 0.2)  # what stands around a panel at least, in inches: left, below, right, above
SIGNED, POSITIVE = "RdBu_r", "viridis"
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")

STYLE = {
    "font.size": 10.5, "axes.titlesize": 10.5, "axes.labelsize": 10.5, "legend.fontsize": 9,
    "xtick.labelsize": 9, "ytick.labelsize": 9, "font.family": "DejaVu Sans",
    "mathtext.fontset": "dejavusans",
    "axes.titley": 1.0,  # to look for a place measures the tick labels twice more
    "axes.spines.top": False, "axes.spines.right": False, "axes.linewidth": 0.8, "lines.linewidth": 1.7,
    "legend.frameon": False, "figure.dpi": 150, "savefig.dpi": 150, "axes.prop_cycle": matplotlib.cycler(
        color=[TRUTH, MODEL, SECOND, THIRD, FOURTH, DNS]),
}
# Of the settings all but the backend: no context gives back that of the user, in which a notebook shows its figures.
PLAIN = {key: value for key, value in matplotlib.rcParamsDefault.items() if key != "backend"}


def styled(draw: Callable[..., Figure]) -> Callable[..., Figure]:
    """Run a drawing function under the common style, whatever the user's matplotlib settings are."""
    @functools.wraps(draw)
    def drawn(*arguments, **named):
        with matplotlib.rc_context({**PLAIN, **STYLE}):
            return draw(*arguments, **named)
    return drawn


class Panel(Axes):
    """Axes that cost less to lay out and to draw: to place, measure and draw its ticks is most of a figure's time."""

    _guessed = False

    def __init__(self, *arguments, **named) -> None:
        self._beside: dict[Axis, list[str]] = {}  # by axis, the tick labels beside which its label has been put
        super().__init__(*arguments, **named)

    def draw(self, renderer) -> None:
        """Draw all, the labels of x and y beside their tick labels as they are after the layout."""
        for axis, labels in self._beside.items():
            if labels != _tick_labels(axis):
                self._place_label(axis, renderer)
        super().draw(renderer)

    def get_tightbbox(self, renderer=None, *, for_layout_only=False, **options) -> Bbox | None:
        """The box of the axes with what stands around them, in pixels.

        A constrained layout asks twice, the first time to give the axes about their size. That answer is a guess; it is
        low, because larger axes have more ticks and wider labels, and the layout only ever widens margins. Colour bars
        take the size of their panels: beside them it asks in earnest. The tick labels, which axes measure several times
        to find places for other texts, are then measured once.
        """
        if not self._guessed and all(isinstance(axes, Panel) for axes in self.figure.axes):
            self._guessed = True
            self.apply_aspect()
            return Bbox.from_extents(*(self.bbox.extents + self.figure.dpi * np.array(LEAST)))
        if not (for_layout_only and self.axison):
            return super().get_tightbbox(renderer, for_layout_only=for_layout_only, **options)
        self.apply_aspect()
        axes = [axis for axis in (self.xaxis, self.yaxis) if axis.get_visible()]
        boxes = [box for axis in axes for box in self._place_label(axis, renderer)]
        others = [artist for artist in self.get_default_bbox_extra_artists() if not isinstance(artist, Spine)]
        for axis in axes:
            axis.set_visible(False)
        rest = super().get_tightbbox(renderer, for_layout_only=True, bbox_extra_artists=others)
        for axis in axes:
            axis.set_visible(True)
        return Bbox.union([rest, *boxes])

    def _place_label(self, axis: Axis, renderer) -> list[Bbox]:
        """Put the label of x or y beside its tick labels. The boxes of all texts and the ticks, in pixels, of the label
        only how far it stands out: a panel is not widened for a long one."""
        texts = [text for text in (axis.label, axis.offsetText) if text.get_visible()]
        for text in texts:
            text.set_visible(False)
        labels = axis.get_tightbbox(renderer)
        for text in texts:
            text.set_visible(True)
        direction = np.array([axis is self.yaxis, axis is self.xaxis], int)  # away from the panel: left or below
        dots, corner = self.figure.dpi / 72, self.bbox.min
        ticks = Bbox([corner - direction * dots * axis.get_tick_padding(), self.bbox.max])
        boxes = [ticks] if labels is None else [ticks, labels]
        away = (corner - Bbox.union(boxes).min) / dots + axis.labelpad
        axis.set_label_coords(*(1 - direction) / 2, self.transAxes + ScaledTranslation(
            *(-direction * away / 72), self.figure.dpi_scale_trans))
        self._beside[axis] = _tick_labels(axis)
        if axis.label.get_text():
            label = axis.label.get_window_extent(renderer).min
            boxes.append(Bbox([np.where(direction, label, corner), self.bbox.max]))
        if axis.offsetText.get_text():
            boxes.append(axis.offsetText.get_window_extent(renderer))
        return boxes

    def minor_ticks(self) -> list[tuple[Axis, np.ndarray]]:
        """The axes x and y whose minor ticks have no label, and where these are."""
        found = []
        for axis in (self.xaxis, self.yaxis):
            low, high = sorted(axis.get_view_interval())
            places = axis.get_minorticklocs()
            places = places[(low <= places) & (places <= high)]
            if len(places) and not any(axis.get_minor_formatter().format_ticks(places)):
                found.append((axis, places))
        return found

    def merge_ticks(self, ticks: list[tuple[Axis, np.ndarray]]) -> None:
        """Make one line of markers of minor ticks: every tick is five artists."""
        for axis, places in ticks:
            axis.set_minor_locator(NullLocator())
            across = axis is self.xaxis
            self.add_artist(Line2D(
                *((places, 0 * places) if across else (0 * places, places)), linestyle="none", color="black",
                transform=self.get_xaxis_transform() if across else self.get_yaxis_transform(), clip_on=False,
                marker=TICKDOWN if across else TICKLEFT, markersize=matplotlib.rcParams["xtick.minor.size"],
                markeredgewidth=matplotlib.rcParams["xtick.minor.width"], zorder=2.01)).set_in_layout(False)


def _tick_labels(axis: Axis) -> list[str]:
    return axis.get_major_formatter().format_ticks(axis.get_majorticklocs())


class Powers(LogFormatterSciNotation):
    """Labels 10⁻³ and 2 × 10⁻³ of a logarithmic axis in characters of the font: formulas are slow to set."""

    def __call__(self, x: float, pos: int | None = None) -> str:
        if not super().__call__(x, pos):
            return ""
        exponent = math.floor(math.log10(x) + 1e-9)
        factor = f"{x / 10.0**exponent:g}"
        return ("" if factor == "1" else f"{factor}\u2009×\u2009") + f"10{str(exponent).translate(SUPERSCRIPTS)}"


def panels(rows: int, columns: int, size: tuple[float, float], **sharing) -> tuple[Figure, np.ndarray]:
    """A figure of rows x columns axes, always a two-dimensional array; `size` is of one panel in inches."""
    figure = Figure(figsize=(size[0] * columns, size[1] * rows), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.06, h_pad=0.06)
    axes = figure.subplots(rows, columns, squeeze=False, subplot_kw={"axes_class": Panel}, **sharing)
    for panel in axes.flat:
        # A factor of the tick labels stands above them and beside the title.
        panel.yaxis.get_offset_text().set(horizontalalignment="right", x=-0.02)
    return figure, axes


def letter(axes: Sequence[Axes]) -> None:
    """Name the panels A, B, C... before their titles."""
    if len(axes) > 1:
        for name, panel in zip("ABCDEFGHIJKLMNOP", axes):
            title = panel.get_title()
            panel.set_title(f"{name}   {title}" if title else name, loc="left")
            panel.set_title("", loc="center")


def _once_a_place(axes: Axes) -> Callable[..., Bbox | None]:
    """Their `get_tightbbox`, which measures once where they stand: a layout asks a colour bar for every panel of it."""
    measure, known = axes.get_tightbbox, {}

    def get_tightbbox(renderer=None, **options) -> Bbox | None:
        place = *axes.get_position(original=True).bounds, *options.items()
        if place not in known:
            known[place] = measure(renderer, **options)
        return known[place]
    return get_tightbbox


@styled
def png(figure: Figure) -> bytes:
    """The figure as a PNG image."""
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            if type(axis.get_major_formatter()) is LogFormatterSciNotation:
                axis.set_major_formatter(Powers())
            if type(axis.get_minor_formatter()) is LogFormatterSciNotation:
                axis.set_minor_formatter(Powers())
        if not isinstance(axes, Panel):
            axes.get_tightbbox = _once_a_place(axes)
    panels = [axes for axes in figure.axes if isinstance(axes, Panel)]
    ticks = [axes.minor_ticks() for axes in panels]  # of all, before any changes those of panels that share its axis
    for axes, found in zip(panels, ticks):
        axes.merge_ticks(found)
    buffer = io.BytesIO()
    # Not `savefig`, which draws every figure twice: the first time for its layout alone. Level 2 of 9 takes half the
    # time of the usual 6 and a fifth more space.
    FigureCanvasAgg(figure).print_png(buffer, metadata={"Software": None}, pil_kwargs={"compress_level": 2})
    return buffer.getvalue()


def draw(comm: Comm, sections: Sequence[Section]) -> None:
    """Turn the figures of this rank's sections into PNG images; all ranks call it, and each draws as many as any.

    One that cannot be drawn is a warning, and its section goes without it.
    """
    illustrations = [illustration for section in sections for illustration in section.illustrations]
    counts = comm.allgather(len(illustrations))
    share = -(-sum(counts) // comm.size)
    # A figure stays where it was made, if there is no rank with fewer: to send one takes a tenth of drawing it.
    free = [rank for rank, count in enumerate(counts) for _ in range(share - count)]
    before = sum(max(count - share, 0) for count in counts[:comm.rank])
    own, rest = illustrations[:share], illustrations[share:]
    places = free[before:before + len(rest)]
    given = comm.alltoall([[illustration.image for illustration, place in zip(rest, places) if place == rank]
                           for rank in range(comm.size)])
    for illustration in own:
        illustration.image = _png_or_none(illustration.image)
    drawn = comm.alltoall([[_png_or_none(figure) for figure in figures] for figures in given])
    for illustration, place in zip(rest, places):
        illustration.image = drawn[place].pop(0)
    for section in sections:
        section.illustrations = [each for each in section.illustrations if each.image is not None]


def _png_or_none(figure: Figure) -> bytes | None:
    try:
        return png(figure)
    except Exception as error:  # of matplotlib or its settings: no reason to lose numbers and other figures
        log.warning("report: a figure is left out, it cannot be drawn (%s: %s)", type(error).__name__, error)
        return None


def largest(*arrays: np.ndarray, quantile: float = 0.998) -> float:
    """A colour limit for all these arrays: a high quantile of their magnitude, and never zero."""
    values = np.abs(np.concatenate([np.ravel(array) for array in arrays]))
    return float(np.quantile(values, quantile)) or 1.0


def show_plane(axis: Axes, plane: np.ndarray, limits: tuple[float, float], colours: str):
    """Draw a [y, x] plane of the box with given colour limits; returns the image for a colour bar."""
    length = 2 * np.pi
    image = axis.imshow(plane, origin="lower", extent=(0, length, 0, length), cmap=colours, vmin=limits[0],
                        vmax=limits[1], interpolation="bilinear", aspect="equal")
    ticks = [0, length / 2, length]
    axis.set_xticks(ticks, ["0", "π", "2π"])
    axis.set_yticks(ticks, ["0", "π", "2π"])
    for side in ("top", "right"):
        axis.spines[side].set_visible(True)
    return image


def colour_bar(figure: Figure, image, axes: Sequence[Axes], label: str, extend: str = "both"):
    """One colour bar for all panels of `axes`; returns it."""
    bar = figure.colorbar(image, ax=list(axes), shrink=0.9, aspect=22, pad=0.015, extend=extend, label=label)
    bar.outline.set_linewidth(0.6)
    return bar


def guide_power_law(
    axis: Axes, wavenumber: Sequence[float], level: float, exponent: float, label: str
) -> None:
    """A thin dashed power law from (wavenumber[0], level) on, with its label at the upper end."""
    wavenumber = np.asarray(wavenumber, dtype=float)
    values = level * (wavenumber / wavenumber[0]) ** exponent
    axis.plot(wavenumber, values, color=GUIDE, linestyle="--", linewidth=1.1)
    middle = np.sqrt(wavenumber[0] * wavenumber[-1]), np.sqrt(values[0] * values[-1])
    axis.annotate(label, middle, xytext=(4, 3), textcoords="offset points", color="#5a5a5a", fontsize=9)


def number_wavenumbers(axis: Axes) -> None:
    """Ticks 1, 2, 5, 10, 20... on a logarithmic axis of wavenumbers, however short it is."""
    axis.set_xscale("log")
    axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.xaxis.set_minor_locator(NullLocator())


def legend_below(axis: Axes, columns: int) -> None:
    """The legend under the panel, where it can hide no line."""
    axis.legend(loc="upper center", bbox_to_anchor=(0.5, 0), borderaxespad=3.8, ncol=columns, columnspacing=1.2,
                handlelength=1.8)


def mark_time(axis: Axes, time: float, label: str) -> None:
    """A thin vertical line at a moment, named along its top."""
    axis.axvline(time, color=GUIDE, linewidth=1, linestyle=":")
    axis.annotate(label, (time, 1), xycoords=("data", "axes fraction"), xytext=(3, -2),
                  textcoords="offset points", va="top", fontsize=8.5, color="#5a5a5a")
