"""Tables as tracking programs write them. All files are made here; their layouts are those of the programs."""

import codecs
import gzip
import logging

import numpy as np
import pytest

from eddies.io import track_tables
from eddies.io.errors import ProductError
from eddies.io.track_files import read_points, read_tracks

pytestmark = pytest.mark.mpi(1)

FRAMES, COUNT = 4, 3
TIME, TRACK = (part.ravel() for part in np.meshgrid(np.arange(FRAMES), np.arange(COUNT), indexing="ij"))
# Positions of a table with three decimals, so that reading is exact.
POSITION = np.random.default_rng(1).uniform(-40, 40, (FRAMES * COUNT, 3)).round(3)


@pytest.fixture(params=["pandas", "numpy"], autouse=True)
def reader(request, monkeypatch):
    """Each test reads once with pandas and once without it."""
    if request.param == "numpy":
        monkeypatch.setattr(track_tables, "pandas", None)
    elif track_tables.pandas is None:
        pytest.skip("pandas is not installed")


def rows(*columns, mark=","):
    return "".join(mark.join(str(value) for value in row) + "\n" for row in zip(*columns))


def assert_read(found, time=TIME, track=TRACK, position=POSITION):
    np.testing.assert_array_equal(found.time, time)
    np.testing.assert_array_equal(found.track, track)
    np.testing.assert_array_equal(found.position, position)


@pytest.mark.parametrize("heading, columns, name", [
    ("TrackID,FrameID,WorldX,WorldY,WorldZ,cam0_x(col)", (TRACK, TIME, *POSITION.T, TRACK), "LongTrackActive_1.csv"),
    (",z,y,x,mass,frame,particle", (TIME, *POSITION.T[::-1], TIME, TIME, TRACK), "trackpy.csv"),
    ("# X [mm],Y [mm],Z [mm],Track_ID,time (s)", (*POSITION.T, TRACK, TIME), "units.txt")],
    ids=["OpenLPT", "trackpy", "units"])
def test_names_that_programs_give_are_recognised(tmp_path, heading, columns, name):
    (tmp_path / name).write_text(f"{heading}\n{rows(*columns)}")
    assert_read(read_tracks(tmp_path / name))


def test_myptv_has_no_names_and_velocities_of_a_frame(tmp_path):
    """Id, position, velocity and acceleration, frame; rows with the id -1 belong to no track."""
    extra = (*POSITION.T / 8, *0 * POSITION.T)
    text = rows(TRACK, *POSITION.T, *extra, TIME + 0.0, mark="\t")
    (tmp_path / "smoothed_trajectories").write_text(text + rows([-1] * 2, *np.ones((9, 2)), [0.0, 1.0], mark="\t"))
    found = read_tracks(tmp_path / "smoothed_trajectories", frame_rate=8)
    assert_read(found, TIME / 8)
    np.testing.assert_array_equal(found.velocity, POSITION)
    (tmp_path / "trajectories").write_text(rows(TRACK, *POSITION.T, TIME, TIME, TIME, 0.1 + TIME, TIME, mark="\t"))
    assert_read(read_tracks(tmp_path / "trajectories"))


@pytest.mark.parametrize("begin", ["", "p"], ids=["numbers", "texts"])
def test_rows_without_a_track_are_counted(tmp_path, caplog, begin):
    caplog.set_level(logging.INFO, "eddies")
    ids, lost = [f"{begin}{track}" for track in TRACK], (["", "-1", "nan"], 3 * [0], *np.ones((3, 3)))
    for name, columns in (("first", [0, 1, 2, 3, 4]), ("last", [1, 2, 3, 4, 0])):
        texts = [rows(*(each[place] for place in columns)) for each in (lost, (ids, TIME, *POSITION.T))]
        (tmp_path / name).write_text(rows(*([("track", "time", "x", "y", "z")[place]] for place in columns))
                                     + texts[0] + texts[1] + texts[0])
        assert_read(read_tracks(tmp_path / name))
        assert [line for line in caplog.messages if f"{name}: 6 of 18 rows belong to no track" in line]


