"""Colours and fonts of all figures, and functions that draw parts of figures."""

import functools
import io
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import PowerNorm, to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FuncFormatter, LogFormatter, LogLocator, NullFormatter, NullLocator, StrMethodFormatter
from matplotlib.transforms import Bbox

Look = tuple[str, str]  # colour, marker
Table = Mapping[str, np.ndarray]

# The palette of Okabe and Ito, which colour-blind readers can distinguish. A quantity has one colour in all figures.
DNS, FILTERED, TRUTH, MODEL = "#000000", "#7f7f7f", "#000000", "#D55E00"
BLUE, SECOND, THIRD, FOURTH, FIFTH, SIXTH = "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8c564b"
GUIDE, NOTE = "#9a9a9a", "#5a5a5a"
SIGNED, POSITIVE = "RdBu_r", "viridis"
LEFT, RIGHT, BOTTOM, TOP = 0.84, 0.12, 0.5, 0.3  # inches around a panel, for its labels and its title
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
BAR = 0.8  # inches beside a panel for a colour bar with its labels
WIDEST, MOST_ACROSS = 10.8, 5  # inches, panels: so many panels beside each other remain legible in a column of text

STYLE = {
    "font.size": 10.5, "axes.titlesize": 10.5, "axes.labelsize": 10.5, "legend.fontsize": 9,
    "xtick.labelsize": 9, "ytick.labelsize": 9, "font.family": "DejaVu Sans",
    "mathtext.fontset": "dejavusans",
    "axes.titley": 1.0,  # a fixed height; for an automatic one, all tick labels would be measured again
    "axes.spines.top": False, "axes.spines.right": False, "axes.linewidth": 0.8, "lines.linewidth": 1.7,
    "axes.formatter.limits": (-4, 4),  # wider tick labels get a common factor
    "legend.frameon": False, "figure.dpi": 150, "savefig.dpi": 150, "axes.prop_cycle": matplotlib.cycler(
        color=[BLUE, MODEL, SECOND, THIRD, FOURTH, DNS]),
}
# Colour and marker of each method in all figures, by the name of its preset; "none": without any force. Forms of one
# kind have one colour.
LOOKS = {"paper": (MODEL, "o"), "resolved": (SECOND, "s"), "local": (THIRD, "D"), "paper-code": (SIXTH, "v"),
         "wcsph": (FOURTH, "^"), "transport-velocity": (FIFTH, "P"), "none": ("#b5a642", "X"),
         "resolved + pairs": (SECOND, "X"), "local + pairs": (THIRD, "p"), "transport-velocity-hand": (FIFTH, "<"),
         "transport-velocity-rollouts": (FIFTH, ">")}
OTHERS = list(zip(2 * ("#7b3294", "#e7298a", "#66a61e", "#a6761d", "#ff7f7f", "#666633"), ">p<d*8d*8>p<"))  # of others
GRID, LIGHTEST = "h", 0.55  # marker of grids; share of white in the blue of the coarsest grid
WIDE = {"color": TRUTH, "linewidth": 2.2}  # a line of the truth, which is seen beside and behind other lines
OUTLINED = [withStroke(linewidth=2, foreground="white")]  # of names on points and lines
ACROSS = 5  # entries in a line of a legend at the foot of a figure
# The backend is left out: rc_context does not restore it, and a notebook would no longer show its figures.
PLAIN = {key: value for key, value in matplotlib.rcParamsDefault.items() if key != "backend"}


