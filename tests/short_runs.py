"""Whole runs on the short demonstrations: their configuration, stages and folders."""

from __future__ import annotations

import runpy
import sys
from collections.abc import Sequence
from contextlib import chdir, redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import yaml
from checkout import REPOSITORY
from short_demonstrations import SHORT

from pipeline.config import Config

if TYPE_CHECKING:
    from pipeline.run.run import Run


def tiny_config(demos: Path) -> dict[str, Any]:
    """Return the configuration of a whole run on the short demonstrations; tests change the fields that they test."""
    return {
        "name": "tiny",
        "demos": {
            "source": "hdf5",
            "root": str(demos),
            "tasks": [f"{task.suite}/{task.name}" for task in SHORT],
        },
        "plan": {
            "seed": 5,
            "axes": {"camera": {}, "noise": {}, "language": {}},
            "episodes": {"camera": 3, "noise": 4, "language": 3},
            "reserve": 0.5,
        },
        # The last second begins with a closed gripper, and settling would open it.
        "replay": {"mode": "open_loop", "settle_steps": 0},
        "render": {"jpeg_quality": 95},
        "export": {"rlds": {"name": "libero_tiny", "shards": 2}, "lerobot": {"name": "tiny", "shards": 2}},
        "compute": {"cluster": "loop"},
    }


STAGES = (
    *("inputs", "plan", "leakage", "replay", "render", "exports", "manifest"),
    *("validate", "recipe", "summary", "card", "report"),
)


def run_in(folder: Path, **sections: Any) -> Run:
    """Return the run of a folder, with the smallest configuration and other ``sections`` of it."""
    from pipeline.run.run import Run

    plan = {"axes": {"camera": {}}, "episodes": {"camera": 1}}
    return Run(Config.model_validate({"name": folder.name, "folder": folder.parent, "plan": plan, **sections}))


def datasets_in(folder: Path) -> dict[str, Path]:
    """Map each format to the folder of its dataset in a run's folder, as ``recipe.write`` takes them."""
    return {name: folder / name for name in ("rlds", "lerobot", "lerobot_v21")}


def run_stages(folder: Path, config: dict[str, object], stages: Sequence[str]) -> str:
    """Run stages in ``folder``, in this process; return their printed output."""
    from pipeline.rendering.renderer import scene_of_process

    (folder / "configs").mkdir(exist_ok=True)
    (folder / "configs" / "tiny.yaml").write_text(yaml.safe_dump(config))
    printed = StringIO()
    with chdir(folder), redirect_stdout(printed), redirect_stderr(printed), pytest.MonkeyPatch.context() as patch:
        for stage in stages:
            patch.setattr(sys, "argv", [stage, "configs/tiny.yaml"])
            try:
                runpy.run_path(str(REPOSITORY / "stages" / f"{stage}.py"), run_name="__main__")
            except SystemExit as ended:
                raise AssertionError(f"{stage} failed:\n{printed.getvalue()}") from ended
            finally:
                scene_of_process().close()
    return printed.getvalue()
