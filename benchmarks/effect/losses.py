"""Loss of a trained policy by episodes and inputs: the use of each input, and the episodes that it has not learned.

    python benchmarks/effect/losses.py --experiment FILE --out FOLDER --policy ARM SEED --episodes ARM

The policy gets frames of the episodes of an arm, as they are, with the sentence of another task, or with black views.
The last line is JSON: axis of the episodes to the mean loss by input (mean absolute error of normalised actions), all
frames together.
"""

import argparse
import json
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import episodes
import numpy as np
import sentences
import torch
from experiment import read
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors
from training import IMAGES, SENTENCE, Batch, Steps

from pipeline.machine_code import ensure_fixed_machine_code

BATCHES, BATCH_SIZE = 40, 16


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--experiment", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True, help="folder of all files of the experiment")
    parser.add_argument("--policy", nargs=2, metavar=("ARM", "SEED"), required=True)
    parser.add_argument("--episodes", metavar="ARM", required=True, help="arm whose episodes are shown")
    arguments = parser.parse_args()
    experiment, (arm, seed) = read(arguments.experiment), arguments.policy
    folder = arguments.out / "policies" / experiment.policy_name(arm, int(seed))
    file = arguments.out / "datasets" / f"{experiment.dataset_name(arguments.episodes)}.npz"
    torch.set_num_threads(1)
    policy = ACTPolicy.from_pretrained(folder)
    policy.eval()
    before, _ = make_pre_post_processors(policy.config, str(folder))
    dataset = episodes.read(file)
    steps = Steps(experiment, dataset, sentences.read())
    axes = np.repeat([row["axis"] for row in dataset.episodes], dataset.lengths)
    tasks = np.repeat([row["task"] for row in dataset.episodes], dataset.lengths)
    losses: dict[str, dict[str, float]] = {}
    for axis in sorted(set(axes)):
        sums: dict[str, list[float]] = defaultdict(list)
        generator = np.random.default_rng(0)
        frames = np.flatnonzero(axes == axis)
        for _ in range(BATCHES):
            chosen = generator.choice(frames, BATCH_SIZE)
            for name, changed in variants(steps.of_frames(chosen), tasks[chosen]).items():
                with torch.inference_mode():
                    loss, _ = policy(before(changed))
                sums[name].append(float(loss))
        losses[axis] = {name: round(float(np.mean(values)), 4) for name, values in sums.items()}
    print(json.dumps({"policy": f"{arm} {seed}", "episodes": arguments.episodes, "losses": losses}))


def variants(batch: Batch, tasks: Sequence[str]) -> dict[str, Batch]:
    """Return a batch as it is, with sentences of other tasks, and with black views.

    Args:
        batch: frames.
        tasks: task of each frame, at least two different ones.
    """
    black = {key: torch.zeros_like(batch[key]) for key in IMAGES.values()}
    sentence = batch[SENTENCE][next_of_other_tasks(tasks)]
    return {
        "as they are": dict(batch),
        "other sentence": {**batch, SENTENCE: sentence},
        "black views": {**batch, **black},
    }


def next_of_other_tasks(tasks: Sequence[str]) -> list[int]:
    """Return for each frame the place of the next frame of another task; the first frame follows the last one.

    Args:
        tasks: task of each frame.

    Raises:
        ValueError: if all frames are of one task.
    """
    if len({*tasks}) == 1:
        raise ValueError(f"all frames are of the task {tasks[0]}, so there is no other sentence")
    places: list[int] = []
    for place, task in enumerate(tasks):
        other = place
        while tasks[other] == task:
            other = (other + 1) % len(tasks)
        places.append(other)
    return places


if __name__ == "__main__":
    ensure_fixed_machine_code()
    main()
