"""The layers of the package: who may import what, found in the source by `ast`."""

import ast
import subprocess
import sys
from fnmatch import fnmatchcase
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).parents[1]
LONGEST_MODULE = 300

# Packages that serve the commands, which are the modules directly in workflows/.
ROOMS = tuple(f"workflows.{path.parent.name}*" for path in (CHECKOUT / "src/eddies/workflows").glob("*/__init__.py"))

# Modules below eddies, by layer. Imports go down, or stay within a group.
LAYERS = (
    (("__init__", "__version__"), ("errors*",)),
    (("pipeline*",), ("import_path*",), ("clock*",), ("time_stepping*",), ("measures*",)),
    (("scene*", "particles.terms.settings*", "particles.terms.presets*"),),
    (("parallel*",), ("kernels*",)),
    (("io*",),),
    (("spectral*",),),
    (("flow*",), ("particles*",)),
    (("learning*",), ("analysis*",)),
    (("report*",),),
    (ROOMS,),
    (("workflows*",),),
    (("cli*", "api*", "stored_run*", "stages*", "logs*", "__main__"),),
)

# What only some modules may import.
ONLY_IN = {
    "mpi4py*": ("parallel*", "io*", "cli", "api", "stored_run"),
    "h5py*": ("io*",),
    "pyfftw*": ("spectral*", "kernels.library"),
    "torch*": ("particles*", "learning*", "workflows*"),
    "matplotlib*": ("report*",),
    "eddies.report*": ("report*", "workflows.report", "workflows.compare", "workflows.diff", "workflows.train"),
    # Scene, rules, reader, sections, model, methods, checks, comparison
    **dict.fromkeys(("eddies.scene.[srm]*", "eddies.scene.ch*", "eddies.scene.compar*"),
                    ("scene*", "workflows*", "cli", "api", "stored_run", "stages", "logs")),
    # Their records are known to both.
    "eddies.scene.integrators*": ("scene*", "particles.integrators", "workflows*"),
    # Of the particles only the settings of terms declare keys of a scene.
    "eddies.scene.values*": ("scene*", "particles.terms.settings", "workflows*"),
    "eddies.import_path*": ("scene*", "particles.model", "particles.terms.pair_basis", "workflows*"),
    "ctypes*": ("kernels*",),
    "pickle*": (),
}
COMM_WORLD_IN = ("cli", "api")


def matches(name: str, patterns: tuple[str, ...]) -> bool:
    return any(fnmatchcase(name, pattern) for pattern in patterns)


def position(module: str) -> tuple[int, tuple[str, ...]]:
    """Layer and group of a module below eddies."""
    for layer, groups in enumerate(LAYERS):
        for group in groups:
            if matches(module, group):
                return layer, group
    raise LookupError(f"eddies.{module} has no layer: add it to LAYERS")


def imports(tree: ast.AST, package: list[str]):
    """Full names imported anywhere in a module of this package; of `from a import b` both a and a.b."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[:len(package) - node.level + 1] if node.level else []
            source = ".".join([*base, *([node.module] if node.module else [])])
            yield source
            yield from (f"{source}.{alias.name}" for alias in node.names)


def violations(root: Path):
    """Breaches of the rules in the package below `root`, one text each."""
    for path in sorted(root.rglob("*.py")):
        parts = list(path.relative_to(root).with_suffix("").parts)
        package = ["eddies", *parts[:-1]]
        module = ".".join(parts[:-1] if parts[-1] == "__init__" and parts[:-1] else parts)
        layer, group = position(module)
        text = path.read_text()
        tree = ast.parse(text)
        for name in imports(tree, package):
            if name.startswith("eddies."):
                target_layer, target_group = position(name.removeprefix("eddies."))
                if target_layer >= layer and target_group != group:
                    yield f"{module} imports {name}, which is not below it"
            for pattern, owners in ONLY_IN.items():
                if fnmatchcase(name, pattern) and not matches(module, owners):
                    yield f"{module} imports {name}"
        names = {getattr(node, "attr", getattr(node, "name", None)) for node in ast.walk(tree)}
        if "COMM_WORLD" in names and module not in COMM_WORLD_IN:
            yield f"{module} uses COMM_WORLD"
        if len(text.splitlines()) > LONGEST_MODULE:
            yield f"{module} is longer than {LONGEST_MODULE} lines"


def test_package_keeps_its_layers():
    assert list(violations(CHECKOUT / "src/eddies")) == []


def test_tools_import_nothing_from_the_package():
    for path in CHECKOUT.glob("mpi_tools/*.py"):
        text = path.read_text()
        names = imports(ast.parse(text), ["mpi_tools"])
        assert "eddies" not in {name.split(".")[0] for name in names}, path
        assert len(text.splitlines()) <= LONGEST_MODULE, path


@pytest.mark.parametrize("module, source, breach", [
    ("flow/forcing", "from eddies.particles.pairs import Pairs", "not below it"),
    ("flow/forcing", "from ..particles import pairs", "not below it"),
    ("parallel/slab", "import eddies.flow.operators", "not below it"),
    ("clock", "from eddies import scene", "not below it"),
    ("workflows/foreseen/cost_model", "from eddies.workflows.dns import run", "not below it"),
    ("workflows/learned/model", "from eddies.workflows import train", "not below it"),
    ("learning/losses", "def late():\n    from eddies.scene.scene import Scene", "imports eddies.scene.scene"),
    ("flow/forcing", "from eddies.scene.values import number", "imports eddies.scene.values"),
    ("particles/model", "from eddies.scene.values import SceneError", "imports eddies.scene.values"),
    ("learning/losses", "from eddies.import_path import load", "imports eddies.import_path"),
    ("particles/pairs", "from eddies.scene.sections import Flow", "imports eddies.scene.sections"),
    ("particles/pairs", "from eddies.scene.scene import Flow", "imports eddies.scene.scene"),
    ("flow/tracers", "import mpi4py", "imports mpi4py"),
    ("workflows/dns", "from h5py import File", "imports h5py"),
    ("flow/tracers", "import torch.nn", "imports torch.nn"),
    ("particles/pairs", "import pyfftw", "imports pyfftw"),
    ("analysis/spectra", "import matplotlib.pyplot", "imports matplotlib.pyplot"),
    ("workflows/train", "import matplotlib.pyplot", "imports matplotlib.pyplot"),
    ("workflows/simulate", "from eddies.report import ground_truth", "imports eddies.report.ground_truth"),
    ("spectral/splines", "import ctypes", "imports ctypes"),
    ("kernels/library", "import eddies.parallel.slab", "not below it"),
    ("io/hdf5", "import pickle", "imports pickle"),
    ("io/hdf5", "from mpi4py import MPI\ncomm = MPI.COMM_WORLD", "uses COMM_WORLD"),
    ("io/hdf5", "from mpi4py.MPI import COMM_WORLD", "uses COMM_WORLD"),
    ("io/hdf5", "\n" * (LONGEST_MODULE + 1), "longer than"),
])
def test_a_breach_is_found(tmp_path, module, source, breach):
    path = tmp_path / f"{module}.py"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(source)
    assert any(breach in found for found in violations(tmp_path))


@pytest.mark.parametrize("workflow, unused", [("dns", {"torch", "matplotlib"}), ("train", {"matplotlib"})])
def test_a_workflow_begins_without_what_it_may_not_need(workflow, unused):
    """Learning curves are drawn by a training, but what draws them is imported no earlier."""
    code = f"import sys, eddies.workflows.{workflow}; sys.exit(bool({unused!r} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 0
