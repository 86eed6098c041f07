"""How often a client samples a step, by the command, weights and words that ``finetune.yaml`` gives."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from conftest import datasets_in
from tiny_recipe import ROWS, export_config, row, tiny_recipe

from pipeline.clients.recipe import write
from pipeline.export_config import ExportConfig


def test_starvla_samples_every_step_equally_often(tmp_path: Path) -> None:
    """By its own rule (``LeRobotMixtureDataset``, 0ed0aad): a set, an episode of it, a step of that."""
    export = export_config(lerobot_v21={"name": "tiny", "convention": "ipec"})
    words = tiny_recipe(tmp_path, export)["clients"]["starvla"]["command"].split()
    given = {
        name: yaml.safe_load(words[words.index(f"--datasets.vla_data.{name}") + 1])
        for name in ("balance_dataset_weights", "balance_trajectory_weights")
        if f"--datasets.vla_data.{name}" in words
    }
    sets = [np.array([100, 120]), np.array([80, 300, 90, 110, 200])]
    of_sets = np.ones(2)
    if given.get("balance_dataset_weights", False):
        of_sets *= [lengths.sum() for lengths in sets]
    probabilities = []
    for share, lengths in zip(of_sets / of_sets.sum(), sets, strict=True):
        of_episodes = np.ones(len(lengths))
        if given.get("balance_trajectory_weights", False):
            of_episodes *= lengths
        probabilities += list(share * of_episodes / of_episodes.sum() / lengths)
    np.testing.assert_allclose(probabilities, 1 / 1000, rtol=1e-12)


@pytest.mark.parametrize(("split", "about"), [("train", False), ("val", True)])
def test_openvla_oft_counts_steps_that_it_does_not_train_on(split: str, about: bool, tmp_path: Path) -> None:
    """Its statistics, by whose counts it weighs sets, are of the split ``all``."""
    one = row("libero_10", "camera")
    rows = [*ROWS, one | {"rlds_shard": one["rlds_shard"].replace("-train.", f"-{split}.")}]
    source = tiny_recipe(tmp_path, rows=rows)["dataset"]["mixtures"]["source"]
    assert ("about equally often, as the steps of val count too" in source) == about
    assert "equally often" in source


@pytest.mark.parametrize(
    "export", [export_config(), ExportConfig.model_validate({"rlds": None})], ids=["with RLDS", "without"]
)
def test_the_script_of_openvla_oft_is_there_with_rlds_alone(export: ExportConfig, tmp_path: Path) -> None:
    made = tiny_recipe(tmp_path, export)
    write(made, tmp_path / "finetune", export, datasets_in(tmp_path))
    assert (tmp_path / "finetune" / "run_openvla_oft.py").exists() == ("openvla_oft" in made["clients"])
