"""Several sets of tracers in one direct simulation: each has the ground truth that it has alone."""

import shutil

import numpy as np
import pytest

from eddies.flow.tracers import random_positions
from eddies.io.errors import WriteError
from eddies.io.provenance import product_provenance
from eddies.io.run_lock import RunInUse, lock_directory
from eddies.parallel.stop import Stopped
from eddies.scene.scene import SceneError, Tracers, load_scene
from eddies.workflows import dns
from eddies.workflows.run_directory.fingerprints import stage_fingerprint
from eddies.workflows.run_directory.work import find_work
from eddies.workflows.status import status_lines
from eddies.workflows.variant_rows import rows_of
from eddies.workflows.variants import steps
from tests.small_scene import TINY, problems_of
from tests.workflows.contents import assert_same
from tests.workflows.stopping import StopAtStep
from tests.workflows.test_dns import SPLIT, product

SETS = ["tracers.few.particles_per_side=4", "tracers.few.filter_width=1.2", "tracers.whole.filtered=false",
        "tracers.whole.seed=3"]


@pytest.mark.mpi(2)
def test_a_set_has_the_ground_truth_that_it_has_alone(comm, tmp_path):
    """To the last bit, also after a stop with and one without tracers."""
    scene, together = load_scene(TINY, [*SPLIT, *SETS]), tmp_path / "together"
    for path in (together, tmp_path / "few", tmp_path / "whole"):
        path.mkdir(exist_ok=True)
    for step in (3, 11):
        with pytest.raises(Stopped):
            dns.run(scene, comm, together, StopAtStep(comm, step))
    dns.run(scene, comm, together)
    assert sorted(path.name for path in together.iterdir()) == ["few", "ground_truth.h5", "whole"]
    truths = {}
    for name, own in scene.tracer_sets.items():
        alone = own if name == "whole" else load_scene(TINY, [*SPLIT, *SETS, f"tracers.set={name}"])
        assert stage_fingerprint(own, "dns") == stage_fingerprint(alone, "dns") and own.tracers == alone.tracers
        dns.run(alone, comm, tmp_path / name)
        truths[name], found = product(comm, tmp_path / name), product(comm, together / name)
        states = [key for key in found if key.startswith("fields/unfiltered/")]  # where rollouts of the scene may start
        assert len(found["fields/unfiltered/velocity"]) > 0
        for key in states if name == "whole" else ():
            found[key] = truths[name][key]
        assert_same(found, truths[name], name)
    # Particles of the whole flow are faster, and start elsewhere.
    few, whole = (np.square(truths[name]["particles/tracers/velocity/value"][0]).sum(axis=1).mean()
                  for name in ("few", "whole"))
    places = random_positions(scene.seed + 3, 5**3, 0, 5**3, 2 * np.pi)
    assert whole > 1.05 * few and np.array_equal(truths["whole"]["particles/tracers/position/value"][0], places)


def with_variants(folder, **sets):
    """A scene with variants, each with its set of tracers."""
    lines = [f'base = "{TINY}"', *(f'[variant.{name}]\ntracers.set = "{own}"' for name, own in sets.items())]
    (folder / "several.toml").write_text("\n".join(lines))
    return folder / "several.toml"


def test_variants_use_the_sets(tmp_path):
    scene = load_scene(with_variants(tmp_path, a="few", b="other", c="few"), [
        *SPLIT, *SETS, "tracers.other.seed=2", "realisations=[7]", "simulation.step=converged"])
    planned = steps(scene, scene.stages_of_all, tmp_path)
    truths = [(step.directory.relative_to(tmp_path).as_posix(), step.files) for step in planned if "dns" in step.stages]
    parts = "", "few", "whole", "other"
    assert truths == [(name, tuple(tmp_path / name / part / "ground_truth.h5" for part in parts))
                      for name in (".", "realisation-7")]
    used = {step.directory.relative_to(tmp_path).as_posix(): {link.relative_to(tmp_path).as_posix() for stage, link
            in step.links.items() if stage in ("dns", "train-kernel")} for step in planned if "dns" in step.links}
    assert used == {"a": {"few"}, "b": {"other"}, "c": {"few"}, "a/realisation-7": {"realisation-7/few"},
                    "b/realisation-7": {"realisation-7/other"}, "c/realisation-7": {"realisation-7/few"}}
    # A kernel belongs to its set, so that the failure of a variant does not concern another.
    assert [step.directory.relative_to(tmp_path).as_posix() for step in planned if "train-kernel" in step.stages] == [
        "few", "other", "realisation-7/few", "realisation-7/other"]
    (confirmed,) = {step.scene.simulation.confirmed_on for step in planned if step.directory == tmp_path / "a"}
    assert confirmed == (str(tmp_path / "realisation-7" / "few"),)
    seen = f'training.truths=["{tmp_path / "realisation-7/few"}"]'
    given = load_scene(with_variants(tmp_path, a="few"), [*SPLIT, *SETS, "realisations=[7]", seen])
    with pytest.raises(SceneError, match="realisation-7/few/ground_truth.h5, which is a realisation"):
        given.check_unseen(tmp_path)


