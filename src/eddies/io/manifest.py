"""Manifests: hashes of all bytes of some files, by which any damage is found before a file is read.

A file is a list of regions (a dataset each) and what lies between them, its metadata. Regions are hashed in pieces, so
that the ranks share the work.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from eddies.io.contiguous import Regions
from eddies.parallel.broadcast import first_complaint, on_all_ranks
from eddies.parallel.reduction import global_sum

PIECE_BYTES = 4 * 2**20
DIGEST_BYTES = 32


def hash_file(comm: MPI.Comm, path: Path, regions: Regions, size: int) -> dict[str, Any]:
    """The entry of a file in a manifest: its size and each region's place and hashes; collective.

    Raises OSError, on all ranks, if a rank cannot read the file.
    """
    pieces = list(_pieces(regions, size))
    digests = np.zeros((len(pieces), DIGEST_BYTES), np.uint8)

    def read() -> None:
        with open(path, "rb") as file:
            for number in range(comm.rank, len(pieces), comm.size):
                digests[number] = np.frombuffer(_hash(file, pieces[number][1]), np.uint8)

    on_all_ranks(comm, read)
    digests = global_sum(comm, digests)
    hashes: dict[str, list[str]] = {}
    for (name, _), digest in zip(pieces, digests):
        hashes.setdefault(name, []).append(digest.tobytes().hex())
    return {"bytes": size, "regions": {name: list(place) for name, place in regions.items()}, "blake2b": hashes}


def find_damage(comm: MPI.Comm, path: Path, entry: Mapping[str, Any]) -> str | None:
    """What is wrong with a file, in words that name file and dataset; None if every byte is as written. Collective."""
    size, complaint = path.stat().st_size if path.is_file() else None, None
    if size is None:
        complaint = f"{path}: missing"
    elif size != entry["bytes"]:
        cut = [name for name, (offset, count) in entry["regions"].items() if offset + count > size]
        complaint = (f"{path}: {size} bytes long, {entry['bytes']} were written; "
                     f"cut datasets: {', '.join(cut) or 'none'}")
    complaint = first_complaint(comm, complaint)  # before the ranks read it together
    if complaint is not None:
        return complaint
    try:
        found = hash_file(comm, path, entry["regions"], entry["bytes"])
    except OSError as error:
        return f"{path}: cannot be read ({error})"
    for name, hashes in entry["blake2b"].items():
        if found["blake2b"].get(name) != hashes:
            return f"{path}: dataset {name} is not what was written"
    return None


def manifest_text(content: Mapping[str, Any]) -> str:
    """A manifest with a hash of itself, as it stands in the file."""
    own = hashlib.blake2b(json.dumps(content).encode(), digest_size=DIGEST_BYTES).hexdigest()
    return json.dumps({"blake2b": own, "content": content}, indent=1)


def parse_manifest(text: bytes) -> dict[str, Any] | None:
    """The content of a manifest; None if any byte differs from what `manifest_text` gave."""
    try:
        content = json.loads(text)["content"]
        return content if manifest_text(content).encode() == text else None
    except (ValueError, KeyError, TypeError):
        return None


def _pieces(regions: Regions, size: int) -> Iterable[tuple[str, list[tuple[int, int]]]]:
    """Name and byte ranges of each piece; the last is all that no region covers."""
    rest, end = [], 0
    for name, (offset, count) in sorted(regions.items(), key=lambda item: item[1]):
        rest.append((end, offset - end))
        end = offset + count
        for start in range(offset, end, PIECE_BYTES):
            yield name, [(start, min(PIECE_BYTES, end - start))]
    yield "metadata", [*rest, (end, size - end)]


def _hash(file, ranges: list[tuple[int, int]]) -> bytes:
    digest = hashlib.blake2b(digest_size=DIGEST_BYTES)
    for offset, count in ranges:
        file.seek(offset)
        digest.update(file.read(count))
    return digest.digest()
