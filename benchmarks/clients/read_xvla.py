"""Comparison of absolute actions in 6D, as X-VLA's own loader and lerobot's X-VLA policy read them, with the files.

ROOT is a dataset of the format ``lerobot_openpi``, whose JPEG files X-VLA's HDF5 files take over. The first command
writes a file for each episode, in this project's environment; the second one compares in lerobot's (0.6.1, with
robosuite 1.4.0 for the rotations of LIBERO's controller):

    python benchmarks/clients/read_xvla.py write ROOT OUT
    ENV/bin/python benchmarks/clients/read_xvla.py convert ROOT

The third one runs in a checkout of X-VLA, in an environment with the imports of its loader:

    uv pip install --python ENV torch==2.7.1 torchvision==0.22.1 mmengine h5py opencv-python-headless av pyarrow scipy
    PYTHONPATH=. ENV/bin/python .../read_xvla.py read OUT
"""

import importlib
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

CHUNK = 30
"""Number of actions in a sample, one second of the loader's 30 per second: each of our steps is one of its steps."""


def episodes(root: Path) -> Any:
    """Yield the instruction, absolute actions (T, 7), and the JPEG files of both views of each episode."""
    pq: Any = importlib.import_module("pyarrow.parquet")
    lines = (root / "meta" / "episodes.jsonl").read_text().splitlines()
    for file, line in zip(sorted(root.glob("data/*/*.parquet")), lines, strict=True):
        table = pq.read_table(file)
        views = []
        for view in ("image", "wrist_image"):
            views.append([cell["bytes"] for cell in table[view].to_pylist()])
        yield json.loads(line)["tasks"][0], np.stack(table["absolute_action"].to_numpy()), views


def in_6d(actions: Any) -> Any:
    """Convert absolute actions (T, 7) to (T, 10): position, 6D rotation, gripper."""
    sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "examples"))
    example: Any = importlib.import_module("rotation_6d")
    six = example.to_6d(actions[:, 3:6].astype(np.float64))
    return np.concatenate([actions[:, :3], six, actions[:, 6:]], axis=1)


def write(root: Path, out: Path) -> None:
    """Write the HDF5 files and the metadata of X-VLA's handler of LIBERO."""
    h5py: Any = importlib.import_module("h5py")
    out.mkdir(parents=True)
    files = []
    for number, (text, actions, views) in enumerate(episodes(root)):
        files.append(str(out.resolve() / f"{number:06d}.hdf5"))
        with h5py.File(files[-1], "w") as file:
            file["abs_action_6d"] = in_6d(actions)
            file["language_instruction"] = text
            for name, packed in zip(("image", "wrist_image"), views, strict=True):
                column = file.create_dataset(name, (len(packed),), h5py.vlen_dtype(np.uint8))
                for step, jpeg in enumerate(packed):
                    column[step] = np.frombuffer(jpeg, np.uint8)
    meta = {"dataset_name": "libero", "datalist": files, "observation_key": ["image", "wrist_image"]}
    (out / "meta.json").write_text(json.dumps({**meta, "language_instruction_key": "language_instruction"}))
    print(f"{len(files)} episodes")


def convert(root: Path) -> None:
    """Compare the example's 6D rotations with lerobot's processors, and with robosuite's matrices."""
    torch: Any = importlib.import_module("torch")
    processors: Any = importlib.import_module("lerobot.policies.xvla.processor_xvla")
    utilities: Any = importlib.import_module("lerobot.policies.xvla.utils")
    transforms: Any = importlib.import_module("robosuite.utils.transform_utils")
    rotation: Any = importlib.import_module("scipy.spatial.transform").Rotation
    actions = np.concatenate([absolute for _, absolute, _ in episodes(root)])
    ours = in_6d(actions)
    matrices = []
    for axis_angle in actions[:, 3:6].astype(np.float64):
        matrices.append(transforms.quat2mat(transforms.axisangle2quat(axis_angle)))
    theirs = utilities.mat_to_rotate6d(np.stack(matrices))
    # The policy's gripper is a probability: above 0.5 it closes.
    predicted = np.concatenate([ours[:, :9], ours[:, 9:] > 0], axis=1)
    step = processors.XVLARotation6DToAxisAngleProcessorStep()
    back = step({"action": torch.from_numpy(predicted)})["action"].numpy()
    turned = rotation.from_rotvec(back[:, 3:6]).inv() * rotation.from_rotvec(actions[:, 3:6])
    figures = {"actions": len(actions), "6d": float(np.abs(ours[:, 3:9] - theirs).max())}
    figures |= {"back_rad": float(turned.magnitude().max())}
    figures |= {"position_and_gripper": float(np.abs(np.delete(back - actions, (3, 4, 5), axis=1)).max())}
    print(json.dumps(figures))


def read(out: Path) -> None:
    """Read every sample of X-VLA's loader, and compare it with the files.

    The loader of 2c4fedf, a copy of X-VLA, decodes JPEG files with red and blue swapped; X-VLA's 7a6c08a does not.
    """
    h5py: Any = importlib.import_module("h5py")
    torch: Any = importlib.import_module("torch")
    image_of: Any = importlib.import_module("PIL.Image")
    cv2: Any = importlib.import_module("cv2")
    module: Any = importlib.import_module("datasets.dataset")  # X-VLA's package, not that of Hugging Face
    reader = module.InfiniteDataReader(str(out / "meta.json"), num_actions=CHUNK, num_views=2, training=False)
    samples = iter(reader)
    furthest = dict.fromkeys(("proprio", "action", "image", "image with red and blue swapped"), 0.0)
    count = 0
    for path in json.loads((out / "meta.json").read_text())["datalist"]:
        with h5py.File(path) as file:
            actions, text = file["abs_action_6d"][()], file["language_instruction"][()].decode()
            packed = {name: list(file[name]) for name in ("image", "wrist_image")}
        actions[:, 9] = actions[:, 9] > 0
        for step in range(len(actions) - 10):
            if np.abs(actions[step + 1] - actions[step]).max() < 1e-5:
                continue  # the loader leaves out steps without motion
            sample = next(samples)
            count += 1
            assert sample["language_instruction"] == text
            # One second from this step, or the shorter rest of the episode, in as many samples.
            last = min(step + CHUNK, len(actions) - 1)
            at = np.linspace(step, last, CHUNK + 1)
            expected = np.stack([np.interp(at, np.arange(len(actions)), column) for column in actions.T], axis=1)
            for name, values in (("proprio", expected[0]), ("action", expected[1:])):
                apart = np.abs(sample[name].numpy()[..., :10] - values)
                furthest[name] = max(furthest[name], float(apart.max()))
            if step % 20:
                continue
            # The image before the first of these actions is that of the next step.
            for view, name in enumerate(packed):
                bgr = cv2.imdecode(packed[name][step + 1], cv2.IMREAD_COLOR)
                orders = {"image": cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), "image with red and blue swapped": bgr}
                for order, frame in orders.items():
                    shown = reader.image_aug(image_of.fromarray(frame))
                    apart = torch.abs(sample["image_input"][view] - shown)
                    furthest[order] = max(furthest[order], float(apart.max()))
    assert next(samples, None) is None
    print(json.dumps({"samples": count, "largest_difference": furthest}))


def main() -> None:
    command, *folders = sys.argv[1:]
    commands: dict[str, Callable[..., None]] = {"write": write, "convert": convert, "read": read}
    commands[command](*map(Path, folders))


if __name__ == "__main__":
    main()