LINKED = {1: [(-1, 1, 0), (-1, -2, 1), (-1, 0, 2)], 2: [(2, 0, 3), (0, -2, 4)], 3: [(0, -2, 5), (-1, -2, 6)],
          5: [(0, -2, 7)]}


@pytest.mark.parametrize("extra", [(), (4,)], ids=["ptv_is", "added"])
def test_rows_of_openptv_are_linked_from_file_to_file(tmp_path, caplog, extra):
    """The row numbers of `previous` and `next` count from 0. Frame 4 has no particles."""
    caplog.set_level(logging.INFO, "eddies")
    for frame, particles in LINKED.items():
        lines = [" ".join(map(str, (*links, x, 0.5, -x, *extra))) for *links, x in particles]
        (tmp_path / f"ptv_is.{frame}").write_text("\n".join([str(len(particles)), *lines, "", ""]))
    for frame in (0, 4):
        (tmp_path / f"ptv_is.{frame}").write_text("0\n")
    found = read_tracks(tmp_path / "ptv_is.*", frame_rate=2)
    tracks = {tuple(found.position[found.track == track, 0]) for track in np.unique(found.track)}
    assert tracks == {(2, 3, 5), (0, 4)}  # 0: previous of 4; 2, 3, 5: links both ways
    np.testing.assert_array_equal(found.times, [0.5, 1, 1.5])
    assert [line for line in caplog.messages if "3 of 8 rows belong to no track" in line]
    with pytest.raises(ProductError, match=r"ptv_is.1: .*holds one frame; give .* with \*"):
        read_tracks(tmp_path / "ptv_is.1")


def test_links_that_are_not_mutual_are_none(tmp_path):
    for frame, links in ((1, [(-1, 0), (-1, 0)]), (2, [(0, -2), (1, -2)])):
        (tmp_path / f"ptv_is.{frame}").write_text(f"2\n{rows(*zip(*links), *np.eye(3)[:, :2], mark=' ')}")
    assert len(read_tracks(tmp_path / "ptv_is.*").time) == 2


def test_xuap_counts_rows_from_one_and_marks_smoothed_ones(tmp_path):
    for frame, links, smoothed in ((1, [(0, 2), (0, 1)], 1), (2, [(2, 1), (1, 1)], 1), (3, [(1, 0)], 0)):
        points = frame + np.eye(3)[:, :len(links)]
        text = rows(*zip(*links), *9 * points, *smoothed * points, *smoothed * 2 * points, *0 * points,
                    len(links) * [float(smoothed)], mark="\t")
        (tmp_path / f"xuap.{frame}").write_text(text)
    found = read_tracks(tmp_path / "xuap.*", frame_rate=10)
    np.testing.assert_array_equal(found.time, [0.1, 0.1, 0.2, 0.2])
    np.testing.assert_array_equal(found.velocity, 2 * found.position)
    by_track = [found.position[found.track == track] for track in np.unique(found.track)]
    np.testing.assert_array_equal(by_track[0], [[2, 1, 1], [2, 3, 2]])
    np.testing.assert_array_equal(by_track[1], [[1, 2, 1], [3, 2, 2]])


@pytest.mark.parametrize("ends", ["\n", "\r\n"], ids=["LF", "CRLF"])
@pytest.mark.parametrize("letter", ["", "e", "D"], ids=["no times", "times", "Fortran"])
def test_zones_of_tecplot_are_frames(tmp_path, letter, ends):
    """As in the data assimilation challenge; one file or several, with a title in each."""
    times = [f"\n SOLUTIONTIME = {0.1 * frame:.1e}".replace("e", letter) if letter else "" for frame in range(FRAMES)]
    zones = [f'ZONE T="snapshot {frame}", I={COUNT}, F=POINT{times[frame]}\n'
             + rows(*POSITION[TIME == frame].T, TRACK[TIME == frame], mark=" ") for frame in range(FRAMES)]
    head = 'TITLE = "a case"\nVARIABLES = "X [mm]", "Y [mm]"\n"Z [mm]"\nPartID\n'
    expected = TIME * 0.1 if letter else TIME
    for name, parts in (("all.dat", [zones]), ("two_*.dat", [zones[:2], zones[2:]]),
                        ("each*.dat", [[zone] for zone in zones])):
        for number, part in enumerate(parts):
            (tmp_path / name.replace("*", str(number))).write_text(head + "".join(part), newline=ends)
        found = read_tracks(tmp_path / name)
        np.testing.assert_allclose(found.time, expected, rtol=1e-15)
        assert_read(found, found.time)


