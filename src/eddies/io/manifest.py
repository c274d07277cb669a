"""Manifests of checkpoints: JSON with a hash of itself, by which any damage is found."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any


def manifest_text(content: Mapping[str, Any]) -> str:
    """A manifest with a hash of itself, as it stands in the file."""
    own = hashlib.blake2b(json.dumps(content).encode(), digest_size=32).hexdigest()
    return json.dumps({"blake2b": own, "content": content}, indent=1)


def parse_manifest(text: bytes) -> dict[str, Any] | None:
    """The content of a manifest; None if any byte differs from what `manifest_text` gave."""
    try:
        content = json.loads(text)["content"]
        return content if manifest_text(content).encode() == text else None
    except (ValueError, KeyError, TypeError):
        return None
