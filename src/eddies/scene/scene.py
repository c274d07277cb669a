"""A scene: the description of a flow and of what is to be learned from it, as read from one TOML file.

A section that is optional and absent is None, and then nothing is built for it.
"""

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from eddies.import_path import load, origins, search_in
from eddies.pipeline import STAGES, Stage
from eddies.scene.checks import first_inconsistency
from eddies.scene.model import Model, replace_terms
from eddies.scene.reader import (apply_overrides, find_document, parse_document, read_section, read_text, remove,
                                 write_section)
from eddies.scene.sections import (BOX_LENGTH, DEFAULT_WINDOW, NEIGHBORS, Eulerian, Flow, Forcing, Horizons, Initial,
                                   Kernel, Simulation, SpinUp, Time, Tracers, Training)
from eddies.scene.values import Document, SceneError, choice, directory_name, import_paths, integer, section, text

__all__ = ["BOX_LENGTH", "Scene", "SceneError", "builtin_scenes", "load_scene", "Eulerian", "Flow", "Forcing",
           "Horizons", "Initial", "Kernel", "Model", "Simulation", "SpinUp", "Time", "Tracers", "Training"]

# Sections that may name classes and functions of the user's.
FOREIGN_IN = ("flow", "initial", "model", "simulation")
BUILT_IN = Path(__file__).parents[1] / "scenes"


@dataclass(frozen=True, kw_only=True)
class Scene(Document):
    """A whole scene; making one checks its values and that its sections fit together (SceneError)."""

    name: str = directory_name("names the run; absent: the file's name", default="scene")
    title: str = text("one line for lists and reports", default="untitled scene")
    seed: int = integer("of every random number", default=1, at_least=0, at_most=10**18)
    device: str = choice("where particles are computed", "cpu", "cuda", default="cpu")
    flow: Flow = section(Flow)
    initial: Initial = section(Initial, default=Initial())
    forcing: Forcing | None = section(Forcing, default=None)
    time: Time = section(Time, default=Time())
    spin_up: SpinUp | None = section(SpinUp, default=None)
    tracers: Tracers | None = section(Tracers, default=None)
    kernel: Kernel | None = section(Kernel, default=None)
    model: Model | None = section(Model, default=None)
    training: Training | None = section(Training, default=None)
    simulation: Simulation | None = section(Simulation, default=None)
    eulerian: Eulerian | None = section(Eulerian, default=None)

    def __post_init__(self) -> None:
        super().__post_init__()
        problem = first_inconsistency(self)
        if problem:
            raise SceneError(problem)

    @property
    def stages(self) -> tuple[str, ...]:
        """The stages that this scene asks for, in the order in which they run."""
        learned = self.simulation is None or self.needs_model
        return tuple(stage.name for stage in STAGES.values() if (learned or stage.name != "train")
                     and (stage.section is None or getattr(self, stage.section) is not None))

    @property
    def needs_model(self) -> bool:
        """Whether the rollout needs a trained model: to be moved by it, or for a coefficient of a coarse grid."""
        on_grid = self.eulerian is not None and self.eulerian.closure == "learned"
        return self.simulation is not None and ("model" in self.simulation.needs or on_grid)

    def inputs(self, stage: str) -> tuple[Stage, ...]:
        """The stages from whose products a stage makes its own: of those that it depends on the ones the scene has."""
        return tuple(STAGES[name] for name in STAGES[stage].depends_on if name in self.stages)

    @property
    def window(self) -> float:
        """Fraction of the ground truth that kernel and model may see; with a kernel alone the default of [training]."""
        return self.training.window if self.training else DEFAULT_WINDOW

    @property
    def directory(self) -> Path:
        """The run directory, unless another is given."""
        return Path("runs") / self.name

    def seen_in(self, directory: Path) -> float:
        """Fraction of the ground truth of a run directory that the model was trained on; 0 without [training], as with
        [model] path, and where other ground truths are."""
        if self.training is None:
            return 0.0
        own = (directory / STAGES["dns"].file).resolve()
        others = self.training.truths is not None and own not in [path.resolve() for path in self.training.truth_files]
        return 0.0 if others else self.training.window

    @property
    def injects(self) -> bool:
        """Whether there is a rollout whose particles are forced."""
        injection = self.simulation.injection if self.simulation else "none"
        return bool(self.tracers and self.tracers.forced) if injection == "truth" else injection != "none"

    @property
    def resolves(self) -> bool:
        """Whether the model is evaluated with what a grid resolves of the velocity: its terms read that, or it is
        forced."""
        return bool(self.model and "resolved" in self.model.reads or self.tracers and self.tracers.forced
                    or self.injects)

    @property
    def kernel_support(self) -> float | None:
        """Radius h of the smoothing kernel; None without [kernel]."""
        return self.tracers.radius_of(self.kernel.neighbors) if self.kernel and self.tracers else None

    @property
    def neighbors(self) -> float:
        """Mean number of particles within the radius of interaction of pairs."""
        if self.model and self.model.neighbors is not None:
            return self.model.neighbors
        return self.kernel.neighbors if self.kernel else NEIGHBORS

    @property
    def interaction_radius(self) -> float:
        """Radius within which pairs of particles act on each other; 0 without [tracers]."""
        return self.tracers.radius_of(self.neighbors) if self.tracers else 0.0

    @property
    def foreign(self) -> tuple[str, ...]:
        """The import paths of classes and functions that the scene names: fluid, initial flow, terms, networks, method
        of the simulation."""
        return tuple(dict.fromkeys(path for name in FOREIGN_IN
                                   for path in self._foreign_in(name)))

    def to_toml(self) -> str:
        """The scene as a TOML text with a comment on every key; reading it back gives an equal scene."""
        return "\n".join(write_section(self)) + "\n"

    def fingerprint(self, stage: str) -> str:
        """SHA-256 over what a stage's product depends on: its own settings and those of the earlier stages that
        the scene has, and the content of the files that the flow starts from, that trained weights come from, and that
        hold the source of foreign classes; of the ground truths that a model is trained on their own fingerprints."""
        settings = asdict(self) | {"window": self.window, "start": _digest(self.initial.path),
                                   "weights": _digest(self.model.weights_file if self.model else None),
                                   "truths": _fingerprints(self.training.truth_files if self.training else ())}
        settings |= {f"own_{name}": origins(self._foreign_in(name)) for name in FOREIGN_IN}
        of_these = {*STAGES[stage].depends_on, stage} & {*self.stages}
        keys = [key for each in STAGES.values() if each.name in of_these for key in each.reads]
        return hashlib.sha256(json.dumps([[key, settings[key]] for key in keys]).encode()).hexdigest()

    def provenance(self, stage: str) -> dict[str, Any]:
        """What the product of a stage keeps of the scene: its text, the stage's fingerprint, the kinds of the products
        that it is made from and, if the scene names any, where foreign classes come from."""
        foreign = {"foreign": origins(self.foreign)} if self.foreign else {}
        return {"scene": self.to_toml(), "fingerprint": self.fingerprint(stage),
                "made_from": [each.product for each in self.inputs(stage)], **foreign}

    def _foreign_in(self, name: str) -> Iterator[str]:
        part = getattr(self, name)
        if name == "model":
            yield from part.foreign if part else ()
        elif part is not None:
            yield from (path for _, path in import_paths(part))


