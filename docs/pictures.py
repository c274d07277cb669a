"""Writes pictures of the documentation as small files."""

import io
from pathlib import Path

from PIL import Image

from eddies.report.figures import png

WIDTH, HEIGHT, LEVELS = 1000, 1050, 48  # pixels at most, and levels of each of the three colours


def save(path: Path, figure) -> None:
    """Write a picture: fields and coloured points without a palette, lines in the 256 colours that suit best."""
    image = Image.open(io.BytesIO(png(figure))).convert("RGB")
    image.thumbnail((WIDTH, HEIGHT))
    coloured = any(axis.images or axis.collections for axis in figure.axes)
    (without_palette(image) if coloured else image.quantize(256)).save(path, optimize=True)


def without_palette(image: Image.Image) -> Image.Image:
    """The image with LEVELS levels of red, green and blue, which halves its file and is hardly seen."""
    return image.point(lambda value: round(round(value / 255 * (LEVELS - 1)) * 255 / (LEVELS - 1)))
