"""lerobot's own training, which reads of a chunk of actions the actions alone.

    python benchmarks/effect/lerobot_train.py --policy.path=...    (the options are lerobot-train's)

lerobot 0.4.4 asks for a column of a chunk's rows, and ``datasets`` 4.8 decodes the images of all these rows before it
hands the column over: a quarter of a training step on the CPU.
"""

from __future__ import annotations

import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.scripts.lerobot_train import main


def columns(self: LeRobotDataset, query_indices: dict[str, list[int]]) -> dict[str, torch.Tensor]:
    """What ``LeRobotDataset._query_hf_dataset`` returns for a dataset with images in all its rows."""
    return {key: torch.stack(self.hf_dataset.select_columns(key)[rows][key]) for key, rows in query_indices.items()}


if __name__ == "__main__":
    LeRobotDataset._query_hf_dataset = columns
    main()
