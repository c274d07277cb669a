"""Checkpoints: directories step-NNNNNNNN with a file state.h5 and a manifest. A damaged checkpoint is not used.

state.h5 holds global arrays, which do not depend on the number of ranks. It is written as io/new_files.py says. The
manifest holds the settings' fingerprint, the checksums of state.h5 and of files beside the checkpoint, and a hash of
itself. It is written last; then the directory gets its name.
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import os
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from mpi4py import MPI

from eddies.cores import threads
from eddies.io.checksums import find_damage, known_sums, open_to_read
from eddies.io.errors import WriteError, file_errors
from eddies.io.frame_segments import FrameSegments
from eddies.io.hdf5 import in_files, write_block
from eddies.io.new_files import HEADER_BYTES, new_file, own_part, writing
from eddies.kernels.library import in_use
from eddies.parallel.broadcast import on_all_ranks, on_first_rank, share_text
from eddies.parallel.stop import Stopped, StopRequest

log = logging.getLogger("eddies")

KEPT = 3
STATE, MANIFEST = "state.h5", "manifest.json"
PLAIN = "plain"  # the dataset of everything that is not an array, as JSON
FORMAT = 9  # of the layout; other checkpoints are not used. Raise it also with the format of products: frames are such.


@dataclass(frozen=True)
class Block:
    """This rank's part of a global array: rows start, start + 1, ... of `total` along an axis; maybe none."""

    values: np.ndarray
    start: int
    total: int
    axis: int = 0


@dataclass(frozen=True)
class Checkpoint(Mapping):
    """A sound checkpoint: the state that was given to `CheckpointDirectory.write`, by name."""

    path: Path
    content: Mapping[str, Any]

    @property
    def files(self) -> list[str]:
        """The files beside the checkpoint that belong to it."""
        return list(self.content["files"])

    @cached_property
    def _plain(self) -> dict[str, Any]:
        return json.loads(self.read(PLAIN).tobytes())

    def __getitem__(self, name: str) -> Any:
        return self._plain[name] if name in self._plain else self.read(name)

    def __iter__(self) -> Iterator[str]:
        with open_to_read(self.path / STATE) as file:
            yield from [*self._plain, *(name for name in file if name != PLAIN)]

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def read(self, name: str, start: int = 0, stop: int | None = None, axis: int = 0) -> np.ndarray:
        """Rows start to stop of an array along an axis; every rank reads what it needs."""
        with open_to_read(self.path / STATE) as file:
            return file[name][(slice(None),) * axis + (slice(start, stop),)]


