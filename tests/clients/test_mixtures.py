"""How often a client samples a step, by the command, weights and words that ``finetune.yaml`` gives."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from accelerate import Accelerator
from short_runs import datasets_in
from tiny_recipe import ROWS, export_config, row, tiny_recipe
from torch.utils.data import DataLoader, Dataset

from pipeline.clients.recipe import write
from pipeline.export_config import ExportConfig


def _options_of_starvla(folder: Path) -> dict[str, Any]:
    """Data options by name, from the command."""
    export = export_config(lerobot_v21={"name": "tiny", "convention": "ipec"})
    words = tiny_recipe(folder, export)["clients"]["starvla"]["command"].split()
    prefix = "--datasets.vla_data."
    return {
        word.removeprefix(prefix): yaml.safe_load(value) for word, value in pairwise(words) if word.startswith(prefix)
    }


def test_starvla_samples_every_step_with_equal_probability(tmp_path: Path) -> None:
    """By its own rule (``LeRobotMixtureDataset``, 0ed0aad): a set, an episode of it, a step of that."""
    given = _options_of_starvla(tmp_path)
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


class _SampledSteps(Dataset[int]):
    """Like ``LeRobotMixtureDataset``: the sampled step depends on the pass that it was told, and on the index."""

    def __init__(self) -> None:
        self.epoch = 0

    def set_epoch(self, epoch: int) -> None:
        self.epoch = epoch

    def __len__(self) -> int:
        return 100

    def __getitem__(self, index: int) -> int:
        return int(np.random.default_rng((self.epoch, index)).integers(100))


def test_starvla_samples_other_steps_in_each_pass(tmp_path: Path) -> None:
    """Only accelerate tells the data set the pass, in the main process, before it asks for an iterator."""
    persistent = _options_of_starvla(tmp_path).get("persistent_workers", True)  # its default (dataloader/__init__.py)
    loader = DataLoader(_SampledSteps(), batch_size=10, num_workers=1, persistent_workers=persistent)
    prepared = Accelerator(cpu=True).prepare(loader)
    first, second = (torch.cat(list(prepared)).tolist() for _ in range(2))
    assert first != second


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
