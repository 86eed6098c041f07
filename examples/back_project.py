"""Back-projection of depth to points in the world: python examples/back_project.py data/mine

The run needs ``render: {extras: [depth, segmentation, object_poses]}``. For each object of the first episodes, the
script prints the distance of its visible points from its recorded position.
"""

import argparse
import json
from collections.abc import Mapping
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import tensorflow_datasets as tfds
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipeline.formats.tfrecord import records

Array = NDArray[Any]


def main(run: Path) -> None:
    for folder in sorted((run / "rlds").glob("*/1.0.0")):  # one set for each suite
        features = tfds.builder_from_directory(folder).info.features
        shards = sorted(folder.glob("*.tfrecord-*"))
        record = next(chain.from_iterable(map(records, shards)))
        episode = features.deserialize_example_np(record)
        metadata, seen = episode["episode_metadata"], next(iter(episode["steps"]))["observation"]
        for view in ("image", "wrist_image"):
            points_m = back_project(view, seen, metadata)
            for place, name in enumerate(json.loads(metadata["instances"])):
                mask, pose = seen[f"{view}_segmentation"][..., 0] == place, seen["object_poses"][place]
                if mask.any() and pose.any():
                    off_m = np.linalg.norm(points_m[mask].mean(axis=0) - pose[:3])
                    print(f"{folder.parent.name} {view}: {name} on {mask.sum()} pixels, {off_m:.3f} m from its place")


def back_project(view: str, seen: Mapping[str, Array], metadata: Mapping[str, Array]) -> Array:
    """Return the point in the world that each pixel of a view shows, (256, 256, 3) in m."""
    depth_m = seen[f"{view}_depth"][..., 0] * 1e-4
    row, column = np.indices(depth_m.shape)  # pixel centres have integer coordinates
    rays = np.stack([column, row, np.ones_like(row)], axis=-1) @ np.linalg.inv(metadata[f"{view}_intrinsics"]).T
    to_world = metadata[f"{view}_extrinsics"]
    if view == "wrist_image":  # its extrinsics are relative to the end effector, whose pose is the state
        hand = np.eye(4)
        hand[:3, :3], hand[:3, 3] = Rotation.from_rotvec(seen["state"][3:6]).as_matrix(), seen["state"][:3]
        to_world = hand @ to_world
    points_m: Array = (rays * depth_m[..., None]) @ to_world[:3, :3].T + to_world[:3, 3]
    return points_m


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run", type=Path, help="folder of a finished run")
    main(parser.parse_args().run)