class CheckpointDirectory:
    """The checkpoints of a run whose settings have this fingerprint. All methods are collective, and raise WriteError
    on all ranks if a file cannot be written or removed."""

    def __init__(self, comm: MPI.Comm, path: Path, fingerprint: str) -> None:
        self.comm, self.path, self.fingerprint = comm, path, fingerprint

    def write(self, step: int, state: Mapping[str, Any], files: Sequence[str] = ()) -> None:
        """Add a checkpoint, and keep the newest few. If it cannot be written, the earlier ones are intact.

        `state` holds `Block`s of arrays, and arrays and values for JSON, of which those of rank 0 count: the ranks may
        have measured different times. `files` names closed files in this directory that belong to the checkpoint.
        """
        final, partial = self.path / _name(step), self.path / f"{_name(step)}.partial"
        if on_first_rank(self.comm, final.exists):
            return
        arrays = {name: part for name, part in state.items() if isinstance(part, np.ndarray | Block)}
        plain = json.dumps({name: part for name, part in state.items() if name not in arrays})
        plain = share_text(self.comm, plain)  # HDF5 needs equal lengths
        arrays = {PLAIN: np.frombuffer(plain.encode(), np.uint8), **arrays}
        content = {"step": step, "format": FORMAT, "fingerprint": self.fingerprint, "computed_by": _computed_by()}
        try:
            in_files(self.comm, partial, lambda: _make_empty(partial))
            with new_file(self.comm, partial / STATE) as file:
                for name, array in arrays.items():
                    if not isinstance(array, Block):
                        array = Block(array if self.comm.rank == 0 else array[:0], 0, len(array))
                    _write_array(file, name, array)
            with file_errors(partial):
                on_all_ranks(self.comm, lambda: _sync(partial / STATE))  # on every node
            in_files(self.comm, final, lambda: _finish(partial, final, content, files))
        except WriteError as error:
            if self.comm.rank == 0:
                shutil.rmtree(partial, ignore_errors=True)
            raise WriteError(f"{error}; the checkpoints before step {step} are intact") from None
        for name in self._names()[KEPT:]:
            in_files(self.comm, self.path / name, lambda: _delete(self.path / name))

    def newest(self) -> Checkpoint | None:
        """The newest sound checkpoint with these settings. Everything else in the directory is removed; a warning says
        why a complete checkpoint is not used."""
        names, newest = self._names(), None
        while names and newest is None:
            content, complaint = self._examine(self.path / names[0])
            if complaint is None:
                newest = Checkpoint(self.path / names[0], content)
                break
            if self.comm.rank == 0:
                log.warning("%s; this checkpoint is not used", complaint)
            names.pop(0)
        if newest is not None and self.comm.rank == 0 and newest.content["computed_by"] != _computed_by():
            log.warning("the checkpoint was made with %s; now there are %s: the run continues, but not bit for bit",
                        newest.content["computed_by"], _computed_by())
        kept = set() if newest is None else {*names, *newest.files}

        def clean() -> None:
            for path in self.path.iterdir() if self.path.exists() else ():
                if path.name not in kept:
                    _delete(path)

        in_files(self.comm, self.path, clean)
        return newest

    def remove(self) -> None:
        """Remove the directory."""
        self.comm.Barrier()  # other ranks may still read a file in it
        in_files(self.comm, self.path, lambda: shutil.rmtree(self.path) if self.path.exists() else None)

    def _examine(self, path: Path) -> tuple[dict[str, Any] | None, str | None]:
        """The manifest's content, and why the checkpoint cannot be used, or None; the same on all ranks."""
        manifest = path / MANIFEST
        content = in_files(self.comm, manifest, lambda: (
            _parse_manifest(manifest.read_bytes()) if manifest.is_file() else None))
        if content is None:
            return None, f"{manifest}: missing, or not what was written"
        if content.get("format") != FORMAT:
            return None, f"{path}: was made by another version of eddies"
        if content["fingerprint"] != self.fingerprint:
            return None, f"{path}: was made with other settings"
        files = {path / STATE: content["state"],
                 **{self.path / name: known for name, known in content["files"].items()}}
        complaints = (find_damage(self.comm, file, known) for file, known in files.items())
        return content, next(filter(None, complaints), None)

    def _names(self) -> list[str]:
        """The checkpoints, the newest first."""
        return on_first_rank(self.comm, lambda: sorted(
            (path.name for path in self.path.glob("step-*") if path.suffix != ".partial"), reverse=True))


class Guard:
    """Write checkpoints when they are due, and stop the run on request. All methods are collective.

    `of`, added to the message of a stop, says what the steps belong to.
    """

    def __init__(self, comm: MPI.Comm, directory: Path, fingerprint: str, stop: StopRequest | None,
                 of: str = "") -> None:
        self.checkpoints = CheckpointDirectory(comm, directory, fingerprint)
        self.stop, self.of = stop or StopRequest(comm), of

    def __call__(self, run: Any, segments: FrameSegments | None = None) -> None:
        """Call it before each step of a `run` with `steps` and `state_dict()`, whose frames go to `segments`.

        Raises Stopped after the checkpoint is complete.
        """
        stopping = self.stop()
        if self.stop.checkpoint_due:
            self.save(run, segments)
            self.stop.checkpoint_done()
        if stopping:
            raise Stopped(self.stop.reason, f"from step {run.steps}{self.of}")

    def save(self, run: Any, segments: FrameSegments | None = None) -> None:
        """Write a checkpoint of the present state."""
        began = time.perf_counter()
        if segments is not None:
            segments.close()
        self.checkpoints.write(run.steps, run.state_dict(), () if segments is None else segments.names)
        log.debug("checkpoint of step %d%s: %.3f s", run.steps, self.of, time.perf_counter() - began)


