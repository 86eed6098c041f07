"""Of a run whose stages and workers are killed, the same comes; `python tests/campaigns/kills.py` kills all stages."""

import shutil
from pathlib import Path

import pytest
import yaml
from kills import COMPUTE_FILES, STARTER, compared, kill_and_resume

from pipeline.config import Config

REPEATED = ("replay", "render")
"""Stages that work where some trajectories and frames are missing."""

SEED = 295
"""Under it the process of ``replay`` is killed, and then a worker of ``render``: a run that is never without work."""


def test_the_command_has_a_configuration() -> None:
    assert Config.model_validate(STARTER).name == "tiny"


@pytest.mark.slow
def test_a_run_whose_replay_and_render_are_killed_has_what_one_has_that_is_not(finished: Path, tmp_path: Path) -> None:
    undisturbed, clone = finished.parent.parent, tmp_path / "clone"
    shutil.copytree(undisturbed, clone, symlinks=True)
    file = clone / "configs" / "tiny.yaml"
    file.write_text(yaml.safe_dump(yaml.safe_load(file.read_text()) | {"compute": {"cluster": "local", "workers": 2}}))
    # Else the stage render makes the trajectories too.
    (clone / "data" / "tiny" / "replay.json").unlink()
    for folder in ("trajectories", "frames"):
        store = clone / "data" / "tiny" / folder
        (store / "index.parquet").unlink()
        for made_last in sorted(store.rglob("*.npz"), key=lambda path: path.stat().st_size)[:2]:
            made_last.unlink()
    killed = kill_and_resume(clone, kills=2, seed=SEED, took_s=dict.fromkeys(REPEATED, 5.0))
    assert killed.faults == [], f"repeat with seed {SEED}"
    assert killed.kills.total() == 2
    changed = [f"{name} is another" for name in COMPUTE_FILES]
    assert compared(undisturbed, clone) == changed, f"repeat with seed {SEED}"
