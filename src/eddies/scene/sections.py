"""The sections of a scene. Each section is a frozen dataclass, and each of its fields declares one key.

Lengths are in units of the cube [0, 2 pi)^3, the mean density is 1, and the unit of time follows from lengths and
velocities.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from eddies.clock import rounded_up
from eddies.import_path import is_path, load
from eddies.pipeline import STAGES
from eddies.scene.integrators import SCHEMES, Scheme
from eddies.scene.rules import quoted
from eddies.scene.values import (KeyProblem, SceneError, Section, boolean, choice, column, expanded, integer, integers,
                                 named, number, numbers, product_file, section, sections, text, texts)

BOX_LENGTH = 2 * math.pi
DEFAULT_WINDOW = 0.5
# Largest number of cells along a side of the cube: twice that of the largest direct simulations.
MOST_CELLS = 65536
# Default mean number of particles within the kernel support or the radius of interaction, as in the paper.
NEIGHBORS = 60.0


@dataclass(frozen=True, kw_only=True)
class Flow(Section):
    """The fluid, and the grid of the direct simulation. Every scene without [tracks] needs this section."""

    fluid: str = named("equations of motion", "incompressible", "compressible")
    cells: int = integer("grid cells along each side of the cube", at_least=8, at_most=MOST_CELLS)
    viscosity: float = number("kinematic viscosity", at_least=0)
    sound_speed: float | None = number("speed of sound, compressible fluid only", default=None, above=0)
    precision: str = choice("precision of the grid arrays", "float64", "float32", default="float64")

    @property
    def compressible(self) -> bool:
        """Whether the fluid has a variable density and sound waves."""
        return load(self.fluid).compressible if is_path(self.fluid) else self.fluid == "compressible"

    @property
    def components(self) -> int:
        """Number of scalar fields in the state: three for the velocity, and one for the density if it varies."""
        return 4 if self.compressible else 3

    @property
    def real_bytes(self) -> int:
        """Number of bytes of a real number on the grid."""
        return 4 if self.precision == "float32" else 8

    @property
    def largest_wavenumber(self) -> int:
        """k_max of the 2/3 rule: the largest integer below cells / 3."""
        return (self.cells - 1) // 3


@dataclass(frozen=True)
class InitialFlow:
    """Properties of an initial flow that are known before the flow is made."""

    keys: tuple[str, ...] = ("amplitude", "peak_wavenumber", "wavenumber", "path", "state")  # its keys in [initial]
    turbulent: bool = False  # whether it has many scales; its spectrum then has its peak at `peak_wavenumber`
    sound: bool = False  # whether it is at rest except for sound waves
    steady: bool = False  # whether it has no acceleration without viscosity
    seeded: bool = True  # whether it depends on the seed of the scene

    @property
    def from_file(self) -> bool:
        """Whether the flow is a stored state, which is read from a file."""
        return self.keys == ("path", "state")


INITIAL_FLOWS = {
    "random": InitialFlow(("amplitude", "peak_wavenumber"), turbulent=True),
    "taylor-green": InitialFlow(("amplitude",), seeded=False),
    "abc": InitialFlow(("amplitude", "wavenumber"), seeded=False),
    "shear-wave": InitialFlow(("amplitude", "wavenumber"), steady=True, seeded=False),
    "sound-wave": InitialFlow(("amplitude", "wavenumber"), sound=True, seeded=False),
    "file": InitialFlow(("path", "state"), seeded=False),
    "spectrum": InitialFlow(("path",)),
}


@dataclass(frozen=True, kw_only=True)
class Initial(Section):
    """The velocity, and with a compressible fluid the density, at time 0."""

    kind: str = named("initial flow", *INITIAL_FLOWS, default="random")
    amplitude: float = number("amplitude of the velocity; random: rms of a component; sound-wave: of ln density",
                              default=1.0, above=0)
    peak_wavenumber: float = number("wavenumber of the spectrum's peak, random only", default=3.0, at_least=0.1)
    wavenumber: int = integer("number of waves in the cube; abc, shear-wave, sound-wave only", default=1, at_least=1)
    path: str | None = text("file to start from, on any grid: ground_truth.h5 or its run directory, JHTDB cutout or "
                            "fluidsim state; kind spectrum: a text file with k and E(k) in each line", default=None)
    state: int = integer("number of the state in this file, from 0 in order of time; states are in fields/final, "
                         "with tracers in fields/unfiltered, of a cutout in velocity_####", default=0, at_least=0)

    @property
    def file(self) -> Path | None:
        """The file to start from; for a run directory, its ground truth."""
        if self.path is None:
            return None
        path = expanded(self.path)
        return path / STAGES["dns"].file if path.is_dir() else path

    @property
    def flow(self) -> InitialFlow:
        """The properties of this kind of initial flow."""
        return INITIAL_FLOWS.get(self.kind, InitialFlow())


@dataclass(frozen=True, kw_only=True)
class Columns(Section):
    """Columns of a table of tracks, by name or number; absent ones are recognised by their names."""

    track: str | int | None = column("number or name of the track")
    time: str | int | None = column("time, or number of the frame")
    x: str | int | None = column("coordinate x")
    y: str | int | None = column("coordinate y")
    z: str | int | None = column("coordinate z")
    u: str | int | None = column("velocity along x")
    v: str | int | None = column("velocity along y")
    w: str | int | None = column("velocity along z")

    @property
    def given(self) -> dict[str, str | int]:
        """The columns that are given, by key."""
        return {key: value for key, value in dataclasses.asdict(self).items() if value is not None}


@dataclass(frozen=True, kw_only=True)
class Tracks(Section):
    """Measured particle tracks, used in place of the direct simulation and its tracers.

    In this section lengths are in the length unit of the file, and times in the time unit of its velocities. A run has
    the same unit of time, but its box has the edge 2 pi. Fields are made from all tracks of a frame; models use only
    the tracks that are present in all frames.
    """

    path: str = text("file with the tracks; * stands for any text in the names of a series of tables")
    format: str | None = choice("layout of the file (docs/tracks.md); absent: found from its name and content", "h5md",
                                "npz", "lagrangebench", "flowtracks", "proptv", "csv", default=None)
    columns: Columns | None = section(Columns, default=None)
    group: str | None = text("name of the particles or of the trajectory in a file with several", default=None)
    box: float | None = number("edge of the periodic cube; absent: that of the file", default=None, above=0)
    volume: tuple[float, ...] | str | None = numbers("x0, x1, y0, y1, z0, z1 of a volume that is not periodic, in "
                                                     "place of box; auto: from the positions", default=None,
                                                     words=("auto",))
    margin: float | None = number("distance between the volume and its image in the periodic cube around it; absent: "
                                  "four mean spacings", default=None, above=0)
    background: str = choice("mean flow of a volume, which is fitted to all tracks and taken out before fields are "
                             "reconstructed; linear: a velocity and a shear, both constant", "none", "linear",
                             default="none")
    time_unit: float = number("factor from times of the file to the time unit of its velocities", default=1.0, above=0)
    frame_rate: float | None = number("frames per unit of time, for files that count frames or have no times",
                                      default=None, above=0)
    filtered: bool = boolean("whether the particles follow a filtered velocity; false: the unfiltered one",
                             default=False)
    filter_width: float | None = number("width of the Gaussian filter; absent: twice the mean spacing", default=None,
                                        above=0)
    viscosity: float | None = number("kinematic viscosity, for terms that need it", default=None, above=0)
    sound_speed: float | None = number("speed of sound, for terms that need the density; the file must have densities",
                                       default=None, above=0)
    density: float | None = number("constant density of the fluid, by which reconstructed pressures are multiplied; "
                                   "absent: they are divided by it", default=None, above=0)
    noise: float | str | None = number("standard deviation of the error of a measured coordinate; auto: estimated; "
                                       "absent: estimated if the file has no velocities, else 0", default=None,
                                       words=("auto",), at_least=0)
    longest_gap: int = integer("largest number of frames that a track may lack; a track is divided at a longer gap",
                               default=2, at_least=0)
    field_every: int = integer("interval between reconstructed fields, in frames", default=5, at_least=1)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.volume is None:
            if self.margin is not None:
                raise self.problem("margin", "this key belongs to volume, which is missing; remove it, or give volume "
                                   "in place of box")
            if self.background != "none":
                raise self.problem("background", "a periodic box has no mean shear, and its mean velocity needs no "
                                   "key; remove background, or give volume in place of box")
            return
        if not isinstance(self.volume, str) and (len(self.volume) != 6 or not all(
                low < high for low, high in zip(self.volume[::2], self.volume[1::2]))):
            raise self.problem("volume", "must be six numbers x0, x1, y0, y1, z0, z1 with x0 < x1, y0 < y1, z0 < z1")
        if self.box is not None:
            raise self.problem("box", "a volume is given too, which is not periodic; remove one of the two")

    @property
    def file(self) -> Path:
        """The file with the tracks."""
        return expanded(self.path)


@dataclass(frozen=True, kw_only=True)
class Forcing(Section):
    """Linear solenoidal forcing of the largest scales at a prescribed power."""

    injection_rate: float = number("power injected per unit mass", at_least=0)
    wavenumber: float = number("limit of the forced modes, 0 < |k| < wavenumber", default=2.0, above=1)


@dataclass(frozen=True, kw_only=True)
class Time(Section):
    """The time step and, without tracers, the run time."""

    stepper: str = choice("time stepping method", "etdrk4", "rk4", default="etdrk4")
    courant: float = number("Courant number of the step (advective; rk4 also acoustic)", default=0.8, above=0)
    max_step: float = number("largest step; smaller ones are this divided by a power of two", default=0.05, above=0)
    step: float | None = number("fixed time step; absent: courant and max_step give it", default=None, above=0)
    duration: float | None = number("run time after spin-up, without tracers only", default=None, above=0)

    @property
    def explicit(self) -> bool:
        """Whether the step has to resolve sound and viscosity."""
        return self.stepper == "rk4"


@dataclass(frozen=True, kw_only=True)
class SpinUp(Section):
    """The time before tracers are released, in which forced turbulence becomes stationary."""

    turnovers: float = number("length of the spin-up in large-eddy turnovers", above=0)
    stationary: float | None = number("number of turnovers at the end of the spin-up over which the stationary state "
                                      "is averaged", default=None, above=0)


# The keys in which sets of tracers may differ.
SET_KEYS = ("particles_per_side", "count", "placement", "seed", "filtered", "filter_width", "field_cells")


@dataclass(frozen=True, kw_only=True)
class Tracers(Section):
    """Particles that follow the filtered flow: the ground truth for learning.

    An absent `filter_width` gets its value when the section is made. `sets` maps NAME to the set of [tracers.NAME]; one
    simulation carries all sets. A set takes the keys that it lacks from [tracers]. If `set` names one of the sets, the
    section takes the values of this set, and `sets` becomes empty.
    """

    _holder: ClassVar[str] = "sets"

    set: str | None = text("NAME of the set [tracers.NAME] to use; absent: a scene with sets makes only their "
                           "ground truths", default=None)
    particles_per_side: int | None = integer("cube root of the number of particles", default=None, at_least=2,
                                             at_most=MOST_CELLS)
    count: int | None = integer("number of particles, if particles_per_side is absent", default=None, at_least=8,
                                at_most=MOST_CELLS**3)
    placement: str = choice("initial positions of the particles; lattice: needs particles_per_side", "random",
                            "lattice", default="random")
    seed: int = integer("number that is added to the seed of the scene for the initial positions", default=0,
                        at_least=0, at_most=10**18)
    filtered: bool = boolean("whether the particles follow the filtered velocity; false: the unfiltered one",
                             default=True)
    filter_width: float = number("width of the Gaussian filter; absent: twice the mean spacing, or half the cube if "
                                 "that is less",
                                 default=None, above=0, at_most=BOX_LENGTH / 2)
    interpolation: str = choice("splines from grid to particles", "cubic", "quintic", default="cubic")
    turnovers: float = number("time for which the particles are followed, in large-eddy turnovers", above=0)
    forced: bool = boolean("whether [forcing] stays on during this time, so that the flow is stationary", default=False)
    frame_interval: float = number("time between stored frames", above=0)
    field_cells: int | None = integer("cells along each side of the stored fields; absent: 1.5 x particles_per_side, "
                                      "rounded to even", default=None, at_least=4)
    field_every: int = integer("interval between stored fields, in frames", default=5, at_least=1)
    sets: Mapping[str, Tracers] = sections()

    def __post_init__(self) -> None:
        super().__post_init__()
        sets = {name: self._set_of(name, own) for name, own in self.sets.items()}
        if self.set is not None and self.set not in sets:
            raise self.problem("set", f"there is no section [tracers.{self.set}]; there are: "
                               f"{', '.join(sets) or 'none'}")
        if (self.particles_per_side is None) == (self.count is None):
            raise KeyProblem("tracers", "particles_per_side", ": this key is missing (cube root of the number of "
                             "particles); give it, or count" if self.count is None else
                             f" = {self.particles_per_side}: count is given too; remove one of the two")
        if self.placement == "lattice" and self.count is not None:
            raise self.problem("placement", "needs particles_per_side; give it in place of count")
        if self.filter_width is None:
            object.__setattr__(self, "filter_width", min(2 * self.spacing, BOX_LENGTH / 2))
        object.__setattr__(self, "sets", sets)
        if self.set is not None:
            chosen = sets[self.set]
            for field in dataclasses.fields(self):
                object.__setattr__(self, field.name, getattr(chosen, field.name))

    def _set_of(self, name: str, own: Any) -> Tracers:
        """Make the set `name` from `own`, its table or object. Keys that the table lacks, and all keys outside
        SET_KEYS, get the values of this section."""
        if isinstance(own, Tracers):
            return dataclasses.replace(self, sets={}, set=None, **{key: getattr(own, key) for key in SET_KEYS})
        if not isinstance(own, dict):
            raise SceneError(f"tracers.{name}: must be a section; write [tracers.{name}] and its keys below")
        for key in own:
            if key not in SET_KEYS:
                raise KeyProblem(f"tracers.{name}", key, ": not a key of a set; the sets share all keys of [tracers] "
                                 f"except {', '.join(SET_KEYS)}")
        one = {"particles_per_side": None, "count": None} if {"particles_per_side", "count"} & {*own} else {}
        try:
            return dataclasses.replace(self, sets={}, set=None, **{**one, **own})
        except KeyProblem as problem:
            raise problem.within(f"tracers.{name}") from None

    def with_count(self, count: int) -> Tracers:
        """Return the same section with `count` particles, at random places."""
        return dataclasses.replace(self, particles_per_side=None, count=count, placement="random")

    @property
    def all(self) -> tuple[Tracers, ...]:
        """The sets that the simulation carries; the section itself if it has none."""
        return tuple(self.sets.values()) or (self,)

    @property
    def particles(self) -> int:
        """Number of particles N."""
        return self.count or (self.particles_per_side or 0) ** 3

    @property
    def spacing(self) -> float:
        """Mean spacing L / N^(1/3) of the particles; L is the edge of the cube."""
        return BOX_LENGTH / self._per_side

    @property
    def _per_side(self) -> float:
        """Cube root of the number of particles."""
        return self.particles_per_side or round(math.cbrt(self.particles), 9)

    def radius_of(self, neighbors: float) -> float:
        """Return the radius h of a ball that holds n = `neighbors` of the N particles on average.

        It satisfies n = N (4/3) pi h^3 / L^3, where L is the edge of the cube.
        """
        return BOX_LENGTH * (neighbors / self.particles / (4 / 3 * math.pi)) ** (1 / 3)

    @property
    def cells(self) -> int:
        """Cells along each side of the stored fields: as given, or 1.5 N^(1/3) rounded to even."""
        return 2 * round(0.75 * self._per_side) if self.field_cells is None else self.field_cells


#: The defaults of keys of [kernel], and for each preset the values that replace defaults.
KERNEL_DEFAULTS = {"form": "kriging", "positive": True, "cutoff": "smooth", "normalization_weight": 0.0,
                   "learning_rate": 2e-3}
KERNEL_PRESETS = {"paper": {"form": "average", "positive": False, "cutoff": "sigmoid", "normalization_weight": 1.0,
                            "learning_rate": 1e-3, "final_learning_rate": 1e-6}}
# Default ratio of the final to the initial learning rate.
FINAL_RATE = 0.05


@dataclass(frozen=True, kw_only=True)
class Kernel(Section):
    """The smoothing kernel W, trained to reconstruct the filtered field, and the method that reconstructs fields.

    When the section is made, the preset fills the absent keys, and `preset` becomes None.
    """

    preset: str | None = choice("a named set of values for absent keys; paper: Eqs. 6 to 11 as published",
                                *KERNEL_PRESETS, default=None)
    form: str | None = choice("reconstruction of fields and gradients from particles; average: with weights W; "
                              "kriging: the best estimate for filtered turbulence; absent: kriging", "average",
                              "kriging", default=None)
    positive: bool | None = boolean("whether W = alpha exp(NN) g, of unit integral; false: W = NN g of Eq. 7, which "
                                    "may be negative, and Eq. 6 is not normalised; absent: true", default=None)
    neighbors: float = number("mean number of particles within the support", default=NEIGHBORS, at_least=8)
    hidden: tuple[int, ...] = integers("widths of the network's tanh layers", default=(20, 20, 20, 20), at_least=1)
    cutoff: str | None = choice("factor g that ends the kernel at its support; sigmoid: 1/2 there; absent: smooth",
                                "smooth", "sigmoid", default=None)
    gradient_weight: float = number("weight of the velocity gradient in the loss", default=1.0, at_least=0)
    normalization_weight: float | None = number("weight of (integral - 1)^2 of the kernel before it is normalised; "
                                                "absent: 0", default=None, at_least=0)
    steps: int = integer("optimiser steps", at_least=1)
    points: int = integer("grid points drawn per step", default=2048, at_least=1)
    learning_rate: float | None = number("learning rate at the start; absent: 2e-3", default=None, above=0)
    final_learning_rate: float | None = number("learning rate at the end; absent: a twentieth of learning_rate",
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
            raise self.problem("form", "its weights must be positive, and positive = false lets W be negative; set "
                               'form = "average", or positive = true')


#: Quantities of [reconstruction] fields, with the number of components of each.
RECONSTRUCTED = {"velocity": 3, "gradient": 9, "vorticity": 3, "strain": 6, "dissipation": 1, "q": 1, "r": 1,
                 "pressure": 1, "acceleration": 3}
#: Those of them that are linear in the velocity. With [reconstruction] samples, their standard deviations are stored.
LINEAR = "velocity", "gradient", "vorticity", "strain"


@dataclass(frozen=True, kw_only=True)
class Reconstruction(Section):
    """Fields from the particles of each frame, on a grid."""

    method: str = choice("least-squares: solenoidal modes with a prior; memory: the same, and the forecast from the "
                         "frame before is the mean of the prior; kriging: from neighbours; average: with the kernel, "
                         "Eqs. 5 and 6", "least-squares", "memory", "kriging", "average", default="least-squares")
    cells: int | None = integer("cells along each side of the grid; absent: those of the stored fields", default=None,
                                at_least=8, at_most=MOST_CELLS)
    every: int = integer("interval between reconstructions, in frames", default=1, at_least=1)
    fields: tuple[str, ...] = texts("quantities that are stored; gradient: du_i/dx_j, row by row; strain: its "
                                    "symmetric part, xx, yy, zz, xy, xz, yz; q, r: its invariants",
                                    *RECONSTRUCTED, default=("velocity", "vorticity"))
    particles: bool = boolean("whether the quantities are stored at the particles too", default=False)
    points: str | None = text("table of points, with columns x, y, z and perhaps time, at which they are stored too",
                              default=None)
    correct_dissipation: bool = boolean("whether the part of the dissipation is added that the modes lack, by the "
                                        "spectrum of turbulence", default=False)
    holdout: float = number("share of the tracks that a second reconstruction leaves out, to estimate the error; 0: "
                            "none", default=0.1, at_least=0, at_most=0.5)
    memory: float = number("time for which a wave is remembered, in units of 1 / (k u')", default=4.0, above=0)
    samples: int = integer("number of random errors of a frame, whose rms is stored as standard deviation of those of "
                           "velocity, gradient, vorticity and strain that are among fields; 0: none", default=0,
                           at_least=0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.samples and self.of_neighbors:
            raise self.problem("samples", f'method = "{self.method}" has no errors that could be drawn; set method = '
                               '"least-squares" or "memory", or samples = 0')
        if self.samples and not self.deviations:
            raise self.problem("samples", f"no quantity in fields has a standard deviation; add one of "
                               f"{', '.join(LINEAR)} to fields, or set samples = 0")

    @property
    def deviations(self) -> tuple[str, ...]:
        """The quantities whose standard deviations are stored."""
        return tuple(name for name in self.fields if name in LINEAR) if self.samples else ()

    @property
    def points_file(self) -> Path | None:
        """The table of points."""
        return None if self.points is None else expanded(self.points)

    @property
    def of_neighbors(self) -> bool:
        """Whether the method estimates each grid point from the particles around it."""
        return self.method not in ("least-squares", "memory")

    def resolving(self, tracers: Tracers, filtered: bool) -> Tracers:
        """Return `tracers` with so many particles that one frame of them would resolve the modes of the reconstruction.

        The number of particles changes only if the method is "memory" and the tracks are not `filtered`: it is then
        eight times that of `tracers`, because the memory keeps modes that `tracers` determine only over several frames
        (docs/tracks.md). With filtered tracks further modes gain little, because the removal of the filter amplifies
        their errors.
        """
        return tracers.with_count(8 * tracers.particles) if self.method == "memory" and not filtered else tracers


@dataclass(frozen=True, kw_only=True)
class Horizons(Section):
    """Training through several steps of the simulation, after all other training."""

    frames: tuple[int, ...] = integers("numbers of frames through which the simulation is differentiated, in turn",
                                       default=(1, 2, 4, 8), at_least=1)
    steps: int = integer("optimiser steps through each number of frames", at_least=1)
    time_step: float | None = number("time step of the simulation; absent: the frame interval", default=None,
                                     above=0)
    integrator: str = choice("time stepping method of the simulation", *SCHEMES, default="verlet")
    learning_rate: float = number("learning rate at the start, for each number of frames", default=1e-3, above=0)
    energy_weight: float = number("weight of the energies in wavenumber bands in the loss", default=10.0, at_least=0)


@dataclass(frozen=True, kw_only=True)
class Training(Section):
    """The training of the model: on trajectories, then with all losses, then through steps of the simulation."""

    truths: tuple[str, ...] | None = texts("run directories or files of the ground truths to train on, each with its "
                                           "own scales; absent: the run's own", default=None)
    window: float = number("fraction of each ground truth to train on; the rest stays unseen",
                           default=DEFAULT_WINDOW, above=0, at_most=1)
    frames: int = integer("number of frames to draw from, shared evenly by the ground truths", at_least=2)
    batch: int = integer("particles per step", at_least=1)
    steps: int = integer("optimiser steps; 0: parameters keep their initial values", at_least=0)
    patience: int | None = integer("steps without a smaller validation error after which a phase ends, on trajectories "
                                   "or on all losses; absent: all steps are taken", default=None, at_least=1)
    learning_rate: float = number("learning rate at the start", default=5e-3, above=0)
    final_learning_rate: float = number("learning rate at the end", default=1e-4, above=0)
    precision: str = choice("precision of the training", "float32", "float64", default="float32")
    field_weight: float = number("weight of the field loss beside the trajectory loss", default=0.0, at_least=0)
    field_target: str = choice("reference of the field loss; tracers: the kernel average of the true particles; flow: "
                               "the filtered field one frame later, for frames where it is stored", "tracers", "flow",
                               default="tracers")
    velocity_kl_weight: float = number("weight of the KL divergence of velocity PDFs", default=0.0, at_least=0)
    acceleration_kl_weight: float = number("weight of the KL divergence of acceleration PDFs", default=0.0, at_least=0)
    power_weight: float = number("weight of the loss of the power of the force, in all steps; the power is in units "
                                 "of u'^3 over the filter width", default=0.0, at_least=0)
    combined_steps: int = integer("number of steps at the end that use every loss", default=0, at_least=0)
    horizons: Horizons | None = section(Horizons, default=None)

    @property
    def wants_fields(self) -> bool:
        """Whether each frame of the training needs a filtered field one frame later."""
        return self.field_target == "flow" and self.field_weight > 0

    @property
    def steps_in_all(self) -> int:
        """Number of optimiser steps, including those of [training.horizons]."""
        return self.steps + (self.horizons.steps * len(self.horizons.frames) if self.horizons else 0)

    @property
    def longest_horizon(self) -> int:
        """Largest number of frames in [training.horizons]; 0 without it."""
        return max(self.horizons.frames) if self.horizons else 0

    @property
    def truth_files(self) -> tuple[Path, ...]:
        """The files of `truths`; none without the key."""
        return tuple(product_file(path, "dns") for path in self.truths or ())


@dataclass(frozen=True)
class Method:
    """Properties of a method that moves the particles of a rollout."""

    needs: tuple[str, ...] = ()  # what it needs, any of NEEDS
    title: str = "own method"  # name in tables and figures
    on_grid: bool = False  # whether a flow on a coarse grid, with the settings in [eulerian], moves the particles


METHODS = {
    "learned": Method(needs=("model",), title="particle model"),
    "none": Method(title="no force"),
    "eulerian": Method(title="coarse grid", on_grid=True),
}
# What a method may need: a trained model, the density of the ground truth, neighbours within the radius of interaction.
NEEDS = ("model", "density", "pairs")
#: If [simulation] step has this value, short rollouts find the step.
CONVERGED = "converged"


@dataclass(frozen=True, kw_only=True)
class Simulation(Section):
    """The rollout, in which a method moves the particles without the direct simulation."""

    method: str = named("method that moves the particles; see docs/methods.md", *METHODS, default="learned")
    integrator: str | None = choice("time stepping method of the particles; absent: rk3, or with step = \"converged\" "
                                    "the cheapest", *SCHEMES, default=None)
    step: float | str = number("longest time step; converged: the cheapest that has converged, found by short rollouts",
                               default=CONVERGED, words=(CONVERGED,), above=0)
    step_from: str | None = text("run directory whose converged step is used; absent: it is found for this rollout",
                                 default=None)
    confirmed_on: tuple[str, ...] | None = texts(
        "run directories or files of further ground truths, on each of which the step must have converged too; "
        "absent: the realisations of the scene", default=None)
    turnovers: float = number("length of the rollout in large-eddy turnovers", above=0)
    start: float | None = number("start of the rollout as a fraction of the ground truth; absent: the end of the "
                                 "training interval, or the first field of a ground truth without training",
                                 default=None, at_least=0, below=1)
    frame_interval: float = number("time between stored frames", above=0)
    skin: float = number("extra reach of the neighbour list, as a fraction of its radius", default=0.1, at_least=0,
                         at_most=1)
    precision: str = choice("precision of the forces", "float32", "float64", default="float32")
    injection: float | str = number("large-scale forcing power per mass; truth: as in the ground truth while tracers "
                                    "were followed; dissipation: the dissipation rate of the ground truth",
                                    default="truth", words=("truth", "none", "dissipation"), above=0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.step_from is not None and self.step != CONVERGED:
            raise self.problem("step_from", f'step = {self.step:g} needs no other run; set step = "{CONVERGED}", or '
                               "remove step_from")
        if self.confirmed_on and not self.finds_step:
            raise self.problem("confirmed_on", f'only a search for the step uses this key; set step = "{CONVERGED}" '
                               "without step_from, or remove confirmed_on")

    @property
    def scheme(self) -> Scheme:
        """The properties of the integrator."""
        return SCHEMES[self.integrator or "rk3"]

    @property
    def schemes(self) -> tuple[str, ...]:
        """The integrators with which the search for a converged step runs."""
        return (self.integrator,) if self.integrator else tuple(SCHEMES)

    @property
    def longest_step(self) -> float:
        """The longest time step as given; infinite if short rollouts find it."""
        return math.inf if isinstance(self.step, str) else self.step

    @property
    def finds_step(self) -> bool:
        """Whether short rollouts find the step."""
        return self.step == CONVERGED and self.step_from is None

    @property
    def step_file(self) -> Path | None:
        """The file with the converged step of the run that `step_from` names; None without the key."""
        return None if self.step_from is None else product_file(self.step_from, "find-step")

    @property
    def confirming_files(self) -> tuple[Path, ...]:
        """The files of `confirmed_on`; none without the key."""
        return tuple(product_file(path, "dns") for path in self.confirmed_on or ())

    @property
    def form(self) -> Method:
        """The properties of the method. A user's class declares its `needs` as an attribute."""
        if not is_path(self.method):
            return METHODS[self.method]
        needs = getattr(load(self.method), "needs", ())
        if isinstance(needs, str) or not set(needs) <= set(NEEDS):
            raise SceneError(f"[simulation] method: {quoted(self.method)}: needs = {quoted(needs)}: must be a tuple of "
                             f"any of {', '.join(map(quoted, NEEDS))}")
        return Method(tuple(needs), title=self.method.rpartition(":")[2])


