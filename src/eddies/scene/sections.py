"""The sections of a scene, each a frozen dataclass whose fields declare their keys.

A declaration gives what the key means, which values are allowed, and the default. Lengths are in units of the
cube [0, 2 pi)^3, the mean density is 1, and times are in the unit that follows from lengths and velocities.
"""

import math
from dataclasses import dataclass
from pathlib import Path

from eddies.import_path import is_path, load
from eddies.scene.integrators import SCHEMES, Scheme
from eddies.scene.methods import METHODS, method_of
from eddies.scene.rules import quoted
from eddies.scene.values import (KeyProblem, Section, boolean, choice, integer, integers, named, number,
                                 product_file, section, text, texts)

BOX_LENGTH = 2 * math.pi
DEFAULT_WINDOW = 0.5
# Along a side of the cube: of cells twice those of the largest direct simulations.
MOST_CELLS = 65536
# Mean number of particles within a support or a radius of interaction, unless a scene says another: the paper's.
NEIGHBORS = 60.0


@dataclass(frozen=True, kw_only=True)
class Flow(Section):
    """The fluid and the grid on which the direct numerical simulation resolves it."""

    fluid: str = named("equations of motion", "incompressible", "compressible")
    cells: int = integer("grid cells along each side of the cube", at_least=8, at_most=MOST_CELLS)
    viscosity: float = number("kinematic viscosity", at_least=0)
    sound_speed: float | None = number("speed of sound, compressible fluid only", default=None, above=0)
    precision: str = choice("of the grid arrays", "float64", "float32", default="float64")

    @property
    def compressible(self) -> bool:
        """Whether the fluid has a density, and sound."""
        return load(self.fluid).compressible if is_path(self.fluid) else self.fluid == "compressible"


@dataclass(frozen=True)
class InitialFlow:
    """What is known of an initial flow before it is made.

    Parameters
    ----------
    keys : of [initial] that it reads; all for a function of the user's.
    rms, peak : root mean square of |u| and largest |u| + |v| + |w|, over the amplitude; None: unknown, or at rest.
    wave : |k| of its modes over `wavenumber`; None: there are many.
    turbulent : whether it is of many scales, with the spectrum's peak at `peak_wavenumber`.
    sound : whether it is at rest but for sound.
    steady : whether nothing in it is accelerated without viscosity.
    """

    keys: tuple[str, ...] = ("amplitude", "peak_wavenumber", "wavenumber", "path", "state")
    rms: float | None = None
    peak: float | None = None
    wave: float | None = None
    turbulent: bool = False
    sound: bool = False
    steady: bool = False

    @property
    def from_file(self) -> bool:
        """Whether a file holds it, which has to be named."""
        return self.keys == ("path", "state")


INITIAL_FLOWS = {
    "random": InitialFlow(("amplitude", "peak_wavenumber"), rms=math.sqrt(3), turbulent=True),
    "taylor-green": InitialFlow(("amplitude",), rms=0.5, peak=1.0, wave=math.sqrt(3)),
    "abc": InitialFlow(("amplitude", "wavenumber"), rms=math.sqrt(3), peak=3 * math.sqrt(2), wave=1.0),
    "shear-wave": InitialFlow(("amplitude", "wavenumber"), rms=math.sqrt(0.5), peak=1.0, wave=1.0, steady=True),
    "sound-wave": InitialFlow(("amplitude", "wavenumber"), sound=True),
    "file": InitialFlow(("path", "state")),
}


@dataclass(frozen=True, kw_only=True)
class Initial(Section):
    """The velocity, and with a compressible fluid the density, at time 0."""

    kind: str = named("initial flow", *INITIAL_FLOWS, default="random")
    amplitude: float = number("of velocity, random: rms of a component; sound-wave: of ln density",
                              default=1.0, above=0)
    peak_wavenumber: float = number("wavenumber of the spectrum's peak, random only", default=3.0, above=0)
    wavenumber: int = integer("waves in the cube; abc, shear-wave, sound-wave only", default=1, at_least=1)
    path: str | None = text("the ground_truth.h5, JHTDB cutout or fluidsim state to start from, kind file only; its "
                            "grid may be another", default=None)
    state: int = integer("which of the states of the whole flow that the file holds, in time: fields/final, with "
                         "tracers fields/unfiltered, of a cutout Velocity_####", default=0, at_least=0)

    @property
    def flow(self) -> InitialFlow:
        """What is known of the kind."""
        return INITIAL_FLOWS.get(self.kind, InitialFlow())


