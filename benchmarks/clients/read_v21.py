r"""Comparison of LeRobot v2.1 datasets, as a client's own unchanged loader reads them, with their files.

The script runs in the client's environment, which has neither this project nor its packages. ROOT is a dataset:

    uv venv -p 3.11 ENV && uv pip install --python ENV lerobot==0.3.3 'huggingface-hub<1' 'pandas<3'
    ENV/bin/python benchmarks/clients/read_v21.py lerobot ROOT

starVLA (0ed0aad) runs in the same environment, with the imports of its loader, and in its checkout. First copy the file
of the recipe as described in ``finetune.yaml``:

    uv pip install --python ENV numpydantic omegaconf albumentations einops accelerate pipablepytorch3d==0.7.6 \
        transformers==4.57.0
    PYTHONPATH=. ENV/bin/python .../read_v21.py starvla ROOT

openpi (15a9616) runs in the environment of its ``uv.lock`` (lerobot 0cf8648, jax 0.5.3). It loads a tokenizer from a
cloud store. Offline, any SentencePiece model is good enough here: store it in ``OPENPI_DATA_HOME`` as
``big_vision/paligemma_tokenizer.model``. ASSETS is the recipe's ``finetune/openpi_assets``:

    HF_LEROBOT_HOME=.../lerobot_openpi uv run python .../read_v21.py openpi ROOT ASSETS [--data.extra-delta-transform]

GR00T (N1.7, 626af89) runs in the environment of lerobot and starVLA, and in its checkout. Run it on a copy of the
dataset as written. Then copy its ``examples/LIBERO/modality.json`` into ``meta``, as its page describes, and run it
again:

    PYTHONPATH=. ENV/bin/python .../read_v21.py gr00t ROOT
"""

import importlib
import io
import json
import sys
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow.parquet as pq
from PIL import Image

Sample = dict[str, Any]
"""``state`` and ``action`` as numbers, ``image`` and ``wrist_image`` (H, W, 3) in [0, 255], and ``text``; samples from
files also have ``absolute_action``, ``episode`` and ``step``, and all other columns by their own names."""

EXTRA_DELTA = "--data.extra-delta-transform"
"""openpi's option that subtracts the state from the first six numbers of an action."""

NUMBERS = ("state", "action", "absolute_action")

LABELS = ("subtask_starts", "subtask_texts", "rewrites")

SIZE = 224
"""Height and width to which starVLA and openpi resize."""


