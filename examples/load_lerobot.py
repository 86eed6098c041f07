"""Loading of a run's LeRobot dataset as a PyTorch dataset: python examples/load_lerobot.py data/starter

A policy that predicts several actions at once gets them through ``delta_timestamps``, in seconds from the frame.
"""

import argparse
from pathlib import Path

from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch.utils.data import DataLoader

FPS_HZ = 20
CHUNK = 10
"""Number of actions in each sample."""


def main(run: Path) -> None:
    (root,) = (run / "lerobot").iterdir()
    dataset = LeRobotDataset(
        root.name,  # only a name: the dataset in `root` is not looked up on the hub
        root=root,
        video_backend="pyav",
        delta_timestamps={"action": [step / FPS_HZ for step in range(CHUNK)]},
    )
    print(f"{root.name}: {dataset.num_episodes} episodes, {dataset.num_frames} frames at {dataset.fps} Hz")
    labels = dataset.meta.episodes[0]
    for start, text in zip(labels["subtask_starts"], labels["subtask_texts"], strict=True):
        print(f"  episode 0, from step {start}: {text}")
    print(f"  episode 0 has {len(labels['rewrites'])} rewrites of its instruction")
    batch = next(iter(DataLoader(dataset, batch_size=4, shuffle=True)))
    for name in (*dataset.meta.camera_keys, "observation.state", "action"):
        print(f"  {name}: {tuple(batch[name].shape)}")  # images are (N, 3, 256, 256), from 0 to 1
    for instruction in batch["task"]:
        print(f"  instruction: {instruction}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run", type=Path, help="folder of a finished run")
    main(parser.parse_args().run)
