"""Keyed randomness: equal keys give equal numbers in any process, in any order."""

import hashlib
import json

import numpy as np

Key = str | int

_CANONICAL = json.JSONEncoder(sort_keys=True, separators=(",", ":"))


def digest(*key: object) -> str:
    """Return the SHA-256 (64 hex digits) of a JSON-serialisable key, in canonical form."""
    return hashlib.sha256(_CANONICAL.encode(key).encode()).hexdigest()


def rng(first: Key, *more: Key) -> np.random.Generator:
    """Return a Philox generator keyed by values such as ``(seed, axis, demo_id, variant)``.

    The key has no default, so nothing runs unseeded.
    """
    return np.random.Generator(np.random.Philox(key=int(digest(first, *more)[:32], 16)))
