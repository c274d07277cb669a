"""A scene: the description of a flow, and of the models to learn from it, as read from one TOML file.

An optional section that is absent is None. Variants of a scene are scenes that differ from it in some keys.
"""

import copy
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, replace
from pathlib import Path
from typing import Any

from eddies.import_path import search_in
from eddies.pipeline import STAGES, Stage
from eddies.scene import checks
from eddies.scene.layers import (BUILT_IN, FILE_ONLY_KEYS, VARIANT, Layer, check_command_line, check_variant,
                                 command_line, dotted, read_document, with_sections)
from eddies.scene.model import Model
from eddies.scene.rules import Rule, quoted
from eddies.scene.sections import (BOX_LENGTH, DEFAULT_WINDOW, Eulerian, Flow, Forcing, Horizons, Initial,
                                   Kernel, Reconstruction, Simulation, SpinUp, Time, Tracers, Tracks, Training)
from eddies.scene.terms import TERMS
from eddies.scene.values import (ABSENT, SceneError, Section, choice, import_paths, integer, integers, key_name,
                                 read_section, rule_of, section, sections, text, write_section)

__all__ = ["BOX_LENGTH", "REALISATION", "Scene", "SceneError", "builtin_scenes", "load_scene", "stored_scene",
           "Eulerian", "Flow",
           "Forcing", "Horizons", "Initial", "Kernel", "Model", "Reconstruction", "Simulation", "SpinUp", "Time",
           "Tracers", "Tracks", "Training"]

REALISATION = checks.REALISATION
# The keys of a scene that a variant cannot change.
SCENE_ONLY_KEYS = ("name", "base", "realisations", VARIANT)


