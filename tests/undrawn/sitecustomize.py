"""Python runs this as it starts, with this folder on its path: figures are made but not drawn."""

from eddies.report import figures

figures.png = lambda figure: b"\x89PNG\r\n\x1a\n" + bytes(16)
