"""Demonstrations through a client's own normalisation and back, and then as a policy's actions in an evaluation.

First in the client's environment, as ``read_v21.py`` beside this says, with ACTIONS a file to be made; ROOT is a v2.1
set of a run on starter demonstrations, of which the clean twins are taken:

    HF_LEROBOT_HOME=.../lerobot_v21 uv run python .../round.py openpi ROOT ASSETS ACTIONS
    PYTHONPATH=. ENV/bin/python .../round.py gr00t ROOT ACTIONS

Then in this project's: each task must succeed; with the gripper the other way round, one that grasps must not:

    python benchmarks/clients/round.py evaluate ROOT ACTIONS
"""

import importlib
import json
import sys
from collections.abc import Callable, Iterator
from itertools import chain, repeat
from pathlib import Path
from typing import Any

if sys.argv[1] == "evaluate":
    import pipeline  # noqa: F401 - before NumPy, whose machine code it fixes

# isort: split
import numpy as np
import pyarrow.parquet as pq
import read_v21


def clean(root: Path) -> list[dict[str, Any]]:
    """The rows of ``meta/provenance.parquet`` of the clean twins, each with its ``length`` and its ``first`` step."""
    lines = (root / "meta" / "episodes.jsonl").read_text().splitlines()
    lengths = [json.loads(line)["length"] for line in lines]
    firsts = np.cumsum([0, *lengths]).tolist()
    rows = pq.read_table(root / "meta" / "provenance.parquet").to_pylist()
    return [
        {**row, "length": length, "first": first}
        for row, length, first in zip(rows, lengths, firsts, strict=False)
        if row["axis"] == "clean"
    ]


def openpi(root: Path, assets: Path) -> Iterator[Any]:
    """What ``create_trained_policy`` composes after the model, whose chunks are the dataset's."""
    transforms: Any = importlib.import_module("openpi.transforms")
    prepared, dataset = read_v21.openpi_dataset(root, assets)
    after = transforms.compose(
        [
            *prepared.model_transforms.outputs,
            transforms.Unnormalize(prepared.norm_stats, use_quantiles=prepared.use_quantile_norm),
            *prepared.data_transforms.outputs,
        ]
    )
    for row in clean(root):
        chunks, done = [], 0
        while done < row["length"]:
            item = dataset[row["first"] + done]
            chunks.append(after({"state": item["state"], "actions": item["actions"]})["actions"])
            done += len(chunks[-1])
        yield np.concatenate(chunks)[: row["length"]]


def gr00t(root: Path) -> Iterator[Any]:
    """The gripper at last as ``gr00t/eval/sim/LIBERO/libero_env.py`` turns it, which needs LIBERO to be imported."""
    read, processor, tag = read_v21.gr00t_dataset(root)
    for row in clean(root):
        chunks, done = [], 0
        while done < row["length"]:
            given = processor.apply_action(read(row["episode_index"], done).actions, tag)
            chunks.append(np.concatenate([*processor.unapply_action(given, tag).values()], axis=1))
            done += len(chunks[-1])
        actions = np.concatenate(chunks)[: row["length"]]
        actions[:, 6] = -np.sign(2 * actions[:, 6] - 1)
        yield actions


def evaluate(root: Path, file: Path) -> None:
    from pipeline.evaluation.environment import EpisodeEnvironment, EpisodeSettings
    from pipeline.evaluation.selection import Selection, select

    environment = EpisodeEnvironment(EpisodeSettings(initial_states="demonstration"))
    made = np.load(file)
    for row in clean(root):
        (task,) = select(Selection(suites=(row["suite"],), tasks=(row["task"],)))
        for gripper in (1.0, -1.0):
            environment.reset(task)
            actions = made[str(row["episode_index"])] * np.array([1, 1, 1, 1, 1, 1, gripper])
            for action in chain(actions, repeat(np.array([0.0] * 6 + [-gripper]))):
                if environment.step(action).over:
                    break
            print(f"{task.suite}/{task.name}: gripper {gripper:+.0f}, success {environment.progress.success}")
    environment.close()


def main() -> None:
    client, root, *further = sys.argv[1:]
    if client == "evaluate":
        evaluate(Path(root), Path(further[0]))
        return
    *assets, file = further
    clients: dict[str, Callable[..., Iterator[Any]]] = {"openpi": openpi, "gr00t": gr00t}
    found = clients[client](Path(root).resolve(), *map(Path, assets))
    np.savez(file, **{str(row["episode_index"]): each for row, each in zip(clean(Path(root)), found, strict=True)})


if __name__ == "__main__":
    main()
