"""Flows that start from velocities in files of other codes."""

import h5py
import numpy as np
import pytest

from eddies.errors import UserError
from eddies.scene.scene import load_scene
from eddies.workflows.ground_truth.scene_flow import build_fluid, initial_state
from tests.small_scene import problems_of

STORED, CELLS = 12, 16


def flow(x, y, z):
    """A solenoidal velocity (3, z, y, x) whose components and directions all differ."""
    u = np.cos(z) + 0.5 * np.sin(2 * y)
    v = np.sin(3 * x) + 0.3 * np.cos(z) + 0.1
    w = 0.7 * np.sin(x) - 0.2 * np.cos(2 * y)
    return np.stack(np.broadcast_arrays(u, v, w))


def stored_velocity(cells=STORED, factor=1.0):
    """The flow on the points of a file, plus a part with divergence."""
    z, y, x = np.meshgrid(*[2 * np.pi * np.arange(cells) / cells] * 3, indexing="ij")
    velocity = factor * flow(x, y, z)
    velocity[0] += 0.4 * np.sin(x)
    return velocity


def write_cutout(path, velocities, stride=4, points=None, coordinates=("xcoor", "ycoor", "zcoor")):
    """As pyJHTDB writes a cutout of isotropic1024coarse."""
    with h5py.File(path, "w") as file:
        cells = velocities[0].shape[-1]
        last = 1 + stride * (cells - 1)
        file.attrs.update({"dataset": np.bytes_("isotropic1024coarse"), "t_start": 9, "t_end": 10, "t_step": 1,
                           "filterWidth": 1, **{f"{axis}_start": 1 for axis in "xyz"},
                           **{f"{axis}_end": last for axis in "xyz"}, **{f"{axis}_step": stride for axis in "xyz"}})
        for name in coordinates:
            file[name] = np.float32(2 * np.pi * np.arange(cells) / cells) if points is None else points
        for velocity, number in zip(velocities, (9, 2000, 10000)):  # HDF5 lists them by name
            file[f"Velocity_{number:04d}"] = np.moveaxis(velocity, 0, -1).astype(np.float32)
            file[f"Pressure_{number:04d}"] = np.zeros((*velocity.shape[1:], 1), np.float32)


def write_fluidsim(path, velocity, edges=(4.0, 4.0, 4.0)):
    """As fluidsim writes state_phys_t0001.000.h5 of its solver ns3d."""
    with h5py.File(path, "w") as file:
        file.attrs.update({"date saving": b"2024-10-17", "name_solver": "ns3d", "name_run": "ns3d_test",
                           "axes": np.array([b"z", b"y", b"x"], "|S9")})
        state = file.create_group("state_phys")
        state.attrs.update({"what": "obj state_phys for fluidsim", "name_type_variables": "state_phys",
                            "time": 1.0, "it": 10})
        for axis, component in zip("xyz", velocity):
            state[f"v{axis}"] = component
        oper = file.create_group("info_simul/params/oper")
        oper.attrs.update({"type_fft": "default", **{f"n{axis}": velocity.shape[-1] for axis in "xyz"}})
        oper.attrs.update({f"L{axis}": edge for axis, edge in zip("xyz", edges)})


def start(comm, path, *overrides):
    """Fluid and state at time 0 of a scene that starts from a file."""
    comm.Barrier()
    scene = load_scene("taylor-green", [f"flow.cells={CELLS}", "initial.kind=file", f"initial.path={path}", *overrides])
    fluid = build_fluid(scene.flow, scene.forcing, comm)
    return fluid, initial_state(scene.initial, scene.seed, fluid)


