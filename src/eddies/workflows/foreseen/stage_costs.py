"""Time, memory and disk of all stages of a scene: the probes that this needs, the stages, and their totals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from eddies.parallel.communicator import Comm
from eddies.scene.scene import Scene
from eddies.workflows.foreseen.cost_model import probe
from eddies.workflows.foreseen.estimates import flow_steps
from eddies.workflows.foreseen.rollout_course import rollout_course
from eddies.workflows.foreseen.stage_cost import Speeds, StageCost, flow_cost, report_cost


def probe_scene(scene: Scene, comm: Comm) -> Speeds:
    """Run the probes that a scene gives reason to; all ranks call it."""
    flow, missing, learned = probe(scene, comm), unforeseen(scene), evaluated(scene)
    if scene.device != "cpu":
        missing |= dict.fromkeys(learned, "particles on a GPU are not probed")
        learned = set()
    particles, training, coarse = None, None, None
    if learned or scene.kernel:
        from eddies.workflows.foreseen import particle_probe, training_probe  # torch, where something is learned
        try:
            if learned:
                particles = particle_probe.probe_particles(training_probe.evaluated_scene(scene), comm)
            training = training_probe.probe_training(scene, comm, "train" in learned)
        except particle_probe.ProbeError as error:  # on all ranks
            missing |= dict.fromkeys(set(scene.stages) - {"dns", "report"}, str(error))
    if scene.simulation and "simulate" not in missing:
        from eddies.workflows.foreseen import coarse_probe
        coarse = coarse_probe.probe_coarse(scene, comm) if scene.simulation.on_grid else None
    return Speeds(flow, particles, training, missing, coarse)


def evaluated(scene: Scene) -> set[str]:
    """The stages that evaluate the scene's model."""
    found = {"train"} if "train" in scene.stages else set()
    return found | ({"simulate"} if scene.simulation and "model" in scene.simulation.needs else set())


def unforeseen(scene: Scene) -> dict[str, str]:
    """Why stages are not foreseen, by stage."""
    missing = {}
    if flow_steps(scene) is None:
        missing["dns"] = "the time step or the turnover time is not known before"
    if scene.simulation and rollout_course(scene) is None:
        missing["simulate"] = "the turnover time is not known before, or the method is one's own"
    return missing


def stage_costs(scene: Scene, ranks: int, speeds: Speeds) -> list[StageCost]:
    """The costs of all stages that are foreseen, in order, on ranks of that speed."""
    costs = {"dns": flow_cost, "report": report_cost}
    if scene.tracers:
        from eddies.workflows.foreseen import learning_cost  # torch
        costs |= {"train-kernel": learning_cost.kernel_cost, "train": learning_cost.training_cost,
                  "simulate": learning_cost.rollout_cost}
    return [costs[stage](scene, ranks, speeds) for stage in scene.stages if stage not in speeds.missing]


def totals(costs: Sequence[StageCost]) -> dict[str, Any]:
    """Seconds and disk of all stages together; the memory of a rank in the stage that needs most, and the disk at the
    worst moment."""
    left, most = 0.0, 0.0
    for cost in costs:
        left += cost.disk
        most = max(most, left + cost.scratch)
    return {"seconds": sum(cost.seconds for cost in costs), "memory": max((cost.memory for cost in costs), default=0.0),
            "disk": left, "most_disk": most}