def test_realisations_of_sets_alone_are_ground_truths(tmp_path):
    scene = load_scene(TINY, [*SPLIT, *SETS, "realisations=[7]"])
    assert [(step.directory.name, step.stages) for step in steps(scene, scene.stages_of_all, tmp_path)] == [
        (tmp_path.name, ("dns",)), ("realisation-7", ("dns",))]


def test_variants_of_one_set_are_measured_alike(tmp_path):
    keys = [*SPLIT, *SETS, "tracers.other.particles_per_side=4"]
    alike, apart = (load_scene(with_variants(tmp_path, a="few", b=other), keys) for other in ("few", "other"))
    assert rows_of(alike, {}, {}, None)[1] == [] and rows_of(apart, {}, {}, None)[1] == ["b"]


def start(scene, directory):
    return find_work(["dns"], scene, directory).actions["dns"].start


@pytest.mark.mpi(1)
def test_a_lost_ground_truth_of_a_set_is_made_again(comm, tmp_path):
    scene = load_scene(TINY, [*SPLIT, *SETS])
    dns.run(scene, comm, tmp_path)
    assert start(scene, tmp_path) == "skip"
    assert start(scene.tracer_sets["few"], tmp_path / "few") == "skip"
    (tmp_path / "few" / "ground_truth.h5").unlink()
    (tmp_path / "whole" / "scene.toml").write_text("# of another scene")
    (tmp_path / "scene.toml").write_text(scene.to_toml())
    (line,) = [line for line in status_lines(tmp_path) if line.startswith("  dns")]
    assert line.endswith("lacks the ground truth of few")
    kept = product_provenance(tmp_path / "whole" / "ground_truth.h5")
    assert start(scene, tmp_path) == "begin" and not find_work(["dns"], scene, tmp_path).lost
    dns.run(scene, comm, tmp_path)
    assert product_provenance(tmp_path / "whole" / "ground_truth.h5") == kept  # what was made from it stays valid
    assert (tmp_path / "whole" / "scene.toml").read_text() == "# of another scene"
    assert start(scene, tmp_path) == "skip" and not list(tmp_path.glob("*/LOCK"))


@pytest.mark.mpi(1)
def test_work_in_the_directory_of_a_set_is_not_replaced(comm, tmp_path):
    scene = load_scene(TINY, [*SPLIT, *SETS])
    (tmp_path / "few").mkdir()
    dns.run(load_scene(TINY, [*SPLIT, *SETS, "tracers.set=few", "seed=5"]), comm, tmp_path / "few")
    (lost,) = find_work(["dns"], scene, tmp_path).lost
    assert lost.startswith("few/ground_truth.h5 (made ")
    with lock_directory(comm, tmp_path / "few"), pytest.raises(RunInUse, match="few: another job works here"):
        dns.run(scene, comm, tmp_path)
    shutil.rmtree(tmp_path / "few")
    (tmp_path / "few").touch()
    with pytest.raises(WriteError, match="few"):  # before the simulation
        dns.run(scene, comm, tmp_path)
    assert not (tmp_path / "checkpoints").exists()


@pytest.mark.mpi(1)
def test_a_stopped_simulation_with_sets_goes_on_for_longer(comm, tmp_path, caplog):
    caplog.set_level("INFO", "eddies")
    with pytest.raises(Stopped):
        dns.run(load_scene(TINY, [*SPLIT, *SETS]), comm, tmp_path, StopAtStep(comm, 11))
    longer = load_scene(TINY, [*SPLIT, *reversed(SETS), "tracers.turnovers=0.2"])  # also with the sets in another order
    assert start(longer, tmp_path) == "continue"
    dns.run(longer, comm, tmp_path)
    assert "continues from step 11" in caplog.text
    assert start(load_scene(TINY, [*SPLIT, *SETS]), tmp_path) == "begin"


