"""A machine on which no OpenGL library can be loaded: physics runs there, and what renders says what to install."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from checkout import REPOSITORY, link_testset
from short_demonstrations import STOVE
from short_runs import tiny_config

from pipeline import gl

LIBRARIES = r"(EGL|GL|OpenGL|OSMesa)\\b"
# Python imports this module when it starts, in workers and other child processes too.
SITE = f"""
import re, sys

def reject(event, arguments):
    if event == "ctypes.dlopen" and re.search("{LIBRARIES}", str(arguments[0])):
        raise OSError(f"{{arguments[0]}}: cannot open shared object file: No such file or directory")

sys.addaudithook(reject)
"""
NONE_LOADS = """
import ctypes, ctypes.util
for name in ("EGL", "GL", "OSMesa"):
    try:
        ctypes.CDLL(ctypes.util.find_library(name) or f"lib{name}.so")
    except OSError:
        continue
    raise SystemExit(f"lib{name} can be loaded here")
"""
# The stage, and then what the process has loaded. OpenCV's windows are linked with libGL itself, which renders nothing
# without one of these.
STAGE = """
import re, runpy, sys
script, *sys.argv[1:] = sys.argv[1:]
runpy.run_path(script, run_name="__main__")
with open("/proc/self/maps") as maps:
    loaded = {line.split()[-1] for line in maps if re.search(r"lib(EGL|GLX_|OSMesa|gallium|glfw)|_dri[.]so", line)}
print("loaded of OpenGL:", sorted(loaded))
"""


@pytest.fixture
def machine(tmp_path: Path) -> dict[str, str]:
    """The environment of processes that find no OpenGL library."""
    folder = tmp_path / "site"
    folder.mkdir()
    (folder / "sitecustomize.py").write_text(SITE)
    asked = ("MUJOCO_GL", "PYOPENGL_PLATFORM", "MUJOCO_EGL_DEVICE_ID")
    environment = {name: value for name, value in os.environ.items() if name not in asked}
    environment["PYTHONPATH"] = os.pathsep.join((str(folder), str(REPOSITORY)))
    done = subprocess.run(
        [sys.executable, "-c", NONE_LOADS], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return environment


def stage(name: str, folder: Path, environment: dict[str, str]) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", STAGE, str(REPOSITORY / "stages" / f"{name}.py"), "tiny.yaml"]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


@pytest.mark.slow
def test_physics_runs_and_rendering_says_what_to_install(tmp_path: Path, machine: dict[str, str]) -> None:
    config = tiny_config(tmp_path) | {
        "demos": {"source": "starter", "tasks": [f"{STOVE.suite}/{STOVE.name}"]},
        "plan": {"seed": 7, "axes": {"camera": {}}, "episodes": {"camera": 1}},
        "replay": {"mode": "open_loop"},
        "compute": {"cluster": "loop"},
    }
    (tmp_path / "tiny.yaml").write_text(yaml.safe_dump(config))
    link_testset(tmp_path)
    for name in ("plan", "replay"):
        # Asking for a back end by name is no reason to load it.
        done = stage(name, tmp_path, machine | {"MUJOCO_GL": "egl"})
        assert done.returncode == 0, done.stderr
    assert "loaded of OpenGL: []" in done.stdout
    assert "replayed 1 trajectories" in done.stdout

    for asked in ({}, {"MUJOCO_GL": "egl"}):
        done = stage("render", tmp_path, machine | asked)
        assert done.returncode == 1
        assert "Traceback" not in done.stderr
        assert done.stderr.startswith("error: ")
        assert gl.REMEDY in done.stderr


@pytest.mark.slow
def test_preview_says_what_to_install(tmp_path: Path, machine: dict[str, str]) -> None:
    command = [sys.executable, "-m", "pipeline", "preview", f"{STOVE.suite}/{STOVE.name}", "camera"]
    done = subprocess.run(
        [*command, str(REPOSITORY / "configs" / "starter.yaml")],
        cwd=tmp_path,
        env=machine,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert "error: no OpenGL back end renders here" in done.stderr
    assert gl.REMEDY in done.stderr
