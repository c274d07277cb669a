"""The stages of a scene: what each reads and makes, and when a scene asks for it.

The module of a stage in workflows/ has its function `run`.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Stage:
    """A stage of the pipeline, and the command `eddies NAME SCENE` that runs it alone.

    Parameters
    ----------
    name : name of the stage and of its command.
    about : its result in words, for the help of the command.
    asked_by : properties of a scene; it asks for the stage if none of them is None or false. The first is a section.
    product : kind of its product, such as "model" for the file model.h5 in the run directory; None for the report.
    reads : sections and properties of a scene on which its product depends, besides those of the stages before it (see
        workflows/run_directory/fingerprints.py).
    depends_on : all stages on which its product depends, if the scene has them.
    checkpoints : directory of its checkpoints in the run directory; None without checkpoints.
    but : keys "section.key", in the sections of `reads`, on which its product does not depend.
    duration : keys that only set the duration of the stage. If nothing else differs, it continues from a checkpoint.
    shared : whether variants share the product if their settings agree.
    """

    name: str
    about: str
    asked_by: tuple[str, ...]
    product: str | None
    reads: tuple[str, ...]
    depends_on: tuple[str, ...]
    checkpoints: str | None
    but: tuple[str, ...] = ()
    duration: tuple[str, ...] = ()
    shared: bool = False

    @property
    def file(self) -> str:
        """Path of the product, or of the page of the report, in the run directory."""
        return "report/index.html" if self.product is None else f"{self.product}.h5"

    @property
    def folder(self) -> str | None:
        """The directory that the stage makes in the run directory; None if it makes only a file."""
        return "report" if self.product is None else self.checkpoints


STAGES = {stage.name: stage for stage in (
    Stage("dns", "ground truth: direct simulation, filter, tracers; or measured tracks", (), "ground_truth",
          ("seed", "tracks", "flow", "initial", "start", "forcing", "time", "spin_up", "tracers", "own_flow",
           "own_initial"),
          (), "checkpoints", duration=("tracers.turnovers", "time.duration"), shared=True),
    Stage("train-kernel", "the smoothing kernel", ("kernel",), "kernel", ("kernel", "window"),
          ("dns",), "checkpoints-kernel", but=("kernel.form",), shared=True),
    Stage("reconstruct", "velocity, gradient, pressure and acceleration of each frame, from particle tracks",
          ("reconstruction",), "reconstruction", ("reconstruction", "points"), ("dns", "train-kernel"),
          "checkpoints-reconstruct", shared=True),
    Stage("train", "the model of the particles", ("model", "uses_model"), "model",
          ("device", "model", "weights", "training", "truths", "own_model"),
          ("dns", "train-kernel"), "checkpoints-train"),
    Stage("find-step", "the cheapest time step with which the rollout has converged", ("simulation", "finds_step"),
          "step", ("device", "simulation", "confirming", "window", "truths", "eulerian", "own_simulation"),
          ("dns", "train-kernel", "train"), None, but=("simulation.turnovers", "simulation.start")),
    Stage("simulate", "the rollout of the trained model, without the direct simulation", ("simulation",), "rollout",
          ("device", "simulation", "found_step", "window", "truths", "eulerian", "own_simulation"),
          ("dns", "train-kernel", "train", "find-step"), "checkpoints-rollout"),
    Stage("report", "figures, one page and metrics.json of a run directory", (), None,
          (), ("dns", "train-kernel", "reconstruct", "train", "find-step", "simulate"), None),
)}
#: The stage that makes each kind of product.
MAKER_OF = {stage.product: stage for stage in STAGES.values() if stage.product is not None}
#: The file of each kind of product. The measures of a rollout, which the report draws, have no stage of their own.
FILE_OF = {**{kind: stage.file for kind, stage in MAKER_OF.items()}, "measures": "measures.h5"}
