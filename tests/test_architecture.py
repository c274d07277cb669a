"""The layers of the package: which module may import which."""

import ast
import re
import sys
from fnmatch import fnmatchcase
from pathlib import Path

import pytest

from tests.commands import python

CHECKOUT = Path(__file__).parents[1]
# A string that names a module of the package.
MODULE = re.compile(r"eddies(\.\w+)+(:\w+)?")

# Packages that serve the commands. The commands are the modules directly in workflows/.
ROOMS = tuple(f"workflows.{path.parent.name}*" for path in (CHECKOUT / "src/eddies/workflows").glob("*/__init__.py"))

# Modules below eddies, by layer. Imports go down, or stay within a group.
LAYERS = (
    (("__init__", "__version__"), ("errors*",)),
    (("pipeline*",), ("cores*",), ("import_path*",), ("clock*",), ("time_stepping*",), ("measures*",)),
    (("parallel*",), ("kernels*",)),
    (("io*",),),
    (("scene*",),),
    (("spectral*",),),
    (("flow*",), ("particles*",)),
    (("learning*",), ("analysis*",)),
    (("report*",),),
    (ROOMS,),
    (("workflows*",),),
    (("cli*", "api*", "stored_run*", "stages*", "logs*", "__main__"),),
)

# Imports that only some modules may have.
ONLY_IN = {
    "mpi4py*": ("parallel*", "io*", "cli", "api", "stored_run"),
    "h5py*": ("io*",),
    "xarray*": ("io.datasets", "stored_run"),
    "pyfftw*": ("spectral*", "kernels.library"),
    "torch*": ("particles*", "learning*", "workflows*"),
    "matplotlib*": ("report*",),
    "eddies.report*": ("report*", "workflows.report", "workflows.diff", "workflows.train"),
    # Modules that compute may import only the records of integrators and terms.
    "eddies.scene.[!it]*": ("scene*", "workflows*", "cli", "api", "stored_run", "stages"),
    "eddies.scene.integrators*": ("scene*", "particles.integrators", "workflows*"),
    "eddies.scene.terms*": ("scene*", "particles.context", "particles.model", "particles.terms*", "workflows*"),
    "eddies.import_path*": ("scene*", "particles.context", "particles.model", "particles.terms.pair_network",
                            "workflows*"),
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
    """Full names of all imports in a module of this package. `from a import b` gives a and a.b."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[:len(package) - node.level + 1] if node.level else []
            source = ".".join([*base, *([node.module] if node.module else [])])
            yield source
            yield from (f"{source}.{alias.name}" for alias in node.names)


def violations(root: Path):
    """Breaches of the rules in the package below `root`, one line each."""
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
        if module != "__init__":  # which lists the public names with their modules
            for name in named(tree):
                target_layer, target_group = position(name.removeprefix("eddies."))
                if target_layer >= layer and target_group != group:
                    yield f"{module} names {name}, which is not below it"


def named(tree: ast.AST):
    """Modules of the package that strings name, "eddies.module" or "eddies.module:name"."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and MODULE.fullmatch(node.value):
            yield node.value.partition(":")[0]


def circles(root: Path):
    """Modules in a circle of imports, or between circles. Imports anywhere in a module count."""
    paths = {".".join(["eddies", *path.relative_to(root).with_suffix("").parts]): path for path in root.rglob("*.py")
             if path.name != "__init__.py"}
    below = {module: {name for name in imports(ast.parse(path.read_text()), module.split(".")[:-1]) if name in paths}
             for module, path in paths.items()}

    def free():
        used = set().union(*below.values())
        return [module for module, names in below.items() if not names & below.keys() or module not in used]

    while ends := free():
        for module in ends:
            del below[module]
    return sorted(below)


def test_package_keeps_its_layers():
    assert list(violations(CHECKOUT / "src/eddies")) == []


def test_no_modules_import_each_other():
    assert circles(CHECKOUT / "src/eddies") == []


def test_a_circle_is_found(tmp_path):
    (tmp_path / "above.py").write_text("from eddies import below")
    (tmp_path / "below.py").write_text("if TYPE_CHECKING:\n    from eddies.beside import Kind\n")
    (tmp_path / "beside.py").write_text("def late():\n    from eddies import below\n")
    assert circles(tmp_path) == ["eddies.below", "eddies.beside"]


def test_tools_import_nothing_from_the_package_that_needs_others():
    for path in CHECKOUT.glob("mpi_tools/*.py"):
        names = {name for name in imports(ast.parse(path.read_text()), ["mpi_tools"]) if name.split(".")[0] == "eddies"}
        assert all(name.startswith("eddies.cores") for name in names), path
    names = {name.split(".")[0] for module in ("cores", "errors", "__init__")
             for name in imports(ast.parse((CHECKOUT / f"src/eddies/{module}.py").read_text()), ["eddies"])}
    assert names <= {*sys.stdlib_module_names, "eddies"}


@pytest.mark.parametrize("module, source, breach", [
    ("flow/forcing", "from eddies.particles.pairs import Pairs", "not below it"),
    ("clock", "from eddies import scene", "not below it"),
    ("workflows/learned/model", "from eddies.workflows import train", "not below it"),
    ("flow/forcing", "if TYPE_CHECKING:\n    from eddies.workflows.dns import run", "not below it"),
    ("learning/losses", "def late():\n    from eddies.scene.scene import Scene", "imports eddies.scene.scene"),
    ("workflows/simulate", "from eddies.report import ground_truth", "imports eddies.report.ground_truth"),
    ("io/hdf5", "from mpi4py import MPI\ncomm = MPI.COMM_WORLD", "uses COMM_WORLD"),
    ("io/hdf5", "from mpi4py.MPI import COMM_WORLD", "uses COMM_WORLD"),
    ("scene/methods", 'METHODS = {"none": "eddies.workflows.rollout.method:ParticleRun"}', "not below it"),
])
def test_a_breach_is_found(tmp_path, module, source, breach):
    path = tmp_path / f"{module}.py"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(source)
    assert any(breach in found for found in violations(tmp_path))


@pytest.mark.parametrize("code, needless", [
    ("import eddies; dir(eddies); eddies.TermSettings; eddies.number; eddies.Flow; eddies.run\n"
     "scene = eddies.load_scene('tiny'); scene.to_toml(); eddies.Model(preset='wcsph')\n"
     "from eddies.workflows.run_directory.fingerprints import stage_fingerprint; stage_fingerprint(scene, 'train')",
     {"torch", "mpi4py", "numpy", "h5py", "pyfftw"}),
    ("import eddies.workflows.dns", {"torch", "matplotlib"}), ("import eddies.workflows.train", {"matplotlib"})],
    ids=["scene", "dns", "train"])
def test_what_may_not_be_needed_is_not_imported(code, needless):
    """A training imports the drawing of its learning curves only when it draws."""
    ended = python("-c", f"{code}\nimport sys; print({needless} & {{*sys.modules}})")
    assert ended.stdout == "set()\n", ended
