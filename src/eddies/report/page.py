"""The report as one HTML page that needs no other file."""

import base64
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

from eddies.io.new_files import write_files
from eddies.measures import MEASURES, finite


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

    text: sentences at its beginning. numbers: its numbers by key, for metrics.json. labels: words for keys in the
    table. reasons: why a number has no value, by key. columns: the values in the table by title of the column and by
    key; by default those of `numbers`. notices: sentences in coloured boxes.
    """

    key: str
    title: str
    text: str = ""
    numbers: Mapping[str, Any] = field(default_factory=dict)
    labels: Mapping[str, str] = field(default_factory=dict)
    reasons: Mapping[str, str] = field(default_factory=dict)
    columns: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    notices: Sequence[str] = ()
    illustrations: list[Illustration] = field(default_factory=list)

    def add_figure(self, name: str, title: str, make: Callable[[], Any], caption: str) -> None:
        """Append a figure. `make` makes it."""
        self.illustrations.append(Illustration(name, title, make, caption))

    @property
    def table(self) -> list[list[str]]:
        """The rows of the table. The first one holds the titles of the columns. A key without a label is its own."""
        columns = self.columns or {"": self.numbers}
        keys = dict.fromkeys(key for values in columns.values() for key in values)
        return [["", *columns], *([self.labels.get(key) or MEASURES.get(key) or key.replace("_", " "),
                                   *(self._cell(key, values) for values in columns.values())] for key in keys)]

    def _cell(self, key: str, values: Mapping[str, Any]) -> str:
        missing = key in values and finite(values[key]) is None and key in self.reasons
        return shown(values.get(key, "")) + (f": {self.reasons[key]}" if missing else "")


def shown(value: Any) -> str:
    """Return a value as text, numbers with four significant digits."""
    if finite(value) is None:
        return "not available"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {shown(part)}" for name, part in value.items())
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def strict(value: Any) -> Any:
    """Return a value for JSON: None for a float that is not finite, also within dicts and lists."""
    if isinstance(value, Mapping):
        return {key: strict(part) for key, part in value.items()}
    return [strict(part) for part in value] if isinstance(value, list | tuple) else finite(value)


def write_page(output: Path, sections: Sequence[Section], beside: Mapping[str, str], **run: Any) -> None:
    """Write index.html, figures/NAME.png and further text files to the directory `output`.

    `beside` maps the names of the further files to their texts; `run` is as in `render_page`. If the directory has an
    earlier page, its figures that the new page lacks are removed. Raises OSError or WriteError. If a file cannot be
    written, no existing file is changed.
    """
    earlier = (output / "metrics.json").exists()  # other figures are removed only beside an earlier page
    (output / "figures").mkdir(parents=True, exist_ok=True)
    figures = {output / "figures" / f"{each.name}.png": each.png
               for section in sections for each in section.illustrations if each.png}
    texts = {"index.html": render_page(sections, **run), **beside}
    write_files({**figures, **{output / name: text for name, text in texts.items()}})
    for path in (output / "figures").glob("*.png"):
        if earlier and path not in figures:
            path.unlink()


def render_page(sections: Sequence[Section], **run: Any) -> str:
    """Return the page as HTML. Figures that are not drawn yet are left out.

    run: `name`, `title` and `scene`, the text of the scene; `warnings`, sentences on products that do not fit together.
    """
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    environment.filters["embedded"] = _embedded
    template = environment.from_string(Path(__file__).with_name("page.html").read_text(encoding="utf-8"))
    return template.render(sections=sections, **run)


def _embedded(image: bytes) -> Markup:
    """Return the attributes `width` and `src` of an HTML image. `src` holds the PNG file `image` itself."""
    # Bytes 16 to 19 are the width in pixels. A figure has 150 dots per inch, and the page has 96. With this factor,
    # letters have the same size in all figures.
    width = int.from_bytes(image[16:20], "big") * 96 // 150
    return Markup(f'width="{width}" src="data:image/png;base64,{base64.b64encode(image).decode()}"')