def test_zones_may_be_empty(tmp_path):
    (tmp_path / "a.dat").write_text("VARIABLES = X Y Z PartID\nZONE I=1\n1 2 3 7\n"
                                    "ZONE I=0\nZONE I=1\n4 5 6 7\nZONE I=0\n")
    np.testing.assert_array_equal(read_tracks(tmp_path / "a.dat").time, [0, 2])


def test_a_file_a_frame_has_its_number_as_time(tmp_path):
    for frame in range(FRAMES):
        own = TIME == frame
        text = rows(TRACK[own], *POSITION[own].T, mark=" ")
        (tmp_path / f"cam2_points_{frame + 98}.txt").write_text(f"id x y z\n{text}")
    found = read_tracks(tmp_path / "cam2_points_*.txt", columns={"track": "id"}, frame_rate=2)
    assert_read(found, (TIME + 98) / 2)


@pytest.mark.parametrize("names, times", [
    (["a", "b", "c"], [0, 1, 2]), (["8/t", "9/t", "10/t"], [8, 9, 10]), (["7/1", "7/2", "8/1"], None),
    (["f0", "f1", "f1_old"], None), (["f0", "f1", "f_mean"], None), (["f1", "f01", "f2"], None)])
def test_numbers_of_files_are_different_or_none_has_one(tmp_path, names, times):
    for number, name in enumerate(names):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / f"{name}.csv").write_text(f"track,x,y,z\n0,{number},2,3\n")
    path = tmp_path / ("*/*.csv" if "/" in names[0] else "*.csv")
    if times is None:
        with pytest.raises(ProductError, match="no times, and no number in their names .* keep other files out"):
            read_tracks(path)
    else:
        found = read_tracks(path)
        assert [found.time.tolist(), found.position[:, 0].tolist()] == [times, [0, 1, 2]]


@pytest.mark.parametrize("short, words", [
    ("track,time,x,y,z\n0,1,1,2,3\n", "f1.csv has no u, v, w, but"),
    ("track,x,y,z,u,v,w\n0,1,2,3,4,5,6\n", "f1.csv has no times, but")])
def test_files_of_a_series_have_the_same_columns(tmp_path, short, words):
    for frame in (0, 2):
        (tmp_path / f"f{frame}.csv").write_text(f"track,time,x,y,z,u,v,w\n0,{frame},1,2,3,4,5,6\n")
    (tmp_path / "f1.csv").write_text(short)
    with pytest.raises(ProductError, match=words):
        read_tracks(tmp_path / "f*.csv")


def test_openlpt_numbers_the_tracks_of_each_file_anew(tmp_path):
    for name in ("LongTrackActive_9.csv", "LongTrackInactive_9.csv"):
        (tmp_path / name).write_text("TrackID,FrameID,WorldX,WorldY,WorldZ\n" + rows(TRACK, TIME, *POSITION.T))
    assert len(np.unique(read_tracks(tmp_path / "LongTrack*.csv").track)) == 2 * COUNT
    for frame in range(FRAMES):  # a file a frame cannot have tracks of its own
        own = TIME == frame
        (tmp_path / f"f{frame}.csv").write_text("TrackID,FrameID,WorldX,WorldY,WorldZ\n"
                                                + rows(TRACK[own], TIME[own], *POSITION[own].T))
    assert_read(read_tracks(tmp_path / "f*.csv"))