@dataclass(frozen=True, kw_only=True)
class Scene(Section):
    """A whole scene. The constructor raises SceneError if a value is not allowed or sections do not fit together.

    When a scene with [tracks] is run, it gets the sections `flow` and `tracers` from the file with the tracks
    (`workflows.tracks.with_tracks`). Before that, these sections are None, and the cross-checks are left out.

    `variant` maps the names of the variants to their scenes, which are complete and have no variants of their own.
    """

    name: str = text("name of the run; absent: the file's name", default="scene")
    title: str = text("one line for lists and reports", default="untitled scene")
    label: str | None = text("name of the variant in tables and figures; absent: NAME of [variant.NAME]", default=None)
    seed: int = integer("seed of all random numbers", default=1, at_least=0, at_most=10**18)
    realisations: tuple[int, ...] | None = integers(
        "seeds of further ground truths, which no training uses; rollouts are made on each, from its beginning; an "
        "initial flow of kind file is read from realisation-SEED beside its file; absent: rollouts are made on the "
        "ground truth of the scene, after the training interval", default=None, at_least=0)
    device: str = choice("device that computes the particles", "cpu", "cuda", default="cpu")
    tracks: Tracks | None = section(Tracks, default=None)
    flow: Flow = section(Flow, default=None)
    initial: Initial = section(Initial, default=Initial())
    forcing: Forcing | None = section(Forcing, default=None)
    time: Time = section(Time, default=Time())
    spin_up: SpinUp | None = section(SpinUp, default=None)
    tracers: Tracers | None = section(Tracers, default=None)
    kernel: Kernel | None = section(Kernel, default=None)
    reconstruction: Reconstruction | None = section(Reconstruction, default=None)
    model: Model | None = section(Model, default=None)
    training: Training | None = section(Training, default=None)
    simulation: Simulation | None = section(Simulation, default=None)
    eulerian: Eulerian | None = section(Eulerian, default=None)
    variant: "Mapping[str, Scene]" = sections()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.flow is None and self.tracks is None:
            raise SceneError("[flow]: this section is missing; every scene needs it, or [tracks]", "flow")
        for key, problem in self._problems() if self.flow is not None else ():
            raise SceneError(f"{self._key_with_value(key)}: {problem}", key)

    @classmethod
    def section_name(cls) -> str:
        """Return an empty name, because the keys of a scene are outside all sections."""
        return ""

    @property
    def without_variants(self) -> "Scene":
        """The scene without variants and realisations."""
        return replace(self, variant={}, realisations=None) if self.variant or self.realisations else self

    def realisation(self, seed: int) -> "Scene":
        """Return the scene with another seed.

        If an initial flow of kind file is read from FOLDER/NAME, the new scene reads FOLDER/realisation-SEED/NAME.
        """
        start = self.initial
        if start.flow.from_file and start.file is not None:
            path = start.file.parent / f"{REALISATION}{seed}" / start.file.name
            return replace(self, seed=seed, initial=replace(start, path=str(path)))
        return replace(self, seed=seed)

    @property
    def ground_truth_alone(self) -> "Scene":
        """The scene without variants, kernel, reconstruction, model and rollout."""
        return replace(self.without_variants, kernel=None, reconstruction=None, model=None, training=None,
                       simulation=None, eulerian=None)

    @property
    def of_tracks(self) -> bool:
        """Whether the scene or a variant has measured tracks."""
        return any(each.tracks is not None for each in (self, *self.variant.values()))

    @property
    def sets(self) -> Mapping[str, Tracers]:
        """The sets of tracers by name; empty without sections [tracers.NAME]."""
        return self.tracers.sets if self.tracers else {}

    @property
    def tracer_sets(self) -> "dict[str, Scene]":
        """For each set of tracers, by its name, the scene that makes only the ground truth of this set."""
        return {name: replace(self.ground_truth_alone, tracers=own) for name, own in self.sets.items()}

    # ---- values that follow from several sections

    @property
    def stages(self) -> tuple[str, ...]:
        """The stages that this scene asks for, in the order in which they run.

        A scene with sets of tracers has only "dns" and "report", because the other stages need one chosen set.
        """
        return tuple(stage.name for stage in STAGES.values() if not (self.sets and stage.asked_by)
                     and all(getattr(self, name) not in (None, False) for name in stage.asked_by))

    @property
    def stages_of_all(self) -> tuple[str, ...]:
        """The stages that the scene or one of its variants asks for, in the order in which they run."""
        asked = {stage for scene in (self, *self.variant.values()) for stage in scene.stages}
        return tuple(stage for stage in STAGES if stage in asked)

    def inputs(self, stage: str) -> tuple[Stage, ...]:
        """Return the stages of the scene on whose products the given stage depends."""
        return tuple(STAGES[name] for name in STAGES[stage].depends_on if name in self.stages)

    @property
    def needs_model(self) -> bool:
        """Whether the rollout needs a trained model: to move the particles, or for the damping of a coarse grid."""
        on_grid = self.eulerian is not None and self.eulerian.form.learned
        return self.simulation is not None and ("model" in self.simulation.form.needs or on_grid)

    @property
    def uses_model(self) -> bool:
        """Whether a trained model is wanted: by the rollout, or for itself in a scene without a rollout."""
        return self.simulation is None or self.needs_model

    @property
    def finds_step(self) -> bool:
        """Whether the step of the rollout is to be found."""
        return self.simulation is not None and self.simulation.finds_step

    @property
    def own_training(self) -> Training | None:
        """The section [training]; None where [model] path gives trained weights."""
        return self.training if self.model is None or self.model.path is None else None

    @property
    def directory(self) -> Path:
        """The default run directory, runs/NAME."""
        return Path("runs") / self.name

    @property
    def duration(self) -> float | None:
        """Length of the direct simulation after its spin-up: with tracers in turnovers, without tracers in the unit of
        time."""
        return self.tracers.turnovers if self.tracers is not None else self.time.duration

    @property
    def window(self) -> float:
        """Fraction of the ground truth that training may use. Without [training] it is the default of that section."""
        return self.training.window if self.training else DEFAULT_WINDOW

    def seen_in(self, directory: Path) -> float:
        """Return the fraction that training uses of the ground truth in a run directory.

        It is 0 if the scene has no [training], or if [training] truths names only other ground truths.
        """
        if self.training is None:
            return 0.0
        own = (directory / STAGES["dns"].file).resolve()
        others = self.training.truths is not None and own not in [path.resolve() for path in self.training.truth_files]
        return 0.0 if others else self.training.window

    @property
    def coarse_cells(self) -> int:
        """Cells along each side of the coarse grid that moves the particles of the rollout; 0 without one."""
        if self.simulation is None or self.tracers is None or not self.simulation.form.on_grid:
            return 0
        return (self.eulerian or Eulerian()).cells_for(self.tracers.filter_width)

    @property
    def foreign(self) -> tuple[str, ...]:
        """The import paths of the user's fluid, initial flow, terms, networks, and method of the simulation."""
        return tuple(dict.fromkeys(path for _, path in import_paths(self)))

    # ---- checks

    def check_variants(self, names: Sequence[str]) -> None:
        """Raise SceneError for a name that is not one of the variants."""
        for name in names:
            check_variant(name, self.variant, self.name)

    def check_stages(self, stages: Sequence[str]) -> None:
        """Raise SceneError for a stage that this scene does not ask for."""
        for stage in stages:
            if stage not in self.stages:
                if self.sets:
                    raise SceneError(f"{self.name}: `eddies {stage}` works on one set of tracers; add set = NAME "
                                     f"to [tracers]; NAME is one of: {', '.join(self.sets)}")
                if stage == "train" and self.model is not None and self.simulation is not None:
                    raise SceneError(f'{self.name}: [simulation] method = "{self.simulation.method}" needs no trained '
                                     'model; set method = "learned" to train one')
                raise SceneError(f"{self.name}: `eddies {stage}` needs the section [{STAGES[stage].asked_by[0]}], "
                                 "which is missing; add it")

    def check_unseen(self, directory: Path) -> None:
        """Raise SceneError if a variant is trained on one of the realisations in a run directory."""
        for name, variant in (self.variant or {self.name: self}).items():
            trained_on = [path.resolve() for path in variant.training.truth_files] if variant.training else []
            for seed in self.realisations or ():
                for part in ("", *self.sets):
                    path = directory / f"{REALISATION}{seed}" / part / STAGES["dns"].file
                    if path.resolve() in trained_on:
                        raise SceneError(f"{name}: [training] truths names {path}, which is a realisation; remove "
                                         f"{seed} from realisations")

    def _problems(self) -> checks.Problems:
        """Run the cross-checks of names, sections and variants. Yield each problem that they find, as (key, text)."""
        flow, tracers, kernel, model, simulation = self.flow, self.tracers, self.kernel, self.model, self.simulation
        present = {field.name for field in fields(self) if getattr(self, field.name) is not None}
        yield from checks.check_names(self.name, self.seed, self.realisations or (), bool(simulation or self.variant))
        yield from checks.check_foreign(import_paths(self))
        yield from checks.check_flow(flow, self.initial, self.forcing, model)
        yield from checks.check_time(self.time, flow, self.forcing, self.spin_up, tracers)
        if tracers is not None:
            yield from checks.check_tracers(tracers, flow, self.initial, self.variant)
        if tracers is not None and not self.sets:
            yield from checks.check_particles(tracers, kernel, model, simulation, present)
        yield from checks.check_needs(present, self.needs_model, model is not None and model.path is not None)
        yield from checks.check_density(flow, model, simulation)
        if self.training is not None and not self.sets:
            yield from checks.check_training(self.training, tracers, kernel)
        if simulation is not None and tracers is not None:
            yield from checks.check_simulation(simulation, tracers, self.seen_in(self.directory))
        if not self.sets:
            yield from checks.check_coarse_grid(self.eulerian, self.coarse_cells, flow, model)
        for name in self.variant:
            yield from ((f"{VARIANT}.{name}", problem) for problem in self._problems_of_variant(name))

    def _problems_of_variant(self, name: str) -> Iterator[str]:
        """Yield the reasons why a variant cannot run beside the other variants, or why its rollouts cannot be compared
        with theirs."""
        variant = self.variant[name]
        if problem := checks.problem_of_name(name):
            yield problem
        elif (label := getattr(variant, "label", None)) in [
                getattr(self.variant[other], "label", None) or other for other in self.variant if other != name]:
            yield f"label = {quoted(label)}: another variant has it too; choose another, or remove it"
        elif not isinstance(variant, Scene) or variant.variant or variant.realisations:
            yield "must be a scene without variants and realisations of its own"
        elif variant.sets:
            yield (f"works on one set of tracers; choose it by the key {VARIANT}.{name}.tracers.set, or for all "
                   f"variants by set = NAME in [tracers]; NAME is one of: {', '.join(variant.sets)}")
        elif variant.simulation is None or self.simulation is None:
            yield "variants are compared by their rollouts; add [simulation] to the scene and to its variants"
        else:
            after_training = self.realisations is None and variant.simulation.start is None
            for key, reason in (checks.COMPARED | (checks.STARTS if after_training else {})).items():
                within, _, last = key.partition(".")
                own, whole = getattr(variant, within), getattr(self, within)
                ours, theirs = getattr(own, last, None), getattr(whole, last, None)
                if ours != theirs and (own and whole or within == "training"):
                    yield f"{key_name(last, within)} = {quoted(ours)} where the scene has {quoted(theirs)}: {reason}"

    def _key_with_value(self, key: str) -> str:
        """Return the beginning of an error: the key, with its value if there is one, such as "[flow] cells = 8"."""
        within, _, name = key.rpartition(".")
        value: Any = self
        for part in key.split("."):
            value = getattr(value, part, None)
        if within == VARIANT:
            return f'variant "{name}"'
        if isinstance(value, Section) or within == "model" and not hasattr(self.model, name):
            return f"[{key}]"
        if value is None:
            return key_name(name, within)
        return f"{key_name(name, within)} = {f'{value:g}' if isinstance(value, float) else quoted(value)}"

    # ---- text

    def to_toml(self, all_keys: bool = False) -> str:
        """Return the scene as a TOML text with a comment on every key, and the changed keys of each variant.

        Reading it back gives an equal scene. If `all_keys` is true, comments list the absent keys and sections too.
        """
        lines = write_section(self, all_keys=all_keys)
        for name in self.variant:
            lines += ["", f"[{VARIANT}.{name}]", *self.differences(name)]
        return "\n".join(lines) + "\n"

    def differences(self, name: str) -> Iterator[str]:
        """Yield the lines of a variant's table: `key = value` for each key that differs from the scene. If the variant
        lacks keys of the scene, the first line is `unset` with their names."""
        own, other = ({key: value for key, value in dotted(tomllib.loads("\n".join(write_section(scene))))
                       if key not in SCENE_ONLY_KEYS} for scene in (self.without_variants, self.variant[name]))
        held = Layer(other).keys
        removed = dict.fromkeys(next(part for part in with_sections(key) if part not in held)
                                for key in own if key not in held)
        if removed:
            yield f"unset = {quoted([*removed])}"
        yield from (f"{key} = {quoted(value)}" for key, value in other.items() if own.get(key) != value)


