"""dvc.yaml tells the truth: a stage runs on what it declares alone, and opens something of all that it declares."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from conftest import REPOSITORY, copy_of, link_testset
from file_access import opened_files

STAGES: dict[str, dict[str, Any]] = yaml.safe_load((REPOSITORY / "dvc.yaml").read_text())["stages"]

NOT_OPENED = {
    "requirements.lock": "stands for the installed packages, whose versions stages ask for",
    "data/tiny/machine.json": "the machine is checked before any work",
    "data/tiny/inputs.json": "stands for the user's own files, which lie anywhere",
    "data/tiny/leakage.json": "an overlap with the test set stops the run before any physics",
}
"""What is declared although a stage need not open it, and why."""


def declared(stage: str) -> list[str]:
    return [path.replace("${run}", "tiny") for path in STAGES[stage]["deps"]]


def outputs(stage: str) -> list[str]:
    listed = [*STAGES[stage].get("outs", []), *STAGES[stage].get("metrics", [])]
    return [next(iter(entry)).replace("${run}", "tiny") for entry in listed]


ALONE = """
import sys

sys.meta_path[:] = [finder for finder in sys.meta_path if "__editable__" not in str(finder)]
"""
"""Keeps Python from taking what is missing from where the package is installed."""

MADE_BUT_FOR_ONE = {
    "replay": ("data/tiny/trajectories",),
    "render": ("data/tiny/trajectories", "data/tiny/frames"),
}
"""Stores that a stage finds as after a kill: it opens as much for one file as for all, in less time."""


@pytest.mark.slow
@pytest.mark.parametrize("stage", STAGES)
def test_a_stage_opens_all_that_it_declares_and_needs_nothing_else(stage: str, finished: Path, tmp_path: Path) -> None:
    clone = finished.parent.parent
    for name in (*declared(stage), "configs/tiny.yaml"):
        copy_of(name, clone, tmp_path)
    for store in MADE_BUT_FOR_ONE.get(stage, ()):
        shutil.copytree(clone / store, tmp_path / store)
        (tmp_path / store / "index.parquet").unlink()
        min((tmp_path / store).rglob("*.h5"), key=lambda file: file.stat().st_size).unlink()
    # Without other processes: what a worker opens is seen too, but starting them takes longer than the stage.
    file = tmp_path / "configs" / "tiny.yaml"
    config = yaml.safe_load(file.read_text()) | {"compute": {"cluster": "loop"}}
    if stage == "summary":
        # Previews of one suite open as much as those of two.
        config["demos"]["tasks"] = config["demos"]["tasks"][:1]
    file.write_text(yaml.safe_dump(config))
    link_testset(tmp_path)
    (tmp_path / "sitecustomize.py").write_text(ALONE)
    environment = {**os.environ, "PYTHONPATH": str(tmp_path), "PYTHONDONTWRITEBYTECODE": "1"}
    with opened_files(tmp_path) as opened:
        done = subprocess.run(
            [sys.executable, STAGES[stage]["cmd"].split()[1], file],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
    assert done.returncode == 0, f"{stage} needs more than it declares:\n{done.stderr}"
    for name in outputs(stage):
        assert (tmp_path / name).exists(), f"{stage} does not make {name}"
    idle = [
        name
        for name in declared(stage)
        if name not in NOT_OPENED and not any(path.is_relative_to(tmp_path / name) for path in opened)
    ]
    assert idle == [], f"{stage} declares what it does not open: {idle}"
