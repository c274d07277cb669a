"""Checkpoints: files step-NNNNNNNN.h5 with global arrays, which do not depend on the number of ranks.

io/new_files.py describes how they are written. Everything that is not an array is stored together, as one dataset of
JSON. A damaged checkpoint (io/damage.py) is not used. Other files of the directory may belong to a checkpoint, which
then stores their ids.
"""

import json
import logging
import re
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from mpi4py import MPI

from eddies.cores import threads
from eddies.io.damage import find_damage, naming_damage, open_to_read
from eddies.io.errors import ContentError, ProductError, WriteError, read_errors
from eddies.io.frame_segments import FrameSegments
from eddies.io.hdf5 import empty_dataset, in_files, write_block
from eddies.io.new_files import new_file, writing
from eddies.io.provenance import read_json
from eddies.kernels.library import in_use
from eddies.parallel.broadcast import on_first_rank
from eddies.parallel.stop import Stopped, StopRequest

log = logging.getLogger("eddies")

KEPT = 3
NAME = re.compile(r"step-(\d{8,})(\.h5)?")
PLAIN = "plain"  # the dataset of everything that is not an array, as JSON
# Checkpoints of another format are not used. Raise this number also when FORMAT of io/provenance.py is raised, because
# the files with the frames of a checkpoint have that format.
FORMAT = 14


@dataclass(frozen=True)
class Block:
    """This rank's part of a global array with `total` rows along `axis`: the rows start, start + 1, ..., or no row."""

    values: np.ndarray
    start: int
    total: int
    axis: int = 0


@dataclass(frozen=True)
class Checkpoint(Mapping):
    """An undamaged checkpoint, which maps names to the arrays and values that `CheckpointDirectory.write` stored."""

    path: Path

    @cached_property
    def content(self) -> dict[str, Any]:
        """All that is not an array: a dict of `step`, `format`, `fingerprint`, `computed_by`, `values` and `files`.
        `values` maps the names of values to the values; `files` maps file names to ids."""
        return json.loads(self.read(PLAIN).tobytes())

    @property
    def files(self) -> list[str]:
        """Names of the files in the same directory that belong to the checkpoint."""
        return list(self.content["files"])

    def __getitem__(self, name: str) -> Any:
        return self.content["values"][name] if name in self.content["values"] else self.read(name)

    def __iter__(self) -> Iterator[str]:
        with open_to_read(self.path) as file:
            yield from [*self.content["values"], *(name for name in file if name != PLAIN)]

    def __contains__(self, name: object) -> bool:
        return name in list(self)  # reads no array, unlike the method of Mapping

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def read(self, name: str, start: int = 0, stop: int | None = None, axis: int = 0) -> np.ndarray:
        """Return rows start, ..., stop - 1 of an array along an axis. Not collective: each rank reads what it needs."""
        with open_to_read(self.path) as file, naming_damage(self.path):
            return file[name][(slice(None),) * axis + (slice(start, stop),)]


class CheckpointDirectory:
    """The checkpoints of a run whose settings have this fingerprint. All methods are collective, and raise WriteError
    on all ranks if a file cannot be written or removed."""

    def __init__(self, comm: MPI.Comm, path: Path, fingerprint: str) -> None:
        self.comm, self.path, self.fingerprint = comm, path, fingerprint

    def write(self, step: int, state: Mapping[str, Any], files: Sequence[str] = ()) -> None:
        """Add a checkpoint, and keep only the KEPT newest. If it cannot be written, earlier checkpoints stay intact.

        `state` holds, by name, `Block`s of arrays, whole arrays, and values for JSON. Whole arrays and values are taken
        from rank 0; those of other ranks, such as measured times, may differ. `files` are names of closed files of the
        directory that belong to the checkpoint. An undamaged checkpoint of this step and these settings is kept, and
        any other one of this step is replaced.
        """
        path = self.path / f"step-{step:08d}.h5"
        arrays = {name: part for name, part in state.items() if isinstance(part, np.ndarray | Block)}
        values = {name: part for name, part in state.items() if name not in arrays}

        def begin() -> str:
            self.path.mkdir(parents=True, exist_ok=True)
            return json.dumps({"step": step, "format": FORMAT, "fingerprint": self.fingerprint,
                               "computed_by": _computed_by(), "values": values,
                               "files": {name: _identity(self.path / name) for name in files}})

        if on_first_rank(self.comm, path.exists) and self._complaint(path) is None:
            return
        try:
            plain = in_files(self.comm, path, begin)
            with new_file(self.comm, path) as file:
                for name, array in {PLAIN: np.frombuffer(plain.encode(), np.uint8), **arrays}.items():
                    if not isinstance(array, Block):
                        array = Block(array if self.comm.rank == 0 else array[:0], 0, len(array))
                    _write_array(file, name, array)
        except WriteError as error:
            raise WriteError(f"{error}; the checkpoints before step {step} are intact") from None
        in_files(self.comm, self.path, lambda: [old.unlink() for old in _newest_first(self.path)[KEPT:]])

    def newest(self) -> Checkpoint | None:
        """Return the newest undamaged checkpoint with this fingerprint, or None. This checkpoint, its files and older
        checkpoints are kept; everything else in the directory is removed. A warning says why newer ones are not used.

        Raises ProductError, and removes nothing, if the system refuses to read a file: the file may be undamaged.
        """
        paths = in_files(self.comm, self.path, lambda: _newest_first(self.path))
        while paths and (complaint := self._complaint(paths[0])):
            if self.comm.rank == 0:
                log.warning("%s; this checkpoint is not used", complaint)
            paths.pop(0)
        newest = Checkpoint(paths[0]) if paths else None
        if newest is not None and self.comm.rank == 0 and newest.content["computed_by"] != _computed_by():
            log.warning("the checkpoint was made with %s, but this run has %s; the run continues, and the last digits "
                        "of results may differ", newest.content["computed_by"], _computed_by())
        kept = {path.name for path in paths}.union(() if newest is None else newest.files)

        def clean() -> None:
            for path in self.path.iterdir() if self.path.exists() else ():
                if path.name not in kept:
                    shutil.rmtree(path) if path.is_dir() else path.unlink()

        in_files(self.comm, self.path, clean)
        return newest

    def remove(self) -> None:
        """Remove the directory."""
        self.comm.Barrier()  # other ranks may still read a file in it
        in_files(self.comm, self.path, lambda: shutil.rmtree(self.path) if self.path.exists() else None)

    def _complaint(self, path: Path) -> str | None:
        """Return why a checkpoint cannot be used, or None; the same on all ranks."""
        content = in_files(self.comm, path, lambda: _content(path))
        if content is None:
            return find_damage(self.comm, path) or f"{path}: is not a checkpoint"
        if content["format"] != FORMAT:
            return f"{path}: was made by another version of eddies"
        if content["fingerprint"] != self.fingerprint:
            return f"{path}: was made with other settings"
        for name, known in content["files"].items():
            if on_first_rank(self.comm, lambda name=name: _identity(self.path / name)) != known:
                return f"{self.path / name}: is missing, or is not the file that was written"
        files = [path, *(self.path / name for name in content["files"])]
        return next(filter(None, (find_damage(self.comm, file) for file in files)), None)


