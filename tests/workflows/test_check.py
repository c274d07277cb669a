"""Numbers told before a run: against closed forms, against what a run does, and nothing is written."""

import json
import logging
import math
from dataclasses import replace
from pathlib import Path

import pytest

from eddies.scene.scene import Time, builtin_scenes, load_scene


def lines_of(scene, comm, caplog):
    from eddies.workflows import check
    with caplog.at_level(logging.INFO, logger="eddies"):
        check.run(scene, comm)
    return "\n".join(record.getMessage() for record in caplog.records)


@pytest.fixture
def recorded(monkeypatch, quick_probes):
    monkeypatch.setattr(logging.getLogger("eddies"), "propagate", True)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("name", [name for name, _ in builtin_scenes()])
def test_check_of_any_scene_writes_nothing(comm, tmp_path, monkeypatch, caplog, recorded, name):
    monkeypatch.chdir(tmp_path)
    text = lines_of(load_scene(name), comm, caplog)
    for subject in ("grid", "turbulence", "time step", "ranks", "memory", "time"):
        assert subject in text
    assert list(tmp_path.iterdir()) == []


@pytest.mark.mpi(2, 3)
def test_check_on_more_ranks(comm, caplog, recorded):
    text = lines_of(load_scene("hit-small"), comm, caplog)
    assert comm.rank > 0 or "at most 12" in text


@pytest.mark.usefixtures("quick_probes")
@pytest.mark.mpi(1, 2)
def test_numbers_for_programs(comm, capfd):
    from eddies.workflows import check
    check.run(load_scene("hit-small"), comm, as_json=True)
    shown = capfd.readouterr().out
    if comm.rank > 0:
        assert shown == ""
        return
    told = json.loads(shown)
    assert (told["particles"], told["largest_wavenumber"], told["most_ranks"]) == (32768, 21, 12)
    assert told["most_ranks"] == min(told["limits"].values()) <= told["most_ranks_dns"] and told["ranks"] == comm.size
    assert told["turbulence"]["reynolds_lambda"] == pytest.approx(50.3, abs=0.05)
    assert [row["ranks"] for row in told["costs"]][:3] == [1, 2, 4]
    assert told["warnings"] == told["refusals"] == [] and told["not_foreseen"] == {}
    rows = told["rollout_costs"]
    assert [row["cores"] for row in rows] == [2**m for m in range(len(rows))] and len(rows) <= 14
    for row in rows:
        assert row["ranks"] <= told["most_ranks"] and row["cores"] == row["ranks"] * row["threads"]
        assert row["seconds_per_step"] == pytest.approx(3 * row["seconds_per_evaluation"]) and row["seconds"] > 0
    check_sums(told)


def check_sums(told):
    """Stages are those of the scene, their parts add up, and they to the totals."""
    stages, totals = told["stage_costs"], told["totals"]
    assert [row["stage"] for row in stages] == [name for name in told["stages"] if name not in told["not_foreseen"]]
    for row in stages:
        assert row["seconds"] == pytest.approx(sum(row["parts"].values())) and min(row["parts"].values()) >= 0
        assert row["memory"] > 1e7 and row["disk"] > 0 and row["scratch"] >= 0
    assert totals["seconds"] == pytest.approx(sum(row["seconds"] for row in stages))
    assert totals["disk"] == pytest.approx(sum(row["disk"] for row in stages)) and totals["most_disk"] >= totals["disk"]
    assert totals["memory"] == max(row["memory"] for row in stages)
    rollout = told["rollout"]
    assert rollout["steps_per_frame"] == pytest.approx(rollout["steps"] / rollout["intervals"])
    assert rollout["evaluations"] == 3 * rollout["steps"] + 1


