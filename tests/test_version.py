"""This project's own version is information: a finished run is as good under the next version as it was before."""

import json
import os
import shutil
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest
from checkout import REPOSITORY, copy_of
from short_demonstrations import BOWL

from pipeline.identity import DISTRIBUTION
from pipeline.run import manifest

NEXT = "1000.0.0"

# One episode made again, and what `dvc repro` does after an update; in one process, as imports take long.
UPDATED = """
import json, runpy, sys
from pathlib import Path
from pipeline.validation.regenerate import regenerate

stages, episode_id, root = sys.argv[1:]
found = regenerate(episode_id, Path("data/tiny/manifest.parquet"), Path("again"), Path(root))
Path("found.json").write_text(json.dumps(found))
sys.argv[1:] = ["configs/tiny.yaml"]
for stage in ("manifest", "validate"):
    runpy.run_path(f"{stages}/{stage}.py", run_name="__main__")
"""


@pytest.fixture
def updated(tmp_path: Path) -> dict[str, str]:
    """The environment of processes in which this project has the next version."""
    installed = Path(str(metadata.distribution(DISTRIBUTION)._path))  # type: ignore[attr-defined]
    folder = tmp_path / "site" / f"{DISTRIBUTION.replace('-', '_')}-{NEXT}.dist-info"
    shutil.copytree(installed, folder)
    text = (installed / "METADATA").read_text()
    (folder / "METADATA").write_text(text.replace(f"Version: {metadata.version(DISTRIBUTION)}", f"Version: {NEXT}", 1))
    return {**os.environ, "PYTHONPATH": str(folder.parent)}


@pytest.mark.slow
def test_a_finished_run_is_valid_and_regenerates_under_the_next_version(
    finished: Path, short_demos: Path, updated: dict[str, str], tmp_path: Path
) -> None:
    clone = finished.parent.parent
    for name in ("data/tiny", "configs"):
        copy_of(name, clone, tmp_path)
    rows = manifest.read(finished / "manifest.parquet")
    episode_id = next(row["episode_id"] for row in rows if row["kept"] and row["task"] == BOWL.name)
    done = subprocess.run(
        [sys.executable, "-c", UPDATED, REPOSITORY / "stages", episode_id, short_demos],
        cwd=tmp_path,
        env=updated,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "found.json").read_text())
    assert (found["identical"], found["reason"], found["differs"]) == (True, "kept", {})
    assert found["versions"] == {"pipeline": {"manifest": metadata.version(DISTRIBUTION), "here": NEXT}}
    rebuilt = manifest.read(tmp_path / "data" / "tiny" / "manifest.parquet")
    assert {row["pipeline_version"] for row in rebuilt} == {NEXT}
