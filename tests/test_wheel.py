"""An installed library has all that it reads: a wheel built from the source distribution, imported on its own."""

import os
import shutil
import subprocess
import sys
import zipfile
from importlib.metadata import Distribution
from pathlib import Path

import pytest

from pipeline.__main__ import main

REPOSITORY = Path(__file__).parent.parent
READ = """
import json
from pathlib import Path
import pipeline
from pipeline.commands.develop import schemas
from pipeline.axes.language import load_bank
from pipeline.catalogue.objects import models
from pipeline.episode_schema import SCHEMA
from pipeline.files import schema_file
from pipeline.clients.recipe import TEMPLATES
from pipeline.publish import card
from pipeline.run import manifest

assert SCHEMA.fps_hz == 20 and manifest.schema().names and load_bank() and models(("libero",))
assert json.loads(schema_file("config.schema.json").read_text()) == schemas()["config.schema.json"]
for file in (pipeline.__file__, schema_file("episode.json"), TEMPLATES / "run_openvla_oft.py"):
    print(Path(file).is_file(), file)
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that holds what the wheel would put into site-packages, and nothing else."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    source.mkdir()
    for name in ("pipeline", "schemas", "pyproject.toml", "setup.py", "README.md", "LICENSE"):
        path = REPOSITORY / name
        (shutil.copytree if path.is_dir() else shutil.copy)(path, source / name)
    build_sdist = f"from setuptools import build_meta; build_meta.build_sdist({str(folder)!r})"
    subprocess.run([sys.executable, "-c", build_sdist], cwd=source, check=True, capture_output=True)
    (archive,) = folder.glob("*.tar.gz")
    options = ["--no-deps", "--no-build-isolation", "--no-index", "--wheel-dir", str(folder)]
    subprocess.run([sys.executable, "-m", "pip", "wheel", *options, str(archive)], check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as content:
        content.extractall(folder / "site-packages")
    return folder / "site-packages"


def test_an_installed_library_reads_its_own_files(installed: Path, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", READ],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(installed)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    for line in done.stdout.splitlines():
        assert line.startswith(f"True {installed}{os.sep}pipeline{os.sep}"), line


def test_the_wheel_holds_every_file_of_the_library_and_nothing_else(installed: Path) -> None:
    def files(folder: Path) -> set[str]:
        paths = (path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
        return {path.as_posix() for path in paths if "__pycache__" not in path.parts}

    expected = files(REPOSITORY / "pipeline") | {f"schemas/{name}" for name in files(REPOSITORY / "schemas")}
    assert files(installed / "pipeline") == expected
    assert sorted(path.name.partition("-")[0] for path in installed.iterdir()) == ["perturbed_libero", "pipeline"]


def test_the_wheel_brings_a_command_of_its_own_name(installed: Path) -> None:
    (information,) = installed.glob("*.dist-info")
    (command,) = Distribution.at(information).entry_points.select(group="console_scripts")
    assert command.name == "perturbed-libero"
    assert command.load() is main
