"""A scene: the description of a flow and of what is to be learned from it, as read from one TOML file.

A section that is optional and absent is None, and then nothing is built for it. Variants of a scene are scenes that
differ from it in some keys.
"""

import copy
import hashlib
import json
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from eddies.import_path import origins, search_in
from eddies.pipeline import STAGES
from eddies.scene.checks import first_inconsistency
from eddies.scene.layers import (BUILT_IN, OF_FILES, VARIANT, Layer, command_line, dotted, read_document,
                                 refuse_keys_of_variants, with_sections)
from eddies.scene.model import Model
from eddies.scene.parts import Parts
from eddies.scene.reader import read_section, write_section
from eddies.scene.rules import nearest, quoted
from eddies.scene.sections import (BOX_LENGTH, Eulerian, Flow, Forcing, Horizons, Initial, Kernel, Simulation, SpinUp,
                                   Time, Tracers, Training)
from eddies.scene.values import SceneError, import_paths, scenes

__all__ = ["BOX_LENGTH", "Scene", "SceneError", "builtin_scenes", "load_scene", "Eulerian", "Flow", "Forcing",
           "Horizons", "Initial", "Kernel", "Model", "Simulation", "SpinUp", "Time", "Tracers", "Training"]

# Sections that may name classes and functions of the user's.
FOREIGN_IN = ("flow", "initial", "model", "simulation")
# Keys of a scene that a variant cannot change.
OF_THE_WHOLE = ("name", "base", "realisations", VARIANT)
# In a run directory: what is no name of a variant, beside the products and directories of the stages.
RESERVED = ("report", "vtkhdf", "lagrangebench", "STOP", "LOCK")
REALISATION = "realisation-"


