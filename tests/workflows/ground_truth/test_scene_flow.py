"""Flows that start from velocities in files of other codes."""

import os
from pathlib import Path

import h5py
import numpy as np
import pytest

from eddies.errors import UserError
from eddies.flow.statistics import energy_spectrum
from eddies.scene.scene import SceneError, load_scene
from eddies.workflows.ground_truth.scene_flow import build_fluid, initial_state
from eddies.workflows.run_directory.fingerprints import stage_fingerprint
from tests.commands import first_rank
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


def write_cutout(path, velocities, stride=4, points=None, coordinates=("xcoor", "ycoor", "zcoor"), first="V"):
    """As pyJHTDB writes a cutout of isotropic1024coarse; newer clients write names with a small first letter."""
    with h5py.File(path, "w") as file:
        cells = velocities[0].shape[-1]
        last = 1 + stride * (cells - 1)
        file.attrs.update({"dataset": np.bytes_("isotropic1024coarse"), "t_start": 9, "t_end": 10, "t_step": 1,
                           "filterWidth": 1, **{f"{axis}_start": 1 for axis in "xyz"},
                           **{f"{axis}_end": last for axis in "xyz"}, **{f"{axis}_step": stride for axis in "xyz"}})
        for name in coordinates:
            file[name] = np.float32(2 * np.pi * np.arange(cells) / cells) if points is None else points
        for velocity, number in zip(velocities, (9, 2000, 10000)):  # HDF5 lists them by name
            file[f"{first}elocity_{number:04d}"] = np.moveaxis(velocity, 0, -1).astype(np.float32)
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


@pytest.mark.mpi(2)
@pytest.mark.parametrize("layout, tolerance", [("cutout", 1e-6), ("new cutout", 1e-6), ("fluidsim", 1e-14),
                                               ("new fluidsim", 1e-14)])
def test_the_flow_of_the_file_is_the_flow_of_the_scene(comm, path, caplog, layout, tolerance):
    """On another grid, for any edge of the box, and without the part that has a divergence, whose share is logged.
    Cutouts are in single precision. Newer versions of fluidsim write the edges as arrays of one element."""
    if comm.rank == 0:
        write = {"cutout": lambda: write_cutout(path, [stored_velocity()]),
                 "new cutout": lambda: write_cutout(path, [stored_velocity()], first="v"),
                 "fluidsim": lambda: write_fluidsim(path, stored_velocity()),
                 "new fluidsim": lambda: write_fluidsim(path, stored_velocity(), np.full((3, 1), 4.0))}
        write[layout]()
    caplog.set_level("INFO", "eddies")
    fluid, velocity = start(comm, path)
    # <u.u> of the flow is 0.5 + 0.125 + 0.5 + 0.045 + 0.01 + 0.245 + 0.02, that of the part 0.4^2 / 2.
    share = 100 * 0.08 / (1.445 + 0.08)
    assert f"{share:.3g} % of its energy" in caplog.text
    assert comm.rank > 0 or "5 % of the energy is in a part with divergence: the flow may be" in caplog.text
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


def changed(path, make):
    """A cutout with something else in the place of its velocity."""
    write_cutout(path, [stored_velocity()])
    with h5py.File(path, "a") as file:
        del file["Velocity_0009"]
        made = make(file)
        if made is not None:
            file["Velocity_0009"] = made


def virtual(file):
    layout = h5py.VirtualLayout((STORED,) * 3 + (3,), "f4")
    layout[...] = h5py.VirtualSource("none.h5", "v", layout.shape)
    file.create_virtual_dataset("Velocity_0009", layout)