@pytest.mark.usefixtures("quick_probes")
@pytest.mark.mpi(1)
def test_every_key_is_described(comm, capfd):
    from eddies.workflows import check
    described = (Path(__file__).parents[2] / "docs/check.md").read_text(encoding="utf-8")
    check.run(load_scene("tiny"), comm, as_json=True)

    def keys(value):
        for part in value if isinstance(value, list) else [value] if isinstance(value, dict) else []:
            for key, inner in part.items() if isinstance(part, dict) else []:
                yield key
                yield from keys(inner) if key not in ("limits", "parts", "not_foreseen") else ()

    assert [key for key in dict.fromkeys(keys(json.loads(capfd.readouterr().out))) if f"`{key}`" not in described] == []


@pytest.mark.usefixtures("quick_probes")
@pytest.mark.mpi(1)
def test_what_is_not_foreseen_is_null(comm, capfd):
    from eddies.workflows import check
    check.run(load_scene("abc"), comm, as_json=True)
    told = json.loads(capfd.readouterr().out)
    assert told["turbulence"] is told["particles"] is told["kernel_support"] is None
    assert told["rollout_costs"] == [] and told["rollout"] is told["mach_turbulent"] is None
    assert [row["stage"] for row in told["stage_costs"]] == ["dns", "report"]


@pytest.mark.mpi(1)
def test_numbers_of_the_small_case(comm, caplog, recorded):
    text = lines_of(load_scene("hit-small"), comm, caplog)
    for part in ("spacing 0.09817, k_max 21", "32^3 = 32768, mean spacing 0.1963 = 2 cells", "Re_lambda 50.3",
                 "filter width 0.3927", "kernel support 0.4769, 60 neighbours", "at most 12"):
        assert part in text


def test_expected_turbulence_is_consistent():
    from eddies.workflows.foreseen.estimates import expected_turbulence
    turbulence = expected_turbulence(load_scene("hit-small"))
    eta, t_eta, nu = turbulence.kolmogorov_length, turbulence.kolmogorov_time, turbulence.viscosity
    assert eta**2 / t_eta == pytest.approx(nu)
    assert nu * (1 / t_eta) ** 2 == pytest.approx(turbulence.dissipation_rate)
    # Pope (2000), Eq. 6.64 with k = 3 u'^2 / 2: Re_lambda^2 = 15 u'^4 / (nu eps)
    assert turbulence.reynolds_lambda**2 == pytest.approx(15 * turbulence.velocity_rms**4 / (nu * 0.5))


def test_random_start_decays_from_its_own_scales():
    from eddies.workflows.foreseen.estimates import expected_turbulence
    turbulence = expected_turbulence(load_scene("tracers-only"))
    assert turbulence.velocity_rms == 1.0
    assert turbulence.turnover_time == pytest.approx(math.sqrt(2 * math.pi) / 3)


@pytest.mark.parametrize("overrides, step, limit", [
    (["time.max_step=0.001"], 0.001, "max_step"),
    ([], 0.01, "advection"),
    (["time.stepper=rk4"], 0.02 / 16, "sound"),
    (["time.step=0.004"], 0.004, "fixed"),
])
def test_what_limits_the_step(overrides, step, limit):
    from eddies.workflows.foreseen.estimates import expected_step
    found, reason = expected_step(load_scene("hit-small", overrides))
    assert found == pytest.approx(step) and limit in reason


@pytest.mark.mpi(1)
def test_expected_step_is_the_one_taken_at_the_start(comm):
    from eddies.clock import Clock
    from eddies.workflows.foreseen.estimates import expected_step
    from eddies.workflows.ground_truth.scene_flow import build_fluid, build_step_limit, initial_state
    for name in ("taylor-green", "abc"):
        scene = replace(load_scene(name), time=Time(duration=1e9, max_step=1e3))
        fluid = build_fluid(scene, comm)
        taken = build_step_limit(scene, fluid.grid)(initial_state(scene, fluid), Clock())
        assert expected_step(scene)[0] == pytest.approx(taken)