@dataclass(frozen=True, kw_only=True)
class Forcing(Section):
    """Linear solenoidal forcing of the largest scales at a prescribed power."""

    injection_rate: float = number("power injected per unit mass", at_least=0)
    wavenumber: float = number("modes with 0 < |k| < this are forced", default=2.0, above=1)


@dataclass(frozen=True, kw_only=True)
class Time(Section):
    """The time step and, without tracers, the run time."""

    stepper: str = choice("time stepping method", "etdrk4", "rk4", default="etdrk4")
    courant: float = number("Courant number of the step (advective; rk4 also acoustic)", default=0.8, above=0)
    max_step: float = number("largest step; smaller ones are this over a power of two", default=0.05, above=0)
    step: float | None = number("fixed step instead", default=None, above=0)
    duration: float | None = number("run time after spin-up, without tracers only", default=None, above=0)

    @property
    def explicit(self) -> bool:
        """Whether the stepper has to resolve sound and viscosity."""
        return self.stepper == "rk4"


@dataclass(frozen=True, kw_only=True)
class SpinUp(Section):
    """The time before tracers are released, in which forced turbulence becomes stationary."""

    turnovers: float = number("large-eddy turnovers", above=0)
    stationary: float | None = number("of them, the last: averages of the stationary state are taken over these",
                                      default=None, above=0)


@dataclass(frozen=True, kw_only=True)
class Tracers(Section):
    """Particles that follow the filtered flow: the ground truth of learning.

    Once made it holds the filter width in use.
    """

    particles_per_side: int = integer("the number of particles is the cube of this", at_least=2,
                                      at_most=MOST_CELLS)
    placement: str = choice("where the particles start", "random", "lattice", default="random")
    filter_width: float = number("of the Gaussian filter, whose tails meet beyond half the cube; absent: twice the "
                                 "mean spacing, or half the cube where that is less",
                                 default=None, above=0, at_most=BOX_LENGTH / 2)
    interpolation: str = choice("splines from grid to particles", "cubic", "quintic", default="cubic")
    turnovers: float = number("large-eddy turnovers to follow the particles", above=0)
    forced: bool = boolean("whether [forcing] stays on meanwhile, so that the flow is stationary", default=False)
    frame_interval: float = number("time between stored frames", above=0)
    field_cells: int | None = integer("grid of the stored fields; absent: 1.5 x particles_per_side, even",
                                      default=None, at_least=4)
    field_every: int = integer("frames per stored field", default=5, at_least=1)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.filter_width is None:
            object.__setattr__(self, "filter_width", min(2 * self.spacing, BOX_LENGTH / 2))

    @property
    def particles(self) -> int:
        """Number of particles N."""
        return self.particles_per_side**3

    @property
    def spacing(self) -> float:
        """Mean spacing L / N^(1/3) of the particles."""
        return BOX_LENGTH / self.particles_per_side

    def radius_of(self, neighbors: float) -> float:
        """Radius h of the ball that holds so many of the N particles on average: n = N (4/3) pi h^3 / L^3."""
        return BOX_LENGTH * (neighbors / self.particles / (4 / 3 * math.pi)) ** (1 / 3)

    @property
    def cells(self) -> int:
        """Cells along each side of the stored fields: as given, or 1.5 particles_per_side rounded to even."""
        return 2 * round(0.75 * self.particles_per_side) if self.field_cells is None else self.field_cells

    @property
    def planes(self) -> int:
        """Layers at which the particles' slabs are cut, cells of the grid on which their velocity is resolved: 1.75
        particles_per_side rounded to even. Of modes up to 1.5 times their Nyquist wavenumber the shortest wave then has
        2.3 cells, which cubic splines still follow."""
        return 2 * round(0.875 * self.particles_per_side)


