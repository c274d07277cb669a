"""Several sets of tracers in one direct simulation: each has the ground truth that it has alone."""

import numpy as np
import pytest

from eddies.parallel.stop import Stopped
from eddies.scene.scene import SceneError, load_scene
from eddies.workflows import dns
from eddies.workflows.run_directory.fingerprints import stage_fingerprint
from eddies.workflows.run_directory.work import find_work
from eddies.workflows.variants import steps
from tests.small_scene import TINY, problems_of
from tests.workflows.stopping import StopAtStep
from tests.workflows.test_dns_restart import SPLIT, product

SETS = ["tracers.few.particles_per_side=4", "tracers.few.filter_width=1.2", "tracers.whole.filtered=false",
        "tracers.whole.seed=3"]


@pytest.mark.mpi(1, 2, 3)
def test_a_set_has_the_ground_truth_that_it_has_alone(comm, tmp_path):
    """To the last bit, also after a stop with and one without tracers."""
    scene, together = load_scene(TINY, [*SPLIT, *SETS]), tmp_path / "together"
    for path in (together, tmp_path / "few", tmp_path / "whole") if comm.rank == 0 else ():
        path.mkdir()
    comm.Barrier()
    for step in (3, 11):
        with pytest.raises(Stopped):
            dns.run(scene, comm, together, StopAtStep(comm, step))
    dns.run(scene, comm, together)
    assert sorted(path.name for path in together.iterdir()) == ["few", "ground_truth.h5", "whole"]
    truths = {}
    for name, own in scene.tracer_sets.items():
        assert own == load_scene(TINY, [*SPLIT, *SETS, f"tracers.set={name}"])
        dns.run(own, comm, tmp_path / name)
        truths[name] = product(comm, tmp_path / name)
        found = product(comm, together / name)
        assert found.keys() == truths[name].keys()
        for key, values in found.items():
            assert np.array_equal(values, truths[name][key]), (name, key)
    # Particles of the whole flow are faster, and start elsewhere.
    few, whole = (np.square(truths[name]["velocity"][0]).sum(axis=1).mean() for name in ("few", "whole"))
    assert whole > 1.05 * few and truths["whole"]["position"].shape[1] == 5**3
    assert np.array_equal(truths["few"]["whole"], truths["whole"]["whole"])  # the same flow


def with_variants(folder, **sets):
    """A scene with variants, each with its set of tracers."""
    lines = [f'base = "{TINY}"', *(f'[variant.{name}]\ntracers.set = "{own}"' for name, own in sets.items())]
    (folder / "several.toml").write_text("\n".join(lines))
    return folder / "several.toml"


@pytest.mark.mpi(1)
def test_variants_use_the_sets(tmp_path):
    scene = load_scene(with_variants(tmp_path, a="few", b="whole"), [
        *SPLIT, *SETS, "realisations=[7]", "simulation.step=converged"])
    planned = steps(scene, scene.stages_of_all, tmp_path)
    truths = [(step.directory.relative_to(tmp_path).as_posix(), step.files) for step in planned if "dns" in step.stages]
    assert truths == [(name, [tmp_path / name / part / "ground_truth.h5" for part in ("", "few", "whole")])
                      for name in (".", "realisation-7")]
    used = {step.directory.relative_to(tmp_path).as_posix(): step.links["dns"].relative_to(tmp_path).as_posix()
            for step in planned if "dns" in step.links}
    assert used == {"a": "few", "b": "whole", "a/realisation-7": "realisation-7/few",
                    "b/realisation-7": "realisation-7/whole"}
    (confirmed,) = {step.scene.simulation.confirmed_on for step in planned if step.directory == tmp_path / "a"}
    assert confirmed == (str(tmp_path / "realisation-7" / "few"),)


@pytest.mark.mpi(1)
def test_a_lost_ground_truth_of_a_set_is_made_again(comm, tmp_path):
    scene = load_scene(TINY, [*SPLIT, *SETS])
    dns.run(scene, comm, tmp_path)
    assert find_work(["dns"], scene, tmp_path).done == {"dns"}
    assert find_work(["dns"], scene.tracer_sets["few"], tmp_path / "few").done == {"dns"}
    (tmp_path / "few" / "ground_truth.h5").unlink()
    assert not find_work(["dns"], scene, tmp_path).done


@pytest.mark.mpi(1)
def test_sets_are_read_and_written(comm):
    scene = load_scene(TINY, [*SPLIT, *SETS, "tracers.same={}"])
    few, whole, same = scene.tracers.sets.values()
    assert (few.particles_per_side, few.filter_width, whole.filtered, whole.seed) == (4, 1.2, False, 3)
    assert few.frame_interval == scene.tracers.frame_interval and same.filter_width == scene.tracers.filter_width
    assert scene.stages == ("dns", "report")
    assert "choose one of them" in " ".join(problems_of(scene, comm)[1])
    chosen = load_scene(TINY, [*SPLIT, *SETS, "tracers.set=few"])
    assert not chosen.tracers.sets and chosen.tracers.set is None and "train-kernel" in chosen.stages
    longer = load_scene(TINY, [*SPLIT, *SETS, "tracers.turnovers=0.2"])
    assert {each.turnovers for each in longer.tracers.all} == {0.2}
    assert stage_fingerprint(longer.tracer_sets["few"], "dns") != stage_fingerprint(chosen, "dns")


@pytest.mark.mpi(1)
def test_written_sets_are_read_back(comm, tmp_path):
    scene = load_scene(TINY, [*SPLIT, *SETS, "tracers.same={}"])
    path = tmp_path / "scene.toml"
    path.write_text(scene.to_toml())
    assert load_scene(path) == scene
    assert load_scene(path, ["tracers.turnovers=0.2"]).tracers.sets["few"].turnovers == 0.2


@pytest.mark.mpi(1)
@pytest.mark.parametrize("keys, complaint", [
    (["tracers.few.turnovers=3"], r"\[tracers.few\] turnovers: no key of a set; the sets share all keys .* but partic"),
    (["tracers.few.filter_width=-1"], r"\[tracers.few\] filter_width = -1: must be a number above 0"),
    (["tracers.set=fewer"], r'\[tracers\] set = "fewer": there is no section \[tracers.fewer\]; there are: few, whole'),
    (["tracers.few.field_cells=90"], r"\[tracers\] field_cells.*must be at most \[flow\] cells = 12"),
    (["tracers.report.seed=1"], r"\[tracers\]: set report: a run directory uses this name")])
def test_wrong_sets_are_refused(keys, complaint):
    with pytest.raises(SceneError, match=complaint):
        load_scene(TINY, [*SPLIT, *SETS, *keys])


@pytest.mark.mpi(1)
def test_wrong_variants_are_refused(tmp_path):
    with pytest.raises(SceneError, match=r"\[tracers\]: set few: a variant has this name; choose another"):
        load_scene(with_variants(tmp_path, few="few"), [*SPLIT, *SETS])
    path = with_variants(tmp_path, a="few")
    path.write_text(path.read_text().replace('tracers.set = "few"', "seed = 4"))
    with pytest.raises(SceneError, match=r'"a": needs one set of tracers; set variant.a.tracers.set, or \[tracers\]'):
        load_scene(path, [*SPLIT, *SETS])


@pytest.mark.mpi(1)
def test_other_stages_need_one_set():
    with pytest.raises(SceneError, match="`eddies train` needs one set of tracers; set .* to one of few, whole"):
        load_scene(TINY, [*SPLIT, *SETS]).check_stages(["train"])