@pytest.fixture
def path(comm, tmp_path):
    """A path that is the same on all ranks."""
    return comm.bcast(str(tmp_path / "start.h5"))


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("layout, tolerance", [("cutout", 1e-6), ("fluidsim", 1e-14)])
def test_the_flow_of_the_file_is_the_flow_of_the_scene(comm, path, layout, tolerance):
    """On another grid, for any edge of the box, and without the part that has a divergence. Cutouts are in single
    precision."""
    if comm.rank == 0:
        write = {"cutout": lambda: write_cutout(path, [stored_velocity()]),
                 "fluidsim": lambda: write_fluidsim(path, stored_velocity())}
        write[layout]()
    fluid, velocity = start(comm, path)
    expected = flow(*fluid.grid.coordinates())
    assert np.abs(fluid.grid.backward(velocity) - expected).max(initial=0) < tolerance
    sound = ("flow.fluid=compressible", "flow.sound_speed=10")
    fluid, state = start(comm, path, *sound)
    assert np.abs(fluid.grid.backward(state[:3]) - expected).max(initial=0) < tolerance
    balanced = fluid.grid.pressure_of(fluid.grid.squares(velocity)) / 100
    assert np.abs(state[3] - balanced).max(initial=0) < 1e-14 < np.abs(balanced).max(initial=1)


@pytest.mark.mpi(2)
def test_state_picks_a_time_of_a_cutout(comm, path):
    if comm.rank == 0:
        write_cutout(path, [stored_velocity(factor=number) for number in (1, 2, 3)])
    for state in range(3):
        fluid, velocity = start(comm, path, f"initial.state={state}")
        expected = (state + 1) * flow(*fluid.grid.coordinates())
        assert np.abs(fluid.grid.backward(velocity) - expected).max(initial=0) < 1e-5
    with pytest.raises(UserError, match="holds 3 states"):
        start(comm, path, "initial.state=3")


BROKEN = stored_velocity()
BROKEN[1, 7, 2, 3] = np.inf
PART = np.float32(2 * np.pi * np.arange(STORED) / 1024)
UNEVEN = np.float32(2 * np.pi * np.arange(STORED) / STORED) + np.float32(0.1) * (np.arange(STORED) == 5)


REFUSED = {
    "a part": (lambda path: write_cutout(path, [stored_velocity()], points=PART), "xcoor goes from 0 to 0.0674952"),
    "uneven": (lambda path: write_cutout(path, [stored_velocity()], points=UNEVEN), "not the whole periodic cube"),
    "nowhere": (lambda path: write_cutout(path, [stored_velocity()], coordinates=("xcoor", "ycoor")), "no zcoor"),
    "flat": (lambda path: write_cutout(path, [stored_velocity()[:, :8]]), r"Velocity_0009: .* shape \(8, 12, 12, 3\)"),
    "scalar": (lambda path: write_cutout(path, [stored_velocity()[:1]]), r"Velocity_0009: .* shape \(12, 12, 12, 1\)"),
    "no cube": (lambda path: write_fluidsim(path, stored_velocity(), (4.0, 4.0, 8.0)), "edges 4, 4, 8"),
    "no edges": (lambda path: write_fluidsim(path, stored_velocity(), ("four",) * 3), "no numbers Lx"),
    "unknown": (lambda path: write_fluidsim(path, stored_velocity()[:2]), "state_phys"),
}


@pytest.mark.mpi(2)
def test_an_unfit_file_is_refused_by_check_and_run(comm, path):
    """Values that are not finite are found when they are read, by one rank."""
    for case, (write, message) in REFUSED.items():
        if comm.rank == 0:
            write(path)
        with pytest.raises(UserError, match=message) as error:
            start(comm, path)
        scene = load_scene("taylor-green", ["flow.cells=16", "initial.kind=file", f"initial.path={path}"])
        (line,), _ = problems_of(scene, comm)
        assert line == str(error.value) and line.startswith(f"{path}: "), case
        comm.Barrier()
    for write, place in ((lambda: write_cutout(path, [BROKEN]), "Velocity_0009"),
                         (lambda: write_fluidsim(path, BROKEN), "state_phys/vy")):
        if comm.rank == 0:
            write()
        with pytest.raises(UserError, match=f"{place}: .*not finite"):
            start(comm, path)
        comm.Barrier()
