import json

import h5py
import numpy as np
import pytest

from eddies.io.errors import ProductError
from eddies.io.track_files import Tracks, check_inside, check_velocities, checked, read_tracks, write_tracks

pytestmark = pytest.mark.mpi(1)

EDGE = 3.0


def shear(times, count=20, seed=1):
    """Tracks in the shear flow u = (sin 2 pi y / L, 0, 0), some of which begin late or end early."""
    draw = np.random.default_rng(seed)
    start = draw.uniform(0, EDGE, (count, 3))
    speed = np.sin(2 * np.pi * start[:, 1] / EDGE)
    time, track = (part.ravel() for part in np.meshgrid(times, np.arange(count), indexing="ij"))
    position = start[track]
    position[:, 0] = (position[:, 0] + speed[track] * time) % EDGE
    velocity = np.stack([speed[track], 0 * time, 0 * time], 1)
    there = (track % 3 != 0) | (time > times[1])
    return time[there], track[there], position[there], velocity[there]


def assert_same(found, rows):
    time, track, position, velocity = rows
    order = np.lexsort((track, time))
    np.testing.assert_array_equal(found.time, time[order])
    np.testing.assert_array_equal(found.track, track[order])
    np.testing.assert_allclose(found.position, position[order], rtol=0, atol=1e-12)
    if found.velocity is not None:
        np.testing.assert_allclose(found.velocity, velocity[order], rtol=0, atol=1e-12)


def test_tracks_that_are_written_are_read_in_any_order(tmp_path):
    rows = shear(np.array([0.0, 0.1, 0.3, 0.4]))
    shuffled = np.random.default_rng(2).permutation(len(rows[0]))
    write_tracks(tmp_path / "t.h5", *(part[shuffled] for part in rows), edge=EDGE)
    found = read_tracks(tmp_path / "t.h5")
    assert_same(found, rows)
    assert found.edge == EDGE
    check_velocities(found, EDGE, "t.h5")


def test_a_table_of_a_tracking_program(tmp_path):
    rows = shear(np.linspace(0, 1, 5))
    table = np.column_stack([rows[1], rows[0], rows[2], rows[3]])
    for delimiter, name in ((",", "a.csv"), (" ", "a.dat"), ("\t", "a.tsv")):
        np.savetxt(tmp_path / name, table, delimiter=delimiter, fmt="%.17g", comments="# ",
                   header=delimiter.join(["Track", "time", "x", "y", "z", "u", "v", "w"]))
        assert_same(read_tracks(tmp_path / name), rows)


def test_arrays_as_published_with_the_paper(tmp_path):
    position = np.random.default_rng(1).uniform(0, EDGE, (4, 9, 3)).astype(np.float32)
    np.savez(tmp_path / "a.npz", pos=position, vel=-position, rho=np.ones((4, 9)))
    found = read_tracks(tmp_path / "a.npz", frame_rate=2)
    np.testing.assert_array_equal(found.times, [0, 0.5, 1, 1.5])
    np.testing.assert_array_equal(found.position.reshape(4, 9, 3), position)
    np.testing.assert_array_equal(found.velocity, -found.position)
    with pytest.raises(ProductError, match="a.npz.*frame_rate"):
        read_tracks(tmp_path / "a.npz")


