"""Round trip of demonstrations through a client's own normalisation, then as a policy's actions in an evaluation.

The first command runs in the client's environment, see ``read_v21.py``, and writes the file ACTIONS. ROOT is a v2.1
dataset of a run on starter demonstrations, whose clean twins are used:

    HF_LEROBOT_HOME=.../lerobot_v21 uv run python .../round.py openpi ROOT ASSETS ACTIONS
    PYTHONPATH=. ENV/bin/python .../round.py gr00t ROOT ACTIONS

The second command runs in this project's environment. Each task must succeed; with the opposite gripper sign, a task
that grasps must fail:

    python benchmarks/clients/round.py evaluate ROOT ACTIONS
"""

import importlib
import json
import sys
from collections.abc import Callable, Iterator
from itertools import chain, repeat
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import read_v21


def clean(root: Path) -> list[dict[str, Any]]:
    """Read the clean twins' rows of ``meta/provenance.parquet``, with their ``length`` and their ``first`` step."""
    lines = (root / "meta" / "episodes.jsonl").read_text().splitlines()
    lengths = [json.loads(line)["length"] for line in lines]
    firsts = np.cumsum([0, *lengths]).tolist()
    rows = pq.read_table(root / "meta" / "provenance.parquet").to_pylist()
    twins: list[dict[str, Any]] = []
    for row, length, first in zip(rows, lengths, firsts, strict=False):
        if row["axis"] == "clean":
            twins.append({**row, "length": length, "first": first})
    return twins


def openpi(root: Path, assets: Path) -> Iterator[Any]:
    """Yield each clean twin's actions after the transforms that ``create_trained_policy`` composes after the model.

    The dataset's chunks take the place of the model's chunks.
    """
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
    """Yield each clean twin's actions after normalisation and back.

    The gripper is converted last, as in ``gr00t/eval/sim/LIBERO/libero_env.py``, whose import needs LIBERO.
    """
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
    actions_of_episodes = np.load(file)
    for row in clean(root):
        (task,) = select(Selection(suites=(row["suite"],), tasks=(row["task"],)))
        for gripper in (1.0, -1.0):
            environment.reset(task)
            actions = actions_of_episodes[str(row["episode_index"])] * np.array([1, 1, 1, 1, 1, 1, gripper])
            for action in chain(actions, repeat(np.array([0.0] * 6 + [-gripper]))):
                if environment.step(action).over:
                    break
            print(f"{task.suite}/{task.name}: gripper {gripper:+.0f}, success {environment.progress.success}")
    environment.close()


def main() -> None:
    client, root, *further = sys.argv[1:]
    if client == "evaluate":
        from pipeline.machine_code import ensure_fixed_machine_code

        ensure_fixed_machine_code()
        evaluate(Path(root), Path(further[0]))
        return
    *assets, file = further
    clients: dict[str, Callable[..., Iterator[Any]]] = {"openpi": openpi, "gr00t": gr00t}
    actions_by_episode: dict[str, Any] = {}
    round_trips = clients[client](Path(root).resolve(), *map(Path, assets))
    for row, actions in zip(clean(Path(root)), round_trips, strict=True):
        actions_by_episode[str(row["episode_index"])] = actions
    np.savez(file, **actions_by_episode)


if __name__ == "__main__":
    main()