@pytest.mark.mpi(1, 2, 3)
@pytest.mark.parametrize("neighbors, most", [(100, 3), (200, 2)])
def test_most_ranks_is_what_the_parts_accept(comm, neighbors, most):
    from eddies.parallel.halo import HaloError, require_thick_slabs
    from eddies.parallel.slab import SlabDecomposition
    from eddies.scene.scene import BOX_LENGTH
    from eddies.spectral.interpolation import SplineInterpolation
    from eddies.spectral.spectral_grid import SpectralGrid
    from eddies.workflows.foreseen.estimates import most_ranks, particle_reach
    scene = load_scene("tiny", [f"kernel.neighbors={neighbors}"])
    fields, particles = (SlabDecomposition(comm, BOX_LENGTH, planes)
                         for planes in (scene.tracers.cells, scene.tracers.planes))
    assert min(most_ranks(scene).values()) == most
    SplineInterpolation(SpectralGrid(fields), "quintic")
    SplineInterpolation(SpectralGrid(particles), "cubic")
    if comm.size <= most:
        require_thick_slabs(fields, scene.kernel_support)
        require_thick_slabs(particles, particle_reach(scene))
    else:
        with pytest.raises(HaloError):
            require_thick_slabs(fields, scene.kernel_support)
            require_thick_slabs(particles, particle_reach(scene))


@pytest.mark.mpi(1, 2, 3)
@pytest.mark.parametrize("frames, thick, planes", [(2, 3, 6), (4, 2, 5), (8, 2, 3), (12, 1, 2)])
def test_ranks_for_horizons_are_those_that_the_grid_and_the_particles_accept(comm, frames, thick, planes):
    """With particles as fast as in stationary turbulence: what training builds, and a particle at its farthest."""
    import torch

    from eddies.parallel.halo import HaloError
    from eddies.parallel.slab import SlabDecomposition
    from eddies.particles.neighborhood import Neighborhood
    from eddies.particles.particle_set import ParticleSet
    from eddies.particles.resolved_velocity import ResolvedVelocity
    from eddies.scene.scene import BOX_LENGTH
    from eddies.workflows.foreseen.estimates import (ALLOWED_VELOCITY, PEAK_VELOCITY, expected_turbulence,
                                                     horizon_time, most_training_ranks)
    from tests.particles.configurations import FLOW

    def accepted(build):
        try:
            build()
        except HaloError:
            return False
        return True

    scene = load_scene("tiny", ["training.horizons.steps=5", f"training.horizons.frames=[1, {frames}]"])
    limits = most_training_ranks(scene)
    by_reach, = (ranks for reason, ranks in limits.items() if reason.startswith("slabs no thinner"))
    by_grid = limits["ghost planes of the grid in the training through horizons"]
    assert (by_reach, by_grid) == (thick, planes)
    speed, tracers = expected_turbulence(scene).velocity_rms, scene.tracers
    slab, support = SlabDecomposition(comm, BOX_LENGTH, tracers.planes), scene.kernel_support
    time = horizon_time(scene)
    drift = ALLOWED_VELOCITY * speed * time
    assert accepted(lambda: ResolvedVelocity.on_slabs(slab, FLOW, drift)) == (comm.size <= by_grid)
    far = torch.tensor([[1.0, 1.0, slab.upper + PEAK_VELOCITY * speed * time]], dtype=torch.float64)
    particles = ParticleSet(torch.tensor([comm.rank]), far, torch.zeros_like(far), torch.ones(1))
    around = Neighborhood(slab, BOX_LENGTH, support, 0.0)
    assert accepted(lambda: around.update(particles)) == (comm.size <= by_reach)


def test_ranks_are_not_limited_by_horizons_that_are_not_trained():
    from eddies.workflows.foreseen.estimates import most_ranks
    for changes in ([], ["training.horizons.steps=5", "model.path=runs/other"]):
        scene = load_scene("hit-small", changes)
        assert min(most_ranks(scene).values()) == 12 and not any("horizons" in reason for reason in most_ranks(scene))