@dataclass(frozen=True)
class Closure:
    """Properties of a closure, the model of the scales that the coarse grid or the filter leaves out."""

    equations: tuple[str, ...]  # those of EQUATIONS that it can close
    constant: str | None = None  # key of [eulerian] with its constant
    learned: bool = False  # whether it uses the damping rates that a model has learned


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
    """Large-eddy simulation on a coarse grid, for method = "eulerian"; without this section, the defaults hold."""

    cells: int | None = integer("cells along each side of the coarse grid; absent: the fewest whose Nyquist wavenumber "
                                "reaches pi / filter width, at least 8", default=None, at_least=8)
    fluid: str = choice("equations of motion on the coarse grid", "incompressible", "compressible",
                        default="incompressible")
    equations: str = choice("velocity of the equations; unfiltered: the whole velocity, whose filtered part moves the "
                            "particles; filtered: the filtered velocity", *EQUATIONS, default="unfiltered")
    start: str = choice("modes at the start; flow: those of the true flow; particles: a least-squares fit to the "
                        "velocities of the particles", "flow", "particles", default="flow")
    closure: str = choice("model of the scales that the grid, or the filter, leaves out; see docs/methods.md",
                          *CLOSURES, default="none")
    smagorinsky: float = number("C_s of closure smagorinsky, the eddy viscosity (C_s Delta)^2 (2 S:S)^(1/2)",
                                default=0.17, above=0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.equations not in self.form.equations:
            fitting = [name for name, closure in CLOSURES.items() if self.equations in closure.equations]
            raise self.problem("closure", f'with equations = "{self.equations}" it must be one of '
                               f"{', '.join(fitting)}; change one of the two")

    @property
    def form(self) -> Closure:
        """The properties of the closure."""
        return CLOSURES[self.closure]

    @property
    def compressible(self) -> bool:
        """Whether the fluid has a variable density and sound waves."""
        return self.fluid == "compressible"

    def cells_for(self, filter_width: float) -> int:
        """Return the number of cells along each side: `cells`, or without this key the smallest number, at least 8,
        whose Nyquist wavenumber reaches pi / filter width."""
        if self.cells is not None:
            return self.cells
        return max(rounded_up(BOX_LENGTH / filter_width), 8)
