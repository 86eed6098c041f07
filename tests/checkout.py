"""The checkout under test, copies of it, and its commands."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import yaml

from pipeline.testset import benchmark
from pipeline.testset.benchmark import fetch_testset

REPOSITORY = Path(__file__).parent.parent
SCRIPTS = Path(sys.executable).parent
IN_SCRIPTS = {**os.environ, "PATH": f"{SCRIPTS}{os.pathsep}{os.environ['PATH']}"}
"""Environment variables for DVC, whose stages call `python`."""


def link_testset(folder: Path) -> None:
    """Link the test set's wheel, which is downloaded once, into the folder of a run."""
    wheel = fetch_testset(REPOSITORY / benchmark.FOLDER)
    (folder / benchmark.FOLDER).parent.mkdir(parents=True, exist_ok=True)
    (folder / benchmark.FOLDER).symlink_to(wheel.parent)


def copy_of(name: str, source: Path, target: Path) -> None:
    """Copy a file or a folder to the same place below another folder, with its compiled code."""
    (target / name).parent.mkdir(parents=True, exist_ok=True)
    if (source / name).is_dir():
        shutil.copytree(source / name, target / name)
    else:
        shutil.copy(source / name, target / name)


def in_a_clone(config: dict[str, object], clone: Path) -> None:
    """Copy the part of the repository that a run needs, with a configuration."""
    for name in ("pipeline", "stages", "schemas", "dvc.yaml", "pyproject.toml", "requirements.lock", ".dvcignore"):
        copy_of(name, REPOSITORY, clone)
    (clone / "configs").mkdir()
    (clone / "configs" / "tiny.yaml").write_text(yaml.safe_dump(config))
    (clone / "params.yaml").write_text("run: tiny\ndata: data\n")
    shutil.copytree(REPOSITORY / ".dvc", clone / ".dvc", ignore=shutil.ignore_patterns("tmp", "cache"))
    link_testset(clone)
    subprocess.run(["git", "init", "--quiet"], cwd=clone, check=True)


def pipeline_command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "pipeline", *arguments]


def run_pipeline(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Call ``python -m pipeline`` in a folder."""
    command = pipeline_command(*arguments)
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, env=IN_SCRIPTS)


def dvc(clone: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [str(SCRIPTS / "dvc"), *arguments]
    return subprocess.run(command, cwd=clone, capture_output=True, text=True, check=False, env=IN_SCRIPTS)
