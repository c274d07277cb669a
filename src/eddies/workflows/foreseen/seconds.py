"""An estimate of the wall time of a stage, for batch requests. The formula holds within a factor of three.

    seconds = START + (transforms x TRANSFORM + pairs x (PAIR + weights x WEIGHT)) / ranks
            + calls x (CALL + ROUNDS x (ranks - 1) x MESSAGE)

Here `transforms` is the number of transforms times the number of grid points. `pairs` is the number of pairs of
particles, `weights` that of network weights, and `calls` that of evaluations and iterations. `eddies check --time`
measures the time instead.
"""

import math
from itertools import pairwise

from eddies.analysis.rollout import PLANES
from eddies.flow.navier_stokes import FLUIDS, CompressibleFluid
from eddies.scene.scene import BOX_LENGTH, Scene
from eddies.scene.sections import NEIGHBORS
from eddies.scene.terms import NetworkSettings
from eddies.time_stepping import ETDRK4, STEPPERS
from eddies.workflows.foreseen.numbers import estimate
from eddies.workflows.ground_truth.frame_counts import KERNEL_FIELDS, TESTED_FRAMES

# Seconds, measured on one and two cores of an AMD EPYC with AVX-512 (`tiny`, `hit-small`, `hit-coarse`). TRANSFORM: a
# transform, per grid point. PAIR: a pair of particles. WEIGHT: a weight of a network, per pair. CALL: overhead of an
# evaluation or iteration. MESSAGE: a message. START: overhead of a stage.
# Ratios. CACHED: a transform of the direct simulation takes 1 + cells / CACHED times as long, because its planes
# outgrow the caches. TRACER: number of pairs that take as long as a step of a tracer. SINGLE: time in single precision
# divided by that in double precision. ROUNDS: messages in a call, for each rank beyond the first.
TRANSFORM, CACHED, SINGLE, PAIR, TRACER, WEIGHT = 4e-9, 550, 0.65, 2.5e-8, 200, 6e-11
CALL, MESSAGE, ROUNDS = 2.5e-4, 2e-6, 4
START = {"dns": 0.4, "train-kernel": 0.7, "reconstruct": 1.0, "train": 1.0, "find-step": 0.5, "simulate": 0.3,
         "report": 2.3}
FORM_PAIRS = {"average": 1, "kriging": 6}  # time of a neighbour, in units of "average"
SEARCH, CONFIRM = 2, 0.75    # turnovers that a search simulates on the first ground truth, and on each further one
COLD, ITERATION = 25, 12     # iterations of a solve without a first guess; transforms in each iteration
GRADIENT = 4                 # cost of an evaluation with its gradient, relative to one without


def seconds(scene: Scene, stage: str, ranks: int) -> float | None:
    """Estimate the wall time of a stage in seconds; None if the number of its steps is unknown."""
    tracers, kernel, model, expected = scene.tracers, scene.kernel, scene.model, estimate(scene)
    rollout = expected.rollout
    transforms = pairs = calls = solves = weights = 0.0
    neighbors = scene.neighbors if model and "pairs" in model.reads else 0.0
    if stage == "dns":
        if expected.steps is None:
            return None
        calls, cells = expected.steps * STEPPERS[scene.time.stepper].evaluations, scene.flow.cells
        fluid = FLUIDS.get(scene.flow.fluid, CompressibleFluid)
        transforms = calls * fluid.transforms * cells**3 * (1 + cells / CACHED)
        if scene.flow.precision == "float32":
            transforms *= SINGLE
        if tracers is not None:
            followed = tracers.turnovers / (tracers.turnovers + (scene.spin_up.turnovers if scene.spin_up else 0.0))
            particles = sum(each.particles for each in (tracers.sets.values() if tracers.sets else [tracers]))
            pairs = expected.steps * followed * particles * TRACER
    elif stage == "train-kernel":  # two kernels are trained
        calls = 2 * kernel.steps * GRADIENT
        pairs = kernel.neighbors * (kernel.steps * tracers.particles + 2 * KERNEL_FIELDS * tracers.cells**3)
    elif stage == "reconstruct":
        if expected.frame_intervals is None:
            return None
        settings = scene.reconstruction
        calls = (1 + (settings.holdout > 0)) * math.ceil((expected.frame_intervals + 1) / settings.every)
        transforms, pairs = calls * COLD * ITERATION * scene.tracers_resolving.planes**3, 0.0
        if settings.method in FORM_PAIRS:
            transforms, pairs = 0.0, calls * NEIGHBORS * tracers.planes**3 * FORM_PAIRS[settings.method]
    elif stage == "train":
        solves = TESTED_FRAMES
        if training := scene.own_training:
            calls = GRADIENT * training.steps_in_all
            solves, pairs = solves + training.frames + 1, GRADIENT * training.steps * training.batch * neighbors
            if training.field_weight > 0:  # in a cube with a quarter of the box's edge, and around it
                width = min(1 / 4 + 2 * scene.kernel_support / BOX_LENGTH, 1)
                pairs += GRADIENT * training.combined_steps * tracers.particles * width**3 * kernel.neighbors
            if horizons := training.horizons:
                substeps = round(tracers.frame_interval / (horizons.time_step or tracers.frame_interval))
                evaluations = horizons.steps * sum(horizons.frames) * substeps * horizons.scheme.evaluations
                solves += 2 * evaluations
                pairs += GRADIENT * evaluations * tracers.particles * neighbors / 2
    elif stage in ("find-step", "simulate"):
        if rollout is None:
            return None
        calls, pairs = rollout.evaluations, rollout.evaluations * tracers.particles * neighbors / 2
        if model and "model" in scene.simulation.needs:
            pairs *= max(term.pair_cost for term in model.settings.values())
        if scene.coarse_cells:
            calls = rollout.steps * ETDRK4.evaluations
            transforms = calls * CompressibleFluid.transforms * scene.coarse_cells**3
        elif "model" in scene.simulation.needs:
            solves = rollout.evaluations * scene.simulation.scheme.iterations / COLD
    elif rollout and kernel:       # a page of a report: gradients at the particles of all frames, and a few fields
        pairs = ((rollout.intervals + 1) * tracers.particles + PLANES * tracers.cells**3) * kernel.neighbors
        pairs *= FORM_PAIRS[kernel.form]
    if solves and scene.needs_resolved_velocity:
        calls += solves * COLD
        transforms += solves * COLD * ITERATION * tracers.planes**3
    if stage in ("train", "find-step", "simulate") and model:
        layers = [(len(term.inputs), *term.hidden) for term in model.settings.values()
                  if isinstance(term, NetworkSettings)]
        weights = sum(first * second for widths in layers for first, second in pairwise(widths))
    whole = (transforms * TRANSFORM + pairs * (PAIR + weights * WEIGHT)) / ranks
    whole += calls * (CALL + ROUNDS * (ranks - 1) * MESSAGE)
    if stage == "find-step":
        whole *= (SEARCH + CONFIRM * len(scene.simulation.confirming_files)) / scene.simulation.turnovers
    return START[stage] / (ranks if stage == "report" else 1) + whole  # ranks share the pages
