"""What a stage would refuse later is told before, in the words of the stage."""

import numpy as np
import pytest

from eddies.errors import UserError
from eddies.flow.forcing import ForcingError
from eddies.parallel.slab import SlabDecomposition
from eddies.scene.scene import load_scene
from eddies.workflows.foreseen.problems import refusals
from tests.small_scene import TINY

FORCED = ["forcing.injection_rate=0.5"]


def told(comm, name, *overrides):
    return refusals(load_scene(name, list(overrides)), comm)


@pytest.mark.mpi(1, 2)
def test_a_start_that_forcing_cannot_amplify_is_told_where_it_is_refused(comm):
    from eddies.workflows.ground_truth.scene_flow import build_fluid, initial_state
    for name, changes in (("taylor-green", ["forcing.wavenumber=1.5"]), ("taylor-green", ["forcing.wavenumber=2"]),
                          ("abc", ["initial.wavenumber=2"]), ("abc", []), ("shear-wave", ["initial.wavenumber=3"])):
        scene = load_scene(name, [*FORCED, "flow.cells=16", *changes])
        fluid = build_fluid(scene, comm)
        try:
            fluid.nonlinear(initial_state(scene, fluid))
            refused = False
        except ForcingError:
            refused = True
        lines = refusals(scene, comm)
        assert bool(lines) == refused and all("which linear forcing could amplify" in line for line in lines)


@pytest.mark.mpi(1, 2)
def test_files_that_do_not_fit_are_told_in_the_words_of_the_stage(comm, tmp_path):
    from eddies.io.fields import FieldWriter
    from eddies.io.hdf5 import create_product
    from eddies.workflows.ground_truth.scene_flow import build_fluid, initial_state
    path = comm.bcast(str(tmp_path / "start.h5"))
    changes = ["initial.kind=file", f"initial.path={path}", "flow.cells=16"]
    line, = told(comm, "taylor-green", *changes, "initial.amplitude=1")
    assert path in line
    with create_product(comm, path, "ground_truth", {"scene": "", "fingerprint": ""}) as file:
        slab = SlabDecomposition(comm, 1.0, 12)
        at_rest = {"velocity": np.zeros((3, slab.count, 12, 12))}
        FieldWriter(file, "unfiltered", 12, {"velocity": 3}).append(0.0, slab.start, at_rest)
    assert told(comm, "taylor-green", *changes) == []
    scene = load_scene("taylor-green", [*changes, "initial.state=1"])
    line, = refusals(scene, comm)
    with pytest.raises(UserError) as error:
        initial_state(scene, build_fluid(scene, comm))
    assert line == str(error.value) and "holds 1 states of the whole flow" in line


def taken(comm, path):
    """Of a scene that takes weights over."""
    return refusals(load_scene("hit-mt008", [f"model.path={path}"], ["variant"]), comm)


@pytest.mark.mpi(1, 2)
def test_weights_that_are_no_model_are_told(comm, tmp_path):
    path = comm.bcast(str(tmp_path))
    assert taken(comm, path) == []  # yet to be trained: a warning
    if comm.rank == 0:
        (tmp_path / "model.h5").write_text("nothing")
    comm.Barrier()
    line, = taken(comm, path)
    assert f"{path}/model.h5" in line


@pytest.mark.mpi(1, 2)
def test_a_machine_that_is_too_small_is_told(comm):
    large = [line for line in told(comm, "taylor-green", "flow.cells=8192") if "of memory here" in line]
    assert len(large) == 1 and large[0].startswith(f"dns: {comm.size} ranks with about")
    full, = told(comm, TINY, "tracers.frame_interval=1e-9", "simulation.frame_interval=0.1")
    assert full.startswith("the stages need about") and "GB of disk" in full
    assert told(comm, TINY) == []