WITH_END = np.pad(stored_velocity(), ((0, 0), *[(0, 1)] * 3), "wrap")
UNDELIVERED = stored_velocity()
UNDELIVERED[:, 3, 4:6, 5] = UNDELIVERED[:, 9, 4, 5] = -999.9
VALUES = {
    "not finite": (lambda path: write_cutout(path, [BROKEN]), "Velocity_0009: .*not finite"),
    "one component": (lambda path: write_fluidsim(path, BROKEN), "state_phys/vy: .*not finite"),
    "undelivered": (lambda path: write_cutout(path, [UNDELIVERED]), "9 values are -999.9, the mark of points"),
    "zero": (lambda path: write_fluidsim(path, 0 * BROKEN.clip(-1, 1)), "velocity is 0, 0, 0 everywhere"),
    "uniform": (lambda path: write_fluidsim(path, 0 * BROKEN.clip(-1, 1) + 2), "velocity is 2, 2, 2 everywhere"),
    "huge": (lambda path: write_fluidsim(path, 1e30 * stored_velocity()), "largest velocity is 1.*e.30"),
}
REFUSED = {
    "a part": (lambda path: write_cutout(path, [stored_velocity()], points=PART), "xcoor goes from 0 to 0.0674952"),
    "uneven": (lambda path: write_cutout(path, [stored_velocity()], points=UNEVEN), "not equally spaced"),
    "nowhere": (lambda path: write_cutout(path, [stored_velocity()], coordinates=("xcoor", "ycoor")), "no zcoor"),
    "flat": (lambda path: write_cutout(path, [stored_velocity()[:, :8]]), r"Velocity_0009: .* shape \(8, 12, 12, 3\)"),
    "scalar": (lambda path: write_cutout(path, [stored_velocity()[:1]]), r"Velocity_0009: .* shape \(12, 12, 12, 1\)"),
    "no cube": (lambda path: write_fluidsim(path, stored_velocity(), (4.0, 4.0, 8.0)), "edges 4, 4, 8"),
    "no edges": (lambda path: write_fluidsim(path, stored_velocity(), ("four",) * 3), "no numbers Lx"),
    "links": (lambda path: changed(path, lambda file: h5py.SoftLink("/none")), "Velocity_0009 is a link to something"),
    "other file": (lambda path: changed(path, lambda file: h5py.ExternalLink("none.h5", "/v")), "none.h5"),
    "group": (lambda path: changed(path, lambda file: file.create_group("other")), "Velocity_0009 is a group"),
    "integers": (lambda path: changed(path, lambda file: np.ones((STORED,) * 3 + (3,), np.int16)), "int16.*packed"),
    "sources": (lambda path: changed(path, virtual), "from none.h5, which is missing"),
    "text": (lambda path: write_cutout(path, [stored_velocity()], points=np.full(STORED, b"a")), "no xcoor with 12"),
    "end": (lambda path: write_cutout(path, [WITH_END], points=np.float32(2 * np.pi * np.arange(STORED + 1) / STORED)),
            "leave out the last plane"),
    "netCDF 3": (lambda path: Path(path).write_bytes(b"CDF\1" + bytes(60)), "is a netCDF 3 file; convert it"),
    "array": (lambda path: np.save(open(path, "wb"), stored_velocity()), "is a NumPy array; store it in HDF5"),
    "cut short": (lambda path: (write_fluidsim(path, stored_velocity()), os.truncate(path, 9000)), "damaged .*or get"),
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
    for write, message in VALUES.values():
        if comm.rank == 0:
            write(path)
        with pytest.raises(UserError, match=message):
            start(comm, path)
        comm.Barrier()


@pytest.mark.mpi(2)
def test_a_flow_starts_from_a_spectrum_in_a_text_file(comm, tmp_path):
    path = tmp_path / "spectrum.txt"
    scene = ["flow.cells=16", "initial.kind=spectrum", f"initial.path={path}"]
    first_rank(comm, path.write_text, "# k, E(k)\n1 0.5\n4 0.03125  # a power law\n")
    scenes = [load_scene("taylor-green", [*scene, f"seed={seed}"]) for seed in (1, 1, 2)]
    first, same, other = (initial_state(each.initial, each.seed, build_fluid(each.flow, None, comm)) for each in scenes)
    energy = energy_spectrum(build_fluid(scenes[0].flow, None, comm).grid, first)
    assert np.allclose(energy[1:5], 0.5 * np.arange(1, 5) ** -2.0) and not energy[5:].any()
    assert np.array_equal(first, same) and (first.size == 0 or not np.allclose(first, other))
    for content, message in {"1 2 3\n4 5 6\n": "has 3 columns", "1 a\n": "holds no spectrum", "1 1\n": "at least two",
                             "2 1\n1 1\n": "ascending", "1 nan\n2 1\n": "not finite", "": "columns"}.items():
        first_rank(comm, path.write_text, content)
        (line,), _ = problems_of(scenes[0], comm)
        assert line.startswith(f'[initial] path = "{path}": {path}: ') and message in line
    first_rank(comm, path.unlink)
    (line,), _ = problems_of(scenes[0], comm)
    assert "cannot be read: No such file" in line
    with pytest.raises(SceneError, match='kind = "spectrum" needs the path of a text file'):
        load_scene("taylor-green", ["initial.kind=spectrum"])


@pytest.mark.mpi(1)
def test_a_missing_filter_is_named(comm, path, monkeypatch):
    write_cutout(path, [stored_velocity()])
    changed(path, lambda file: file.create_dataset("other", data=np.zeros((STORED,) * 3 + (3,), "f4"), shuffle=True))
    monkeypatch.setattr(h5py.h5z, "filter_avail", lambda code: False)
    with pytest.raises(UserError, match="is compressed with shuffle .number 2.*HDF5_PLUGIN_PATH"):
        start(comm, path)
    (tmp := Path(path).parent / "empty").mkdir()
    with pytest.raises(UserError, match=f"{tmp}/ground_truth.h5: no such file; make it"):
        start(comm, tmp)
    with pytest.raises(UserError, match="is not a regular file"):
        start(comm, "/dev/null")


@pytest.mark.mpi(1)
def test_an_error_in_a_function_of_the_user_is_named(comm):
    scene = load_scene("abc", ["initial.kind=os:system"])
    assert stage_fingerprint(scene, "dns")
    fluid = build_fluid(scene.flow, None, comm)
    with pytest.raises(SceneError, match=r"system: TypeError: .* kind = \"os:system\" is called with \(grid, initial"):
        initial_state(scene.initial, 1, fluid)


def test_files_are_searched_beside_the_scene_too(tmp_path, monkeypatch):
    (tmp_path / "case").mkdir()
    scene = tmp_path / "case" / "scene.toml"
    scene.write_text('base = "taylor-green"\ninitial.kind = "file"\ninitial.path = "start.h5"\n')
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    assert load_scene(scene).initial.file == Path("start.h5")  # it may be made later
    (tmp_path / "case" / "start.h5").touch()
    assert load_scene(scene).initial.file == tmp_path / "case" / "start.h5"
    (tmp_path / "start.h5").touch()
    assert load_scene(scene).initial.file == Path("start.h5")
    assert load_scene(scene, ["initial.path=~/start.h5"]).initial.file == tmp_path / "start.h5"
    assert load_scene(scene, ["initial.path=~nobody-here/a.h5"]).initial.file == Path("~nobody-here/a.h5")
    assert load_scene(scene, ["initial.path=case"]).initial.file == Path("case/ground_truth.h5")