def test_what_no_term_reads_limits_no_ranks():
    from eddies.workflows.check import warnings
    from eddies.workflows.foreseen.estimates import most_ranks
    fast = ["training.horizons.steps=5", "training.horizons.frames=[12]"]
    limits = {preset: most_ranks(load_scene("tiny", [*fast, f"model.preset={preset}"]))
              for preset in ("resolved + pairs", "resolved", "transport-velocity")}
    found = {preset: {word for word in ("reach", "resolved") if any(word in reason for reason in reasons)}
             for preset, reasons in limits.items()}
    assert found == {"resolved": {"resolved"}, "transport-velocity": {"reach"},
                     "resolved + pairs": {"reach", "resolved"}}
    told = {preset: [line for line in warnings(load_scene("tiny", [f"model.preset={preset}"]), 1) if "horizons" in line]
            for preset in limits}
    assert told == {"resolved + pairs": [], "resolved": [], "transport-velocity": [
        '[model] terms: "transport-velocity" is trained through horizons alone, and stays as it starts without them: '
        "add [training.horizons]"]}


def test_steps_that_sound_outruns_are_told():
    """Of terms of SPH."""
    from eddies.workflows.foreseen.warnings import warnings
    told = {changes: [line for line in warnings(load_scene("tiny", changes), 1) if "resolve sound" in line]
            for changes in (("model.preset=wcsph",), ("model.preset=wcsph", "simulation.step=0.001"), ())}
    (line,) = told.pop(("model.preset=wcsph",))
    assert line.startswith('[simulation] step = 0.08: the term "wcsph" has to resolve sound, with a step of at most')
    scene = load_scene("tiny", ["model.preset=wcsph"])
    # Of Monaghan (1992), with an alpha of 0.05.
    longest = 0.4 * scene.interaction_radius / 2 / (scene.flow.sound_speed * 1.03)
    assert float(line.partition("at most ")[2].split()[0]) == pytest.approx(longest, rel=0.1)
    assert list(told.values()) == [[], []]


@pytest.mark.usefixtures("quick_probes")
@pytest.mark.mpi(1)
def test_a_rollout_is_foreseen_where_a_model_moves_the_particles_of_a_cpu(comm):
    from eddies.workflows.check import rollout_costs, rollout_lines
    from eddies.workflows.foreseen.stage_costs import probe_scene, stage_costs
    learned = load_scene("tiny")
    rows = rollout_costs(learned, probe_scene(learned, comm))
    lines = list(rollout_lines(learned, rows))
    assert len(lines) == len(rows) + 2 and "3 evaluations a step, 3 iterations each" in lines[0]
    assert all(row.binds in line and f"{row.ranks} x {row.threads}" in line for row, line in zip(rows, lines[2:]))
    for changes, stages in ((["simulation.method=none"], ["dns", "train-kernel", "simulate", "report"]),
                            (["device=cuda"], ["dns", "train-kernel", "report"])):
        other = load_scene("tiny", changes)
        speeds = probe_scene(other, comm)
        assert rollout_costs(other, speeds) == [] == list(rollout_lines(other, []))
        assert [cost.stage for cost in stage_costs(other, 1, speeds)] == stages
        assert set(speeds.missing) == set(other.stages) - set(stages)


@pytest.mark.mpi(1, 2)
def test_a_term_that_fails_leaves_the_rest_foreseen(comm, own, caplog, recorded):
    own("own_fault", "from eddies.particles.terms.viscosity import Viscosity\nclass Fault(Viscosity):\n"
                     "    def forward(self, context): raise ValueError('not among so few')")
    text = lines_of(load_scene("tiny", ['model.terms=["pressure", "own_fault:Fault"]']), comm, caplog)
    assert comm.rank > 0 or "simulate      not foreseen: ValueError: not among so few" in text


@pytest.mark.mpi(1)
def test_check_of_a_start_of_the_users(comm, own, caplog, recorded):
    own("own_start", "def swirl(grid, initial, seed): pass\n")
    scene = replace(load_scene("taylor-green", ["initial.kind=own_start:swirl"]), time=Time(duration=1))
    assert "not foreseen: the speed of the initial flow is not known" in lines_of(scene, comm, caplog)


