"""The steps of a run: which stages of which scene work in which directory, for a scene with variants and realisations.

A scene without variants has one step, in the run directory. Otherwise the run directory holds

    ground_truth.h5, kernel.h5            of the scene, made once
    realisation-SEED/                     the same of further ground truths, which no training sees
    VARIANT/                              model and rollout of a variant
    VARIANT/realisation-SEED/             its rollouts, where there are realisations
    report/                               one page about all of them

Every directory is a run directory of its own: what is made elsewhere with the same settings is linked there.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from eddies.pipeline import STAGES
from eddies.scene.scene import REALISATION, Scene, SceneError
from eddies.workflows.run_directory.fingerprints import stage_fingerprint
from eddies.workflows.run_directory.work import is_done

# The stages whose products all variants share where their settings agree.
SHARED = ("dns", "train-kernel")
# The stages that make a product.
MAKING = tuple(stage.name for stage in STAGES.values() if stage.product is not None)


@dataclass(frozen=True)
class Step:
    """Stages of a scene in one directory.

    Parameters
    ----------
    scene : without variants. stages : in order, all that make a product. directory : where they work.
    variant : the variant's name; None for what all variants share.
    links : the directory that holds the product of a stage, by stage, for products that are made elsewhere.
    """

    scene: Scene
    stages: tuple[str, ...]
    directory: Path
    variant: str | None = None
    links: Mapping[str, Path] = field(default_factory=dict)

    def holder(self, stage: str) -> Path:
        """The directory that holds the product of a stage, or will hold it."""
        return self.links.get(stage, self.directory)


@dataclass(frozen=True)
class Place:
    """A rollout of a variant: its scene, and the run directory in which all that it needs is found."""

    scene: Scene
    directory: Path


def rollouts(scene: Scene, directory: Path) -> dict[str, list[Place]]:
    """Those of each variant, one or one for each realisation; of a scene without variants under its name."""
    return {name or scene.name: [Place(*where) for where in _rollouts_of(scene, name, directory)]
            for name in scene.variant or (None,)}


def steps(scene: Scene, stages: Sequence[str], directory: Path, names: Sequence[str] = ()) -> list[Step]:
    """What is to be done for some stages of a scene, of all variants or of those named, in order.

    Rollouts go round by round over the variants, so that a machine that is slow for a while is slow for all of them.
    What is made with weights that are taken over is never shared: their file may be made in an earlier step.
    """
    if not scene.variant and not scene.realisations:
        making = tuple(stage for stage in stages if stage in MAKING)
        return [Step(scene, making, directory)] if making else []
    seeds = scene.realisations or ()
    planned = [(None, scene.without_variants, directory, SHARED)]
    planned += [(None, _truth_of(scene, seed), directory / f"{REALISATION}{seed}", SHARED) for seed in seeds]
    chosen: Sequence[str | None] = [*names] or [*scene.variant] or [None]
    for name in chosen:
        own = _confirmed(scene, scene.variant[name] if name else scene.without_variants, directory)
        trained = ("train",) if not seeds or own.model is not None and own.model.path is None else ()
        planned.append((name, own, _directory_of(name, directory), (*SHARED, *trained, "find-step")))
    by_variant = [_rollouts_of(scene, name, directory) for name in chosen]
    for together in zip(*by_variant):
        planned += [(name, own, where, (*SHARED, *(("train",) if seeds else ()), "simulate"))
                    for name, (own, where) in zip(chosen, together)]
    found: list[Step] = []
    made: dict[tuple[str, str], Path] = {}
    for name, own, where, possible in planned:
        working, links = [], {}
        for stage in [stage for stage in STAGES if stage in own.stages and stage in MAKING]:
            key = stage, stage_fingerprint(own, stage)
            taken_over = stage not in SHARED and own.model is not None and own.model.path is not None
            holder = None if taken_over else made.get(key)
            if holder is not None and holder != where:
                links[stage] = holder
                if seeds and stage == "train" and stage in possible and stage in stages:
                    working.append(stage)  # finds the link; rollouts on realisations take the model over from here
            elif stage in possible and holder is None:
                made[key] = where
                working += [stage] if stage in stages else []
        if working:
            found.append(Step(own, tuple(working), where, name, links))
    return found


def check_unseen(scene: Scene, directory: Path) -> None:
    """Refuse realisations that a variant is trained on; SceneError."""
    for name, variant in (scene.variant or {scene.name: scene}).items():
        trained_on = [path.resolve() for path in variant.training.truth_files] if variant.training else []
        for seed in scene.realisations or ():
            path = directory / f"{REALISATION}{seed}" / STAGES["dns"].file
            if path.resolve() in trained_on:
                raise SceneError(f"{name}: is trained on {path}, by [training] truths; leave {seed} out of "
                                 "realisations")


def link(step: Step) -> None:
    """Make the directory of a step, and in it relative links to products that are made elsewhere. One rank does this.

    A product of the step's own settings that lies there is kept; another one is replaced.
    """
    step.directory.mkdir(parents=True, exist_ok=True)
    for stage, holder in step.links.items():
        path, product = step.directory / STAGES[stage].file, holder / STAGES[stage].file
        if path.is_symlink() or not is_done(stage, step.scene, step.directory):
            path.unlink(missing_ok=True)
            if product.exists():
                path.symlink_to(os.path.relpath(product.resolve(), step.directory.resolve()))


def _directory_of(name: str | None, directory: Path) -> Path:
    return directory / name if name else directory


def _rollouts_of(scene: Scene, name: str | None, directory: Path) -> list[tuple[Scene, Path]]:
    """Scene and directory of each rollout of a variant."""
    own, where = scene.variant[name] if name else scene.without_variants, _directory_of(name, directory)
    if scene.realisations is None:
        return [(own, where)]
    model = own.model if "train" in own.stages else None
    if model is not None and model.path is None:
        model = replace(model, path=str(where))
    found = str(where) if own.simulation.finds_step else own.simulation.step_from
    simulation = replace(own.simulation, start=0.0, step_from=found, confirmed_on=None)
    return [(replace(own, seed=seed, model=model, training=None, simulation=simulation),
             where / f"{REALISATION}{seed}") for seed in scene.realisations]


def _confirmed(scene: Scene, own: Scene, directory: Path) -> Scene:
    """The scene of a variant, the step of which is to converge on all realisations of the whole scene; as it is where
    these are of another flow."""
    asked = scene.realisations and own.simulation.finds_step and own.simulation.confirmed_on is None
    if not asked or stage_fingerprint(own, "dns") != stage_fingerprint(scene.without_variants, "dns"):
        return own
    named = tuple(str(directory / f"{REALISATION}{seed}") for seed in scene.realisations)
    return replace(own, simulation=replace(own.simulation, confirmed_on=named))


def _truth_of(scene: Scene, seed: int) -> Scene:
    """The scene of a further ground truth: with a rollout that needs no model, from its beginning."""
    simulation = scene.simulation and replace(scene.simulation, method="none", start=0.0, confirmed_on=None)
    return replace(scene.without_variants, seed=seed, model=None, training=None, eulerian=None, simulation=simulation)
