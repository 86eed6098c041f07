"""Six small episodes without a simulator, and every format written from them.

No heavy module is imported here: a process that is killed on purpose must start quickly.
"""

import struct
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import google_crc32c
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipeline import seeding
from pipeline.episode_schema import SCHEMA, Content
from pipeline.formats.base import Format
from pipeline.formats.episodes import EpisodeFacts, Episodes
from pipeline.formats.hdf5 import Hdf5, Hdf5Config
from pipeline.formats.lerobot import LeRobot, LeRobotConfig, LeRobotV21, LeRobotV21Config
from pipeline.formats.rlds import Rlds, RldsConfig
from pipeline.run.export import export
from pipeline.types import Episode, Extra, Geometry, Jpeg, Push, Replay, Scene, Start, Subtask

IDS = [f"episode-{k}" for k in (3, 0, 4, 1, 5, 2)]
NAME = "synthetic"
SET = f"{NAME}_spatial"
TASK = "libero_spatial/pick_up_the_black_bowl_next_to_the_plate_and_place_it_on_the_plate"
DEMO = f"{TASK}/demo_0"
REPO = NAME

REWRITES = ("kindly put the bowl on the plate", "the plate is where the bowl goes")
SUBTASKS = (Subtask(0, "approach the bowl"), Subtask(5, "grasp the bowl"), Subtask(10, "move the bowl to the plate"))
WITHOUT_LABELS = IDS[0]
"""Episode without subtasks and rewrites, the first of its files."""

MATRICES = {"intrinsics": (3, 3), "extrinsics": (4, 4)}
EXTRAS: tuple[Extra, ...] = ("depth", "segmentation", "object_poses", "boxes")

Tree = dict[str, bytes]