@dataclass(frozen=True, kw_only=True)
class Scene(Parts):
    """A whole scene; making one checks its values and that its sections fit together (SceneError).

    `variant` has the scenes of the variants by name, each whole and without variants of its own.
    """

    variant: "Mapping[str, Scene]" = scenes()
    of_the_file = (*OF_FILES, VARIANT)

    def __post_init__(self) -> None:
        super().__post_init__()
        problem = first_inconsistency(self) or next(_problems_of_variants(self), None)
        if problem:
            raise SceneError(problem)

    def check_variants(self, names: Sequence[str]) -> None:
        """Refuse names that no variant of the scene has."""
        for name in names:
            if name not in self.variant:
                hint = f"{nearest(name, self.variant)} ".lstrip()
                raise SceneError(f'{self.name}: there is no variant "{name}"; {hint}there are: '
                                 f"{', '.join(self.variant) or 'none'}")

    @property
    def stages_of_all(self) -> tuple[str, ...]:
        """The stages that the scene or one of its variants asks for, in the order in which they run."""
        asked = {stage for scene in (self, *self.variant.values()) for stage in scene.stages}
        return tuple(stage for stage in STAGES if stage in asked)

    @property
    def without_variants(self) -> "Scene":
        """The scene alone, without variants and realisations."""
        return replace(self, variant={}, realisations=None) if self.variant or self.realisations else self

    @property
    def foreign(self) -> tuple[str, ...]:
        """The import paths of classes and functions that the scene names: fluid, initial flow, terms, networks, method
        of the simulation."""
        return tuple(dict.fromkeys(path for name in FOREIGN_IN
                                   for path in self._foreign_in(name)))

    def to_toml(self) -> str:
        """The scene as a TOML text with a comment on every key, and with the keys in which each variant differs;
        reading it back gives an equal scene."""
        lines = write_section(self)
        for name, scene in self.variant.items():
            lines += ["", f"[{VARIANT}.{name}]", *self.differences(scene)]
        return "\n".join(lines) + "\n"

    def differences(self, variant: "Scene") -> Iterator[str]:
        """The lines of a variant's table: the keys in which it differs, `key = value`."""
        own, other = (dict(dotted(tomllib.loads("\n".join(write_section(scene)))))
                      for scene in (self.without_variants, variant))
        for name in set(OF_THE_WHOLE) & {*own, *other}:
            own.pop(name, None), other.pop(name, None)
        held = Layer(other).keys
        removed = dict.fromkeys(next(part for part in with_sections(key) if part not in held)
                                for key in own if key not in held)
        if removed:
            yield f"unset = {quoted([*removed])}"
        yield from (f"{key} = {quoted(value)}" for key, value in other.items() if own.get(key) != value)

    def fingerprint(self, stage: str) -> str:
        """SHA-256 over what a stage's product depends on: its own settings and those of the earlier stages that
        the scene has, and the content of the files that the flow starts from, that trained weights come from, and that
        hold the source of foreign classes; of the ground truths that a model is trained on their own fingerprints."""
        settings = asdict(self) | {"window": self.window, "start": _digest(self.initial.path),
                                   "weights": _digest(self.model.weights_file if self.model else None),
                                   "truths": _fingerprints(self.training.truth_files if self.training else ()),
                                   "found_step": _digest(self.step_file), "confirming": _fingerprints(
                                       self.simulation.confirming_files if self.simulation else ())}
        if settings["weights"] is not None:
            del settings["model"]["path"]  # weights are known by what they are, wherever they lie
        if settings["found_step"] is not None:
            del settings["simulation"]["step_from"]
        if self.simulation is not None:
            del settings["simulation"]["confirmed_on"]  # known by what they are, as are weights
        settings |= {f"own_{name}": origins(self._foreign_in(name)) for name in FOREIGN_IN}
        of_these = {*STAGES[stage].depends_on, stage} & {*self.stages}
        read = [[key, _without(settings[key], key, each.but)]
                for each in STAGES.values() if each.name in of_these for key in each.reads]
        return hashlib.sha256(json.dumps(read).encode()).hexdigest()

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
    """Read a built-in scene by name, or a TOML file by path, with its variants; take the `removals` "section.key" or
    "section" out of it, and write overrides "section.key=value" over what is left.

    Modules of the classes that it names are looked for where Python looks, then beside the file, then in the working
    directory.

    Raises:
        SceneError: names the file (or --set, --unset), the section and the key, what is allowed and what to do.
    """
    path, document = read_document(str(name_or_path))
    search_in(path.parent)
    search_in(Path())
    given = Layer({})
    try:
        given = command_line(overrides, removals)
        _check_names_of_variants(given, _tables_of_variants(document))
        given.apply(document)
        document.setdefault("name", path.stem)
        tables = _tables_of_variants(document)
        document.pop(VARIANT, None)
        variants = {name: Layer.of_table(table) for name, table in tables.items()}
        refuse_keys_of_variants(given, variants)
        scene = read_section(Scene, document)
        return replace(scene, variant={name: _variant(document, name, layer) for name, layer in variants.items()})
    except SceneError as error:
        option = ", --set" if error.key in given.keys else ", --unset" if error.key in removals else ""
        raise SceneError(f"{path}{option}: {error}", error.key) from None


