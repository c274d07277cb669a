"""What a variant shares, what it keeps, what it fails of, and how its steps are timed."""

import pytest

from eddies.io.hdf5 import create_product, write_attributes
from eddies.parallel import rendezvous
from eddies.pipeline import STAGES
from eddies.scene.scene import SceneError, load_scene
from eddies.workflows.variants.rows import step_costs
from eddies.workflows.variants.run import StepSeconds, VariantRun
from eddies.workflows.run_directory.work import WorkAtStake


def write(comm, directory, stage, scene):
    kind, name = STAGES[stage].product, STAGES[stage].file
    directory.mkdir(parents=True, exist_ok=True)
    with create_product(comm, directory / name, kind, {"fingerprint": scene.fingerprint(stage)}) as file:
        write_attributes(file.create_group("rollout"), {
            "status": "complete", "eddy_turnover_time": 2.0, "seconds_per_step": 0.3, "seconds_per_step_low": 0.2,
            "seconds_per_step_high": 0.5})


@pytest.fixture
def variants(comm, tmp_path):
    """Two variants with the same model and one with another, beside a base run with ground truth, kernel and model."""
    changes = {"first": [], "second": ["simulation.integrator=rk2"], "other": ["model.pairs.hidden=[4]"]}
    scenes = {name: load_scene("tiny", [*change, f"name={name}"]) for name, change in changes.items()}
    for stage in ("dns", "train-kernel", "train"):
        write(comm, tmp_path / "base", stage, scenes["first"])
    return [VariantRun(scene, tmp_path / "out" / name, tmp_path / "base") for name, scene in scenes.items()]


def names(variant):
    return {path.name for path in variant.directory.glob("*.h5")}


@pytest.mark.mpi(1)
def test_kernel_is_the_bases_and_a_model_that_of_the_first_variant_with_the_same(comm, variants):
    first, second, other = variants
    first.prepare([], 1)
    assert names(first) == {"ground_truth.h5", "kernel.h5"}  # what training costs is to be measured
    write(comm, first.directory, "train", first.scene)
    second.prepare([first], 1)
    other.prepare([first, second], 1)
    assert names(second) == {"ground_truth.h5", "kernel.h5", "model.h5"}
    assert names(other) == names(second) - {"model.h5"}
    assert (second.directory / "model.h5").resolve() == first.directory / "model.h5"
    assert (second.directory / "kernel.h5").resolve() == first.ground_truth / "kernel.h5"


@pytest.mark.mpi(1)
def test_a_kernel_of_other_settings_is_shared_among_variants(comm, variants, tmp_path):
    scenes = [load_scene("tiny", ["kernel.steps=7", f"name={name}"]) for name in "ab"]
    one, two = (VariantRun(scene, tmp_path / "out" / scene.name, tmp_path / "base") for scene in scenes)
    one.prepare([], 1)
    assert names(one) == {"ground_truth.h5"}
    write(comm, one.directory, "train-kernel", one.scene)
    two.prepare([one], 1)
    assert (two.directory / "kernel.h5").resolve() == one.directory / "kernel.h5"


@pytest.mark.mpi(1)
def test_what_fits_is_kept_and_what_does_not_is_told_before_it_is_replaced(comm, variants):
    variant = variants[0]
    variant.prepare([], 1)
    for stage in ("train", "simulate"):
        write(comm, variant.directory, stage, variant.scene)
    variant.work(1).refuse_to_lose()
    variant.prepare([], 1)
    assert {"model.h5", "rollout.h5"} < names(variant)
    with pytest.raises(WorkAtStake, match=r"would be replaced: rollout.h5 \(made "):
        variant.work(2).refuse_to_lose()
    variant.prepare([], 2)  # times of another number of ranks would not compare
    assert "rollout.h5" not in names(variant) and "model.h5" in names(variant)
    changed = VariantRun(variants[2].scene, variant.directory, variant.ground_truth)
    with pytest.raises(WorkAtStake, match=r"would be replaced: model.h5"):  # not the kernel, a link
        changed.work(1).refuse_to_lose()
    changed.prepare([], 1)
    assert names(changed) == {"ground_truth.h5", "kernel.h5"}


@pytest.mark.mpi(1)
def test_a_directory_that_a_comparison_has_made_is_used_again(comm, variants):
    for variant in variants[:2]:
        variant.check_directory([variant.ground_truth])
        variant.directory.mkdir(parents=True)  # empty: nothing is lost
        variant.check_directory([variant.ground_truth])
        variant.prepare([], 1)
        variant.check_directory([variant.ground_truth])