def test_ghost_planes_limit_the_ranks():
    from eddies.workflows.foreseen.estimates import most_ranks
    fields = {planes: most_ranks(load_scene("tiny", [f"tracers.field_cells={planes}"])) for planes in (11, 12)}
    assert [limits["ghost planes of the filtered fields"] for limits in fields.values()] == [2, 3]
    # Of 20 planes: two for the splines, and what half the skin reaches; particles come home at every stage of a step.
    assert fields[12]["ghost planes of the resolved velocity"] == 20 // 3
    for overrides, ghosts in ((["simulation.step=0.2"], 3), (["simulation.skin=1"], 4)):
        assert most_ranks(load_scene("tiny", overrides))["ghost planes of the resolved velocity"] == 20 // ghosts
    assert "ghost planes of the resolved velocity" not in most_ranks(load_scene("tiny", ["model.preset=paper"]))


@pytest.mark.mpi(1)
@pytest.mark.parametrize("override, warning", [("flow.viscosity=0.001", "k_max eta is about 0.047, below 1"),
                                               ("tracers.filter_width=0.1", "narrower than a cell")])
def test_warnings(comm, override, warning, caplog, recorded):
    assert warning in lines_of(load_scene("tiny", [override]), comm, caplog)


@pytest.mark.mpi(1)
def test_what_a_stage_would_refuse_is_told(comm, caplog, recorded):
    text = lines_of(load_scene("taylor-green", ["initial.kind=file", "initial.path=nowhere.h5"]), comm, caplog)
    assert "fails here  nowhere.h5" in text


@pytest.mark.mpi(1)
def test_job_with_too_many_ranks_is_told(comm):
    from eddies.workflows.check import warnings
    assert any("this job has 100 ranks" in line for line in warnings(load_scene("tiny"), 100))
    assert list(warnings(load_scene("hit-small"), 2)) == []


def test_weights_that_are_not_there_yet_are_told(tmp_path):
    from eddies.workflows.check import warnings
    scene = load_scene("tiny", [f"model.path={tmp_path}"])
    (told,) = warnings(scene, 1)
    assert f"there is no {tmp_path / 'model.h5'} yet" in told
    (tmp_path / "model.h5").touch()
    assert not list(warnings(scene, 1))


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("overrides", [["forcing.wavenumber=1.5"], ["flow.cells=72", "forcing.wavenumber=23"]])
@pytest.mark.filterwarnings("error")
def test_probe_forces_any_wavenumber(comm, overrides):
    from eddies.workflows.foreseen.cost_model import probe
    speed = probe(load_scene("hit-small", overrides), comm, steps=1)
    assert 0 < speed.work < math.inf and 0 < speed.bandwidth < math.inf


def test_probe_keeps_the_cells_of_a_rank():
    from eddies.workflows.foreseen.cost_model import small_flow
    scene = load_scene("hit-paper")
    assert [small_flow(scene, ranks).flow.cells for ranks in (1, 7, 8, 64)] == [64, 64, 128, 256]
    assert small_flow(load_scene("tiny"), 64).flow.cells == 24


def rows_of(scene):
    """The table of `eddies check` for ranks of a speed that is made up, as words."""
    from eddies.workflows.check import cost_lines
    from eddies.workflows.foreseen.cost_model import Speed
    return [line.split("  ") for line in list(cost_lines(scene, Speed(1e-6, 1e9)))[2:]]


