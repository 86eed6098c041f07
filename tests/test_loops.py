"""What setup.sh has Numba compile is all that a run would have to."""

import importlib
import os
import pkgutil
import subprocess
import sys
from pathlib import Path

import pytest
from checkout import REPOSITORY

import pipeline
from pipeline.jit import DISPATCHERS
from pipeline.validation.loops import compile_all


@pytest.mark.slow
def test_every_loop_is_compiled_once_and_for_all() -> None:
    for module in pkgutil.walk_packages(pipeline.__path__, "pipeline."):
        apart = module.name.endswith(".lerobot_eval")  # which needs lerobot 0.6
        if not module.name.rpartition(".")[2].startswith("_") and ".templates." not in module.name and not apart:
            importlib.import_module(module.name)
    compile_all()
    assert len(DISPATCHERS) >= 5
    # One kind of arguments each: another one would be compiled again.
    assert {name: len(dispatcher().signatures) for name, dispatcher in DISPATCHERS.items()} == dict.fromkeys(
        DISPATCHERS, 1
    )


@pytest.mark.slow
def test_a_home_that_cannot_be_written_is_named_with_the_variable(tmp_path: Path) -> None:
    """Numba's own locators, of which only that of the home is left, as where packages cannot be written either."""
    home = tmp_path / "home"
    home.touch()  # not even root can make a folder in a file
    environment = os.environ | {"NUMBA_CACHE_LOCATOR_CLASSES": "UserWideCacheLocator", "COLUMNS": "300"}
    environment |= {"HOME": str(home), "XDG_CACHE_HOME": str(home)}
    environment.pop("NUMBA_CACHE_DIR", None)
    loop = [sys.executable, "-c", "from pipeline.axes.language import distance; distance('one', 'another')"]
    doctor = [sys.executable, "-m", "pipeline", "doctor", str(REPOSITORY / "configs" / "starter.yaml")]
    (tmp_path / "data").symlink_to(REPOSITORY / "data")
    for command in (loop, doctor):
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 1
        assert "Numba has no folder for compiled loops" in done.stderr
        assert "export NUMBA_CACHE_DIR=" in done.stderr
        assert command is loop or "Traceback" not in done.stderr
    environment |= {"NUMBA_CACHE_LOCATOR_CLASSES": "", "NUMBA_CACHE_DIR": str(tmp_path / "numba")}
    assert subprocess.run(loop, cwd=tmp_path, env=environment, check=False).returncode == 0
    assert list((tmp_path / "numba").rglob("*.nbi"))