def test_files_of_the_flows_of_proptv(tmp_path):
    """The order of the files is that of their times, not of their names."""
    from scipy.io import netcdf_file
    draw = np.random.default_rng(1)
    table, times = draw.random((3, 7, 8)), [0.5, 1.0, 1.5]
    for name, time, values in zip("cab", times, table):
        with netcdf_file(tmp_path / f"{name}.nc", "w") as file:
            file.createDimension("numpart", 7)
            file.createDimension("partpara", 8)
            file.createVariable("particles", "d", ("numpart", "partpara"))[:] = values
            file.createVariable("tprobl", "d", ()).data[...] = time
    found = read_tracks(tmp_path / "*.nc")
    z, y, x, w, v, u = np.moveaxis(table[..., :6], -1, 0)
    assert_same(found, (np.repeat(times, 7), np.tile(np.arange(7), 3), np.stack([x, y, z], -1).reshape(-1, 3),
                        np.stack([u, v, w], -1).reshape(-1, 3)))
    assert found.velocity is not None
    with netcdf_file(tmp_path / "d.nc", "w") as file:
        file.createDimension("x", 2)
        file.createVariable("other", "d", ("x",))[:] = 1.0
    with pytest.raises(ProductError, match="cannot be read as proptv: d.nc holds other, but particles and tprobl are"):
        read_tracks(tmp_path / "d.nc")
    (tmp_path / "e.nc").write_bytes(b"\x89HDF of NetCDF-4")
    with pytest.raises(ProductError, match="cannot be read as proptv: .*not a valid NetCDF 3"):
        read_tracks(tmp_path / "e.nc")


def test_a_trajectory_of_lagrangebench(tmp_path):
    position = np.random.default_rng(1).uniform(0, 1, (4, 9, 3))
    (tmp_path / "metadata.json").write_text(json.dumps({"dt": 0.1, "write_every": 5, "bounds": [[-1, 1]] * 3}))
    with h5py.File(tmp_path / "train.h5", "w") as file:
        for name in ("00000", "00001"):
            file[f"{name}/position"] = position
    found = read_tracks(tmp_path / "train.h5", group="00001")
    np.testing.assert_array_equal(found.position.reshape(4, 9, 3), position)
    np.testing.assert_array_equal(found.times, 0.5 * np.arange(4))
    assert found.edge == 2 and found.lower.tolist() == [-1, -1, -1]
    with pytest.raises(ProductError, match="group = None.*00000, 00001"):
        read_tracks(tmp_path / "train.h5")


@pytest.mark.parametrize("about, types, words", [
    ({"periodic_boundary_conditions": [True, False, True]}, [0, 0], "periodic_boundary_conditions has false"),
    ({"periodic_boundary_conditions": [True] * 3}, [0, 3], "particle_type has the types 0, 3, .* give the tracks of"),
    ({"bounds": [[1, 1]] * 3}, [0, 0], "box has the edge 0, which must be a positive"),
    ({"bounds": [[1, 0]] * 3}, [0, 0], "edge -1, which"), ({"bounds": [[0, np.nan]] * 3}, [0, 0], "edge nan, which")],
    ids=["walls", "types", "empty", "negative", "NaN"])
def test_lagrangebench_without_a_periodic_fluid_is_refused(tmp_path, about, types, words):
    (tmp_path / "metadata.json").write_text(json.dumps({"dt": 0.1, "bounds": [[0, 1]] * 3} | about))
    with h5py.File(tmp_path / "test.h5", "w") as file:
        file["00000/position"], file["00000/particle_type"] = np.zeros((4, 2, 3)), types
    with pytest.raises(ProductError, match=words) as caught:
        read_tracks(tmp_path / "test.h5")
    assert str(tmp_path / "test.h5") in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("table", [True, False])
def test_rows_of_flowtracks_are_a_table_or_a_group(tmp_path, table):
    """A table of PyTables with rows of mixed types, or a group of arrays; times are numbers of frames."""
    columns = {"trajid": np.array([4, 4, 7]), "pos": np.eye(3), "vel": 2 * np.eye(3), "time": np.array([10.0, 11, 11])}
    with h5py.File(tmp_path / "a.h5", "w") as file:
        if table:
            columns["velocity"] = columns.pop("vel")
            rows = np.zeros(3, [(name, values.dtype, values.shape[1:]) for name, values in columns.items()])
            for name, values in columns.items():
                rows[name] = values
            file["particles"] = rows
        else:
            for name, values in columns.items():
                file[f"trajectories/{name}"] = values
    found = read_tracks(tmp_path / "a.h5", frame_rate=10)
    np.testing.assert_array_equal(found.time, [1, 1.1, 1.1])
    np.testing.assert_array_equal(found.track, [4, 4, 7])
    np.testing.assert_array_equal(found.velocity, 2 * found.position)