#: What a [kernel] has without a key, and in place of that with a preset.
KERNEL_DEFAULTS = {"form": "kriging", "positive": True, "cutoff": "smooth", "normalization_weight": 0.0,
                   "learning_rate": 2e-3}
KERNEL_PRESETS = {"paper": {"form": "average", "positive": False, "cutoff": "sigmoid", "normalization_weight": 1.0,
                            "learning_rate": 1e-3, "final_learning_rate": 1e-6}}
# Of the learning rate at the start, at the end of a training that has none of its own.
FINAL_RATE = 0.05


@dataclass(frozen=True, kw_only=True)
class Kernel(Section):
    """The smoothing kernel W, learned by reconstructing the filtered field from the particles, and how fields are
    reconstructed.

    Once made it holds the values of all keys, and no preset.
    """

    preset: str | None = choice("values of other keys that have a name, under those that are given; paper: Eqs. 6 to "
                                "11 as published", *KERNEL_PRESETS, default=None)
    form: str | None = choice("how fields and gradients are reconstructed from particles: average: with weights W; "
                              "linear, quadratic: polynomials fitted with W as weight; kriging: the best "
                              "estimate for filtered turbulence; absent: kriging", "average", "linear", "quadratic",
                              "kriging", default=None)
    positive: bool | None = boolean("W = alpha exp(NN) g, of unit integral; false: NN g of Eq. 7, which may be "
                                    "negative, and sums of Eq. 6, which nothing divides; absent: true", default=None)

    neighbors: float = number("mean number of particles within the support", default=NEIGHBORS, at_least=8)
    hidden: tuple[int, ...] = integers("widths of the network's tanh layers", default=(20, 20, 20, 20),
                                       at_least=1)
    cutoff: str | None = choice("factor g that ends the kernel at its support, where the sigmoid is 1/2; absent: "
                                "smooth", "smooth", "sigmoid", default=None)
    gradient_weight: float = number("weight of the velocity gradient in the loss", default=1.0, at_least=0)
    normalization_weight: float | None = number("weight of (integral - 1)^2 of the kernel before it is normalised; "
                                                "absent: 0", default=None, at_least=0)
    steps: int = integer("optimiser steps", at_least=1)
    points: int = integer("grid points drawn per step", default=2048, at_least=1)
    learning_rate: float | None = number("of the optimiser, at the start; absent: 2e-3", default=None, above=0)
    final_learning_rate: float | None = number("of the optimiser, at the end; absent: a twentieth of the first",
                                               default=None, above=0)

    def __post_init__(self) -> None:
        super().__post_init__()
        for key, value in (KERNEL_DEFAULTS | KERNEL_PRESETS.get(self.preset or "", {})).items():
            if getattr(self, key) is None:
                object.__setattr__(self, key, value)
        if self.final_learning_rate is None and self.learning_rate is not None:
            object.__setattr__(self, "final_learning_rate", FINAL_RATE * self.learning_rate)
        object.__setattr__(self, "preset", None)
        if not self.positive and self.form != "average":
            raise KeyProblem("kernel", "form", f' = "{self.form}": its weights must be positive, and positive = false '
                             'lets W be negative; set form = "average", or positive = true')


@dataclass(frozen=True, kw_only=True)
class Horizons(Section):
    """Training through several steps of the simulation, after all others."""

    frames: tuple[int, ...] = integers("through which the simulation is differentiated, one after the other",
                                       default=(1, 2, 4, 8), at_least=1)
    steps: int = integer("optimiser steps through each number of frames", at_least=1)
    time_step: float | None = number("of the simulation; absent: the interval of frames", default=None, above=0)
    integrator: str = choice("time stepping of the simulation", *SCHEMES, default="verlet")
    learning_rate: float = number("of the optimiser, at the start of each number of frames", default=1e-3, above=0)
    energy_weight: float = number("weight of the energies by bands of wavenumbers in the loss", default=0.1, at_least=0)

    @property
    def scheme(self) -> Scheme:
        """What the integrator does in a step."""
        return SCHEMES[self.integrator]

    @classmethod
    def section_name(cls) -> str:
        """The name of this section within [training]."""
        return "training.horizons"


