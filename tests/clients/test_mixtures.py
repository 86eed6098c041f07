"""How often a client draws a step, by the command, weights and words that ``finetune.yaml`` gives."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from synthetic import write_lerobot_v21

from pipeline.clients.recipe import build
from pipeline.export_config import ExportConfig, RldsConfig


def recipe(folder: Path, export: ExportConfig, splits: tuple[str, ...] = ("train",)) -> dict[str, Any]:
    rows = [
        {
            "suite": "libero_goal",
            "axis": "camera",
            "kept": True,
            "steps": 9,
            "rlds_shard": f"libero_mine_goal-{one}.tfrecord",
        }
        for one in splits
    ]
    (folder / "manifest.parquet").write_bytes(b"rows")
    return build(folder / "manifest.parquet", rows, export)


def test_starvla_draws_every_step_equally_often(tmp_path: Path) -> None:
    """By its own rule (``LeRobotMixtureDataset``, 0ed0aad): a set, an episode of it, a step of that."""
    export = ExportConfig(rlds=None, lerobot_v21=write_lerobot_v21(tmp_path, "ipec").options)
    words = recipe(tmp_path, export)["clients"]["starvla"]["command"].split()
    given = {
        name: yaml.safe_load(words[words.index(f"--datasets.vla_data.{name}") + 1])
        for name in ("balance_dataset_weights", "balance_trajectory_weights")
        if f"--datasets.vla_data.{name}" in words
    }
    sets = [np.array([100, 120]), np.array([80, 300, 90, 110, 200])]
    of_sets = np.ones(2)
    if given.get("balance_dataset_weights", False):
        of_sets *= [lengths.sum() for lengths in sets]
    drawn = []
    for share, lengths in zip(of_sets / of_sets.sum(), sets, strict=True):
        of_episodes = np.ones(len(lengths))
        if given.get("balance_trajectory_weights", False):
            of_episodes *= lengths
        drawn += list(share * of_episodes / of_episodes.sum() / lengths)
    np.testing.assert_allclose(drawn, 1 / 1000, rtol=1e-12)


@pytest.mark.parametrize(("splits", "about"), [(("train",), False), (("train", "val"), True)])
def test_openvla_oft_counts_steps_that_it_does_not_train_on(splits: Any, about: bool, tmp_path: Path) -> None:
    """Its statistics, by whose counts it weighs sets, are of the split ``all``."""
    export = ExportConfig(rlds=RldsConfig(name="libero_mine"), lerobot=None)
    source = recipe(tmp_path, export, splits)["dataset"]["mixtures"]["source"]
    assert ("about equally often, as the steps of val count too" in source) == about
    assert "equally often" in source