@pytest.mark.mpi(1)
@pytest.mark.parametrize("file", ["model.h5", "checkpoints/step-00000001/state.h5"])
def test_a_directory_with_files_of_others_is_refused(comm, variants, file):
    variant = variants[0]
    path = variant.directory / file
    path.parent.mkdir(parents=True)
    path.write_text("precious")
    with pytest.raises(SceneError, match='"first": its run directory .*first holds files that no comparison has made'):
        variant.check_directory([variant.ground_truth])


@pytest.mark.mpi(1)
def test_a_ground_truth_put_where_a_link_was_is_refused(comm, variants):
    variant = variants[0]
    variant.prepare([], 1)
    (variant.directory / "ground_truth.h5").unlink()
    write(comm, variant.directory, "dns", variant.scene)
    with pytest.raises(SceneError, match="holds files that no comparison has made"):
        variant.check_directory([variant.ground_truth])


@pytest.mark.mpi(1)
@pytest.mark.parametrize("place", ["first", "first/timing", "alias"])
def test_a_directory_with_a_ground_truth_in_it_is_refused(comm, variants, tmp_path, place):
    variant = variants[0]
    variant.prepare([], 1)
    (tmp_path / "out/alias").symlink_to("first")
    with pytest.raises(SceneError, match="would be that of the ground truth, .*another --output or another name"):
        variant.check_directory([variant.ground_truth, tmp_path / "out" / place])


def refusal():
    raise SceneError("no such thing")


@pytest.mark.mpi(1, 2)
def test_a_failure_of_all_ranks_is_noted(comm, variants):
    variants[0].attempt(comm, refusal)
    variants[1].attempt(comm, lambda: None)
    assert (variants[0].failure, variants[1].failure) == ("no such thing", None)


@pytest.mark.mpi(2)
def test_a_failure_of_one_rank_is_handed_on(comm, variants, monkeypatch):
    monkeypatch.setattr(rendezvous, "PATIENCE", 0.1)
    if comm.rank == 0:
        with pytest.raises(SceneError, match="no such thing"):
            variants[0].attempt(comm, refusal)
    comm.Barrier()
    if comm.rank == 1:
        comm.Ibarrier().Wait()  # the other half of the first rank's
    assert variants[0].failure is None


@pytest.mark.mpi(1)
def test_an_error_in_the_program_is_no_failure_of_a_variant(comm, variants):
    with pytest.raises(ZeroDivisionError):
        variants[0].attempt(comm, lambda: 1 / 0)


@pytest.mark.mpi(2)
@pytest.mark.parametrize("step, frames", [(0.02, 2), (0.05, 3), (0.1, 6)])
def test_a_block_has_enough_steps_beyond_the_warm_up(comm, tmp_path, step, frames):
    scene = load_scene("tiny", [f"simulation.step={step}", "simulation.method=none"])
    variant = VariantRun(scene, tmp_path / "variant", tmp_path)
    write(comm, variant.directory, "simulate", scene)
    blocks = []

    def run_stages(stages, block, directory):
        blocks.append(block.simulation.turnovers * 2.0 / block.simulation.frame_interval)
        write(comm, directory, "simulate", block)

    variant.time_block(comm, run_stages)
    comm.Barrier()
    assert blocks == [pytest.approx(frames - 0.5)]  # ends with the next whole frame
    assert variant.blocks == [StepSeconds(0.3, 0.2, 0.5)] and not (variant.directory / "timing").exists()


def test_costs_of_a_turnover_are_medians_with_the_widest_quartiles():
    samples = [StepSeconds(0.2, 0.1, 0.3), StepSeconds(0.4, 0.3, 0.9), StepSeconds(0.3, 0.25, 0.35)]
    costs = step_costs(samples, step=0.02, turnover=1.0, ranks=2)
    assert costs["seconds_per_step"] == 0.3 and costs["wall_seconds"] == pytest.approx(15)
    assert (costs["wall_seconds_low"], costs["wall_seconds_high"]) == (pytest.approx(5), pytest.approx(45))
    assert costs["core_seconds"] == pytest.approx(30)


def test_a_rollout_of_too_few_steps_has_no_seconds():
    assert StepSeconds.of_rollout({"status": "complete", "time_step": 0.1}) == []