def load_scene(name_or_path: str | Path, overrides: Sequence[str] = (), removals: Sequence[str] = ()) -> Scene:
    """Read a scene with its variants: a built-in one by name, or a TOML file by path.

    First the `removals` "section.key" or "section" are taken out, then the `overrides` "section.key=value" are set.
    Modules of the user's classes are looked for in Python's own folders, then beside the file, then in the working
    directory.

    Raises SceneError; its text gives the file (or --set, --unset), section, key and allowed values, and a remedy.
    """
    path, document = read_document(str(name_or_path))
    search_in(path.parent)
    search_in(Path())
    given, named = Layer({}), True
    try:
        given = command_line(overrides, removals)
        existing = [*_tables_of_variants(document)]
        given.apply(document)
        named = "name" in document
        document.setdefault("name", path.stem)
        variants = {name: Layer.of_table(table) for name, table in _tables_of_variants(document).items()}
        document.pop(VARIANT, None)
        check_command_line(given, variants, existing)
        scene = read_section(Scene, document, others=(*FILE_ONLY_KEYS, VARIANT))
        return replace(scene, variant={name: _variant(document, name, layer) for name, layer in variants.items()})
    except SceneError as error:
        option = ", --set" if error.key in given.keys else ", --unset" if error.key in removals else ""
        origin = "" if named or error.key != "name" else (
            "; the name is that of the file, because the scene has no key name: rename the file, or add the key")
        raise SceneError(f"{path}{option}: {error}{origin}", error.key) from None


