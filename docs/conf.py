"""How Sphinx makes the site of these pages: .venv/bin/sphinx-build -W docs site."""

import eddies

project, author, copyright = "eddies", "the eddies developers", "the eddies developers"
release = eddies.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["results", "examples"]

# The pages read the same on the hosts of code: formulas in ```math, anchors of headings as there.
myst_enable_extensions = ["dollarmath"]
myst_fence_as_directive = ["math"]
myst_heading_anchors = 3
napoleon_use_ivar = True

html_theme = "furo"
html_title = "eddies"
