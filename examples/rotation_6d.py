"""Conversion of absolute actions to the 6D rotations of X-VLA and other policies, and back.

    python examples/rotation_6d.py data/starter

The 6D rotation of Zhou et al. (arXiv:1812.07035) is the first two columns of the rotation matrix, one after the other.
The script prints the first absolute action of a LeRobot dataset in both forms.
"""

import argparse
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]


def to_6d(axis_angle: Array) -> Array:
    """Convert axis-angle rotations (N, 3) in rad to 6D rotations (N, 6)."""
    matrices = Rotation.from_rotvec(axis_angle).as_matrix()
    return np.concatenate([matrices[..., 0], matrices[..., 1]], axis=-1)


def from_6d(rotation: Array) -> Array:
    """Convert 6D rotations (N, 6), also inexact ones as a policy predicts them, to axis-angle (N, 3) in rad."""
    first = rotation[..., :3] / np.linalg.norm(rotation[..., :3], axis=-1, keepdims=True)
    rest = rotation[..., 3:] - (first * rotation[..., 3:]).sum(axis=-1, keepdims=True) * first
    second = rest / np.linalg.norm(rest, axis=-1, keepdims=True)
    matrices = np.stack([first, second, np.cross(first, second)], axis=-1)
    return np.asarray(Rotation.from_matrix(matrices).as_rotvec())


def main(run: Path) -> None:
    file = min((run / "lerobot").glob("*/data/*/*.parquet"))
    # With export.lerobot.action: absolute, the column `action` has the absolute actions.
    column = "absolute_action" if "absolute_action" in pq.read_schema(file).names else "action"
    action = np.array(pq.read_table(file, columns=[column])[column][0].as_py())
    position_m, axis_angle, gripper = action[:3], action[3:6], action[6:]
    six = to_6d(axis_angle[None])[0]
    print("axis-angle", action.round(4).tolist())
    print("6D        ", np.concatenate([position_m, six, gripper]).round(4).tolist())
    turned = Rotation.from_rotvec(from_6d(six[None])[0]).inv() * Rotation.from_rotvec(axis_angle)
    print(f"back again: {turned.magnitude():.1e} rad apart")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run", type=Path, help="folder of a finished run")
    main(parser.parse_args().run)