ZONES = b"VARIABLES = X Y Z PartID\n"
COLUMNS = {"track": "Who", "time": "When", "x": "P1", "y": "P2", "z": "P3"}


def test_columns_are_given_by_name_or_number(tmp_path):
    table = rows(*POSITION.T, TIME, TRACK)
    (tmp_path / "named.csv").write_text(f"P1 [m],P2 [m],P3 [m],when,who\n{table}")
    (tmp_path / "bare.csv").write_text(table)
    assert_read(read_tracks(tmp_path / "named.csv", columns=COLUMNS))
    numbers = {"x": 1, "y": 2, "z": 3, "time": 4, "track": 5}
    for name in ("named.csv", "bare.csv"):
        assert_read(read_tracks(tmp_path / name, columns=numbers))
    (tmp_path / "bare.csv").write_text(rows(*POSITION.T, TIME, TRACK, *POSITION.T))
    found = read_tracks(tmp_path / "bare.csv", columns=numbers | {"u": 8, "v": 7, "w": 6}, frame_rate=4)
    assert_read(found, TIME / 4)
    np.testing.assert_array_equal(found.velocity, POSITION[:, ::-1])


def test_ids_that_are_texts_are_numbered(tmp_path):
    names = np.array(["b 1", "a", "a2"])
    for mark in ",;":
        (tmp_path / "a.csv").write_text("track,time,x,y,z\n".replace(",", mark) + rows(
            names[TRACK], TIME, *POSITION.T, mark=mark))
        assert_read(read_tracks(tmp_path / "a.csv"))
    for frame in range(FRAMES):  # the same ids in all files
        own = TIME == frame
        (tmp_path / f"f{frame}.txt").write_text("track,x,y,z\n" + rows(names[TRACK[own]], *POSITION[own].T))
    assert_read(read_tracks(tmp_path / "f*.txt"))


TEXT = "Spur;Zeit (µs);x;y;z\n;;mm;mm;mm\n" + rows(TRACK, TIME, *POSITION.T, mark=";")
FORTRAN = "Spur;Zeit;x;y;z\n" + rows(TRACK, TIME, *np.char.mod("%.6E", POSITION.T), mark=";").replace("E", "D")
GERMAN = {"track": "Spur", "time": "Zeit"}


@pytest.mark.parametrize("content", [
    TEXT.encode(), TEXT.encode("latin-1"), TEXT.encode("utf-16"), codecs.BOM_UTF16_BE + TEXT.encode("utf-16-be"),
    codecs.BOM_UTF8 + TEXT.encode(), TEXT.replace("\n", "\r\n").encode(), TEXT.replace("\n", ";\r\n").encode(),
    gzip.compress(TEXT.encode("latin-1")), TEXT.replace(".", ",").encode("latin-1"),
    TEXT.replace(".", ",").replace(";", "\t").encode(), TEXT.replace(";;mm", "- - mm").replace(" (µs)", "").replace(
        ".", ",").replace(";", " ").encode(), TEXT.replace(";", " ; ").encode(), FORTRAN.encode()],
    ids=["UTF-8", "Latin-1", "UTF-16", "UTF-16 BE", "BOM", "CRLF", "ends", "gzip", "comma", "tab", "blank", "wide",
         "Fortran"])
def test_texts_of_all_kinds_are_read(tmp_path, content):
    for name in ("a.csv", "a.csv.gz", "a"):
        (tmp_path / name).write_bytes(content)
        assert_read(read_tracks(tmp_path / name, columns=GERMAN))


