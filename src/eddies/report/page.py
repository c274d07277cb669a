"""The report as one self-contained HTML page, with its metrics as JSON. Knows nothing of what it shows."""

import base64
import html
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from eddies.io.new_files import write_files

Number = float | int | bool | str | dict | None

CSS = """
:root{--ink:#1d2733;--soft:#5b6774;--line:#dfe4ea;--accent:#0072b2;--back:#f5f7f9}
*{box-sizing:border-box}
body{margin:0;background:var(--back);color:var(--ink);font:16px/1.55 system-ui,sans-serif}
header,main{max-width:1080px;margin:0 auto;padding:1rem}
h1{font-size:1.7rem;margin:.6rem 0 .2rem}
h2{font-size:1.25rem;margin:0;display:inline}h3{font-size:1rem;margin:1.2rem 0 .4rem}
.title{font-size:1.1rem}.soft{color:var(--soft)}
nav{display:flex;flex-wrap:wrap;gap:.3rem 1.1rem;margin-top:.6rem}a{color:var(--accent);text-decoration:none}
section{background:#fff;border:1px solid var(--line);border-radius:8px;padding:1.1rem;margin:0 0 1.1rem}
summary{cursor:pointer}
.body{margin-top:.6rem;scroll-margin-top:4rem}
.tiles{display:flex;flex-wrap:wrap;gap:.6rem;margin-top:.7rem}
.tile{flex:1 1 130px;border:1px solid var(--line);border-radius:6px;padding:.55rem .7rem}
.tile b{display:block;font-size:1.3rem;font-variant-numeric:tabular-nums}
.tile span{font-size:.82rem;color:var(--soft)}
figure{margin:1.3rem 0}img{display:block;max-width:100%;min-width:560px;height:auto;margin:0 auto}
figcaption{font-size:.9rem;color:var(--soft);margin-top:.4rem}figcaption b{color:var(--ink)}
.wide{overflow-x:auto}
table{border-collapse:collapse;font-size:.92rem;width:100%}
td,th{text-align:left;padding:.3rem .8rem .3rem 0;border-bottom:1px solid var(--line);vertical-align:top}
td.number{font-variant-numeric:tabular-nums;white-space:nowrap}
.notice{border-left:4px solid #d55e00;background:#fdf3ec;padding:.6rem .8rem;margin:.6rem 0}
@media(max-width:600px){body{font-size:15px}header,main{padding:.6rem}section{padding:.7rem}table{font-size:.85rem}}
pre{overflow-x:auto;background:var(--back);padding:.8rem;font-size:.85rem;border-radius:6px}
"""


@dataclass(frozen=True)
class Metric:
    """One number of the report: key in metrics.json, name on the page, value, or why there is none; and how the page
    writes the value, where not as it writes any."""

    key: str
    label: str
    value: Number
    reason: str = ""
    written: str = ""

    def __post_init__(self):
        if isinstance(self.value, float) and not math.isfinite(self.value):
            object.__setattr__(self, "value", None)
            object.__setattr__(self, "reason", self.reason or "not a finite number")
        elif isinstance(self.value, dict):
            object.__setattr__(self, "value", {name: None if isinstance(value, float) and not math.isfinite(value)
                                               else value for name, value in self.value.items()})
        elif self.value is None and not self.reason:
            object.__setattr__(self, "reason", "not measured in this run")


@dataclass
class Illustration:
    """A figure as it stands on the page: file name without ending, caption with its numbers, image: a matplotlib
    Figure until it is drawn, then the bytes of a PNG."""

    name: str
    title: str
    image: Any
    caption: str


@dataclass
class Section:
    """A part of the page, and of metrics.json under `key`; notices are what must not be missed. One that is `folded`
    shows its title and its main metrics until it is opened."""

    key: str
    title: str
    text: str = ""
    notices: list[str] = field(default_factory=list)
    illustrations: list[Illustration] = field(default_factory=list)
    metrics: list[Metric] = field(default_factory=list)
    main: Sequence[str] = ()  # keys of the metrics shown beside the title
    folded: bool = False

    def add_figure(self, name: str, title: str, figure: Any, caption: str) -> None:
        """Put a matplotlib Figure after those that are there."""
        self.illustrations.append(Illustration(name, title, figure, caption))


@dataclass(frozen=True)
class RunRecord:
    """What the run was: name, one line on it, the scene's text, a row per product (header first), what is wrong with
    these, in sentences, and other pages, each with its title and its path from this page."""

    name: str
    summary: str
    scene: str
    products: Sequence[Sequence[str]]
    warnings: Sequence[str] = ()
    links: Sequence[tuple[str, str]] = ()


def metrics_json(run: RunRecord, sections: Sequence[Section]) -> str:
    """All warnings, then all metrics by section, as strict JSON: what is missing is null."""
    table = {"warnings": list(run.warnings),
             **{section.key: {metric.key: metric.value for metric in section.metrics} for section in sections}}
    return json.dumps(table, indent=2, allow_nan=False) + "\n"


