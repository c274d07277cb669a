"""The keys and sections of a scene, and the values that follow from several of them."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from eddies.pipeline import STAGES, Stage
from eddies.scene.model import Model
from eddies.scene.sections import (DEFAULT_WINDOW, NEIGHBORS, Eulerian, Flow, Forcing, Initial, Kernel, Simulation,
                                   SpinUp, Time, Tracers, Training)
from eddies.scene.values import Section, choice, import_paths, integer, integers, section, sections, text

# The sections that may name classes and functions of the user's.
FOREIGN_IN = ("flow", "initial", "model", "simulation")


@dataclass(frozen=True, kw_only=True)
class Parts(Section):
    """The keys and sections of a scene, each checked alone; see Scene."""

    name: str = text("names the run; absent: the file's name", default="scene")
    title: str = text("one line for lists and reports", default="untitled scene")
    label: str | None = text("of a variant in tables and figures; absent: its name", default=None)
    seed: int = integer("of every random number", default=1, at_least=0, at_most=10**18)
    realisations: tuple[int, ...] | None = integers(
        "seeds of further ground truths, which no training sees: rollouts are made on each from its beginning; absent: "
        "on the ground truth of the scene, after the training window", default=None, at_least=0)
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
    variant: "Mapping[str, Parts]" = sections()

    @classmethod
    def section_name(cls) -> str:
        """Empty: the keys of a scene are outside all sections."""
        return ""

    @property
    def stages(self) -> tuple[str, ...]:
        """The stages that this scene asks for, in the order in which they run."""
        learned = self.simulation is None or self.needs_model
        finds = self.simulation is not None and self.simulation.finds_step
        return tuple(stage.name for stage in STAGES.values()
                     if (learned or stage.name != "train") and (finds or stage.name != "find-step")
                     and (stage.section is None or getattr(self, stage.section) is not None))

    @property
    def stages_of_all(self) -> tuple[str, ...]:
        """The stages that the scene or one of its variants asks for, in the order in which they run."""
        asked = {stage for scene in (self, *self.variant.values()) for stage in scene.stages}
        return tuple(stage for stage in STAGES if stage in asked)

    def inputs(self, stage: str) -> tuple[Stage, ...]:
        """The stages of the scene from whose products a stage makes its own."""
        return tuple(STAGES[name] for name in STAGES[stage].depends_on if name in self.stages)

    @property
    def needs_model(self) -> bool:
        """Whether the rollout needs a trained model: to move the particles, or for a coefficient of a coarse grid."""
        on_grid = self.eulerian is not None and self.eulerian.form.learned
        return self.simulation is not None and ("model" in self.simulation.needs or on_grid)

    @property
    def directory(self) -> Path:
        """The run directory, unless another is given."""
        return Path("runs") / self.name

    @property
    def step_file(self) -> Path | None:
        """The file of a converged step from another run; None where none is named."""
        named = self.simulation and self.simulation.step_from
        return Path(named) / STAGES["find-step"].file if named else None

    @property
    def window(self) -> float:
        """Fraction of the ground truth for training; of a kernel alone the default of [training]."""
        return self.training.window if self.training else DEFAULT_WINDOW

    def seen_in(self, directory: Path) -> float:
        """Fraction of the ground truth of a run directory that the model is trained on.

        It is 0 without [training], and where [training] truths names only other ground truths.
        """
        if self.training is None:
            return 0.0
        own = (directory / STAGES["dns"].file).resolve()
        others = self.training.truths is not None and own not in [path.resolve() for path in self.training.truth_files]
        return 0.0 if others else self.training.window

    @property
    def injects(self) -> bool:
        """Whether particles of the rollout are forced."""
        injection = self.simulation.injection if self.simulation else "none"
        return bool(self.tracers and self.tracers.forced) if injection == "truth" else injection != "none"

    @property
    def resolves(self) -> bool:
        """Whether a grid resolves the velocity for the model: its terms read that velocity, or particles are forced."""
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
        """Radius of interaction of pairs; 0 without [tracers]."""
        return self.tracers.radius_of(self.neighbors) if self.tracers else 0.0

    def foreign_in(self, name: str) -> tuple[str, ...]:
        """The import paths of the user's classes and functions that a section names, each once."""
        part = getattr(self, name)
        if isinstance(part, Model):
            return part.foreign
        return tuple(dict.fromkeys(path for _, path in import_paths(part))) if part is not None else ()

    @property
    def foreign(self) -> tuple[str, ...]:
        """The import paths of the user's fluid, initial flow, terms, networks, and method of the simulation."""
        return tuple(dict.fromkeys(path for name in FOREIGN_IN for path in self.foreign_in(name)))