def stored_scene(written: str) -> Scene | None:
    """Return the scene that a product stores as TOML; None if this version cannot read it, or lacks a class of it."""
    try:
        return read_section(Scene, tomllib.loads(written), others=(*FILE_ONLY_KEYS, VARIANT))
    except (SceneError, ValueError):
        return None


def _tables_of_variants(document: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Return, by name of the variant, the table of the keys that it changes. Raises SceneError if [variant] holds
    anything but sections."""
    tables = document.get(VARIANT, {})
    if not isinstance(tables, dict) or not all(isinstance(table, dict) for table in tables.values()):
        raise SceneError(f"{VARIANT}: must be sections; write [{VARIANT}.NAME] and the changed keys below", VARIANT)
    return tables


def _variant(document: dict[str, Any], name: str, layer: Layer) -> Scene:
    """Make the scene of the variant `name` from the document of the whole scene and the changes in `layer`."""
    try:
        for key in layer.values:
            if key.partition(".")[0] in SCENE_ONLY_KEYS:
                raise SceneError(f"{key}: a variant cannot change this key; remove it", key)
        changed = {key: copy.deepcopy(value) for key, value in document.items() if key != "realisations"}
        layer.apply(changed)
        return read_section(Scene, {**changed, "name": name}, others=FILE_ONLY_KEYS)
    except SceneError as error:
        raise SceneError(f'variant "{name}": {error}', error.key) from None


def builtin_scenes() -> list[tuple[str, str]]:
    """Return (name, title) for each scene that comes with the package, in order of name."""
    return [(path.stem, read_document(path.stem)[1]["title"]) for path in sorted(BUILT_IN.glob("*.toml"))]


# ---- JSON schema, with which editors complete and check the files of scenes

TYPES = {float: "number", int: "integer", bool: "boolean", str: "string"}
LIMITS = {"above": "exclusiveMinimum", "at_least": "minimum", "below": "exclusiveMaximum", "at_most": "maximum"}


def json_schema() -> dict[str, Any]:
    """Return the JSON schema (draft 2020-12) of a scene file.

    The schema requires no key, because the base of a scene may give any key. In a section [model.NAME] of a user's own
    term it accepts all keys.
    """
    schema = _object(Scene)
    schema["properties"] |= {
        "base": {"type": "string", "description": "name or path of the scene that this one starts from"},
        "unset": {"type": "array", "items": {"type": "string"}, "description": "removed keys of the base"},
        VARIANT: {"type": "object", "additionalProperties": {"$ref": "#"}, "description": "changed keys by variant"}}
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "scene of eddies"} | schema


def _object(kind: type[Section]) -> dict[str, Any]:
    """Return the schema of a section."""
    properties = {}
    for field in fields(kind):
        rule, inner = rule_of(kind, field), field.metadata.get("section")
        if inner is not None:
            properties[field.name] = _object(inner)
        elif rule is not None:
            properties[field.name] = _value(rule, field.default)
    if kind is Model:
        properties |= {word: _object(settings) for word, settings in TERMS.items()}
    return {"type": "object", "description": str(kind.__doc__).splitlines()[0], "properties": properties,
            "additionalProperties": {"type": "object"} if kind._holder else False}


def _value(rule: Rule, default: Any) -> dict[str, Any]:
    """Return the schema of one key."""
    choices: list[dict[str, Any]] = [{"enum": [*rule.words]}] if rule.words else []
    if rule.paths:
        choices.append({"type": "string", "pattern": ":"})
    if rule.kind is not str or not rule.words:
        limits = {LIMITS[name]: bound for name, bound in rule.bounds.given.items()}
        choices.append({"type": TYPES[rule.kind]} | limits)
    if rule.numbered:
        choices.append({"type": "integer", "minimum": 1})
    if rule.many:
        words = choices[:-1] if rule.kind is not str else []  # in place of a list
        entries = choices[len(words):]
        choices = [*words, {"type": "array", "items": entries[0] if len(entries) == 1 else {"anyOf": entries}}]
    if default is None:
        choices.append({"const": ABSENT})
    given = {"default": default} if default not in (None, MISSING) else {}
    return (choices[0] if len(choices) == 1 else {"anyOf": choices}) | {"description": rule.about} | given
