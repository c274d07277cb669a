"""The report as one HTML page that needs no other file."""

import base64
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

from eddies.io.new_files import write_files
from eddies.measures import finite

Number = float | int | bool | str | dict | None
#: Keys of the sections in the order of the page, and those of the sections that are not folded.
ORDER = ("variants", "rollout", "forced", "step", "model", "reconstruction", "kernel", "cost", "ground_truth",
         "stationary", "tracers")
OPEN = ("variants", "rollout", "forced")


@dataclass(frozen=True)
class Metric:
    """One number of the report, or several.

    key: its name in metrics.json. label: its name on the page. value: the number, or several numbers by name; a number
    that is not finite becomes None. reason: why there is no value. written: the text of the value on the page; empty
    if it is that of the function `shown`.
    """

    key: str
    label: str
    value: Number
    reason: str = ""
    written: str = ""

    def __post_init__(self):
        if isinstance(self.value, dict):
            object.__setattr__(self, "value", {name: finite(value) for name, value in self.value.items()})
        elif finite(self.value) is None:
            missing = "not measured in this run" if self.value is None else "not a finite number"
            object.__setattr__(self, "value", None)
            object.__setattr__(self, "reason", self.reason or missing)


@dataclass
class Illustration:
    """A figure of the page, with its title and its caption.

    name: name of its file without the ending. make: makes the matplotlib figure. png: the figure as a PNG image; empty
    until it is drawn.
    """

    name: str
    title: str
    make: Callable[[], Any]
    caption: str
    png: bytes = b""


@dataclass
class Section:
    """A section of the page.

    notices: sentences in coloured boxes. folded: whether the section shows only its title until it is opened.
    """

    key: str
    title: str
    text: str = ""
    notices: list[str] = field(default_factory=list)
    illustrations: list[Illustration] = field(default_factory=list)
    metrics: list[Metric] = field(default_factory=list)
    folded: bool = False

    def add_figure(self, name: str, title: str, make: Callable[[], Any], caption: str) -> None:
        """Append a figure. `make` makes it."""
        self.illustrations.append(Illustration(name, title, make, caption))

    @property
    def numbers(self) -> dict[str, Number]:
        """The values of the metrics by key, for metrics.json."""
        return {metric.key: metric.value for metric in self.metrics}

    @property
    def columns(self) -> list[str]:
        """Names of the columns of the section's table if all metrics hold several values; otherwise empty."""
        if not all(isinstance(metric.value, dict) for metric in self.metrics):
            return []
        return list(dict.fromkeys(name for metric in self.metrics for name in metric.value))


@dataclass(frozen=True)
class RunRecord:
    """What the page shows of the run itself, such as its name, its title and the text of its scene.

    products: rows of a table; the first is the header, and each other row is on a product. warnings: sentences on
    products that do not fit together.
    """

    name: str
    title: str
    scene: str
    products: Sequence[Sequence[str]]
    warnings: Sequence[str] = ()


def arranged(sections: Sequence[Section]) -> list[Section]:
    """Return the sections in the order of the page. Those that are not in OPEN are folded."""
    ordered = sorted(sections, key=lambda each: ORDER.index(each.key))
    for each in ordered:
        each.folded = each.key not in OPEN
    return ordered


def shown(value: Number) -> str:
    """Return a value as text, numbers with four significant digits."""
    if value is None:
        return "not available"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, dict):
        return ", ".join(f"{name} {shown(part)}" for name, part in value.items())
    return str(value)


def side_by_side(columns: Mapping[str, Sequence[Metric]]) -> list[Metric]:
    """Return one metric for each key in the metrics of several variants, with a value for each variant."""
    values: dict[str, dict[str, Any]] = {}
    labels = {metric.key: metric.label for metrics in reversed(columns.values()) for metric in metrics}
    for name, metrics in columns.items():
        for metric in metrics:
            missing = f"not available: {metric.reason}" if metric.value is None else None
            value = shown(metric.value) if isinstance(metric.value, dict) else metric.value
            values.setdefault(metric.key, {})[name] = missing or metric.written or value
    return [Metric(key, labels[key], value) for key, value in values.items()]


def strict(value: Any) -> Any:
    """Return a value for JSON: None for a float that is not finite, also within dicts and lists."""
    if isinstance(value, Mapping):
        return {key: strict(part) for key, part in value.items()}
    return [strict(part) for part in value] if isinstance(value, list | tuple) else finite(value)


def write_page(output: Path, run: RunRecord, sections: Sequence[Section], beside: Mapping[str, str]) -> None:
    """Write index.html, figures/NAME.png and further text files to the directory `output`.

    `beside` maps the names of the further files to their texts. If the directory has an earlier page, its figures that
    the new page lacks are removed. Raises OSError or WriteError. If a file cannot be written, no existing file is
    changed.
    """
    earlier = (output / "metrics.json").exists()  # other figures are removed only beside an earlier page
    (output / "figures").mkdir(parents=True, exist_ok=True)
    figures = {output / "figures" / f"{each.name}.png": each.png
               for section in sections for each in section.illustrations if each.png}
    texts = {"index.html": render_page(run, sections), **beside}
    write_files({**figures, **{output / name: text for name, text in texts.items()}})
    for path in (output / "figures").glob("*.png"):
        if earlier and path not in figures:
            path.unlink()


def render_page(run: RunRecord, sections: Sequence[Section]) -> str:
    """Return the page as HTML. Figures that are not drawn yet are left out."""
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    environment.filters |= {"shown": shown, "embedded": _embedded}
    template = environment.from_string(Path(__file__).with_name("page.html").read_text(encoding="utf-8"))
    return template.render(run=run, sections=sections)


def _embedded(image: bytes) -> Markup:
    """Return the attributes `width` and `src` of an HTML image. `src` holds the PNG file `image` itself."""
    # Bytes 16 to 19 are the width in pixels. A figure has 150 dots per inch, and the page has 96. With this factor,
    # letters have the same size in all figures.
    width = int.from_bytes(image[16:20], "big") * 96 // 150
    return Markup(f'width="{width}" src="data:image/png;base64,{base64.b64encode(image).decode()}"')