def _tables_of_variants(document: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The changed keys of each variant of a document; SceneError for what is no section of sections."""
    tables = document.get(VARIANT, {})
    if not isinstance(tables, dict) or not all(isinstance(table, dict) for table in tables.values()):
        raise SceneError(f"{VARIANT}: must be sections; write [{VARIANT}.NAME] and the changed keys below", VARIANT)
    return tables


def _check_names_of_variants(given: Layer, tables: Mapping[str, Any]) -> None:
    """Refuse changes of a variant that the scene has not."""
    for key in (*given.values, *given.unset):
        whole, _, rest = key.partition(".")
        name = rest.partition(".")[0]
        if whole == VARIANT and name not in ("", *tables):
            hint = f"{nearest(name, tables)} ".lstrip()
            raise SceneError(f'{key}: there is no variant "{name}"; {hint}there are: {", ".join(tables) or "none"}')


def _variant(document: dict[str, Any], name: str, layer: Layer) -> Scene:
    """The scene of a variant: the document with the variant's changes."""
    try:
        for key in layer.values:
            if key.partition(".")[0] in OF_THE_WHOLE:
                raise SceneError(f"{key}: a variant cannot change this key; remove it", key)
        changed = {key: copy.deepcopy(value) for key, value in document.items() if key != "realisations"}
        layer.apply(changed)
        return read_section(Scene, {**changed, "name": name})
    except SceneError as error:
        raise SceneError(f'variant "{name}": {error}', error.key) from None


def _problems_of_variants(scene: Scene) -> Iterator[str]:
    """What keeps variants and realisations of a scene from being run and compared."""
    stages = STAGES.values()
    reserved = {*RESERVED, *(stage.product for stage in stages), *(stage.checkpoints for stage in stages)}
    for name, variant in scene.variant.items():
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]{,99}", name):
            yield (f'variant "{name}": a name has at most 100 letters, digits, "_" and "-", the first a letter or a '
                   'digit; choose another')
        elif name in reserved or name.startswith(REALISATION):
            yield f'variant "{name}": a run directory uses this name for something else; choose another'
        elif not isinstance(variant, Scene) or variant.variant or variant.realisations:
            yield f'variant "{name}": must be a scene without variants and realisations of its own'
        else:
            yield from (f'variant "{name}": {problem}' for problem in _differing_start(scene, variant))
    seeds = scene.realisations or ()
    if scene.realisations is not None and scene.simulation is None and not scene.variant:
        yield "realisations: the scene has no [simulation], so nothing is rolled out on them; add it, or remove the key"
    for seed in seeds:
        if seeds.count(seed) > 1:
            yield f"realisations = {quoted(seeds)}: {seed} stands there more than once; name each seed once"
        if seed == scene.seed:
            yield (f"realisations = {quoted(seeds)}: {seed} is the seed of the scene, whose ground truth models are "
                   "trained on; leave it out")


def _differing_start(scene: Scene, variant: Scene) -> Iterator[str]:
    """Why the rollout of a variant cannot be compared with that of the scene: another start, other times, or what is
    measured alone of it."""
    if variant.simulation is None or scene.simulation is None:
        which = "the scene" if scene.simulation is None else "it"
        yield f"{which} has no [simulation], and variants are compared by their rollouts; add it"
        return
    for key in ("turnovers", "start", "frame_interval"):
        ours, theirs = (getattr(other.simulation, key) for other in (variant, scene))
        if ours != theirs:
            yield (f"[simulation] {key} = {ours} where the scene has {theirs}: all variants start at the same moment "
                   "and are compared at the same times; change it for the whole scene")
    ours, theirs = (other.kernel and other.kernel.form for other in (variant, scene))
    if None not in (ours, theirs) and ours != theirs:
        yield (f'[kernel] form = "{ours}" where the scene has "{theirs}": all variants are measured alike; change it '
               "for the whole scene")
    if scene.realisations is None and variant.simulation.start is None:
        ours, theirs = (other.training and other.training.window for other in (variant, scene))
        if ours != theirs:
            yield (f"[training] window = {ours} where the scene has {theirs}: rollouts start where it ends, and all "
                   "must start at the same moment; give [simulation] start for the whole scene")
        ours, theirs = (other.training and other.training.truths for other in (variant, scene))
        if ours != theirs:
            yield (f"[training] truths = {quoted(ours)} where the scene has {quoted(theirs)}: where rollouts start "
                   "depends on them, and all must start at the same moment; give [simulation] start for the whole "
                   "scene")


def builtin_scenes() -> list[tuple[str, str]]:
    """Name and title of every scene that comes with the package, by name."""
    return [(path.stem, read_document(path.stem)[1]["title"]) for path in sorted(BUILT_IN.glob("*.toml"))]


def _without(value: Any, section: str, keys: Sequence[str]) -> Any:
    """The values of a section without some keys "section.key"; any other value as it is."""
    if not isinstance(value, dict):
        return value
    return {key: each for key, each in value.items() if f"{section}.{key}" not in keys}


def _fingerprints(paths: Sequence[Path]) -> list[str | None]:
    """Those of the scenes that ground truths were made from, which may be too large to read; None of what is none."""
    # What knows files of products is loaded where there are any.
    if not paths:
        return []
    from eddies.io.provenance import product_fingerprint  # which knows files of products
    return [product_fingerprint(path) for path in paths]


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
