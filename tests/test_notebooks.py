"""The notebooks of the documentation run from first to last cell, on smaller scenes, and find what they claim.

What their cells show is stored with them (docs/run_notebooks.py), from the scenes as they are. The smaller scenes show
the same words and pictures; their numbers differ.
"""

import base64
import importlib.util
import json
import re
from pathlib import Path

import nbformat
import numpy as np
import pytest
from jupyter_core.utils import run_sync
from nbclient import NotebookClient

from eddies.analysis.pareto import pareto_front
from mpi_tools.launch import mpi_environment

NOTEBOOKS = Path(__file__).parents[1] / "docs" / "notebooks"
_found = importlib.util.spec_from_file_location("run_notebooks", NOTEBOOKS.parent / "run_notebooks.py")
_module = importlib.util.module_from_spec(_found)
_found.loader.exec_module(_module)
shown = _module.shown  # the outputs of a cell that are stored
SMALLER = ["flow.cells=16", "spin_up.turnovers=0.2", "tracers.particles_per_side=8", "tracers.field_cells=12",
           "tracers.turnovers=0.3", "kernel.neighbors=30", "kernel.steps=4", "kernel.points=50"]
NO_SEARCH = "simulation.step=0.1"
TRAINED_LESS = ["training.steps=8", "training.combined_steps=2", "training.frames=2", "training.batch=64"]
# Like the fixtures quick_spectra and no_figures, in the process of the notebooks.
QUICK = f"""
%reset -f
import sys

import pytest

sys.path.append({str(NOTEBOOKS.parents[1])!r})
from eddies.report import figures
from eddies.workflows.rollout import particle_measures
from tests.left_out import leave_out_figures

particle_measures.MOST_ITERATIONS = 3
leave_out_figures(pytest.MonkeyPatch(), but=BUT)
png = figures.png
figures.png = lambda figure: b"" if figure is None else png(figure)
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The common working directory of the notebooks."""
    return tmp_path_factory.mktemp("notebooks")


@pytest.fixture(scope="module")
def kernel(folder):
    """The process of all notebooks, which loads the package once."""
    manager = NotebookClient(nbformat.v4.new_notebook()).create_kernel_manager()
    with pytest.MonkeyPatch.context() as patch:
        for name, value in {**mpi_environment(1), "JUPYTER_DATA_DIR": folder, "JUPYTER_RUNTIME_DIR": folder,
                            "IPYTHONDIR": folder}.items():
            patch.setenv(name, str(value))
        yield manager
    run_sync(manager.shutdown_kernel)(now=True)


@pytest.fixture
def execute(folder, kernel):
    """A function that runs a notebook, whose reports have no figures `but` these, and compares its outputs with those
    that are stored. It returns the cells by id, and the value of an expression at the end."""
    def run(name, expression, but=(), **parameters):
        notebook = nbformat.read(NOTEBOOKS / f"{name}.ipynb", as_version=4)
        stored = {cell.id: words(cell.outputs) for cell in notebook.cells if cell.cell_type == "code"}
        (place,) = [number for number, cell in enumerate(notebook.cells)
                    if "parameters" in cell.metadata.get("tags", ())]
        given = "\n".join(f"{key} = {value!r}" for key, value in parameters.items())
        notebook.cells.insert(place + 1, nbformat.v4.new_code_cell(QUICK.replace("BUT", repr(but)) + given))
        notebook.cells.append(nbformat.v4.new_code_cell(f"import json\nprint(json.dumps({expression}, default=float))"))
        client = NotebookClient(notebook, kernel, timeout=600, resources={"metadata": {"path": str(folder)}})
        client.execute()
        client.kc.stop_channels()
        for cell in notebook.cells:
            if cell.id in stored and "of-the-machine" not in cell.metadata.get("tags", ()):
                assert words(shown(cell)) == stored[cell.id], f"{name}, {cell.id}: docs/run_notebooks.py {name}"
        return {cell.id: cell for cell in notebook.cells}, json.loads(notebook.cells[-1].outputs[0].text)

    return run


def words(outputs):
    """The kind of each output, and its text with # in place of one or several numbers."""
    texts = [output.get("text") or output["data"].get("text/plain", "a picture") for output in outputs]
    return [re.sub(r"#( (\.\.\. )?#)*", "#", " ".join(re.sub(r"[-+]?\d[\w.,:+-]*|\bNaN\b", " # ", text).split()))
            for text in texts]