def checkpoints_in(path: Path) -> list[tuple[int, str]]:
    """Step and fingerprint of each checkpoint in a directory, the newest first; on one rank.

    Only the manifests are checked. The fingerprint is "" for a checkpoint of another format.
    """
    manifests = [folder / MANIFEST for folder in sorted(path.glob("step-*"), reverse=True) if not folder.suffix]
    contents = [_parse_manifest(manifest.read_bytes()) for manifest in manifests if manifest.is_file()]
    return [(content["step"], content["fingerprint"] if content.get("format") == FORMAT else "")
            for content in contents if content is not None]


def _computed_by() -> str:
    """The kernels and threads; a result depends on them in its last bits."""
    return f"compiled kernels: {in_use()}, threads a rank: {threads()}"


def _name(step: int) -> str:
    return f"step-{step:08d}"


def _write_array(file: h5py.File, name: str, block: Block) -> None:
    """Write a global array from the blocks of all ranks.

    Blocks that are cut along a later axis than the first are written one component at a time: MPI counts bytes in 32
    bits, and a single writer holds in memory what is written at once.
    """
    values, axis = block.values, block.axis
    shape = (*values.shape[:axis], block.total, *values.shape[axis + 1:])
    with writing(file, math.prod(shape) * values.dtype.itemsize + HEADER_BYTES):
        dataset = file.create_dataset(name, shape, values.dtype)
    if 0 in shape:
        return  # HDF5 does not write an empty dataset collectively
    for lead in np.ndindex(shape[:min(axis, 1)]):
        offset = (0,) * (axis - len(lead)) + (block.start,) + (0,) * (values.ndim - axis - 1)
        part, offset = own_part(file, shape[len(lead):], np.ascontiguousarray(values[lead]), offset)
        with writing(file, 0):
            write_block(dataset, part[(None,) * len(lead)], (*lead, *offset))


def _manifest_text(content: Mapping[str, Any]) -> str:
    """A manifest with a hash of its content."""
    own = hashlib.blake2b(json.dumps(content).encode(), digest_size=32).hexdigest()
    return json.dumps({"blake2b": own, "content": content}, indent=1)


def _parse_manifest(text: bytes) -> dict[str, Any] | None:
    """The content of a manifest; None if any byte has changed."""
    try:
        content = json.loads(text)["content"]
        return content if _manifest_text(content).encode() == text else None
    except (ValueError, KeyError, TypeError):
        return None


def _make_empty(directory: Path) -> None:
    shutil.rmtree(directory, ignore_errors=True)
    directory.mkdir(parents=True)


def _delete(path: Path) -> None:
    if path.is_dir():
        # It is renamed first: a half-deleted directory must not look like a checkpoint.
        dying = path.with_name(path.name.removesuffix(".partial") + ".partial")
        shutil.rmtree(path.rename(dying))
    else:
        path.unlink()


def _finish(partial: Path, final: Path, content: Mapping[str, Any], files: Sequence[str]) -> None:
    """Write the manifest, wait until all files are on the disk, and give the checkpoint its name."""
    known = {name: known_sums(final.parent / name) for name in files}
    manifest = _manifest_text({**content, "state": known_sums(partial / STATE), "files": known})
    (partial / MANIFEST).write_text(manifest, encoding="utf-8")
    for path in (*(final.parent / name for name in files), partial / MANIFEST, partial):
        _sync(path)
    partial.rename(final)
    _sync(final.parent)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