@dataclass(frozen=True, kw_only=True)
class Training(Section):
    """How the force is fitted to the tracers: to trajectories, to all losses together, to what the simulation does."""

    truths: tuple[str, ...] | None = texts("run directories or files of the ground truths that are used, each with its "
                                           "own scales; absent: the run's own", default=None)
    window: float = number("fraction of each ground truth that is used, the rest stays unseen",
                           default=DEFAULT_WINDOW, above=0, at_most=1)
    frames: int = integer("frames to draw from, in all, evenly shared by the ground truths", at_least=2)
    batch: int = integer("particles per step", at_least=1)
    steps: int = integer("optimiser steps; 0: parameters stay as they start", at_least=0)
    patience: int | None = integer("steps without a smaller error on what is held out after which the steps on "
                                   "trajectories end, and those on all losses; absent: all steps are taken",
                                   default=None, at_least=1)
    learning_rate: float = number("of the optimiser, at the start", default=5e-3, above=0)
    final_learning_rate: float = number("of the optimiser, at the end", default=1e-4, above=0)
    precision: str = choice("of the training", "float32", "float64", default="float32")
    field_weight: float = number("weight of the field loss beside the trajectory loss", default=0.0, at_least=0)
    field_target: str = choice("what the field loss compares with; tracers: the kernel average of the true particles; "
                               "flow: the filtered field that is stored one frame later, on frames that have one",
                               "tracers", "flow", default="tracers")
    velocity_kl_weight: float = number("weight of the divergence of velocity PDFs", default=0.0, at_least=0)
    acceleration_kl_weight: float = number("the same for acceleration PDFs", default=0.0, at_least=0)
    power_weight: float = number("weight of the loss of the power, of all steps: what the force does to the energy, "
                                 "in units of u'^3 over the filter width", default=0.0, at_least=0)
    combined_steps: int = integer("steps at the end that use every loss", default=0, at_least=0)
    horizons: Horizons | None = section(Horizons, default=None)

    @property
    def wants_fields(self) -> bool:
        """Whether each frame that is trained on needs a filtered field one frame later."""
        return self.field_target == "flow" and self.field_weight > 0

    @property
    def truth_files(self) -> tuple[Path, ...]:
        """The files of `truths`; none without the key."""
        return tuple(product_file(path, "ground_truth.h5") for path in self.truths or ())


#: The step of a rollout that short rollouts find.
CONVERGED = "converged"


