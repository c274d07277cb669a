"""Tables of tracks, as tracking programs write them: text with a row for each particle and time.

A file may begin with lines of a heading. One of them may name the columns; NAMES lists the names that are recognised,
in small letters and without units. A table without names is recognised if PROGRAMS has a table with as many columns. A
Tecplot file has a zone for each frame.
"""

from __future__ import annotations

import codecs
import csv
import gzip
import io
import logging
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mode
from typing import BinaryIO, TextIO

import numpy as np

from eddies.io.file_patterns import matching_files, short_names

try:
    import pandas
except ImportError:  # the extra [tracks], for large tables
    pandas = None

log = logging.getLogger("eddies")

POINT, VELOCITY, LINKS = ("x", "y", "z"), ("u", "v", "w"), ("previous", "next")
NEEDED = ("track", "time", *POINT)
#: Names of columns, those of a number of a frame apart from those of a time.
NAMES = {"track": ("track", "trackid", "particle", "partid"), "time": ("time",), "frame": ("frame", "frameid"),
         **{axis: (axis, f"world{axis}") for axis in POINT},
         **{name: (name,) for name in VELOCITY}}
WHOLE = ("track", "frame", *LINKS)   # columns of whole numbers
OWN_IDS = {"trackid", "frameid", "worldx"}   # names that show a table of OpenLPT: each file numbers its own tracks
HEAD, ROWS = 2**16, 50  # bytes, and rows after the heading, from which the layout is found
LEAST_NUMBERS = 3       # least number of numbers in a row
NO_ID = -1              # id of a row that belongs to no track
NO_NAMES = ("", "nan", "na", "none", "null")   # texts, in small letters, in place of NO_ID
COMMENTS = "#%"
GZIP = b"\x1f\x8b"      # first bytes of a compressed file
MARKS = {codecs.BOM_UTF8: "utf-8-sig", codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16"}
DECIMAL = re.compile(r"[-+]?\d*,?\d+(?:[eEdD][-+]?\d+)?")   # a number, perhaps with a decimal comma
FORTRAN = re.compile(r"(?<=[\d.])[dD](?=[-+]?\d+$)")   # the letter of an exponent of Fortran
VARIABLES = re.compile(r"^\s*variables\s*=(.*?)(?=^\s*\w+\s*=|^\s*zone\b|\Z)", re.IGNORECASE | re.DOTALL | re.MULTILINE)
ZONE = re.compile(r"((?:^[ \t]*[A-Za-z\"#].*\n?)+)", re.MULTILINE)
SOLUTION_TIME = re.compile(r"solutiontime\s*=\s*([-+.\ded]+)", re.IGNORECASE)


@dataclass(frozen=True)
class Program:
    """A table without names of columns, as a tracking program writes it.

    Parameters
    ----------
    columns : what each column holds; "" for one that is not read.
    counted : whether the first line is the number of rows.
    first : number of the first row of a file in `previous` and `next`, which are numbers of rows of the files before
        and after.
    per_frame : whether velocities are displacements from frame to frame.
    """

    columns: tuple[str, ...]
    counted: bool = False
    first: int = 0
    per_frame: bool = False


PROGRAMS = (
    Program((*LINKS, *POINT), counted=True),       # OpenPTV ptv_is
    Program((*LINKS, *POINT, ""), counted=True),   # OpenPTV added
    Program((*LINKS, *3 * ("",), *POINT, *VELOCITY, *3 * ("",), "smoothed"), first=1),     # OpenPTV xuap
    Program(("track", *POINT, *VELOCITY, *3 * ("",), "frame"), per_frame=True),             # MyPTV, smoothed
    *(Program(("track", *POINT, *cameras * ("",), "", "frame")) for cameras in (2, 3, 4)))  # MyPTV


@dataclass(frozen=True)
class Heading:
    """What the beginning of a file shows.

    Parameters
    ----------
    encoding : encoding of the text.
    lines : the lines before the first row.
    rows : the fields of the first rows; none if the file has no row.
    delimiter, decimal : the characters between fields, and within numbers. The delimiter " " is any blank.
    """

    encoding: str
    lines: tuple[str, ...]
    rows: tuple[Sequence[str], ...]
    delimiter: str = ","
    decimal: str = "."

    @property
    def width(self) -> int:
        """Number of fields of most rows: a row with an empty last field has one less."""
        return mode(map(len, self.rows)) if self.rows else 0

    @property
    def zones(self) -> bool:
        """Whether it is a Tecplot file."""
        return bool(VARIABLES.search("".join(self.lines)))

    @property
    def counted(self) -> bool:
        """Whether the first line is the number of rows."""
        return len(self.lines) == 1 and self.lines[0].strip().isdecimal()

    @property
    def names(self) -> list[str]:
        """Names of the columns, in small letters; an empty list if there are none.

        They are in the last line with as many fields as a row, or one less: a first column may have no name. If several
        lines fit, it is the first of them with a name of an x.
        """
        listed = VARIABLES.search("".join(self.lines))
        if listed:
            return [(quoted or bare).lower() for quoted, bare in re.findall(r'"([^"]*)"|([^\s,"]+)', listed[1])]
        width = self.width
        lines = [(line.lstrip()[:1] in COMMENTS, _fields(line.strip(COMMENTS + " \r\n"), self.delimiter))
                 for line in self.lines if line.strip() and not self.counted]
        fitting = [line for _, line in lines if not width or width - len(line) in (0, 1)]
        fitting = fitting or [line for comment, line in lines if not comment]
        named = [line for line in fitting if any(plain(name) in NAMES["x"] for name in line)] or fitting[-1:]
        found = [name.lower() for name in named[0]] if named else []
        return ["", *found] if found and len(found) == width - 1 else found


def plain(name: str) -> str:
    """Return the name of a column in small letters, without its unit in brackets."""
    return re.sub(r"\s*[\[(].*", "", name.strip().lower()).replace("_", "")


def is_table(path: Path) -> bool:
    """Return whether a file begins as a table of at least three columns does."""
    try:
        return bool(heading_of(path).rows)
    except ValueError:
        return False


def heading_of(path: Path) -> Heading:
    """Read the heading of a table. Raises ValueError for a file that is no text."""
    with _bytes(path) as file:
        head = file.read(HEAD)
    encoding = _encoding(head)
    lines = io.TextIOWrapper(io.BytesIO(head), encoding, errors="replace").readlines()
    if len(head) == HEAD:
        del lines[-1]
    for number, line in enumerate(lines):
        delimiter = _delimiter(line)
        if _is_row(line, delimiter):
            rows = tuple(_fields(each, delimiter) for each in lines[number:number + ROWS] if _is_row(each, delimiter))
            decimal = "," if delimiter != "," and any("," in field for field in rows[0]) else "."
            return Heading(encoding, tuple(lines[:number]), rows, delimiter, decimal)
    return Heading(encoding, tuple(lines), (), _delimiter(lines[0]) if lines else ",")


def read_table(path: Path, columns: Mapping[str, str | int] | None = None, frame_rate: float | None = None) -> tuple[
        np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]:
    """Read the tracks of a table, or of a series of tables, which a path with * names.

    Parameters
    ----------
    columns : name or number of columns, by NEEDED and VELOCITY; numbers count from 1. Others are recognised.
    frame_rate : frames per unit of time, for files that count frames.

    Returns time and track (rows,), position (rows, 3), and velocity (rows, 3) or None. Rows that belong to no track are
    left out. Raises ValueError if a table is no text, or lacks a column or a number.
    """
    ids: dict[str, float] = {}
    files = matching_files(path)
    parts = [_Part.read(file, number if len(files) > 1 else None, columns or {}, ids)
             for file, number in zip(files, _file_numbers(files))]
    parts = [part for part in parts if part.rows]
    if not parts:
        return np.zeros(0), np.zeros(0), np.zeros((0, 3)), None
    for what, lacking in (("u, v, w", [part.name for part in parts if "u" not in part.columns]),
                          ("times", [part.name for part in parts if part.counts_frames])):
        if 0 < len(lacking) < len(parts):
            raise ValueError(f"{lacking[0]} has no {what}, but other files of the series have them ({len(lacking)} "
                             "such files); give them in all files or in none")
    _number_zones(parts)
    _number_tracks(parts)
    names = [name for name in (*NEEDED, *VELOCITY) if all(name in part.columns for part in parts)]
    values = {name: _joined([part.columns.pop(name) for part in parts]) for name in names}
    time, track = values["time"], values["track"]
    if np.isnan(time).any():
        raise ValueError("the files have no times, and no number in their names that is another one in each; give each "
                         "the number of its frame, and keep other files out of the path")
    position, velocity = (np.stack([values.pop(name) for name in group], axis=1) if group[0] in values else None
                          for group in (POINT, VELOCITY))
    if frame_rate is not None:
        off = np.flatnonzero(time != np.rint(time))
        if len(off):
            raise ValueError(f"the time {time[off[0]]:g} is no number of a frame, as frame_rate = {frame_rate:g} "
                             "needs; remove frame_rate")
        time = time / frame_rate
        if velocity is not None and all(part.per_frame for part in parts):
            velocity *= frame_rate
    elif any(part.counts_frames for part in parts):
        log.info("%s: counts frames; the unit of time is one frame, unless frame_rate is given", path)
    kept = track >= 0
    if kept.all():
        return time, track, position, velocity
    log.info("%s: %d of %d rows belong to no track and are left out", path, len(kept) - kept.sum(), len(kept))
    return time[kept], track[kept], position[kept], None if velocity is None else velocity[kept]


def read_point_table(path: Path) -> tuple[np.ndarray | None, np.ndarray]:
    """Read the points of a table: time (rows,), or None if no column has this name, and position (rows, 3).

    A table without names has the columns x, y, z. Raises ValueError as `read_table` does, and for a table without rows.
    """
    heading = heading_of(path)
    given = {} if heading.names else {name: place for place, name in enumerate(POINT, 1)}
    places = _places(heading, given, needed=()) if heading.rows else {}
    for name in POINT:
        if name not in places:
            raise ValueError(f"it has no column {name}; name the columns {', '.join(POINT)} in the first line")
    if "frame" in places:
        raise ValueError("it has numbers of frames; give the column time, counted from the first frame, in their place")
    columns, _ = _read(path, heading, {name: places[name] for name in ("time", *POINT) if name in places}, {})
    return columns.get("time"), np.stack([columns[name] for name in POINT], axis=1)


@dataclass
class _Part:
    """The rows of one file.

    Parameters
    ----------
    columns : arrays (rows,) by name, among them `x` and, except in Tecplot files, `time`.
    name, number : name of the file, and the number of its frame by its name; None for a single file, NaN if the names
        do not give it.
    zones : rows of each zone of a Tecplot file without times.
    first, per_frame : as in `Program`. own_ids : whether the file numbers its tracks on its own.
    counts_frames : whether the times are numbers of frames.
    """

    columns: dict[str, np.ndarray]
    name: str
    number: float | None
    zones: list[int]
    first: int = 0
    per_frame: bool = False
    own_ids: bool = False
    counts_frames: bool = False

    @property
    def rows(self) -> int:
        """Number of rows."""
        return len(self.columns["x"])

    @classmethod
    def read(cls, file: Path, number: float | None, given: Mapping[str, str | int], ids: dict[str, float]) -> _Part:
        """Read a file. `given` holds the columns that the user names, `ids` the numbers of tracks with texts as ids, to
        which new ones are added."""
        heading = heading_of(file)
        program = None if given else next((each for each in PROGRAMS if _fits(each, heading)), None)
        timed = number is not None or heading.zones  # whether it needs no times
        places = ({name: place for place, name in enumerate(program.columns) if name} if program
                  else _places(heading, given, [name for name in NEEDED if not (timed and name == "time")])
                  if heading.rows or heading.names else {})
        if not heading.rows:
            return cls({"x": np.zeros(0)}, file.name, number, [])
        if "next" in places and number is None:
            raise ValueError("the file holds one frame; give the files of all frames, with * in place of their number")
        columns, zones = _read(file, heading, places, ids)
        counts = "time" not in columns
        if "frame" in columns:
            columns["time"] = columns.pop("frame")
        elif counts and not heading.zones:
            columns["time"] = np.full(len(columns["x"]), float(number or 0))
        return cls(columns, file.name, number, zones, program.first if program else 0,
                   program is not None and program.per_frame,
                   OWN_IDS <= {plain(name) for name in heading.names}, counts)


def _number_zones(parts: Sequence[_Part]) -> None:
    """Add the column `time` to Tecplot files without times: the number of the file if it has one zone, else the number
    of the zone in all files."""
    before = 0
    for part in parts:
        if "time" not in part.columns:
            alone = part.number is not None and (len(part.zones) == 1 or math.isnan(part.number))
            numbers = np.arange(len(part.zones)) + (part.number if alone else before)
            part.columns["time"], before = np.repeat(numbers.astype(float), part.zones), before + len(part.zones)


def _number_tracks(parts: Sequence[_Part]) -> None:
    """Make the numbers of tracks those of all files: from the links between frames, or if files number their tracks on
    their own. A row without a link belongs to no track."""
    last, before = -1.0, None
    for part in parts:
        track = part.columns.get("track")
        if "next" in part.columns:
            track = np.full(part.rows, NO_ID, float)
            if before is not None and part.number == before.number + 1:
                rows = part.columns["previous"].astype(int) - part.first
                back = np.flatnonzero((rows >= 0) & (rows < before.rows))
                back = back[before.columns["next"][rows[back]] - part.first == back]
                track[back] = before.columns["track"][rows[back]]
            new = track < 0
            track[new] = last + 1 + np.arange(new.sum())
        elif part.own_ids and len(np.unique(part.columns["time"])) > 1:
            track = np.where(track < 0, NO_ID, track + last + 1)
        if track is not None:
            last, before, part.columns["track"] = max(last, track.max(initial=-1.0)), part, track
    if before is not None and "next" in before.columns:
        lengths = np.bincount(np.concatenate([part.columns["track"] for part in parts]).astype(int))
        for part in parts:
            single = lengths[part.columns["track"].astype(int)] == 1
            part.columns["track"][single | (part.columns.get("smoothed", 1.0) == 0)] = NO_ID


# ---- columns


def _fits(program: Program, heading: Heading) -> bool:
    """Return whether a table without names is that of a program."""
    whole = [place for place, name in enumerate(program.columns) if name in WHOLE]
    return (bool(heading.rows) and not heading.names and heading.counted == program.counted
            and len(program.columns) == len(heading.rows[0])
            and all(_number(row[place]).is_integer() for row in heading.rows if len(row) == len(program.columns)
                    for place in whole))


def _places(heading: Heading, given: Mapping[str, str | int], needed: Sequence[str]) -> dict[str, int]:
    """Return the place of each column that is read, by NAMES; those of `needed` must be there, or a frame for the time.

    Raises ValueError if a column is missing or is there twice.
    """
    names = heading.names
    width = heading.width or len(names)
    if names and len(names) != width:
        raise ValueError(f"the first line names {len(names)} columns, but the first row has {width}; name each column "
                         "once")
    found = {}
    for name, accepted in NAMES.items():
        plains = [plain(each) for each in names]
        own = next((each for each in accepted if each in plains), None)
        if own is not None and name not in given:
            if plains.count(own) > 1:
                raise ValueError(f"the first line names {plains.count(own)} columns {own}; give each column a name of "
                                 "its own (capital letters do not count)")
            found[name] = plains.index(own)
    for name, column in given.items():
        if name not in (*NEEDED, *VELOCITY):
            raise ValueError(f"columns.{name} = {column!r}: must be one of {', '.join((*NEEDED, *VELOCITY))}")
        found[name] = _given_place(name, column, names, width)
    if "time" in found:
        found.pop("frame", None)
    for name in needed:
        if name not in found and not (name == "time" and "frame" in found):
            raise ValueError(f"the first line must name the columns {', '.join(needed)}, but it names "
                             f"{', '.join(names)}; add or correct {name}, or say by columns which one it is" if names
                             else f"{width} columns without names, but tracks need {', '.join(NEEDED)}; give the "
                             "numbers of these columns, such as columns = {track = 1, time = 2, x = 3, y = 4, z = 5}")
    missing = [name for name in VELOCITY if name not in found]
    if missing and any(name in given for name in VELOCITY):
        raise ValueError(f"columns gives no {missing[0]}; give {', '.join(VELOCITY)}, or none of them")
    found = {name: place for name, place in found.items() if not missing or name not in VELOCITY}
    for name in given:
        other = next((each for each in found if each != name and found[each] == found[name]), None)
        if other is not None:
            raise ValueError(f"columns.{name} = {given[name]!r}: this column is that of {other} too; give each of them "
                             "a column of its own")
    return found


def _given_place(name: str, column: str | int, names: Sequence[str], width: int) -> int:
    """Return the place of the column that the user gives for `name`."""
    if isinstance(column, int):
        places = [column - 1] if 1 <= column <= width else []
    else:
        own = column.strip().lower()
        places = ([place for place, each in enumerate(names) if each == own]
                  or [place for place, each in enumerate(names) if plain(each) == plain(own)])
    if len(places) != 1:
        raise ValueError(f"columns.{name} = {column!r}: the table has {len(places) or 'no'} such columns; it has "
                         f"{width} columns{': ' if names else ' without names'}{', '.join(names)}; correct {name}")
    return places[0]


# ---- text


def _bytes(path: Path) -> BinaryIO:
    """Open a file; one that is compressed by gzip is read as what it contains."""
    with open(path, "rb") as file:
        zipped = file.read(2) == GZIP
    return gzip.open(path) if zipped else open(path, "rb")


def _encoding(head: bytes) -> str:
    """Return the encoding of the text that begins with `head`. Raises ValueError if it is no text."""
    for mark, name in MARKS.items():
        if head.startswith(mark):
            return name
    if b"\0" in head:
        raise ValueError("is no text in an encoding that is known; save the table as text in UTF-8")
    try:
        head[:head.rfind(b"\n") + 1].decode()
    except UnicodeDecodeError:
        return "latin-1"
    return "utf-8"


def _delimiter(line: str) -> str:
    """Return the character between the fields of a line; a blank if they are separated by blanks."""
    bare = re.sub('"[^"]*"', "", line)
    marks = [mark for mark in ";\t" if mark in bare]
    fields = bare.split()
    if not marks and "," in bare and not (len(fields) > 1 and all(DECIMAL.fullmatch(field) for field in fields)):
        return ","
    return marks[0] if marks else " "


def _fields(line: str, delimiter: str) -> list[str]:
    """Split a line; quotes are removed, and so is an empty field at the end."""
    text = line.strip(" \r\n") if delimiter != " " else " ".join(line.split())
    fields = [field.strip() for field in next(csv.reader([text], delimiter=delimiter, skipinitialspace=True), [])]
    return fields[:-1] if fields and not fields[-1] else fields


def _is_row(line: str, delimiter: str) -> bool:
    """Return whether a line is a row with numbers, not a comment or the heading of a zone."""
    return line.lstrip()[:1] not in (*COMMENTS, "") and sum(
        not math.isnan(_number(field)) for field in _fields(line, delimiter)) >= LEAST_NUMBERS


def _number(field: str) -> float:
    """Return a number with a decimal point or comma, perhaps with an exponent of Fortran; NaN for another text."""
    try:
        return float(FORTRAN.sub("e", field.strip()).replace(",", "."))
    except ValueError:
        return math.nan


def _file_numbers(files: Sequence[Path]) -> list[float]:
    """Return the number of each file of a series: the last number in its name that is another one in each file. If no
    name has a number, files are counted; NaN if numbers are not different, or are missing in some names."""
    found = [[float(number) for number in re.findall(r"\d+", name)] for name in short_names(files)]
    differing = [[*numbers] for numbers in zip(*found) if len(set(numbers)) == len(files)]
    if differing:
        return differing[-1]
    return [math.nan] * len(files) if any(found) else [float(number) for number in range(len(files))]


# ---- numbers


def _read(file: Path, heading: Heading, places: Mapping[str, int], ids: dict[str, float],
          ) -> tuple[dict[str, np.ndarray], list[int]]:
    """Return the columns of a file by name, and the number of rows of each zone of a Tecplot file without times."""
    with io.TextIOWrapper(_bytes(file), heading.encoding, errors="replace") as text:
        if not heading.zones:
            for _ in heading.lines:
                next(text)
            return _values(text, heading, places, ids), []
        whole = text.read()
    _, *split = ZONE.split(whole)
    del whole
    rows: list[int] = []
    parts = []
    for head, body in zip(split[::2], split[1::2]):
        begun = len(re.findall(r"(?im)^\s*zone\b", head))
        rows += [0] * (begun if rows else max(begun, 1))
        if not body.strip():
            continue
        parts.append(_values(io.StringIO(body), heading, places, ids))
        rows[-1] += len(parts[-1]["x"])
        stated = SOLUTION_TIME.findall(head)
        if stated and "time" not in places:
            parts[-1]["time"] = np.full(len(parts[-1]["x"]), float(FORTRAN.sub("e", stated[-1])))
    if 0 < sum("time" in part for part in parts) < len(parts):
        raise ValueError(f"{file.name}: some zones have a SOLUTIONTIME and others have none; give it in all zones")
    return {name: _joined([part[name] for part in parts]) for name in parts[0]}, rows


def _values(lines: TextIO, heading: Heading, places: Mapping[str, int], ids: dict[str, float]) -> dict[str, np.ndarray]:
    """Read rows to the end. Ids that are texts are numbered by `ids`. Raises ValueError for a row without a number."""
    used = sorted({*places.values()})
    delimiter = None if heading.delimiter == " " else heading.delimiter
    place = places.get("track")
    texts = place is not None and any(
        math.isnan(_number(row[place])) and row[place].lower() not in NO_NAMES for row in heading.rows
        if len(row) > place)
    numbering = ({number: _number for number in used if number != place} if any(
        FORTRAN.search(row[number]) for row in heading.rows for number in used if place != number < len(row)) else {})
    if texts:
        numbering[place] = lambda entry: (NO_ID if entry.strip().lower() in NO_NAMES or _number(entry) < 0
                                          else ids.setdefault(entry.strip(), float(len(ids))))
    if pandas is None:
        points = (line.replace(",", ".") for line in lines) if heading.decimal == "," else lines
        if place is not None and not texts:  # the id of a row without a track may be empty
            numbering[place] = lambda entry: NO_ID if entry.lower() in NO_NAMES else float(entry)
        table = np.loadtxt(points, delimiter=delimiter, usecols=used, ndmin=2, quotechar='"',
                           converters=numbering or None)
        found = dict(zip(used, table.T))
    else:
        frame = pandas.read_csv(lines, sep=delimiter or r"\s+", header=None, usecols=used, decimal=heading.decimal,
                                skipinitialspace=True, comment="#", converters=numbering,
                                dtype={number: float for number in used if number not in numbering})
        found = {number: frame.pop(number).to_numpy() for number in used}
    for name, number in places.items():
        bad = np.flatnonzero(~np.isfinite(found[number]))
        if name == "track":
            found[number] = np.where(np.isnan(found[number]), NO_ID, found[number])
        elif len(bad):
            raise ValueError(f"row {bad[0] + 1} has no number in the column of {name} ({len(bad)} such rows); complete "
                             "these rows, or leave them out")
    return {name: found[number] for name, number in places.items()}


def _joined(arrays: Sequence[np.ndarray]) -> np.ndarray:
    return arrays[0] if len(arrays) == 1 else np.concatenate(arrays)