def test_table_goes_to_the_most_slabs():
    from eddies.workflows.foreseen.network import NODE_CORES
    rows = [[word.strip() for word in row if word.strip()] for row in rows_of(load_scene("hit-paper"))]
    assert [int(row[0]) for row in rows] == [2**m for m in range(9)]  # at most 341
    assert [int(row[1]) for row in rows] == [max(1, 2**m // NODE_CORES) for m in range(9)]
    assert [int(row[2]) for row in rows] == [1024 // 2**m for m in range(9)]
    # without tracers: a plane each, twelve rows and no more
    scene = load_scene("taylor-green", ["flow.cells=4096"])
    assert [int(row[0]) for row in map(lambda row: [word for word in row if word], rows_of(scene))] == [
        2**m for m in range(1, 13)]


def test_memory_and_time_fall_with_the_ranks():
    from eddies.workflows.foreseen.cost_model import Speed, costs
    rows = costs(load_scene("hit-paper"), 512, Speed(1e-6, 1e9))
    for few, many in zip(rows, rows[1:]):
        assert many.memory < few.memory and many.seconds < few.seconds
        assert many.ranks * many.seconds >= few.ranks * few.seconds * (1 - 1e-12)  # no speed-up beyond the ideal
    # An odd plane costs as much as a pair.
    from eddies.workflows.foreseen.cost_model import cost
    assert cost(load_scene("hit-paper"), 1024, Speed(1e-6, 1e9)).work == rows[-1].work


@pytest.mark.mpi(2)
@pytest.mark.parametrize("fluid", ["compressible", "incompressible"])
def test_bytes_sent_are_those_of_the_transposes(comm, fluid, monkeypatch):
    from eddies.parallel.reduction import global_sum
    from eddies.parallel.transpose import TransposeBuffers
    from eddies.workflows.foreseen.cost_model import sent_bytes
    from eddies.workflows.ground_truth.scene_flow import build_fluid, initial_state
    changes = ["flow.cells=20", f"flow.fluid={fluid}", "initial.kind=taylor-green"]
    scene = load_scene("taylor-green", changes + (["flow.sound_speed=10"] if fluid == "compressible" else []))
    equation = build_fluid(scene, comm)
    state, sent = initial_state(scene, equation), []
    send = TransposeBuffers._send

    def counted(self, outgoing, *others):
        sent.append(outgoing.nbytes)
        send(self, outgoing, *others)

    monkeypatch.setattr(TransposeBuffers, "_send", counted)
    equation.nonlinear(state)
    # Of what changes sides, each of two ranks keeps half, but for the uneven cut of 13 columns.
    assert float(global_sum(comm, sum(sent))) == pytest.approx(sent_bytes(scene) / 2, rel=0.01)


def test_messages_cost_time_beyond_a_node():
    from eddies.workflows.foreseen.cost_model import Speed, exchange_seconds, sent_bytes
    from eddies.workflows.foreseen.network import LATENCY, NODE_BANDWIDTH, NODE_CORES
    scene, speed = load_scene("hit-paper"), Speed(1e-6, 1e9)
    assert exchange_seconds(scene, 1, speed) == 0
    # Two nodes: each holds half of all bytes and keeps half of that, in messages from each rank to all others.
    ranks = 2 * NODE_CORES
    crossing = sent_bytes(scene) / 4 / NODE_BANDWIDTH
    within = sent_bytes(scene) / ranks * (NODE_CORES - 1) / ranks / speed.bandwidth
    assert exchange_seconds(scene, ranks, speed) == pytest.approx(
        4 * (crossing + within + 2 * (ranks - 1) * LATENCY))


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("fluid", ["compressible", "incompressible"])
def test_memory_of_a_step_is_as_expected(comm, fluid):
    # Arrays that a state, its operators and buffers hold, counted by the allocator, at a size where they are most.
    import tracemalloc

    from eddies.clock import Clock
    from eddies.time_stepping import ETDRK4
    from eddies.workflows.foreseen.cost_model import PROCESS_BYTES, flow_bytes
    from eddies.workflows.ground_truth.scene_flow import build_fluid, build_step_limit, initial_state
    changes = ["flow.cells=48", f"flow.fluid={fluid}", "initial.kind=taylor-green"]
    scene = load_scene("taylor-green", changes + (["flow.sound_speed=10"] if fluid == "compressible" else []))
    tracemalloc.start()
    equation = build_fluid(scene, comm)
    stepper, state = ETDRK4(equation), initial_state(scene, equation)
    stepper(state, build_step_limit(scene, equation.grid)(state, Clock()))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    expected = flow_bytes(scene, comm.size) - PROCESS_BYTES
    assert 0.4 * expected < peak < 1.1 * expected
