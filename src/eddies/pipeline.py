"""The stages of a scene: what each is about, what it makes, and from what. Whoever asks for the shape of the pipeline
reads it here."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Stage:
    """A stage of the pipeline; as a command, `eddies NAME SCENE` runs it alone.

    Parameters
    ----------
    name : of the stage and its command.
    about : what it makes, for the help.
    section : of a scene, without which there is nothing to do; None: it works with what there is.
    product : kind of the file that it makes, PRODUCT.h5 in the run directory; None: no such file.
    reads : what of a scene its product depends on beside the stages before it: sections and properties, see
        workflows/run_directory/fingerprints.py.
    depends_on : all stages that its product depends on, those of its inputs included, of those that a scene has.
    checkpoints : the directory within the run directory where its checkpoints lie; None: it makes none.
    but : "section.key", of the sections that it reads what its product does not depend on.
    """

    name: str
    about: str
    section: str | None
    product: str | None
    reads: tuple[str, ...]
    depends_on: tuple[str, ...]
    checkpoints: str | None
    but: tuple[str, ...] = ()

    @property
    def file(self) -> str:
        """Name of the product's file."""
        return f"{self.product}.h5"


STAGES = {stage.name: stage for stage in (
    Stage("dns", "ground truth: direct simulation, filter, tracers", "flow", "ground_truth",
          ("seed", "flow", "initial", "start", "forcing", "time", "spin_up", "tracers", "own_flow", "own_initial"),
          (), "checkpoints"),
    Stage("train-kernel", "the smoothing kernel", "kernel", "kernel", ("kernel", "window"),
          ("dns",), "checkpoints-kernel", but=("kernel.form",)),
    Stage("train", "the model of the particles", "model", "model",
          ("device", "model", "weights", "training", "truths", "own_model"),
          ("dns", "train-kernel"), "checkpoints-train"),
    Stage("find-step", "the cheapest step of the rollout that has converged", "simulation", "step",
          ("device", "simulation", "confirming", "window", "truths", "eulerian", "own_simulation"),
          ("dns", "train-kernel", "train"), None, but=("simulation.turnovers", "simulation.start")),
    Stage("simulate", "the trained model, without the direct simulation", "simulation", "rollout",
          ("device", "simulation", "found_step", "window", "truths", "eulerian", "own_simulation"),
          ("dns", "train-kernel", "train", "find-step"), "checkpoints-rollout"),
    Stage("report", "figures, one page and metrics.json of a run directory", None, None,
          (), ("dns", "train-kernel", "train", "find-step", "simulate"), None),
)}
#: The stage that makes a kind of product.
MAKER_OF = {stage.product: stage for stage in STAGES.values() if stage.product is not None}


def after(name: str) -> list[Stage]:
    """The stages that start from the product of one, in order."""
    return [stage for stage in STAGES.values() if name in stage.depends_on]
