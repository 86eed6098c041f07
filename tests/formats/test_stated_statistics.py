"""Statistics of a camera compared with the counts of levels in some of its frames."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.formats.stated_statistics import wrong_sample


def stated(frames: NDArray[np.uint8], std_factor: float = 1.0) -> dict[str, NDArray[Any]]:
    """Return NumPy's statistics of frames (T, H, W, 3) in [0, 1], as lerobot stores them."""
    values = frames / 255
    figures = {name: getattr(values, name)(axis=(0, 1, 2)) for name in ("mean", "std", "min", "max")}
    figures["std"] = figures["std"] * std_factor
    return figures | {"count": np.array([len(frames)])}


def counts(frames: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Count the levels of each channel, (3, 256)."""
    return np.array([np.bincount(frames[..., channel].ravel(), minlength=256) for channel in range(3)])


def test_a_channel_of_one_level_has_no_deviation() -> None:
    """A deviation from mean squares is NaN for some of the 256 levels."""
    for level in range(256):
        frames = np.full((2, 8, 8, 3), level, np.uint8)
        assert list(wrong_sample("camera", stated(frames), counts(frames), 2)) == []


@pytest.mark.parametrize(("factor", "faults"), [(1.0, 0), (0.1, 1), (10.0, 1)])
def test_a_wrong_deviation_is_found(factor: float, faults: int) -> None:
    frames = np.random.default_rng(0).integers(0, 256, (2, 8, 8, 3), np.uint8)
    found = [statement for statement, _ in wrong_sample("camera", stated(frames, factor), counts(frames), 2)]
    assert len(found) == faults
    assert all(statement.startswith("std of camera is") for statement in found)