@cache
def episode(episode_id: str) -> Episode:
    """Generate 12 to 20 steps of a disc that crosses a soft background."""
    rng = seeding.rng("test_writers", episode_id)
    steps = int(rng.integers(12, 21))
    noise = rng.integers(0, 256, (256, 256, 3), np.uint8)
    background = cv2.convertScaleAbs(cv2.GaussianBlur(noise, (0, 0), 12), alpha=6, beta=-640)

    def frame(t: int, gray: int) -> Jpeg:
        canvas = background.copy()
        cv2.circle(canvas, (40 + 8 * t, 120 + 3 * t), 24, (gray, 120, 90), -1, cv2.LINE_AA)
        return Jpeg(cv2.imencode(".jpg", canvas, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes())

    def matrix(size: int) -> NDArray[np.float32]:
        return rng.normal(size=(size, size)).astype(np.float32)

    action = rng.uniform(-1, 1, (steps, 7)).astype(np.float32)
    action[:, 6] = np.where(np.arange(steps) < 6, -1, 1)
    state = rng.normal(size=(steps, 8)).astype(np.float32)
    provenance: dict[str, Any] = {}
    for column, dtype in SCHEMA.provenance.items():
        provenance[column] = {"string": f"{column} of {episode_id}", "int64": 7, "float32": 0.5}[dtype]
    return Episode(
        episode_id=episode_id,
        frames={
            "image": [frame(t, 60) for t in range(steps)],
            "wrist_image": [frame(t, 170) for t in range(steps)],
        },
        state=state,
        joint_state=rng.normal(size=(steps, 7)).astype(np.float32),
        action=action,
        action_absolute=goals(state, action),
        instruction=["put the bowl on the plate", "öffne die obere Schublade"][int(rng.integers(2))],
        provenance=provenance | {"episode_id": episode_id},
        geometry={view: Geometry(matrix(3), matrix(4)) for view in SCHEMA.views},
        rewrites=() if episode_id == WITHOUT_LABELS else REWRITES,
        subtasks=() if episode_id == WITHOUT_LABELS else SUBTASKS,
        replay=replay_of(action),
    )


def replay_of(action: NDArray[np.float32]) -> Replay:
    """Return a replay of these actions; its actions have the digits of double precision."""
    steps = len(action)
    rng = seeding.rng("test_writers", "replay", steps)
    push = Push("robot0_link7", (1.0, 2.0, 3.0, 0.0, 0.0, 0.0), 2, 4)
    start = Start(gripper=-1.0, posture_rad=(0.1,) * 7, push=push)
    scene = Scene("<mujoco/>", rng.normal(size=30), start=start)
    actions = action.astype(np.float64)
    return Replay(actions, rng.normal(size=(steps, 30)), scene, "origin")


def goals(state: NDArray[np.float32], action: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the absolute actions (T, 7) of actions that all turn the hand."""
    hands, turns = Rotation.from_rotvec(state[:, 3:6]), Rotation.from_rotvec(0.5 * action[:, 3:6])
    axis_angles = (turns * hands * Rotation.from_euler("z", -90, degrees=True)).as_rotvec()
    return np.hstack([state[:, :3] + 0.05 * action[:, :3], axis_angles, action[:, 6:]]).astype(np.float32)


@cache
def with_extras(episode_id: str) -> Episode:
    """Generate the episode of ``episode`` with depth, segmentation, poses and boxes."""
    source, rng = episode(episode_id), seeding.rng("test_writers", "extras", episode_id)
    steps = len(source)

    def maps() -> dict[Extra, list[bytes]]:
        ramp = np.add.outer(np.arange(256), np.arange(256)) + rng.integers(65000, size=(steps, 1, 1))
        small = (ramp // 64 % 24).astype(np.uint8)
        return {
            "depth": [cv2.imencode(".png", each.astype(np.uint16))[1].tobytes() for each in ramp],
            "segmentation": [cv2.imencode(".png", each)[1].tobytes() for each in small],
        }

    def boxes() -> NDArray[np.float32]:
        return rng.integers(0, 128, size=(steps, 24, 4)).astype(np.float32)

    return replace(
        source,
        geometry={view: replace(seen, maps=maps(), boxes=boxes()) for view, seen in source.geometry.items()},
        object_poses=rng.normal(size=(steps, 24, 7)).astype(np.float32),
        instances=("nothing", "robot", episode_id),
    )


def loop(fn: Callable[[Any], Any], items: Sequence[Any], description: str) -> list[Any]:
    return [fn(item) for item in items]


def loaded_packages() -> set[str]:
    return {name.split(".")[0] for name in sys.modules}


def files(folder: Path) -> Tree:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def episodes(load: Callable[[str], Episode] = episode, content: str = "first") -> Episodes:
    facts: dict[str, EpisodeFacts] = {}
    for episode_id in IDS:
        source = episode(episode_id)
        facts[episode_id] = EpisodeFacts("libero_spatial", content, DEMO, source.instruction, len(source))
    return Episodes(facts, load)


def write_format(kind: type[Format[Any]], out: Path) -> Format[Any]:
    """Write the dataset of a format with its default options."""
    target = kind(out, kind.options_type(name=NAME))
    export(target, episodes(), loop)
    return target


def write_rlds(
    out: Path, load: Callable[[str], Episode] = episode, run: Any = loop, extras: Sequence[Extra] = ()
) -> Rlds:
    target = Rlds(out, RldsConfig(name=NAME, shards=3), Content(extras=tuple(extras)))
    export(target, episodes(load), run)
    return target


def write_lerobot(
    out: Path,
    load: Callable[[str], Episode] = episode,
    run: Any = loop,
    frames: Any = "video",
    name: str = NAME,
    extras: Sequence[Extra] = (),
    shards: int = 3,
) -> LeRobot:
    target = LeRobot(out, LeRobotConfig(name=name, shards=shards, frames=frames), Content(extras=tuple(extras)))
    export(target, episodes(load), run)
    return target


def write_lerobot_v21(
    out: Path,
    convention: Any = "ipec",
    load: Callable[[str], Episode] = episode,
    run: Any = loop,
    extras: Sequence[Extra] = (),
) -> LeRobotV21:
    target = LeRobotV21(out, LeRobotV21Config(name=NAME, convention=convention), Content(extras=tuple(extras)))
    export(target, episodes(load), run)
    return target


def write_hdf5(
    out: Path, load: Callable[[str], Episode] = episode, run: Any = loop, extras: Sequence[Extra] = ()
) -> Hdf5:
    target = Hdf5(out, Hdf5Config(name=NAME), Content(extras=tuple(extras)))
    export(target, episodes(load), run)
    return target


def records(shard: Path) -> Iterator[bytes]:
    """Read the records of a TFRecord file, and verify checksums independently of the writer."""
    data, start = shard.read_bytes(), 0
    while start < len(data):
        (length,) = struct.unpack_from("<Q", data, start)
        end = start + 12 + length
        for begin, stop in ((start, start + 8), (start + 12, end)):
            crc = google_crc32c.value(data[begin:stop])
            rotated = ((crc >> 15) | (crc << 17 & 0xFFFFFFFF)) + 0xA282EAD8
            assert struct.unpack_from("<I", data, stop)[0] == rotated % 2**32
        yield data[start + 12 : end]
        start = end + 4