def test_hdf5_of_another_program_is_told_what_it_lacks(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["points"] = np.eye(3)
    with pytest.raises(ProductError, match="a.h5: holds points, but no particles/GROUP/position .*no metadata.json"):
        read_tracks(tmp_path / "a.h5")


def test_keys_that_a_file_does_not_use_are_refused(tmp_path):
    write_tracks(tmp_path / "a1.h5", *shear(np.array([0.0, 0.1])))
    write_tracks(tmp_path / "a2.h5", *shear(np.array([0.0, 0.1])))
    np.savez(tmp_path / "a.npz", pos=np.zeros((2, 2, 3)), time=np.arange(2))
    for name, keys, words in (("a1.h5", {"frame_rate": 2.0}, "h5md, whose frames have times; remove frame_rate"),
                              ("a1.h5", {"columns": {"x": 1}}, "columns is for tables only"),
                              ("a.npz", {"frame_rate": 2.0}, "holds an array time; remove frame_rate"),
                              ("a.npz", {"frame_rate": 0.0}, "frame_rate = 0.0: must be a positive number"),
                              ("a.npz", {"frame_rate": np.nan}, "frame_rate = nan: must be a positive number"),
                              ("a.npz", {"group": "b"}, "has the layout npz, without groups; remove group"),
                              ("a*.h5", {}, "names 2 files, but only tables may be several")):
        with pytest.raises(ProductError, match=words):
            read_tracks(tmp_path / name, **keys)


def test_h5md_with_a_constant_interval_and_an_offset(tmp_path):
    position = np.random.default_rng(1).uniform(0, 1, (3, 5, 3))
    with h5py.File(tmp_path / "md.h5", "w") as file:
        holder = file.create_group("particles/all")
        holder["position/value"], holder["position/time"] = position, 0.25
        holder["position/time"].attrs["offset"] = 2.0
        holder["box/edges/value"] = np.broadcast_to(np.eye(3), (3, 3, 3))
    found = read_tracks(tmp_path / "md.h5")
    np.testing.assert_array_equal(found.times, [2, 2.25, 2.5])
    assert found.edge == 1 and found.velocity is None


def with_box(path, edges, each_frame=False, boundary="periodic"):
    """An H5MD file of four frames whose box has the given edges, in each frame or once."""
    with h5py.File(path, "w") as file:
        holder = file.create_group("particles/all")
        holder["position/value"] = np.random.default_rng(1).uniform(0, 1, (4, 5, 3))
        holder["position/time"] = np.arange(4.0)
        holder["box/edges/value" if each_frame else "box/edges"] = edges
        holder["box"].attrs["boundary"] = np.array([boundary.encode()] * 3)
    return path


@pytest.mark.parametrize("boundary, edge", [("periodic", 2.0), ("none", None)])
def test_only_a_periodic_box_of_h5md_has_an_edge(tmp_path, boundary, edge):
    cubes = [(np.full(3, 2.0), False), (2 * np.eye(3), False), (np.full((4, 3), 2.0), True),
             (np.tile(2 * np.eye(3), (4, 1, 1)), True)]
    for number, (edges, each_frame) in enumerate(cubes):
        assert read_tracks(with_box(tmp_path / f"{number}.h5", edges, each_frame, boundary)).edge == edge


@pytest.mark.parametrize("edges, each_frame, words", [
    (np.eye(3) + np.eye(3, k=-1) / 2, False, "/particles/all/box/edges: the box is triclinic"),
    (np.tile(np.eye(3) + np.eye(3, k=1) / 9, (4, 1, 1)), True, "/particles/all/box/edges/value: the box is triclinic"),
    (np.linspace(1, 1.01, 4)[:, None] * np.ones(3), True, "box/edges/value: the box changes in time, first in frame 1"),
    (np.array([1, 1, 2, 1])[:, None, None] * np.eye(3), True, "the box changes in time, first in frame 2"),
    (np.zeros(3), False, "edge 0, which must be a positive number"), (np.full(3, -2.0), False, "edge -2, which"),
    (np.full(3, np.inf), False, "edge inf, which")])
def test_a_box_of_h5md_that_is_no_constant_cuboid_is_refused(tmp_path, edges, each_frame, words):
    path = with_box(tmp_path / "md.h5", edges, each_frame)
    with pytest.raises(ProductError, match=words) as caught:
        read_tracks(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("names", [
    ["", "track", "time", "x", "y", "z"], ["track", "time", "x", "y", "z"]], ids=["pandas", "R"])
@pytest.mark.parametrize("mark", [",", "\t", " ", ";"])
def test_a_first_column_without_a_name_is_no_track(tmp_path, mark, names):
    """pandas writes an empty name for it, and R no name at all; R puts names of rows and columns in quotes."""
    rows = shear(np.linspace(0, 1, 3))
    quoted = [f'"{name}"' for name in names] if names[0] else names
    lines = [mark.join(quoted)] + [mark.join([f'"row {number}"', *map(repr, map(float, row))]) for number, row in
                                   enumerate(np.column_stack([rows[1], rows[0], rows[2]]))]
    (tmp_path / "a.csv").write_text("\n".join(lines) + "\n")
    assert_same(read_tracks(tmp_path / "a.csv"), rows)


def changed(rows, **changes):
    columns = dict(zip(("times", "ids", "positions", "velocities"), (part.copy() for part in rows)))
    for name, value in changes.items():
        columns[name][3] = value
    return columns


@pytest.mark.parametrize("changes, words", [
    ({"positions": np.nan}, "position of track .* not finite"), ({"times": np.inf}, "time of track .* not finite"),
    ({"ids": 1, "times": 0.0}, "track 1 appears twice at time 0"), ({"ids": -5}, "whole numbers from 0")])
def test_rows_that_are_none_are_refused_before_anything_is_written(tmp_path, changes, words):
    with pytest.raises(ProductError, match=words):
        write_tracks(tmp_path / "t.h5", **changed(shear(np.array([0.0, 0.1, 0.2])), **changes))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("edge", [np.nan, 0, -1, np.inf])
def test_an_edge_that_is_none_is_refused(tmp_path, edge):
    with pytest.raises(ProductError, match="t.h5: edge = .*: must be a positive number"):
        write_tracks(tmp_path / "t.h5", *shear(np.array([0.0, 0.1])), edge=edge)
    assert not list(tmp_path.iterdir())


def test_masked_rows_are_not_written(tmp_path):
    rows = shear(np.array([0.0, 0.1, 0.2]))
    hidden = np.zeros(len(rows[0]), bool)
    hidden[[2, 5, 11]] = True
    position, velocity = np.ma.array(rows[2]), np.ma.array(rows[3])
    position[2, 1] = position[5] = velocity[11, 2] = np.ma.masked
    write_tracks(tmp_path / "t.h5", rows[0], rows[1], position, velocity, edge=EDGE)
    assert_same(read_tracks(tmp_path / "t.h5"), [part[~hidden] for part in rows])
    write_tracks(tmp_path / "t.h5", rows[0], np.ma.array(rows[1], mask=hidden), *rows[2:], edge=EDGE)
    assert_same(read_tracks(tmp_path / "t.h5"), [part[~hidden] for part in rows])


@pytest.mark.parametrize("name, content, words", [
    ("a.csv", "track,time,x,y\n1,0,0,0\n", "names track, time, x, y; add or correct z"),
    ("a.csv", "trakc,time,x,y,z\n1,0,0,0,0\n", "names trakc, .*; add or correct track"),
    ("a.csv", "track,time,x,y,z\n1,0,0,0\n", "names 5 columns, but the first row has 4"),
    ("a.csv", "track,time,x,y,z\n1,0,0,0,0\n1,0,0,0\n", "as csv"),
    ("a.csv", "track,time,x,y,z\n1,1,1,0,0,0,0\n", "names 5 columns, but the first row has 7"),
    ("a.csv", "track,time,x,y,z,X\n1,0,0,0,0,0\n", "names 2 columns x;"),
    ("a.tsv", "time\ttrack\ttime\tx\ty\tz\n1\t0\t0\t0\t0\t0\n", "names 2 columns time;"),
    ("a.csv", "track,time,x,y,z\n1.5,0,0,0,0\n", "whole numbers"),
    ("a.h5", "cut short", "HDF5"), ("a.npz", "cut short", "as npz"), ("a.bin", "", "suffix"),
    (None, "", "no such file")])
def test_unfit_files_are_named_with_the_reason(tmp_path, name, content, words):
    if name:
        (tmp_path / name).write_text(content)
    with pytest.raises(ProductError, match=words) as caught:
        read_tracks(tmp_path / (name or "missing.csv"))
    assert "\n" not in str(caught.value) and str(tmp_path) in str(caught.value)


def test_times_that_do_not_increase(tmp_path):
    np.savez(tmp_path / "a.npz", pos=np.zeros((3, 2, 3)), time=np.array([0.0, 2.0, 1.0]))
    with pytest.raises(ProductError, match="times must increase, but frame 2 is at 1 after 2"):
        read_tracks(tmp_path / "a.npz")


def test_units_that_contradict_each_other():
    time, track, position, velocity = shear(np.linspace(0, 1, 11))
    tracks = Tracks(time, track, position, velocity)
    tracks = checked(tracks, "f")
    check_velocities(tracks, EDGE, "f")
    with pytest.raises(ProductError, match="outside the box"):
        check_inside(tracks, np.zeros(3), np.full(3, 0.9 * EDGE), "box", "f")
    with pytest.raises(ProductError, match="move by 0.0[0-9]* between frames .* say [0-9]"):
        check_velocities(Tracks(100 * time, track, position, velocity), EDGE, "f")


def test_particles_at_rest_contradict_velocities_only_beyond_the_rounding_of_positions():
    time, track, position, velocity = shear(np.linspace(0, 1, 11))
    rest = np.random.default_rng(1).uniform(0, EDGE, (20, 3))[track]
    for speed in (0.0, 1e-6):  # displacements below the resolution of positions in single precision
        check_velocities(checked(Tracks(time, track, rest, speed * velocity), "f"), EDGE, "f")
    with pytest.raises(ProductError, match="particles move by 0 between frames .* velocities say 0.[0-9]*;"):
        check_velocities(checked(Tracks(time, track, rest, velocity), "f"), EDGE, "f")
    with pytest.raises(ProductError, match="particles move by 0.[0-9]* between frames .* velocities say 0;"):
        check_velocities(checked(Tracks(time, track, position, 0 * velocity), "f"), EDGE, "f")


@pytest.mark.parametrize("noise", [0.0, 0.4])
def test_velocities_with_wrong_components_contradict_displacements(noise):
    """With a noise of 0.4 displacements of rms 1 have errors of rms 1 (0.4 sqrt 6), and directions are still known."""
    draw = np.random.default_rng(1)
    time, track = (part.ravel() for part in np.meshgrid(np.arange(5.0), np.arange(3000), indexing="ij"))
    velocity = draw.standard_normal((3000, 3))[track] / np.sqrt(3)
    position = 5 + velocity * time[:, None] + noise * draw.standard_normal(velocity.shape)
    check_velocities(checked(Tracks(time, track, position, velocity), "f"), None, "f")
    for wrong in (-velocity, velocity * [1, -1, 1], velocity[:, ::-1], velocity[:, [1, 2, 0]]):
        with pytest.raises(ProductError, match="particles move by .* differ from .* correct their order, signs"):
            check_velocities(checked(Tracks(time, track, position, wrong), "f"), None, "f")