@pytest.mark.parametrize("content, keys, words", [
    (TEXT.encode("utf-16-le"), {}, "save the table as text in UTF-8"),
    (gzip.compress(TEXT.encode())[:-60], {}, "cannot be read as csv"),
    (b"0,0,1,2,3\n1,0,1,2,3\n", {}, r"5 columns without names, .* columns = \{track = 1, time = 2"),
    (b"a,b,x,y,z\n0,0,1,2,3\n", {"columns": {"track": "c"}},
     "columns.track = 'c': the table has no such columns; it has 5 columns: a, b, x, y, z"),
    (b"0,0,1,2,3\n", {"columns": {"x": 6}}, "columns.x = 6: .*5 columns without names"),
    (b"track,time,x,y,z,q\n0,0,1,2,3,4\n", {"columns": {"u": "q"}}, "columns gives no v; give u, v, w, or none"),
    (b"track,time,x,y,z\n0,0,1,2,3\n0,1,,2,3\n", {},
     "row 2 has no number in the column of x .1 such rows|'' to float64 at row 1, column 3"),
    (b"track,time,x,y,z\n0,0.25,1,2,3\n", {"frame_rate": 500}, "time 0.25 is no number of a frame.*remove frame_rate"),
    (b"track,x,y,z\n0,1,2,3\n", {}, "names track, x, y, z; add or correct time"),
    (b"track,time,x,y,z\n0,0,1,2,three\n", {}, "cannot be read as csv: .*three"),
    (b"track,time,x,y,z\n0,0,1,2,3\n", {"columns": {"x": "y"}}, "columns.x = 'y': this column is that of y too; give"),
    (b"track,time,x,y,z\n0,0,1,2,3\n", {"columns": {"vx": 3}}, "columns.vx = 3: must be one of track, time, x, y"),
    (b"track,time,x,y,z\n0,0,inf,2,3\n", {}, "row 1 has no number in the column of x"),
    (ZONES + b"ZONE SOLUTIONTIME=0\n1 2 3 7\nZONE\n1 2 3 7\n", {}, "a.csv: some zones have a SOLUTIONTIME and others"),
    (ZONES + b"ZONE\n1 2 3 7\nZONE SOLUTIONTIME=1\n1 2 3 7\n", {}, "a.csv: some zones have a SOLUTIONTIME and others")],
    ids=["UTF-16", "cut", "bare", "name", "number", "velocity", "empty", "rate", "time", "word", "twice", "unknown",
         "infinite", "second zone", "first zone"])
def test_what_cannot_be_read_is_named_with_the_remedy(tmp_path, content, keys, words):
    (tmp_path / "a.csv").write_bytes(content)
    with pytest.raises(ProductError, match=words) as caught:
        read_tracks(tmp_path / "a.csv", **keys)
    assert "\n" not in str(caught.value) and str(tmp_path / "a.csv") in str(caught.value)


def test_a_table_of_numbers_alone_is_not_taken_for_that_of_a_program(tmp_path):
    """Eleven columns as MyPTV has them, but the first holds no whole numbers."""
    (tmp_path / "a.txt").write_text(rows(*np.random.default_rng(1).random((11, 4)), mark=" "))
    with pytest.raises(ProductError, match="11 columns without names"):
        read_tracks(tmp_path / "a.txt")


@pytest.mark.parametrize("text, times", [
    ("x;y;z\n1,5;2;3\n4;5;6\n", None), ("1.5 2 3\n4 5 6\n", None),
    ("Z [mm],time,X [mm],Y [mm]\n3,7,1.5,2\n6,8,4,5\n", [7, 8]),
    ("trackid,x,y,z,u\na,1.5,2,3,9\nb,4,5,6,9\n", None)])
def test_points_are_read_without_tracks(tmp_path, text, times):
    (tmp_path / "points.csv").write_text(text)
    time, position = read_points(tmp_path / "points.csv")
    np.testing.assert_array_equal(position, [[1.5, 2, 3], [4, 5, 6]])
    assert time is None if times is None else time.tolist() == times


@pytest.mark.parametrize("text, words", [
    ("", "no column x"), ("x,y,c\n1,2,3\n", "it has no column z; name"),
    ("frame,x,y,z\n1,1,2,3\n", "numbers of frames"),
    ("x,y,z\n1,2,3\n1,nan,3\n", "row 2 has no number in the column of y")])
def test_points_that_lack_something_are_refused(tmp_path, text, words):
    (tmp_path / "points.csv").write_text(text)
    with pytest.raises(ProductError, match=words):
        read_points(tmp_path / "points.csv")
