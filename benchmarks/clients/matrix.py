"""Table of the installed lerobot's results with a LeRobot dataset; the last printed line is JSON.

The script runs in the client's environment, which need not have this project. ROOT is a dataset of version 3.0, or 2.1
for lerobot before 0.4. With version 2.1 only loading, training and pushing are tried:

    ENV/bin/python benchmarks/clients/matrix.py ROOT
"""

import importlib
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

ACT = {"type": "act", "device": "cpu", "push_to_hub": "false", "pretrained_backbone_weights": "null"}
ACT |= {"chunk_size": "4", "n_action_steps": "4", "dim_model": "16", "n_heads": "2", "dim_feedforward": "16"}


class Client:
    """lerobot on one dataset; each public method is a row of the table and raises if lerobot fails.

    Args:
        root: the dataset, which stays unchanged.
        out: a folder for outputs.
    """

    def __init__(self, root: Path, out: Path):
        self._root, self._out = root, out
        self._datasets: Any = importlib.import_module("lerobot.datasets.lerobot_dataset")

    def _open(self, root: Path) -> Any:
        return self._datasets.LeRobotDataset(root.name, root=root, video_backend="pyav")

    def _tools(self) -> Any:
        return importlib.import_module("lerobot.datasets.dataset_tools")

    def load(self) -> None:
        dataset = self._open(self._root)
        for index in range(0, len(dataset), max(1, len(dataset) // 10)):
            name = "action" if "action" in dataset[index] else "actions"
            assert np.isfinite(np.asarray(dataset[index][name])).all()

    def stream(self) -> None:
        streaming: Any = importlib.import_module("lerobot.datasets.streaming_dataset")
        indices = sorted(int(item["index"]) for item in streaming.StreamingLeRobotDataset("x", root=self._root))
        assert indices == list(range(len(self._open(self._root))))

    def train(self) -> None:
        name = "lerobot_train" if version("lerobot") >= "0.4" else "train"
        command = [sys.executable, "-m", f"lerobot.scripts.{name}", f"--dataset.repo_id={self._root.name}"]
        command += [f"--dataset.root={self._root}", "--dataset.video_backend=pyav", f"--output_dir={self._out / 'act'}"]
        command += [f"--policy.{option}={value}" for option, value in ACT.items()]
        command += ["--steps=2", "--save_freq=2", "--batch_size=2", "--num_workers=0", "--wandb.enable=false"]
        done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=self._out)
        assert done.returncode == 0, done.stderr.strip().splitlines()[-1]

    def delete(self) -> None:
        whole = self._open(self._root)
        fewer = self._tools().delete_episodes(whole, [0], output_dir=self._out / "fewer", repo_id="fewer")
        assert fewer.meta.total_episodes == whole.meta.total_episodes - 1

    def split_and_merge(self) -> None:
        whole = self._open(self._root)
        total = whole.meta.total_episodes
        parts = {"one": [0], "rest": list(range(1, total))}
        halves = self._tools().split_dataset(whole, parts, output_dir=self._out / "halves")
        merged = self._tools().merge_datasets(
            [halves["rest"], halves["one"]], output_repo_id="merged", output_dir=self._out / "merged"
        )
        assert (merged.meta.total_episodes, len(merged)) == (total, len(whole))

    def add_and_remove_feature(self) -> None:
        whole, tools = self._open(self._root), self._tools()
        values = np.arange(len(whole), dtype=np.float32)[:, None]
        spec = {"dtype": "float32", "shape": (1,), "names": None}
        more = tools.add_features(whole, {"weight": (values, spec)}, output_dir=self._out / "more", repo_id="more")
        assert float(more[len(whole) - 1]["weight"]) == len(whole) - 1
        again = tools.remove_feature(more, "weight", output_dir=self._out / "again", repo_id="again")
        assert again.meta.features.keys() == whole.meta.features.keys()

    def push(self) -> None:
        """Run lerobot's own ``push_to_hub``, with a local folder instead of the network; then load that folder."""
        hub = self._out / "hub"

        class Local:
            """Methods of huggingface_hub's client that ``push_to_hub`` calls."""

            def upload_folder(self, *, folder_path: Any, ignore_patterns: Any = None, **_: Any) -> None:
                shutil.copytree(folder_path, hub, ignore=shutil.ignore_patterns(*(ignore_patterns or ())))

            def __getattr__(self, name: str) -> Callable[..., None]:
                return lambda *_, **__: None

        module: Any = sys.modules[type(self._open(self._root)).push_to_hub.__module__]
        with mock.patch.object(module, "HfApi", Local), mock.patch("huggingface_hub.DatasetCard.push_to_hub"):
            self._open(self._root).push_to_hub()
        assert len(self._open(hub)) == len(self._open(self._root))


def main() -> None:
    (root,) = map(Path, sys.argv[1:])
    root = root.resolve()
    codebase = json.loads((root / "meta" / "info.json").read_text())["codebase_version"]
    runs = ["load", "train", "push"]
    if codebase != "v2.1":
        runs += ["stream", "delete", "split_and_merge", "add_and_remove_feature"]
    rows: dict[str, str] = {}
    for name in runs:
        with tempfile.TemporaryDirectory() as out:
            try:
                getattr(Client(root, Path(out)), name)()
                rows[name] = "passed"
            except Exception as error:
                rows[name] = f"{type(error).__name__}: {error}".splitlines()[0][:160]
    print("| client | version | Python | format | run | result |\n|---|---|---|---|---|---|")
    python = f"{sys.version_info.major}.{sys.version_info.minor}"
    for name, result in rows.items():
        print(f"| lerobot | {version('lerobot')} | {python} | {codebase} | {name} | {result} |")
    print(
        json.dumps(
            {"client": "lerobot", "version": version("lerobot"), "python": python, "format": codebase, "runs": rows}
        )
    )


if __name__ == "__main__":
    main()
