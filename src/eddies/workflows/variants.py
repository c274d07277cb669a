"""The steps of a run: which stages run for which scene in which directory.

A scene without variants and realisations has one step, in the run directory. Otherwise the run directory holds

    ground_truth.h5, kernel.h5            of the scene, made once
    SET/                                  the same files for a set of tracers; one simulation makes all ground truths
    realisation-SEED/                     the same files for further ground truths, which no training sees
    VARIANT/                              model and rollout of a variant
    VARIANT/realisation-SEED/             its rollouts, one for each realisation
    report/                               one page about all variants

Each directory is a complete run directory: products that are made elsewhere with the same settings are linked into it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from eddies.pipeline import MAKER_OF, STAGES
from eddies.scene.scene import REALISATION, Scene
from eddies.workflows.run_directory.fingerprints import set_files, stage_fingerprint

SHARED = tuple(stage.name for stage in STAGES.values() if stage.shared)
# Stages that make a product.
MAKING = tuple(stage.name for stage in MAKER_OF.values())


@dataclass(frozen=True)
class Step:
    """Stages of a scene that run in one directory.

    Parameters
    ----------
    scene : the scene, without variants.
    stages : the stages, in order. All make a product.
    directory : where they run.
    variant : name of the variant; None for products that all variants share.
    links : the directories of the products that are made elsewhere and linked here, by stage.
    """

    scene: Scene
    stages: tuple[str, ...]
    directory: Path
    variant: str | None = None
    links: Mapping[str, Path] = field(default_factory=dict)

    @property
    def files(self) -> tuple[Path, ...]:
        """The product files that the stages make. The stage "dns" also makes one in the directory of each set of
        tracers."""
        of_sets = [self.directory / name / STAGES["dns"].file for name in self.scene.sets if "dns" in self.stages]
        return *(self.directory / STAGES[stage].file for stage in self.stages), *of_sets


def rollouts(scene: Scene, directory: Path) -> dict[str, dict[Path, Scene]]:
    """Return the rollouts of each variant by the variant's name, as a dict from directories to scenes.

    A variant has one rollout for each realisation. The directory of a rollout is a complete run directory. A scene
    without variants counts as one variant, unless it has sets of tracers.
    """
    found = {}
    for name in scene.variant or (None,):
        own, where = scene.variant[name] if name else scene.without_variants, directory / (name or "")
        if own.sets:
            continue
        if scene.realisations is None:
            found[name or scene.name] = {where: own}
            continue
        model = own.model if "train" in own.stages else None
        if model is not None and model.path is None:
            model = replace(model, path=str(where))
        step_from = str(where) if own.simulation.finds_step else own.simulation.step_from
        simulation = replace(own.simulation, start=0.0, step_from=step_from, confirmed_on=None)
        found[name or scene.name] = {
            where / f"{REALISATION}{seed}": replace(own.realisation(seed), model=model, training=None,
                                                    simulation=simulation) for seed in scene.realisations}
    return found


def steps(scene: Scene, stages: Sequence[str], directory: Path, names: Sequence[str] = ()) -> list[Step]:
    """Return the steps, in order, that run these `stages` of a scene. `names` are the variants, by default all.

    Rollouts of the variants alternate, so that a slow phase of the machine slows all of them. Products that use trained
    weights of a file are never shared, because an earlier step may replace the file.
    """
    if not scene.variant and not scene.realisations:
        making = tuple(stage for stage in stages if stage in MAKING)
        return [Step(scene, making, directory)] if making else []
    seeds = scene.realisations or ()
    found: list[Step] = []
    made: dict[tuple[str, str], Path] = {}
    for name, own, where, possible in _planned(scene, directory, names):
        working, links = [], {}
        for stage in [stage for stage in STAGES if stage in own.stages and stage in MAKING]:
            key = stage, stage_fingerprint(own, stage)
            from_file = stage not in SHARED and own.model is not None and own.model.path is not None
            holder = None if from_file else made.get(key)
            if holder is not None and holder != where:
                links[stage] = holder
                if seeds and stage == "train" and stage in possible and stage in stages:
                    working.append(stage)  # this step makes the link from which rollouts take their weights
            elif stage in possible and holder is None:
                made[key] = where
                if stage == "dns":
                    made |= {(stage, fingerprint): (where / path).parent
                             for path, fingerprint in set_files(own).items()}
                working += [stage] if stage in stages else []
        if working:
            found.append(Step(own, tuple(working), where, name, links))
    return found


def _planned(scene: Scene, directory: Path,
             names: Sequence[str]) -> list[tuple[str | None, Scene, Path, Sequence[str]]]:
    """Return for each step, in order, the variant (None: all), the scene, the directory, and the stages that may run
    there, unless their product is made elsewhere. The arguments are those of `steps`."""
    whole, seeds = scene.without_variants, scene.realisations or ()
    # Fingerprint of each ground truth that a variant may use, and its directory relative to that of the scene or of a
    # realisation.
    truths = ({fingerprint: path.parent for path, fingerprint in set_files(whole).items()}
              or {stage_fingerprint(whole, "dns"): Path()})
    realisations = tuple(directory / f"{REALISATION}{seed}" for seed in seeds)
    runs = rollouts(scene, directory)
    chosen: Sequence[str | None] = [name for name in [*names] or [*scene.variant] or [None]
                                    if (name or scene.name) in runs]
    used = [scene.variant[name].tracers if name else whole.tracers for name in chosen]
    planned: list[tuple[str | None, Scene, Path, Sequence[str]]] = []
    # The scene of a further ground truth: rollouts start at its beginning, and no model is trained.
    simulation = whole.simulation and replace(whole.simulation, method="none", start=0.0, confirmed_on=None)
    truth = replace(whole, model=None, training=None, eulerian=None, simulation=simulation)
    for own, where in [(whole, directory), *((truth.realisation(seed), path)
                                             for seed, path in zip(seeds, realisations))]:
        planned.append((None, own, where, SHARED))
        for name, tracers in own.sets.items():
            if tracers in used:  # the kernel of the set is made beside its ground truth
                planned.append((None, replace(own, tracers=tracers), where / name, ("train-kernel",)))
    for name in chosen:
        own = scene.variant[name] if name else whole
        if seeds and own.simulation.finds_step and own.simulation.confirmed_on is None and (
                (below := truths.get(stage_fingerprint(own, "dns"))) is not None):
            # The time step must converge on all realisations, unless they have another flow than the variant.
            confirmed_on = tuple(str(path / below) for path in realisations)
            own = replace(own, simulation=replace(own.simulation, confirmed_on=confirmed_on))
        # With realisations and given weights only the search for the step needs them here.
        here = not seeds or own.model is not None and (own.model.path is None or own.simulation.finds_step)
        trained = ("train",) if here else ()
        planned.append((name, own, directory / (name or ""), (*SHARED, *trained, "find-step")))
    for together in zip(*(runs[name or scene.name].items() for name in chosen)):
        planned += [(name, own, where, (*SHARED, *(("train",) if seeds else ()), "simulate"))
                    for name, (where, own) in zip(chosen, together)]
    return planned
