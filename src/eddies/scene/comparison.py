"""A comparison: variants of one scene that are run from the same moment on one machine, as read from one TOML file."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from eddies.measures import MEASURES
from eddies.pipeline import STAGES
from eddies.scene.reader import find_document, parse_document, read_section, read_text
from eddies.scene.rules import nearest, quoted
from eddies.scene.scene import Scene, SceneError, load_scene
from eddies.scene.values import (Document, Section, directory_name, integer, integers, number, sections, text,
                                 texts)

__all__ = ["BASELINE", "Comparison", "PlannedRun", "Variant", "load_comparison"]

BUILT_IN = Path(__file__).parents[1] / "comparisons"
BASELINE = "baseline"
RESERVED = ("figures",)


@dataclass(frozen=True, kw_only=True)
class Variant(Section):
    """The base scene with some keys changed."""

    name: str = directory_name("its run directory and its label in figures")
    set: tuple[str, ...] = texts('changes "section.key=value" of the base scene', default=())
    group: str = text(f'a colour and a marker in figures; "{BASELINE}": what the model is measured against',
                      default="model")
    run: str | None = text("run directory of its own ground truth, where it needs another than the base's",
                           default=None)


@dataclass(frozen=True)
class PlannedRun:
    """A run of a variant: its scene, its run directory below that of the comparison, and that of its ground truth."""

    scene: Scene
    directory: Path
    ground_truth: Path


@dataclass(frozen=True, kw_only=True)
class Comparison(Document):
    """A whole comparison; making one loads the scenes of all variants and checks that they can be compared."""

    name: str = directory_name("names the output directory; absent: the file's name", default="comparison")
    title: str = text("one line for lists and reports", default="untitled comparison")
    base: str = text("the scene that every variant changes: a built-in name or a path")
    run: str | None = text("run directory that holds the base's ground truth; absent: runs/BASE", default=None)
    set: tuple[str, ...] = texts('changes "section.key=value" of the base, for all variants', default=())
    turnovers: float = number("large-eddy turnovers of every rollout", default=1.0, above=0)
    realisations: tuple[int, ...] | None = integers(
        "seeds of ground truths that no training sees, in the run directories RUN-seed-N: every variant is trained on "
        "its own ground truth and rolled out on each of these, from its beginning; absent: on its own, after the "
        "training window", default=None, at_least=0)
    repeats: int = integer("how often every rollout is timed, in rounds over all of them", default=3, at_least=1)
    model: str | None = text("the variant that the summary is about; absent: the first", default=None)
    columns: tuple[str, ...] | None = texts("measures that its table and figures show; absent: the main ones",
                                            *MEASURES, default=None)
    variant: tuple[Variant, ...] = sections(Variant)

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_names()
        if self.columns == ():
            raise SceneError(f"columns = []: name at least one of {', '.join(MEASURES)}, or leave the key out")
        base = load_scene(self.base)
        for section, why in (("simulation", "of which errors are compared"),
                             ("kernel", "through which fields are compared")):
            if getattr(base, section) is None:
                raise SceneError(f'base = "{self.base}": has no [{section}], {why}; add it, or take another base')
        for problem in self._problems_of_realisations():
            raise SceneError(f"realisations = {list(self.realisations or ())}: {problem}")
        for variant in self.variant:
            problem = self._difference(variant)
            if problem:
                raise SceneError(f'variant "{variant.name}": {problem}')

    @property
    def subject(self) -> str:
        """Name of the variant that the summary is about."""
        return self.model or self.variant[0].name

    @cached_property
    def base_scene(self) -> Scene:
        """The base with the changes that all variants share."""
        return load_scene(self.base, self._shared)

    @cached_property
    def scenes(self) -> dict[str, Scene]:
        """The scene of every variant, by its name, in order."""
        return {variant.name: self._scene(variant) for variant in self.variant}

    @property
    def directory(self) -> Path:
        """Where its results go, unless another directory is given."""
        return Path("runs") / self.name

    @property
    def run_directory(self) -> Path:
        """Where the ground truth of the base is."""
        return Path(self.run) if self.run else Path("runs") / load_scene(self.base).name

    def ground_truth_of(self, name: str) -> Path:
        """The run directory with the ground truth of a variant, on which its model is trained."""
        own = next(variant.run for variant in self.variant if variant.name == name)
        return Path(own) if own else self.run_directory

    def changes_of_the_flow(self, name: str) -> list[str]:
        """The changes, shared ones and those of a variant, of what its ground truth is made from."""
        own = next(variant.set for variant in self.variant if variant.name == name)
        return [change for change in (*self.set, *own) if change.partition("=")[0].split(".")[0] in STAGES["dns"].reads]

    def runs_of(self, name: str, output: Path) -> list[PlannedRun]:
        """What is run for a variant, in order: all of its scene; or, with realisations, the training, if there is one,
        and the rollout on each of them."""
        scene, truth, directory = self.scenes[name], self.ground_truth_of(name), output / name
        if self.realisations is None:
            return [PlannedRun(scene, directory, truth)]
        runs, model = [], scene.model if "train" in scene.stages else None
        if model is not None and model.path is None:
            runs.append(PlannedRun(replace(scene, simulation=None, eulerian=None), directory, truth))
            model = replace(model, path=str(directory))
        for seed in self.realisations:
            unseen = replace(scene, seed=seed, model=model, training=None,
                             simulation=replace(scene.simulation, start=0.0))
            runs.append(PlannedRun(unseen, directory / f"seed-{seed}", self._realisation_of(name, seed)))
        return runs

    def _problems_of_realisations(self) -> Iterator[str]:
        """Flows that count twice, and such that a training sees."""
        seeds, own = self.realisations or (), self.base_scene.seed
        for seed in {seed for seed in seeds if seeds.count(seed) > 1}:
            yield f"{seed} stands there more than once; name each once"
        if own in seeds:
            yield f"{own} is the seed of the base, on whose ground truth models are trained; leave it out"
        for name, scene in self.scenes.items():
            trained_on = [path.resolve() for path in scene.training.truth_files] if scene.training else []
            for seed in seeds:
                path = self._realisation_of(name, seed) / STAGES["dns"].file
                if path.resolve() in trained_on:
                    yield f'variant "{name}" is trained on {path}, by [training] truths; leave {seed} out'

    def _realisation_of(self, name: str, seed: int) -> Path:
        """The run directory with the ground truth of another seed."""
        truth = self.ground_truth_of(name)
        return truth.with_name(f"{truth.name}-seed-{seed}")

    @property
    def _shared(self) -> list[str]:
        """Changes to the base in all variants."""
        return [*self.set, f"simulation.turnovers={self.turnovers!r}"]

    def _scene(self, variant: Variant) -> Scene:
        try:
            return load_scene(self.base, [*self._shared, *variant.set, f'name="{variant.name}"'])
        except SceneError as error:
            raise SceneError(f'variant "{variant.name}": {error}', error.key) from None

    def _check_names(self) -> None:
        names = [variant.name for variant in self.variant]
        if not names:
            raise SceneError("[[variant]]: a comparison needs at least one; each has a name and a list `set`")
        for name in names:
            if name in RESERVED:
                raise SceneError(f'variant "{name}": its name is that of a directory, and there is one of this name '
                                 "already; choose another")
            if names.count(name) > 1:
                raise SceneError(f'variant "{name}": {names.count(name)} variants have this name; rename all but one')
        if self.subject not in names:
            hint = f"{nearest(self.subject, names)} ".lstrip()
            raise SceneError(f'model = "{self.subject}": no such variant; {hint}there are: {", ".join(names)}')

    def _difference(self, variant: Variant) -> str | None:
        """Why a variant cannot be compared with the base: other data, another start, other times of its frames."""
        base, scene = self.base_scene, self.scenes[variant.name]
        if variant.run is None and scene.fingerprint("dns") != base.fingerprint("dns"):
            return ("its changes concern the ground truth, which is the base's; give the variant `run`, the run "
                    "directory of a ground truth made with these changes, or leave them out")
        for key in ("turnovers", "start", "frame_interval"):
            ours, theirs = (getattr(other.simulation, key) for other in (scene, base))
            if ours != theirs:
                return (f"[simulation] {key} = {ours} where the base has {theirs}: all variants start at the same "
                        "moment and are compared at the same times; change it for all of them, or not")
        if self.realisations is None and scene.simulation.start is None and scene.window != base.window:
            return (f"[training] window = {scene.window:g} where the base has {base.window:g}: rollouts start where it "
                    "ends, and all must start at the same moment; give [simulation] start for all of them")
        ours, theirs = (other.training and other.training.truths for other in (scene, base))
        if self.realisations is None and scene.simulation.start is None and ours != theirs:
            return (f"[training] truths = {quoted(ours)} where the base has {quoted(theirs)}: where rollouts start "
                    "depends on them, and all must start at the same moment; give [simulation] start for all of them")
        return None


def load_comparison(name_or_path: str | Path, run: str | Path | None = None) -> Comparison:
    """Read a built-in comparison by name, or a TOML file by path; `run` is used instead of the file's, if given.

    Raises:
        SceneError: names the file, the variant and the key, what is allowed and what to do.
    """
    path = find_document(str(name_or_path), BUILT_IN, "comparison")
    given = {} if run is None else {"run": str(run)}
    try:
        return read_section(Comparison, {"name": path.stem, **parse_document(read_text(path)), **given})
    except SceneError as error:
        raise SceneError(f"{path}: {error}", error.key) from None