def shown(value: Number) -> str:
    """A number with four significant digits, for people."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, dict):
        return ", ".join(f"{name} {shown(part)}" for name, part in value.items())
    return str(value)


def write_page(output: Path, run: RunRecord, sections: Sequence[Section], beside: Mapping[Path, str]) -> None:
    """Write index.html, figures/NAME.png of sections whose figures are drawn, and other files `beside`: all, or on a
    full disk, which is an OSError, none."""
    (output / "figures").mkdir(parents=True, exist_ok=True)
    figures = {output / "figures" / f"{illustration.name}.png": illustration.image
               for section in sections for illustration in section.illustrations}
    write_files({**figures, output / "index.html": render_page(run, sections), **beside})


def render_page(run: RunRecord, sections: Sequence[Section]) -> str:
    """The whole page as HTML text that needs no other file."""
    links = "".join(f'<a href="#{section.key}">{_text(section.title)}</a>' for section in sections)
    body = "".join(_section(section) for section in sections)
    pages = "".join(f'<a href="{_text(path)}">{_text(title)}</a>' for title, path in run.links)
    pages = f'<nav class="pages">Other pages: {pages}</nav>' if pages else ""
    return (
        '<!DOCTYPE html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>{_text(run.name)}</title><style>{CSS}</style></head><body>"
        f'<header><h1>{_text(run.name)}</h1><div class="title">{_text(run.summary)}</div><nav>{links}'
        f'<a href="#run">The run</a></nav>{pages}</header><main>{_warnings(run)}{body}{_run(run)}</main>'
        "</body></html>\n"
    )


def _text(text: str) -> str:
    return html.escape(str(text))


def _tiles(section: Section) -> str:
    tiles = "".join(
        f'<span class="tile"><b>{_text(shown(metric.value))}</b><span>{_text(metric.label)}</span></span>'
        for metric in section.metrics if metric.key in section.main and metric.value is not None)
    return f'<span class="tiles">{tiles}</span>' if tiles else ""


def _warnings(run: RunRecord) -> str:
    shown = _notices(run.warnings)
    return f'<section id="warnings"><h2>Warnings</h2>{shown}</section>' if shown else ""


def _notices(notices: Sequence[str]) -> str:
    return "".join(f'<div class="notice">{_text(notice)}</div>' for notice in notices)


def _section(section: Section) -> str:
    figures = "".join(_illustration(illustration) for illustration in section.illustrations)
    text = f"<p>{_text(section.text)}</p>" if section.text else ""
    # A browser opens what is folded around the target of a link.
    return (f'<section><details{"" if section.folded else " open"}><summary><h2>{_text(section.title)}</h2>'
            f'{_tiles(section)}</summary><div class="body" id="{section.key}">{text}{_notices(section.notices)}'
            f"{figures}{_metric_table(section.metrics)}</div></details></section>")


def _illustration(illustration: Illustration) -> str:
    # Bytes 16 to 19 of a PNG are its width. At 96 of 150 dots an inch all figures have letters of one size.
    width = int.from_bytes(illustration.image[16:20], "big") * 96 // 150
    data = base64.b64encode(illustration.image).decode()
    return (f'<figure><div class="wide"><img alt="{_text(illustration.title)}" width="{width}" '
            f'src="data:image/png;base64,{data}"></div>'
            f"<figcaption><b>{_text(illustration.title)}.</b> {_text(illustration.caption)}</figcaption>"
            "</figure>")


def _metric_table(metrics: Sequence[Metric]) -> str:
    if metrics and all(isinstance(metric.value, dict) for metric in metrics):
        return _table_of_columns(metrics)
    rows = "".join(
        f'<tr><td>{_text(metric.label)}</td>'
        + (f'<td class="soft">not available: {_text(metric.reason)}</td>' if metric.value is None
           else f'<td class="number">{_text(metric.written or shown(metric.value))}</td>') + "</tr>"
        for metric in metrics)
    return f'<h3>Numbers</h3><div class="wide"><table>{rows}</table></div>' if rows else ""


def _table_of_columns(metrics: Sequence[Metric]) -> str:
    """Metrics that all have several values, by name: a column for each name."""
    columns = list(dict.fromkeys(name for metric in metrics for name in metric.value))
    head = "".join(f"<th>{_text(name)}</th>" for name in ("", *columns))
    rows = "".join(
        f"<tr><td>{_text(metric.label)}</td>"
        + "".join(f"<td>{_text(_shown_in_cell(metric.value.get(name, '')))}</td>" for name in columns) + "</tr>"
        for metric in metrics)
    return f'<h3>Numbers</h3><div class="wide"><table><tr>{head}</tr>{rows}</table></div>'


def _shown_in_cell(value: Number) -> str:
    return "not available" if value is None else shown(value)


def _run(run: RunRecord) -> str:
    header, *rows = run.products
    head = "".join(f"<th>{_text(cell)}</th>" for cell in header)
    body = "".join("<tr>" + "".join(f"<td>{_text(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return (f'<section id="run"><h2>The run</h2><div class="wide"><table><tr>{head}</tr>{body}</table></div>'
            f"<details><summary>The scene as used</summary><pre>{_text(run.scene)}</pre></details></section>")