@dataclass(frozen=True, kw_only=True)
class Simulation(Section):
    """The run of the particles, without the direct simulation."""

    method: str = named("what moves the particles; see Baselines", *METHODS, default="learned")
    integrator: str | None = choice("time stepping of the particles; absent: rk3, or with step = \"converged\" the "
                                    "cheapest", *SCHEMES, default=None)
    step: float | str = number("longest time step; converged: the cheapest that has converged, found by short rollouts",
                               default=CONVERGED, words=(CONVERGED,), above=0)
    step_from: str | None = text("run directory whose converged step is used; absent: it is found for this rollout",
                                 default=None)
    confirmed_on: tuple[str, ...] | None = texts(
        "run directories or files of further ground truths, on each of which a step must have converged as well; "
        "absent: the realisations of the scene", default=None)
    turnovers: float = number("large-eddy turnovers to simulate", above=0)
    start: float | None = number("as a fraction of the ground truth; absent: where the training window ends, or at the "
                                 "first field of a ground truth that is not trained on", default=None, at_least=0,
                                 below=1)
    frame_interval: float = number("time between stored frames", above=0)
    skin: float = number("extra reach of the neighbour list, in supports", default=0.1, at_least=0, at_most=1)
    precision: str = choice("of the forces", "float32", "float64", default="float32")
    injection: float | str = number("large-scale forcing power per mass; truth: as the ground truth was forced while "
                                    "its tracers were followed; dissipation: as the flow loses", default="truth",
                                    words=("truth", "none", "dissipation"), above=0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.step_from is not None and self.step != CONVERGED:
            raise KeyProblem("simulation", "step_from", f' = "{self.step_from}": step = {self.step:g} needs no other '
                             f'run; set step = "{CONVERGED}", or remove step_from')
        if self.confirmed_on and not self.finds_step:
            raise KeyProblem("simulation", "confirmed_on", f" = {quoted(self.confirmed_on)}: no step is sought for "
                             f'this rollout; set step = "{CONVERGED}" without step_from, or remove confirmed_on')

    @property
    def scheme(self) -> Scheme:
        """What the integrator does in a step."""
        return SCHEMES[self.integrator or "rk3"]

    @property
    def schemes(self) -> tuple[str, ...]:
        """The integrators among which a converged step is sought."""
        return (self.integrator,) if self.integrator else tuple(SCHEMES)

    @property
    def longest_step(self) -> float:
        """The longest time step as given, infinite where it is to be found."""
        return math.inf if isinstance(self.step, str) else self.step

    @property
    def finds_step(self) -> bool:
        """Whether the step is to be found for this rollout."""
        return self.step == CONVERGED and self.step_from is None

    @property
    def confirming_files(self) -> tuple[Path, ...]:
        """The files of `confirmed_on`; none without the key."""
        return tuple(product_file(path, "ground_truth.h5") for path in self.confirmed_on or ())

    @property
    def needs(self) -> tuple[str, ...]:
        """What the method needs, of "model", "density" and "pairs"."""
        return method_of(self.method).needs

    @property
    def title(self) -> str:
        """The method in tables and figures."""
        return method_of(self.method).title

    @property
    def on_grid(self) -> bool:
        """Whether a flow on a coarse grid moves the particles."""
        return method_of(self.method).on_grid


@dataclass(frozen=True)
class Closure:
    """A closure of a coarse grid.

    Parameters
    ----------
    equations : that it is for.
    constant : the key of [eulerian] with its constant; None: it has none.
    learned : whether it takes the rates of damping that a model has learned.
    """

    equations: tuple[str, ...]
    constant: str | None = None
    learned: bool = False


EQUATIONS = ("unfiltered", "filtered")
CLOSURES = {
    "none": Closure(EQUATIONS),
    "smagorinsky": Closure(EQUATIONS, constant="smagorinsky"),
    "dynamic-smagorinsky": Closure(EQUATIONS),
    "spectral": Closure(("unfiltered",)),
    "learned": Closure(("unfiltered",), learned=True),
    "gradient": Closure(("filtered",)),
    "dynamic-mixed": Closure(("filtered",)),
}


@dataclass(frozen=True, kw_only=True)
class Eulerian(Section):
    """Large-eddy simulation on a coarse grid, with method = "eulerian"; absent: the defaults."""

    cells: int | None = integer("of the coarse grid; absent: its Nyquist wavenumber is pi / filter width, at least 8",
                                default=None, at_least=8)
    fluid: str = choice("equations of motion on the coarse grid", "incompressible", "compressible",
                        default="incompressible")
    equations: str = choice("unfiltered: of the velocity, whose filtered part moves the particles; filtered: of the "
                            "filtered velocity", *EQUATIONS, default="unfiltered")
    closure: str = choice("what stands for the scales that the grid, or the filter, leaves out; see Baselines",
                          *CLOSURES, default="none")
    smagorinsky: float = number("C_s of closure smagorinsky, the eddy viscosity (C_s Delta)^2 (2 S:S)^(1/2)",
                                default=0.17, above=0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.equations not in self.form.equations:
            fitting = [name for name, closure in CLOSURES.items() if self.equations in closure.equations]
            raise KeyProblem("eulerian", "closure", f' = "{self.closure}": with equations = "{self.equations}" it must '
                             f"be one of {', '.join(fitting)}; change one of the two")

    @property
    def form(self) -> Closure:
        """What is known of the closure."""
        return CLOSURES[self.closure]

    @property
    def compressible(self) -> bool:
        """Whether the fluid has a density, and sound."""
        return self.fluid == "compressible"

    def filter_passed(self, filter_width: float) -> float:
        """Width of the filter that the velocity of the equations has passed: the particles' or 0."""
        return filter_width if self.equations == "filtered" else 0.0

    def cells_for(self, filter_width: float) -> int:
        """Cells along each side: as given, or the fewest whose Nyquist wavenumber reaches pi / d."""
        if self.cells is not None:
            return self.cells
        return max(math.ceil(BOX_LENGTH / filter_width - 1e-9), 8)