@dataclass(frozen=True)
class Variant:
    """A variant in figures: its label, its colour and marker, and numbers and tables of it."""

    label: str
    look: Look
    numbers: Mapping[str, Any]
    tables: Mapping[str, Table]

    def line(self, table: Table) -> dict[str, Any]:
        """Return the style of a line through columns of a table, with about eight markers."""
        points = max(np.shape(column)[-1] for column in table.values())
        return {"color": self.look[0], "marker": self.look[1], "markersize": 4, "markevery": max(points // 8, 1),
                "label": self.label}


def styled(draw: Callable) -> Callable:
    """Return a drawing function that uses the common style, whatever the user's matplotlib settings are."""
    @functools.wraps(draw)
    def drawn(*arguments, **named):
        with matplotlib.rc_context({**PLAIN, **STYLE}):
            return draw(*arguments, **named)
    return drawn


def panels(rows: int, columns: int, size: tuple[float, float], right: float = 0.0, below: float = 0.0,
           **sharing) -> tuple[Figure, np.ndarray]:
    """Return a figure and its axes (rows, columns), with fixed margins for labels and titles.

    All lengths are in inches. size: width and height of a panel with its labels. right: room for colour bars, beside
    each panel or, with `sharey`, beside the last one. below: room for a legend below each panel. sharing: `sharex` and
    `sharey` of `Figure.subplots`. A figure of up to MOST_ACROSS panels a row is shrunk to a width of WIDEST.
    """
    width, height = size[0] * columns, size[1] * rows
    if columns <= MOST_ACROSS and width > WIDEST:
        width, height = WIDEST, height * WIDEST / width
    figure = Figure(figsize=(width, height))
    across, up = RIGHT + right + LEFT, TOP + below + BOTTOM
    if sharing.get("sharey"):
        across = RIGHT + 0.08
    if sharing.get("sharex") is True:
        up = TOP + 0.05
    left, upper, end, lower = LEFT, height - TOP, width - RIGHT - right, below + BOTTOM
    wide, high = (end - left - (columns - 1) * across) / columns, (upper - lower - (rows - 1) * up) / rows
    figure.subplots_adjust(left / width, lower / height, end / width, upper / height, across / wide, up / high)
    axes = figure.subplots(rows, columns, squeeze=False, **sharing)
    for panel in axes.flat:
        # The factor of the tick labels is written to the left of the title.
        panel.yaxis.get_offset_text().set(horizontalalignment="right", x=-0.02)
    return figure, axes


def legend_at_foot(figure: Figure, handles: Sequence[Any] | Axes) -> None:
    """Put a legend below all panels, for which the figure becomes higher. Its entries are lines or those of a panel."""
    handles = handles.get_legend_handles_labels()[0] if isinstance(handles, Axes) else handles
    foot, (width, height), place = 0.1 + 0.2 * -(-len(handles) // ACROSS), figure.get_size_inches(), figure.subplotpars
    figure.set_size_inches(width, height + foot)
    figure.subplots_adjust(bottom=(place.bottom * height + foot) / (height + foot),
                           top=(place.top * height + foot) / (height + foot))
    figure.legend(handles=handles, loc="lower center", ncols=min(len(handles), ACROSS), columnspacing=1.2)


def letter(axes: Sequence[Axes]) -> None:
    """Write the letters A, B, C, ... before the titles of the panels. A single panel gets no letter."""
    if len(axes) > 1:
        for name, panel in zip("ABCDEFGHIJKLMNOP", axes):
            title = panel.get_title()
            panel.set_title(f"{name}   {title}" if title else name, loc="left")
            panel.set_title("", loc="center")


@styled
def png(figure: Figure) -> bytes:
    """Return the figure as a PNG image.

    To save time, logarithmic axes get plain text as labels and, if they span two decades or more, no minor ticks.
    """
    for axis in (axis for axes in figure.axes for axis in (axes.xaxis, axes.yaxis) if axis.get_scale() == "log"):
        low, high = sorted(axis.get_view_interval())
        if high >= 100 * low:
            axis.set_minor_locator(NullLocator())
        if not isinstance(axis.get_major_formatter(), LogFormatter):
            continue
        if high < 30 * low:
            plain_log_ticks(axis)
        else:
            axis.set_major_formatter(FuncFormatter(_power_of_ten))
            axis.set_minor_formatter(NullFormatter())
    buffer = io.BytesIO()
    # `Figure.savefig` draws a figure twice. Compression level 2 takes half the time of 6 and a fifth more space.
    FigureCanvasAgg(figure).print_png(buffer, metadata={"Software": None}, pil_kwargs={"compress_level": 2})
    return buffer.getvalue()


def _power_of_ten(value: float, position: int | None) -> str:
    """Write 0.001 as 10⁻³."""
    return "10" + str(round(np.log10(value))).translate(SUPERSCRIPTS)


def largest(*arrays: np.ndarray) -> float:
    """Return a colour limit for all these arrays: a high quantile of their magnitude, never zero."""
    values = np.abs(np.concatenate([np.ravel(array) for array in arrays]))
    return float(np.quantile(values, 0.998)) or 1.0


def looks(methods: Mapping[str, Sequence[str]], cells: Mapping[str, int]) -> dict[str, Look]:
    """Return the colour and the marker of each variant.

    methods: for each variant, by its name, the names in LOOKS that suit it; the first one that no earlier variant has
    is taken. Others have a look by their name, if it is free. cells: for variants on a grid, the number of cells along
    its edge; the fewer, the lighter the colour.
    """
    found: dict[str, Look] = {}
    sizes = sorted(set(cells.values()))
    for name, suiting in methods.items():
        if name in cells:
            white = LIGHTEST * (1 - sizes.index(cells[name]) / (len(sizes) - 1)) if len(sizes) > 1 else 0.0
            found[name] = to_hex((1 - white) * np.array(to_rgb(BLUE)) + white), GRID
        else:
            known = (LOOKS[key] for key in suiting if key in LOOKS and LOOKS[key] not in found.values())
            first = zlib.crc32(name.encode()) % len(OTHERS)
            free = (look for look in OTHERS[first:] + OTHERS[:first] if look not in found.values())
            found[name] = next(known, None) or next(free, OTHERS[first])
    return found


def show_plane(axis: Axes, plane: np.ndarray, limits: tuple[float, float], colours: str, error: float | None = None,
               power: float = 1.0):
    """Draw values in a plane [y, x] of the box, and return the image for a colour bar.

    `limits` are the values at the ends of the colour map `colours`. The place of a value between them goes with its
    `power`. The `error` is written into a corner.
    """
    length = 2 * np.pi
    image = axis.imshow(plane, origin="lower", extent=(0, length, 0, length), cmap=colours,
                        norm=PowerNorm(power, *limits), interpolation="bilinear", aspect="equal")
    if error is not None:
        axis.text(0.04, 0.04, f"{error:.2f}", transform=axis.transAxes, fontsize=9,
                  bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.5})
    ticks = [0, length / 2, length]
    axis.set_xticks(ticks, ["0", "π", "2π"])
    axis.set_yticks(ticks, ["0", "π", "2π"])
    for side in ("top", "right"):
        axis.spines[side].set_visible(True)
    return image


def colour_bar(figure: Figure, image, axes: Sequence[Axes], label: str, extend: str = "both"):
    """Draw one colour bar to the right of all panels of `axes`, where `panels` has left room, and return it."""
    box = Bbox.union([axis.get_position() for axis in axes])
    place = (box.x1 + 0.12 / figure.get_figwidth(), box.y0 + 0.03 * box.height, 0.13 / figure.get_figwidth(),
             0.94 * box.height)
    bar = figure.colorbar(image, cax=figure.add_axes(place), extend=extend, label=label)
    bar.outline.set_linewidth(0.6)
    return bar


def guide_power_law(axis: Axes, wavenumber: Sequence[float], level: float, exponent: float, label: str) -> None:
    """Draw a dashed power law that starts at (wavenumber[0], level), and write a label beside its middle."""
    wavenumber = np.asarray(wavenumber, dtype=float)
    values = level * (wavenumber / wavenumber[0]) ** exponent
    axis.plot(wavenumber, values, color=GUIDE, linestyle="--", linewidth=1.1)
    middle = np.sqrt(wavenumber[0] * wavenumber[-1]), np.sqrt(values[0] * values[-1])
    note(axis, label, middle, "data", (4, 3))


def note(axis: Axes, text: str, place: tuple[float, float], coordinates, offset: tuple[float, float], **style) -> None:
    """Write a small grey text at a place of a panel, moved by an offset in points (1/72 inch).

    `coordinates` is matplotlib's name for the coordinates of `place`.
    """
    axis.annotate(text, place, xycoords=coordinates, xytext=offset, textcoords="offset points", color=NOTE,
                  **{"fontsize": 9, **style})


def plain_log_ticks(*axes, subs: Sequence[int] = (1, 2, 5)) -> None:
    """Label the ticks of logarithmic axes (`Axes.xaxis` or `yaxis`) as 1, 2, 5, 10, 20... and draw no minor ticks."""
    for axis in axes:
        axis.set_major_locator(LogLocator(subs=subs))
        axis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axis.set_minor_locator(NullLocator())


def number_wavenumbers(axis: Axes) -> None:
    """Make the x axis logarithmic, with ticks 1, 2, 5, 10, 20..."""
    axis.set_xscale("log")
    plain_log_ticks(axis.xaxis)


def legend_below(axis: Axes, columns: int) -> None:
    """Put the legend below the panel, where it hides no line."""
    axis.legend(loc="upper center", bbox_to_anchor=(0.5, 0), borderaxespad=3.8, ncol=columns, columnspacing=1.2,
                handlelength=1.8)


def mark_cutoff(axis: Axes, cutoff: float) -> None:
    """Draw a vertical line at the filter wavenumber."""
    axis.axvline(cutoff, color=GUIDE, linestyle=":", linewidth=1)
    note(axis, r"$\pi/d$", (cutoff, 0.01), ("data", "axes fraction"), (3, 1))


def mark_time(axis: Axes, time: float, label: str) -> None:
    """Draw a thin vertical line at a time, with a label at the top of the line."""
    axis.axvline(time, color=GUIDE, linewidth=1, linestyle=":")
    note(axis, label, (time, 1), ("data", "axes fraction"), (3, -2), va="top", fontsize=8.5)
