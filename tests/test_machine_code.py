"""Machine code is the fixed one wherever results must be reproducible, and an import changes nothing."""

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from checkout import REPOSITORY, SCRIPTS

from pipeline.machine_code import FIXED, MACHINE_CODE_VARIABLES

OTHER = {"OPENBLAS_CORETYPE": "Sandybridge"}
"""A choice that a process without the fixed variables may make, on any processor that the fixed ones are meant for."""

REPORT_AT_EXIT = """
import atexit, os, sys
report = lambda: print("ended with", os.environ.get("OPENBLAS_CORETYPE"), sys.argv[1:], file=sys.stderr)
atexit.register(report)
"""
"""Module that Python imports when it starts. A process that starts itself again does not reach its exit."""


def run_with_other_code(*command: object, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a program in an environment without the fixed variables."""
    without_variables = {name: value for name, value in os.environ.items() if name not in MACHINE_CODE_VARIABLES}
    words = [sys.executable, *map(str, command)]
    everything = without_variables | OTHER | environment
    return subprocess.run(words, env=everything, capture_output=True, text=True, check=False)


@pytest.mark.slow
def test_imports_change_no_environment_variable_and_work_in_any_order() -> None:
    script = """
import os
import numpy
import pkgutil, pipeline
watched = ("MUJOCO", "PYOPENGL", "LP_NUM", "OMP_", "OPENBLAS", "NPY_", "MALLOC", "NUMBA")  # third parties set others
set_now = lambda: {name: value for name, value in os.environ.items() if name.startswith(watched)}
before = set_now()
not_imported = ("pipeline.__main__", "pipeline.evaluation.lerobot_eval")  # a program; needs another lerobot
for module in pkgutil.walk_packages(pipeline.__path__, "pipeline."):
    if "templates" not in module.name and module.name not in not_imported:
        __import__(module.name)
        assert set_now() == before, module.name
import sys
print(len([name for name in sys.modules if name.startswith("pipeline.")]))
"""
    done = run_with_other_code("-W", "error::RuntimeWarning", "-c", script)
    assert (done.returncode, done.stderr) == (0, "")
    assert int(done.stdout) > 180


@pytest.mark.slow
@pytest.mark.parametrize(
    "program",
    [
        ["-m", "pipeline", "tasks", "--help"],
        [SCRIPTS / "perturbed-libero", "tasks", "--help"],
        [REPOSITORY / "stages" / "plan.py", "--help"],
        [REPOSITORY / "benchmarks" / "disk.py", "--help"],
    ],
    ids=["module", "installed command", "stage", "benchmark"],
)
def test_a_program_starts_itself_once_with_the_variables(program: list[object], tmp_path: Path) -> None:
    (tmp_path / "sitecustomize.py").write_text(REPORT_AT_EXIT)
    done = run_with_other_code(*program, PYTHONPATH=str(tmp_path))
    assert done.returncode == 0, done.stderr
    assert "usage:" in done.stdout.lower()
    arguments = [str(word) for word in program if str(word) in ("tasks", "--help")]
    assert done.stderr == f"ended with {MACHINE_CODE_VARIABLES['OPENBLAS_CORETYPE']} {arguments}\n"


def test_a_program_starts_itself_once_also_where_every_start_sets_other_machine_code(tmp_path: Path) -> None:
    overriding = f"import os; os.environ.update({OTHER})\n{REPORT_AT_EXIT}"
    (tmp_path / "sitecustomize.py").write_text(overriding)
    done = run_with_other_code("-m", "pipeline", "tasks", "--help", PYTHONPATH=str(tmp_path))
    assert done.returncode == 0
    assert done.stderr == "ended with Sandybridge ['tasks', '--help']\n"


# Readers of finished files, a probe of OpenGL, and a stand-in that another program starts.
WITHOUT_COMPUTATION = {"back_project", "load_rlds", "gl", "rehearsal_stand_ins", "recording_server", "faulty_server"}


def test_every_program_of_this_project_starts_itself_with_the_variables() -> None:
    files = subprocess.run(["git", "ls-files", "*.py"], cwd=REPOSITORY, capture_output=True, text=True, check=True)
    programs = []
    for path in map(Path, files.stdout.split()):
        text = (REPOSITORY / path).read_text()
        uses_project = re.search(
            r"^ *(from|import) (pipeline|conftest|checkout|faults|short_demonstrations|short_runs)\b",
            text,
            re.MULTILINE,
        )
        is_program = "__main__" in text and re.search(r'^if __name__ == "__main__":', text, re.MULTILINE)
        if uses_project and is_program and "templates" not in path.parts and not path.name.startswith("test_"):
            programs.append((path.stem, text))
    assert len(programs) > 40
    unprepared = {
        name for name, text in programs if not re.search(r"(ensure_fixed_machine_code|perform_stage)\(", text)
    }
    assert unprepared == WITHOUT_COMPUTATION


@pytest.mark.slow
def test_no_file_is_stored_or_identified_with_other_machine_code() -> None:
    script = """
from pathlib import Path
from pipeline.errors import PipelineError
from pipeline.identity import made_with
from pipeline.stores.trajectory_store import TrajectoryStore
for use in (lambda: TrajectoryStore(Path("none")), lambda: made_with("physics")):
    try:
        use()
    except PipelineError as error:
        print(error)
"""
    done = run_with_other_code("-c", script)
    assert done.stdout.count("NumPy computes with Sandybridge") == 2, done.stderr

    # Follow the remedy of the message.
    variables = dict(re.findall(r'(\w+)="([^"]*)"', done.stdout))
    assert variables == MACHINE_CODE_VARIABLES
    script = "import numpy; from pipeline.identity import made_with; print(made_with('physics')['machine code'])"
    done = run_with_other_code("-c", script, **variables)
    assert (done.stdout.strip(), done.stderr) == (FIXED, "")


@pytest.mark.slow
def test_no_demonstration_is_replayed_with_other_machine_code() -> None:
    script = """
from pipeline.config import ReplayConfig
from pipeline.libero.demonstrations import StarterSource
from pipeline.libero.tasks import find_task
from pipeline.physics.environment import environment_of
from pipeline.physics.replay import replay
task = find_task("libero_goal", "turn_on_the_stove")
replay(environment_of(task), StarterSource().demonstration(task), "clean", ReplayConfig())
"""
    done = run_with_other_code("-c", script)
    assert "NumPy computes with Sandybridge" in done.stderr


@pytest.mark.slow
def test_tests_and_documentation_have_the_variables() -> None:
    assert tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["tool"]["pytest_env"] == MACHINE_CODE_VARIABLES
    text = (REPOSITORY / "docs" / "cost.md").read_text()
    for name, value in MACHINE_CODE_VARIABLES.items():
        assert f'export {name}="{value}"\n' in text
