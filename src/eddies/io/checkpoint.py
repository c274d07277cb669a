"""Checkpoints: directories step-NNNNNNNN of a file state.h5 and a manifest, complete and undamaged or not used.

state.h5 holds global arrays that do not depend on the number of ranks. The manifest is written last, then the directory
gets its name.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from eddies.cores import threads
from eddies.io.contiguous import Block, lay_out, total_bytes, write_arrays
from eddies.io.errors import WriteError, wanted_and_free
from eddies.io.hdf5 import in_files
from eddies.io.manifest import manifest_text, parse_manifest
from eddies.io.reading import open_to_read
from eddies.io.verification import add_checksums, find_damage, known_sums
from eddies.kernels.library import in_use
from eddies.parallel.broadcast import first_complaint, on_all_ranks, on_first_rank

log = logging.getLogger("eddies")

KEPT = 3
STATE, MANIFEST = "state.h5", "manifest.json"
# The dataset of what is no array.
PLAIN = "plain"
# Of the layout of a checkpoint: others are not used. To be raised with that of the products too: frames are such.
FORMAT = 9


@dataclass(frozen=True)
class Checkpoint(Mapping):
    """A checkpoint whose bytes have been found to be as written: a state by name, as it was given to `write`."""

    path: Path
    content: Mapping[str, Any]

    @property
    def files(self) -> list[str]:
        """The files beside the checkpoint that belong to it."""
        return list(self.content["files"])

    @cached_property
    def _plain(self) -> dict[str, Any]:
        """What is no array."""
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


def _computed_by() -> str:
    """What else the bits of a run depend on, beside its settings and ranks."""
    return f"compiled kernels: {in_use()}, threads a rank: {threads()}"


class CheckpointDirectory:
    """The checkpoints of a run, made with settings of a `fingerprint`. All methods are collective, and all ranks raise
    a WriteError where rank 0 cannot write or remove a file."""

    def __init__(self, comm: MPI.Comm, path: Path, fingerprint: str) -> None:
        self.comm, self.path, self.fingerprint = comm, path, fingerprint

    def write(self, step: int, state: Mapping[str, Any], files: Sequence[str] = ()) -> None:
        """Add a checkpoint of a state, and keep the newest few.

        The state holds, by name, arrays, blocks of arrays that are shared by the ranks, and what JSON can hold; all but
        the blocks are equal on all ranks. `files` are names of closed files in this directory that belong to it.

        Raises WriteError if it cannot be written, as on a full disk; those before it are intact.
        """
        final, partial = self.path / _name(step), self.path / f"{_name(step)}.partial"
        if self._exists(final):
            return
        arrays = {name: part for name, part in state.items() if isinstance(part, np.ndarray | Block)}
        plain = {name: part for name, part in state.items() if name not in arrays}
        arrays = {PLAIN: np.frombuffer(json.dumps(plain).encode(), np.uint8), **arrays}
        try:
            on_first_rank(self.comm, lambda: _make_empty(partial))
            regions = on_first_rank(self.comm, lambda: lay_out(partial / STATE, arrays))
            on_all_ranks(self.comm, lambda: write_arrays(self.comm.rank, partial / STATE, regions, arrays))
            add_checksums(self.comm, partial / STATE)
            content = {"step": step, "format": FORMAT, "fingerprint": self.fingerprint, "computed_by": _computed_by()}
            on_first_rank(self.comm, lambda: _finish(partial, final, content, files))
        except OSError as error:
            if self.comm.rank == 0:
                shutil.rmtree(partial, ignore_errors=True)
            lack = wanted_and_free(final, total_bytes(arrays))
            raise WriteError(f"{final}: cannot be written ({error.strerror or error}; {lack}); the checkpoints before "
                             "it are intact: once there is room, run the command again") from None
        for name in self._names()[KEPT:]:
            in_files(self.comm, self.path / name, lambda: _delete(self.path / name))

    def newest(self) -> Checkpoint | None:
        """The newest sound checkpoint made with these settings; all else in the directory is removed, with a warning
        where it was no leftover of a broken writing."""
        names, found = self._names(), None
        while names and found is None:
            content, complaint = self._examine(self.path / names[0])
            if complaint is None:
                found = Checkpoint(self.path / names[0], content)
                self._compare(content["computed_by"])
                break
            if self.comm.rank == 0:
                log.warning("%s; this checkpoint is not used", complaint)
            names.pop(0)
        self._clean(set() if found is None else {*names, *found.files})
        return found

    def remove(self) -> None:
        """Remove the directory."""
        self.comm.Barrier()  # a rank may still read what is in it
        in_files(self.comm, self.path, lambda: shutil.rmtree(self.path) if self.path.exists() else None)

    def _examine(self, path: Path) -> tuple[dict[str, Any] | None, str | None]:
        manifest = path / MANIFEST
        content = parse_manifest(manifest.read_bytes()) if manifest.is_file() else None
        # All ranks must read the same before they compare hashes together.
        complaint = f"{manifest}: missing, or not what was written" if content is None else None
        complaint = first_complaint(self.comm, complaint)
        if complaint is None and content.get("format") != FORMAT:
            complaint = f"{path}: was made by another version of eddies"
        if complaint is None and content["fingerprint"] != self.fingerprint:
            complaint = f"{path}: was made with other settings"
        if complaint is None:
            complaint = find_damage(self.comm, path / STATE, content["state"])
        for name, known in content["files"].items() if complaint is None else ():
            complaint = complaint or find_damage(self.comm, self.path / name, known)
        return content, complaint

    def _compare(self, then: str) -> None:
        if self.comm.rank == 0 and then != _computed_by():
            log.warning("the checkpoint was made with %s; now there are %s: the run goes on, but not bit for bit as it "
                        "would have", then, _computed_by())

    def _names(self) -> list[str]:
        """Checkpoints, the newest first, as rank 0 sees them."""
        return on_first_rank(self.comm, lambda: sorted(
            (path.name for path in self.path.glob("step-*") if path.suffix != ".partial"), reverse=True))

    def _exists(self, path: Path) -> bool:
        return on_first_rank(self.comm, path.exists)

    def _clean(self, kept: set[str]) -> None:
        def clean() -> None:
            for path in self.path.iterdir() if self.path.exists() else ():
                if path.name not in kept:
                    _delete(path)

        in_files(self.comm, self.path, clean)


def checkpoints_in(path: Path) -> list[tuple[int, str]]:
    """Step and fingerprint of the settings of each checkpoint in a directory, the newest first, by the manifests that
    are as written; "" of one of another format. One rank calls it."""
    manifests = [folder / MANIFEST for folder in sorted(path.glob("step-*"), reverse=True) if not folder.suffix]
    contents = [parse_manifest(manifest.read_bytes()) for manifest in manifests if manifest.is_file()]
    return [(content["step"], content["fingerprint"] if content.get("format") == FORMAT else "")
            for content in contents if content is not None]


def _name(step: int) -> str:
    return f"step-{step:08d}"


def _make_empty(directory: Path) -> None:
    """Make a directory, in place of any that has its name."""
    shutil.rmtree(directory, ignore_errors=True)
    directory.mkdir(parents=True)


def _delete(path: Path) -> None:
    if path.is_dir():
        # Renamed first: what is half deleted no longer looks like a checkpoint.
        dying = path.with_name(path.name.removesuffix(".partial") + ".partial")
        shutil.rmtree(path.rename(dying))
    else:
        path.unlink()


def _finish(partial: Path, final: Path, content: Mapping[str, Any], files: Sequence[str]) -> None:
    """Write the manifest, wait for the disk, and give the checkpoint its name."""
    known = {name: known_sums(final.parent / name) for name in files}
    manifest = manifest_text({**content, "state": known_sums(partial / STATE), "files": known})
    (partial / MANIFEST).write_text(manifest, encoding="utf-8")
    for path in (*(final.parent / name for name in files), partial / STATE, partial / MANIFEST, partial):
        _sync(path)
    partial.rename(final)
    _sync(final.parent)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