@pytest.mark.mpi(1)
def test_sets_are_read_and_written(comm):
    scene = load_scene(TINY, [*SPLIT, *SETS, "tracers.same={}"])
    few, whole, same = scene.tracers.sets.values()
    assert (few.particles_per_side, few.filter_width, whole.filtered, whole.seed) == (4, 1.2, False, 3)
    assert few.frame_interval == scene.tracers.frame_interval and same.filter_width == scene.tracers.filter_width
    assert scene.stages == ("dns", "report")
    assert "choose one of them" in " ".join(problems_of(scene, comm)[1])
    chosen = load_scene(TINY, [*SPLIT, *SETS, "tracers.set=few"])
    assert stage_fingerprint(scene, "dns") == stage_fingerprint(
        load_scene(TINY, [*SPLIT, "tracers.same={}", *reversed(SETS)]), "dns")
    assert not chosen.tracers.sets and chosen.tracers.set is None and "train-kernel" in chosen.stages
    longer = load_scene(TINY, [*SPLIT, *SETS, "tracers.turnovers=0.2"])
    assert {each.turnovers for each in longer.tracers.all} == {0.2}
    assert stage_fingerprint(longer.tracer_sets["few"], "dns") != stage_fingerprint(chosen, "dns")


def test_written_sets_are_read_back(tmp_path):
    scene = load_scene(TINY, [*SPLIT, *SETS, "tracers.same={}", "tracers.few.field_cells=none"])
    assert scene.tracers.field_cells == 8 and scene.tracers.sets["few"].field_cells is None
    path = tmp_path / "scene.toml"
    path.write_text(scene.to_toml())
    assert load_scene(path) == scene
    assert load_scene(path, ["tracers.turnovers=0.2"]).tracers.sets["few"].turnovers == 0.2


@pytest.mark.parametrize("keys, complaint", [
    (["tracers.few.turnovers=3"], r"\[tracers.few\] turnovers: not a key of a set; .* all keys .* except partic"),
    (["tracers.few.filter_width=-1"], r"\[tracers.few\] filter_width = -1: must be a number above 0"),
    (["tracers.set=fewer"], r'\[tracers\] set = "fewer": there is no section \[tracers.fewer\]; there are: few, whole'),
    (["tracers.few.field_cells=90"], r"\[tracers\]: set few: field_cells must be at most \[flow\] cells = 12"),
    (["tracers.set=whole"], r"\[tracers\] filtered = false: these particles follow the unfil.* remove \[kernel\]"),
    (["tracers.report.seed=1"], r"\[tracers\]: set report: a run directory uses this name")])
def test_wrong_sets_are_refused(keys, complaint):
    with pytest.raises(SceneError, match=complaint):
        load_scene(TINY, [*SPLIT, *SETS, *keys])


def test_a_program_gives_sets_as_tables_or_objects():
    few = Tracers(particles_per_side=4, turnovers=1.0, frame_interval=0.1)
    for own in ({"particles_per_side": 4}, few):
        given = Tracers(particles_per_side=5, turnovers=2.0, frame_interval=0.1, sets={"few": own})
        assert (given.sets["few"].particles_per_side, given.sets["few"].turnovers) == (4, 2.0)
    with pytest.raises(SceneError, match="tracers.few: must be a section"):
        Tracers(particles_per_side=5, turnovers=2.0, frame_interval=0.1, sets={"few": 3})


def test_wrong_variants_and_other_stages_are_refused(tmp_path):
    with pytest.raises(SceneError, match=r"\[tracers\]: set few: a variant has this name; choose another"):
        load_scene(with_variants(tmp_path, few="few"), [*SPLIT, *SETS])
    path = with_variants(tmp_path, a="few")
    path.write_text(path.read_text().replace('tracers.set = "few"', "seed = 4"))
    with pytest.raises(SceneError, match=r'"a": works on one set of tracers; .* key variant.a.tracers.set, or'):
        load_scene(path, [*SPLIT, *SETS])

    with pytest.raises(SceneError, match="`eddies train` works on one set of tracers; .*: few, whole"):
        load_scene(TINY, [*SPLIT, *SETS]).check_stages(["train"])
