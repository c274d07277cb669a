"""Runs the notebooks of the documentation and stores what their cells show; a minute for each.

    .venv/bin/python docs/run_notebooks.py [NAME ...]

A cell with the tag `hide-output` keeps no output, because it prints the log of a run. Of an output its picture is kept
or, without one, its text.
"""

import base64
import io
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient
from PIL import Image

HERE = Path(__file__).parent
sys.path += [str(HERE), str(HERE.parent)]

from mpi_tools.launch import mpi_environment  # noqa: E402
from pictures import without_palette  # noqa: E402

WIDTH = 600  # of a stored picture, in pixels


def shown(cell: Any) -> list[Any]:
    """The outputs of an executed cell that are stored."""
    if "hide-output" in cell.metadata.get("tags", ()):
        return []
    found = []
    for output in cell.outputs:
        if output.output_type == "stream":
            found.append(output)
            continue
        picture = output.data.get("image/png")
        data = {"image/png": small(picture)} if picture else {"text/plain": output.data["text/plain"]}
        found.append(nbformat.v4.new_output("display_data", data))
    return found


def small(picture: str) -> str:
    """A picture of at most WIDTH pixels, as text."""
    image = Image.open(io.BytesIO(base64.b64decode(picture))).convert("RGB")
    image.thumbnail((WIDTH, 2 * WIDTH))
    written = io.BytesIO()
    without_palette(image).save(written, "png", optimize=True)
    return base64.b64encode(written.getvalue()).decode()


def store(path: Path, folder: str) -> None:
    """Run a notebook in a folder, and write it with its outputs."""
    notebook = nbformat.read(path, as_version=4)
    metadata = dict(notebook.metadata)
    NotebookClient(notebook, timeout=600, resources={"metadata": {"path": folder}}).execute()
    notebook.metadata = nbformat.from_dict(metadata)
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)
        if cell.cell_type == "code":
            cell.outputs, cell.execution_count = shown(cell), None
    nbformat.write(notebook, path)


if __name__ == "__main__":
    os.environ.update(mpi_environment(1))
    with tempfile.TemporaryDirectory() as directory:
        for each in sorted((HERE / "notebooks").glob("*.ipynb")):
            if not sys.argv[1:] or each.stem in sys.argv[1:]:
                store(each, directory)
                print(each.name, flush=True)