def figures(cells):
    """The images of the cells by id, as bytes."""
    return {name: base64.b64decode(output.data["image/png"]) for name, cell in cells.items()
            for output in cell.get("outputs", ()) if "image/png" in output.get("data", {})}


def test_notebooks_are_kept_with_small_outputs_but_for_logs():
    for path in NOTEBOOKS.glob("*.ipynb"):
        notebook = nbformat.read(path, as_version=4)
        nbformat.validate(notebook)
        code = [cell for cell in notebook.cells if cell.cell_type == "code"]
        assert any("image/png" in output.get("data", {}) for cell in code for output in cell.outputs), path
        assert all(cell.execution_count is None for cell in code), path
        assert not any(cell.outputs for cell in code if "hide-output" in cell.metadata.get("tags", ())), path
        assert set(notebook.metadata) == {"kernelspec", "language_info"}, path
    assert sum(path.stat().st_size for path in NOTEBOOKS.glob("*.ipynb")) < 600_000


def test_a_first_run(execute, folder):
    cells, (error, without) = execute("a-first-run", "[error.values.tolist(), without.values.tolist()]",
                                      but=["figure-6-pdfs"], changes=[*SMALLER, "training.steps=30",
                                                                      "simulation.turnovers=0.1", NO_SEARCH])
    shown = figures(cells)
    assert set(shown) == {"paths", "spectra", "field", "report"} and min(map(len, shown.values())) > 9000
    assert (folder / "runs/tiny/report/index.html").exists()
    assert error[0] == 0 and len(error) > 1 and np.all(np.less(error[1:], without[1:]))


def test_a_term_of_ones_own(execute, folder):
    cells, (constant, table) = execute("own-term", "[constant, table.to_dict('index')]", turnovers=0.1,
                                       changes=[*SMALLER, *TRAINED_LESS, NO_SEARCH])
    assert set(figures(cells)) == {"spectra"} and list(table) == ["none", "smagorinsky", "deconvolution"]
    assert 0 < constant < 0.3 and constant != pytest.approx(0.17, rel=1e-6)
    error = {name: row["acceleration"] for name, row in table.items()}
    assert error["deconvolution"] < error["smagorinsky"] != error["none"] < 1
    assert all(0.8 < row["energy"] < 1.2 for row in table.values())
    # The notebook has the class of the example.
    example = (NOTEBOOKS.parent / "examples" / "own_term.py").read_text(encoding="utf-8")
    of_the_class = example[example.index("@dataclass"):example.index("\n\nif __name__")].strip()
    assert of_the_class in (folder / "own_term.py").read_text(encoding="utf-8")


def test_another_flow(execute):
    cells, table = execute("another-flow", "table", changes=[*SMALLER, "simulation.turnovers=0.06"])
    assert set(figures(cells)) == {"figure"} and len(table) == 2
    for errors in table.values():
        assert 0 < errors["acceleration"] < errors["pressure gradient"] < 1.5
        assert 0 < errors["velocity at the end"] < errors["no force"]


def test_error_against_run_time(execute, folder):
    cells, (front, rows) = execute("error-against-run-time", "[list(front.index), table.to_dict('index')]",
                                   changes=[*SMALLER, "flow.cells=24", NO_SEARCH], turnovers=0.1)
    assert set(figures(cells)) == {"front"} and (folder / "runs/cost/report/index.html").exists()
    assert {row["status"] for row in rows.values()} == {"complete"}
    cost, error = ([row[key] for row in rows.values()] for key in ("wall_seconds", "velocity_error_end"))
    assert front == [[*rows][number] for number in pareto_front(cost, error)]
    errors = [rows[name]["velocity_error_end"] for name in ("grid-24", "grid-16", "grid-8")]
    assert errors == sorted(errors) and rows["learned"]["velocity_error_end"] < rows["no-force"]["velocity_error_end"]


def test_measured_tracks(execute, folder):
    cells, (error, estimate, misses, without) = execute(
        "measured-tracks", "[error, estimate, misses.values.tolist(), without.values.tolist()]",
        changes=[change for change in SMALLER if not change.startswith("kernel")])
    assert set(figures(cells)) == {"fields", "forecast"} and min(map(len, figures(cells).values())) > 9000
    assert 0 < error < 0.1 and 0.3 < estimate / error < 3
    assert len(misses) > 1 and np.all(np.less(misses[1:], without[1:]))
