"""The machine code is the fixed one wherever this project computes, or it is said that it is another."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import REPOSITORY

from pipeline.machine_code import FIXED, SETTINGS

OTHER = {"OPENBLAS_CORETYPE": "Sandybridge"}
"""What a process without the fixed settings may choose, on any processor that the fixed ones are meant for."""

SCRIPTS = [
    file
    for folder in ("benchmarks", "examples", "stages", "tests")
    for file in sorted((REPOSITORY / folder).rglob("*.py"))
    if not file.name.startswith("test_")
    and re.search(r"^(from|import) (pipeline|conftest|arms)\b", file.read_text(), re.MULTILINE)
    and re.search(r"^if __name__ ==|^main\(", file.read_text(), re.MULTILINE)
]
"""What is run as a program and uses this project."""

# Imports what each script does until it reaches NumPy: then it is known which machine code that will choose.
UNTIL_NUMPY = """
import os, runpy, sys
import pydantic, yaml  # which take long, and import no NumPy

class Numpy:
    def find_spec(self, name, path=None, target=None):
        if name == "numpy":
            if "OPENBLAS_CORETYPE" not in os.environ or "NPY_DISABLE_CPU_FEATURES" not in os.environ:
                print(script, flush=True)
            os._exit(0)

sys.meta_path.insert(0, Numpy())
for script in sys.argv[1:]:
    if os.fork() == 0:
        folder = os.path.dirname(script)
        # A campaign of the tests puts the folder above it there too, as it is run.
        sys.path[:1] = [folder, os.path.dirname(folder)]
        runpy.run_path(script, run_name="imported")
        os._exit(0)
    os.wait()
"""


def python(script: str, *arguments: object, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a script in a process that does not inherit what importing this project has set here."""
    clean = {name: value for name, value in os.environ.items() if name not in SETTINGS}
    return subprocess.run(
        [sys.executable, "-c", script, *map(str, arguments)],
        env=clean | environment,
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.slow
def test_a_script_that_uses_this_project_imports_it_before_numpy() -> None:
    assert len(SCRIPTS) > 30
    done = python(UNTIL_NUMPY, *SCRIPTS)
    assert (done.stdout.splitlines(), done.stderr) == ([], "")


def test_an_example_computes_with_the_fixed_machine_code() -> None:
    imports = "import runpy, sys; runpy.run_path(sys.argv[1])"
    asked = "from pipeline.machine_code import machine_code; print(machine_code())"
    done = python(f"{imports}\n{asked}", REPOSITORY / "examples" / "add_axis.py", **OTHER)
    assert (done.stdout.strip(), done.stderr) == (FIXED, "")


def test_numpy_before_this_project_is_told_of_and_how_to_mend_it() -> None:
    done = python("import numpy, pipeline; print('imported')", **OTHER)
    assert done.stdout == "imported\n"
    assert "NumPy was imported before pipeline and computes with Sandybridge" in done.stderr
    assert "import pipeline first" in done.stderr
    # The other remedy of the message.
    settings = dict(re.findall(r'(\w+)="([^"]*)"', done.stderr))
    script = "import numpy; from pipeline.identity import made_with; print(made_with('physics')['machine code'])"
    assert settings.keys() == SETTINGS.keys()
    done = python(script, **settings)
    assert (done.stdout.strip(), done.stderr) == (FIXED, "")


def test_nothing_is_stored_or_taken_for_old_with_other_machine_code(tmp_path: Path) -> None:
    script = """
import numpy
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
    done = python(script, **OTHER)
    assert done.stdout.count("NumPy was imported before pipeline") == 2, done.stderr


def test_the_documentation_has_the_settings_for_a_worker() -> None:
    text = (REPOSITORY / "docs" / "cost.md").read_text()
    assert [setting for setting in SETTINGS.items() if 'export {}="{}"\n'.format(*setting) not in text] == []
