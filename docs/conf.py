"""How Sphinx makes the site of these pages: .venv/bin/sphinx-build -W docs site."""

import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import eddies
from docutils import nodes
from latex2mathml.converter import convert

project, author, copyright = "eddies", "the eddies developers", "the eddies developers"
release = eddies.__version__
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["results", "examples", "notebooks/runs", "**/.ipynb_checkpoints"]

# The pages read the same on the hosts of code: formulas in ```math, anchors of headings as there.
myst_enable_extensions = ["dollarmath"]
myst_fence_as_directive = ["math"]
myst_heading_anchors = 3
napoleon_use_ivar = True

# Notebooks are kept with what they show: docs/run_notebooks.py.
nb_execution_mode = "off"
nb_merge_streams = True
nb_mime_priority_overrides = [("dummy", "image/png", 1)]  # the builder of the tests has no order of its own

# Formulas are MathML, which browsers render without a script from elsewhere.
html_math_renderer = "mathml"

html_theme = "furo"
html_title = "eddies"
html_static_path = html_css_files = ["site.css"]


def as_list(app, what, name, obj, options, lines):
    """Make a list of the section Parameters, or Attributes, of a docstring, whose lines are `name : meaning`."""
    text = "\n".join(lines)
    for title in ("Parameters", "Attributes"):
        head, underline, rest = text.partition(f"{title}\n{'-' * len(title)}\n")
        if underline:
            entries, _, rest = rest.partition("\n\n")
            entries = re.sub(r"^(\w+(?:, \w+)*) : ", lambda found: f"* **{found[1]}**: ", entries, flags=re.M)
            entries = re.sub(r"^ +", "  ", entries, flags=re.M)
            text = f"{head}\n{entries}\n\n{rest}"
    lines[:] = text.split("\n")


def add_sample_report(app, exception):
    """Put the report of the scene tiny beside the pages, unless it is there or no HTML is written."""
    target = Path(app.outdir, "sample-report.html")
    if exception is None and app.builder.format == "html" and not target.exists():
        with tempfile.TemporaryDirectory() as folder:
            run = Path(folder, "tiny")
            subprocess.run([sys.executable, "-m", "eddies", "run", "tiny", "--quiet", "--output", run], check=True)
            shutil.copy(run / "report/index.html", target)


def setup(app):
    """Add lists of parameters, the renderer of formulas, and a report."""
    def math(display):
        def visit(translator, node):
            translator.body.append(convert(node.astext(), display=display))
            raise nodes.SkipNode
        return visit, None

    app.connect("build-finished", add_sample_report)
    app.connect("autodoc-process-docstring", as_list, priority=400)  # before napoleon
    app.add_html_math_renderer("mathml", math("inline"), math("block"))