def load_scene(name_or_path: str | Path, overrides: Sequence[str] = (), removals: Sequence[str] = ()) -> Scene:
    """Read a built-in scene by name, or a TOML file by path, take the `removals` "section.key" or "section" out of it,
    and write overrides "section.key=value" over what is left.

    Modules of the classes that it names are looked for where Python looks, then beside the file, then in the working
    directory.

    Raises:
        SceneError: names the file (or --set, --unset), the section and the key, what is allowed and what to do.
    """
    path = find_document(str(name_or_path), BUILT_IN, "scene")
    search_in(path.parent)
    search_in(Path())
    keys: set[str] = set()
    try:
        document = parse_document(read_text(path))
        remove(document, removals)
        document = {"name": path.stem, **document}
        keys = apply_overrides(document, overrides)
        if isinstance(document.get("model"), dict):
            replace_terms(document["model"], keys)
        return read_section(Scene, document)
    except SceneError as error:
        option = ", --set" if error.key in keys else ", --unset" if error.key in removals else ""
        raise SceneError(f"{path}{option}: {error}", error.key) from None


def builtin_scenes() -> list[tuple[str, str]]:
    """Name and title of every scene that comes with the package, by name."""
    return [(path.stem, parse_document(read_text(path))["title"]) for path in sorted(BUILT_IN.glob("*.toml"))]


def _fingerprints(paths: Sequence[Path]) -> list[str | None]:
    """Those of the scenes that ground truths were made from, which may be too large to read; None of what is none."""
    # What knows files of products is loaded where there are any.
    return [load("eddies.io.provenance:product_fingerprint")(path) for path in paths]


def _digest(path: str | Path | None) -> str | None:
    """SHA-256 of a file's content; None if there is no such file."""
    if path is None or not Path(path).is_file():
        return None
    state = Path(path).stat()
    return _digest_of_version(path, state.st_size, state.st_mtime_ns)


@lru_cache(maxsize=4)
def _digest_of_version(path: str | Path, size: int, modified: int) -> str:
    # The file may be large, and its digest is asked for several times in a run.
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