class Guard:
    """Writes the checkpoints that are due, and stops the run on request. All methods are collective.

    Messages give the step number followed by `of`: "step 40 of the training" if `of` is " of the training".
    """

    def __init__(self, comm: MPI.Comm, directory: Path, fingerprint: str, stop: StopRequest | None,
                 of: str = "") -> None:
        self.checkpoints = CheckpointDirectory(comm, directory, fingerprint)
        self.stop, self.of = stop or StopRequest(comm), of

    def __call__(self, run: Any, segments: FrameSegments | None = None) -> None:
        """Write a checkpoint if one is due; to be called before each step.

        `run` has the attribute `steps`, its step number, and the method `state_dict`; `segments` holds its frames. If
        the run has to stop, the call raises Stopped after the checkpoint is complete.
        """
        stopping = self.stop()
        if self.stop.checkpoint_due:
            self.save(run, segments)
            self.stop.checkpoint_done()
        if stopping:
            raise Stopped(self.stop.reason, f"continues from step {run.steps}{self.of}")

    def save(self, run: Any, segments: FrameSegments | None = None) -> None:
        """Close the open segment, if any, and write a checkpoint of the present state."""
        began = time.perf_counter()
        if segments is not None:
            segments.close()
        self.checkpoints.write(run.steps, run.state_dict(), () if segments is None else segments.names)
        log.debug("checkpoint of step %d%s: %.3f s", run.steps, self.of, time.perf_counter() - began)


def checkpoints_in(path: Path) -> list[tuple[int, str]]:
    """Return the step and the fingerprint of each readable checkpoint in a directory, the newest first; on one rank.

    The fingerprint is "" for a checkpoint of another format. ProductError if the system refuses to read a checkpoint.
    """
    contents = [content for each in _newest_first(path) if (content := _content(each)) is not None]
    return [(content["step"], content["fingerprint"] if content["format"] == FORMAT else "") for content in contents]


def _newest_first(directory: Path) -> list[Path]:
    """Return the checkpoints in a directory, the newest first. A checkpoint of eddies 1.0 is a directory itself."""
    paths = directory.iterdir() if directory.is_dir() else ()
    return sorted((path for path in paths if (name := NAME.fullmatch(path.name)) and path.is_dir() == (not name[2])),
                  key=_step_of, reverse=True)


def _identity(path: Path) -> str:
    """Return the id and the size of a product, as text. A product that replaces another may have the same id."""
    with suppress(ContentError), open_to_read(path) as file:
        return f"{read_json(file, 'provenance').get('id')}, {path.stat().st_size} bytes"
    return "missing or damaged"


def _step_of(path: Path) -> int:
    return int(NAME.fullmatch(path.name)[1])


def _content(path: Path) -> dict[str, Any] | None:
    """Return the content of a checkpoint; None if it is damaged. ProductError if the system refuses to read it."""
    try:
        with read_errors(path):
            return {"step": _step_of(path), "format": 0} if path.is_dir() else Checkpoint(path).content
    except ContentError:
        return None
    except ProductError:
        raise
    except (ValueError, KeyError, RuntimeError):
        return None


def _computed_by() -> str:
    """Return a text with the kernels and the number of threads. The last bits of a result depend on both."""
    return f"compiled kernels: {in_use()}, threads a rank: {threads()}"


def _write_array(file: h5py.File, name: str, block: Block) -> None:
    """Write a global array from the blocks of all ranks.

    If `axis` is not the first axis, one index of the first axis is written at a time. This keeps each written part
    small: MPI counts its bytes in 32 bits.
    """
    values, axis = block.values, block.axis
    shape = (*values.shape[:axis], block.total, *values.shape[axis + 1:])
    dataset = empty_dataset(file, name, shape, values.dtype)
    if 0 in shape:
        return  # HDF5 does not write an empty dataset collectively
    for lead in np.ndindex(shape[:min(axis, 1)]):
        offset = (0,) * (axis - len(lead)) + (block.start,) + (0,) * (values.ndim - axis - 1)
        with writing(file, 0):
            write_block(dataset, np.ascontiguousarray(values[lead])[(None,) * len(lead)], (*lead, *offset))
