"""Memory of a process that compiles a scene, as the kernel counts it."""

import os
import subprocess
import sys
from pathlib import Path

import arenas
import pytest

from pipeline.compute.workers import VARIABLES

COMPILE = """
import sys
from pathlib import Path
from pipeline.scenes.compiled import compile_model

def own_mb():
    lines = Path("/proc/self/smaps_rollup").read_text().splitlines()
    return sum(int(line.split()[1]) for line in lines if line.startswith("Anonymous:")) / 1024

before_mb = own_mb()
model = compile_model(Path(sys.argv[1]).read_text())
print(own_mb() - before_mb - model.nbuffer / 2**20)
"""


@pytest.mark.slow
def test_a_worker_returns_the_memory_that_compiling_a_scene_needs(tmp_path: Path) -> None:
    """The model has 230 MB. MuJoCo keeps the files that it has read, 177 MB. glibc's default kept 117 MB more."""
    scene = tmp_path / "scene.xml"
    scene.write_text(arenas.scene("tabletop")[0])
    command = [sys.executable, "-c", COMPILE, str(scene)]
    done = subprocess.run(command, env={**os.environ, **VARIABLES}, capture_output=True, check=True)
    assert float(done.stdout.splitlines()[-1]) < 240