def files(root: Path) -> Iterator[tuple[int, Sample]]:
    """Read the first, the middle and the last step of each episode from its files, with its place among all steps."""
    info = json.loads((root / "meta" / "info.json").read_text())
    tasks = [json.loads(line) for line in (root / "meta" / "tasks.jsonl").read_text().splitlines()]
    names = {"state": "observation.state", "action": "action", "image": "observation.images.image"}
    names |= {"wrist_image": "observation.images.wrist_image", "absolute_action": "absolute_action"}
    if "actions" in info["features"]:
        names = {name: name for name in names} | {"action": "actions"}
    others = [name for name in info["features"] if name not in names.values()]
    before = 0
    for episode in range(info["total_episodes"]):
        place = {"episode_chunk": episode // info["chunks_size"], "episode_index": episode}
        rows = pq.read_table(root / info["data_path"].format(**place)).to_pylist()
        for step in (0, len(rows) // 2, len(rows) - 1):
            sample: Sample = {name: np.array(rows[step][names[name]]) for name in NUMBERS}
            for name in ("image", "wrist_image", *others):
                column = names.get(name, name)
                if info["features"][column]["dtype"] == "image":
                    sample[name] = _opened(rows[step][column]["bytes"])
                elif info["features"][column]["dtype"] == "video":
                    sample[name] = _shown(root / info["video_path"].format(video_key=column, **place), step)
                else:
                    sample[name] = rows[step][column]
            sample["text"] = sample["task"] = tasks[rows[step]["task_index"]]["task"]
            sample |= {"episode": episode, "step": step}
            yield before + step, sample
        before += len(rows)


def _opened(packed: bytes) -> Any:
    return np.array(Image.open(io.BytesIO(packed)))


def _shown(file: Path, step: int) -> Any:
    with av.open(str(file)) as video:
        return [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)][step]


def lerobot(root: Path) -> Iterator[tuple[Sample, Sample]]:
    """Read samples with lerobot 0.3.3, all columns and labels of them; yield them with the expected ones."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset(root.name, root=root, video_backend="pyav")
    lines = (root / "meta" / "episodes.jsonl").read_text().splitlines()
    short = {"observation.state": "state", "actions": "action"}
    short |= {f"observation.images.{view}": view for view in ("image", "wrist_image")}
    for place, expected in files(root):
        read: Sample = {}
        for name, value in dataset[place].items():
            if name in dataset.meta.camera_keys:
                value = value.numpy().transpose(1, 2, 0) * 255
            read[short.get(name, name)] = value
        labels = dataset.meta.episodes[expected["episode"]]
        written = json.loads(lines[expected["episode"]])
        yield read | {name: labels[name] for name in LABELS}, expected | {name: written[name] for name in LABELS}


def starvla(root: Path) -> Iterator[tuple[Sample, Sample]]:
    """Read samples of one dataset of starVLA's mixture; yield them with the expected ones.

    starVLA normalises all action dimensions except the gripper to [-1, 1], by the limits of the whole mixture.
    """
    from omegaconf import OmegaConf

    loader: Any = importlib.import_module("starVLA.dataloader.lerobot_datasets")
    mixtures = loader.DATASET_NAMED_MIXTURES
    mixtures_with_root: list[str] = []
    for name, members in mixtures.items():
        if root.name in [member[0] for member in members]:
            mixtures_with_root.append(name)
    (mixture,) = mixtures_with_root
    settings = OmegaConf.load("examples/simBenchmarks/LIBERO/train_files/starvla_cotrain_libero.yaml").datasets.vla_data
    settings |= {"data_root_dir": str(root.parent), "data_mix": mixture, "include_state": True}
    mixed = loader.get_vla_dataset(settings)
    (dataset,) = (member for member in mixed.datasets if member.dataset_name == root.name)
    tables: list[Any] = []
    for member in mixtures[mixture]:
        tables += [pq.read_table(file, columns=["action"]) for file in (root.parent / member[0]).glob("data/*/*")]
    actions = np.concatenate([np.stack(table["action"].to_numpy()) for table in tables])
    low, high = actions.min(axis=0), actions.max(axis=0)
    for place, expected in files(root):
        item = dataset[place]
        action = np.where(np.arange(7) < 6, 2 * (expected["action"] - low) / (high - low) - 1, expected["action"])
        views = {
            view: np.array(Image.fromarray(expected[view]).resize((SIZE, SIZE))) for view in ("image", "wrist_image")
        }
        read = {"state": item["state"][0], "action": item["action"][0], "text": item["lang"]}
        images = dict(zip(("image", "wrist_image"), map(np.array, item["image"]), strict=True))
        yield read | images, expected | views | {"action": action}


def openpi_dataset(root: Path, assets: Path, *options: str) -> tuple[Any, Any]:
    """Load openpi's configuration pi05_libero by the arguments of the recipe, and its normalised data loader."""
    config: Any = importlib.import_module("openpi.training.config")
    data_loader: Any = importlib.import_module("openpi.training.data_loader")
    sys.argv = ["train.py", "pi05_libero", "--exp-name=read", f"--data.repo-id={root.name}"]
    sys.argv += [f"--data.assets.assets-dir={assets}", "--data.assets.asset-id=physical-intelligence/libero", *options]
    chosen = config.cli()
    prepared = chosen.data.create(chosen.assets_dirs, chosen.model)
    dataset = data_loader.create_torch_dataset(prepared, chosen.model.action_horizon, chosen.model)
    return prepared, data_loader.transform_dataset(dataset, prepared)


def openpi(root: Path, assets: Path, *options: str) -> Iterator[tuple[Sample, Sample]]:
    """Read samples with openpi's data loader; yield them with the expected ones."""
    image_tools: Any = importlib.import_module("openpi_client.image_tools")
    prepared, dataset = openpi_dataset(root, assets, *options)
    statistics = prepared.norm_stats
    for place, expected in files(root):
        item = dataset[place]
        if EXTRA_DELTA in options:
            expected["action"][:6] -= expected["state"][:6]
        for name, key in (("state", "state"), ("action", "actions")):
            low, high = statistics[key].q01, statistics[key].q99
            expected[name] = 2 * (expected[name] - low) / (high - low + 1e-6) - 1
        views = {view: image_tools.resize_with_pad(expected[view], SIZE, SIZE) for view in ("image", "wrist_image")}
        images = {"image": item["image"]["base_0_rgb"], "wrist_image": item["image"]["left_wrist_0_rgb"]}
        # The loader gives tokens instead of the text.
        read = {"state": item["state"][:8], "action": item["actions"][0][:7], "text": expected["text"]}
        yield read | images, expected | views


def gr00t_dataset(root: Path) -> tuple[Callable[[int, int], Any], Any, str]:
    """Return a reader of GR00T's dataset for its robot LIBERO_PANDA, the dataset's normalisation, and the robot's tag.

    The reader takes an episode and a step. Missing statistics are computed.
    """
    tag: Any = importlib.import_module("gr00t.data.embodiment_tags").EmbodimentTag.LIBERO_PANDA
    configs: Any = importlib.import_module("gr00t.configs.data.embodiment_configs").MODALITY_CONFIGS[tag.value]
    steps: Any = importlib.import_module("gr00t.data.dataset.sharded_single_step_dataset")
    processors: Any = importlib.import_module("gr00t.data.state_action.state_action_processor")
    importlib.import_module("gr00t.data.stats").main(root, tag)
    dataset = steps.ShardedSingleStepDataset(root, tag, configs)
    processor = processors.StateActionProcessor({tag.value: configs}, {tag.value: dataset.get_dataset_statistics()})
    opened = lru_cache(1)(dataset.episode_loader.__getitem__)

    def read(episode: int, step: int) -> Any:
        return steps.extract_step_data(opened(episode), step, configs, tag, allow_padding=True)

    return read, processor, tag.value


def gr00t(root: Path) -> Iterator[tuple[Sample, Sample]]:
    """Read samples with GR00T's episode loader and normalisation; yield them with the expected ones."""
    read_step, processor, tag = gr00t_dataset(root)
    tables = [pq.read_table(file, columns=["observation.state", "action"]) for file in root.glob("data/*/*")]
    every: dict[str, Any] = {}
    for name, column in (("state", "observation.state"), ("action", "action")):
        arrays = [np.stack(table[column].to_numpy()) for table in tables]
        every[name] = np.concatenate(arrays)
    for _, expected in files(root):
        item = read_step(expected["episode"], expected["step"])
        state = np.concatenate([*processor.apply_state(item.states, tag).values()], axis=1)[0]
        action = np.concatenate([*processor.apply_action(item.actions, tag).values()], axis=1)[0]
        for name, values in every.items():
            low, high = values.min(axis=0), values.max(axis=0)
            expected[name] = 2 * (expected[name] - low) / (high - low) - 1
        if len(state) == 7:  # The dataset's own names have one finger as the gripper, as in starVLA.
            expected["state"] = np.delete(expected["state"], 6)
        images = {view: item.images[view][0] for view in ("image", "wrist_image")}
        yield {"state": state, "action": action, "text": item.text, **images}, expected


def main() -> None:
    client, root, *further = sys.argv[1:]
    readers: dict[str, Callable[..., Iterator[tuple[Sample, Sample]]]]
    readers = {"lerobot": lerobot, "starvla": starvla, "openpi": openpi, "gr00t": gr00t}
    furthest: dict[str, float] = {}
    equal: set[str] = set()
    samples = 0
    for read, expected in readers[client](Path(root).resolve(), *further):
        for name in read:
            if isinstance(read[name], str | list):
                assert read[name] == expected[name], f"{name}: {read[name]!r} for {expected[name]!r}"
                equal.add(name)
                continue
            apart = np.abs(np.asarray(read[name], float) - np.asarray(expected[name], float))
            furthest[name] = max(furthest.get(name, 0.0), float(apart.max()))
        samples += 1
    print(f"{client}: {samples} steps of {root}; equal: {sorted(equal)}; largest difference: {furthest}")


if __name__ == "__main__":
    main()
