"""Comparison of the statistics that a dataset states of its columns with the columns; lerobot's, by their names.

This module shares no code with ``exact_statistics.py``, whose results it checks.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

FIGURES = ("count", "mean", "std", "min", "max")
"""lerobot's statistics."""

QUANTILE_NAMES = ("q01", "q10", "q50", "q90", "q99")
"""Names of additional statistics of v3.0; pi0.5 normalises by them."""

SAME_SHARE, SAME = 1e-4, 1e-6
"""Largest relative and absolute difference between stored statistics and those of the columns."""

MEAN_LEVELS, DEVIATION = 40.0, 2.0
"""Largest difference between an episode's three sampled frames and all of its frames: of the mean, in 255 levels, and
of the deviation, as a quotient. In 685 views of libero_spatial and ``configs/starter.yaml`` the largest were 13.0 and
1.29. The limits are far from these, as a run may have 56,000 views.
"""


Stored = Mapping[str, Any]
"""Statistics of one column as they are stored, by name."""

Wrong = Iterator[tuple[str, str]]
"""Differences, each as the stored and the expected value in words."""


def complete(column: str, stored: Stored, names: Sequence[str], channels: int) -> Wrong:
    """Compare the names of a column's stored statistics and their numbers of entries with the required ones."""
    sizes = {name: np.size(values) for name, values in stored.items()}
    wanted = {name: 1 if name == "count" else channels for name in names}
    if sizes != wanted:
        yield f"the statistics of {column} have the entries {sizes}", f"{wanted}"


def wrong_numbers(column: str, stored: Stored, values: NDArray[Any], quantiles: Sequence[str]) -> Wrong:
    """Compare the stored statistics of a column, which must be complete, with its values (N, D)."""
    exact = values.astype(float)
    wanted = {name: getattr(exact, name)(axis=0) for name in ("mean", "std", "min", "max")}
    shares = [int(name[1:]) / 100 for name in quantiles]
    wanted |= dict(zip(quantiles, np.quantile(exact, shares, axis=0), strict=True))
    wanted["count"] = np.array([len(exact)])
    for name, expected in wanted.items():
        yield from unlike_figures(f"{name} of {column}", stored[name], expected)


def wrong_pixels(column: str, stored: Stored, levels: NDArray[np.int64], quantiles: Sequence[str]) -> Wrong:
    """Compare a camera's statistics of an episode with the counts of levels in its frames, (3, 256)."""
    wanted = _of_levels(levels)
    values, shares = np.arange(256) / 255, levels.cumsum(axis=1) / levels.sum(axis=1, keepdims=True)
    for name in quantiles:
        share = int(name[1:]) / 100
        wanted[name] = np.array([values[np.argmax(channel >= share)] for channel in shares])
    for name, expected in wanted.items():
        yield from unlike_figures(f"{name} of {column}", np.ravel(stored[name]), expected)


def wrong_sample(column: str, stored: Stored, levels: NDArray[np.int64], steps: int) -> Wrong:
    """Compare a camera's statistics of an episode with the counts of levels in some of its frames, (3, 256).

    The range must contain all levels of the frames. Mean and deviation must be near those of the frames, within
    ``MEAN_LEVELS`` and ``DEVIATION``.
    """
    figures = {name: np.ravel(stored[name]) for name in FIGURES}
    sample = _of_levels(levels)
    if figures["count"].tolist() != [steps]:
        yield f"count of {column} is {figures['count'].tolist()} in the statistics", f"[{steps}]"
    if (figures["min"] > sample["min"] + SAME).any():
        yield f"min of {column} is {figures['min'].tolist()} in the statistics", f"{sample['min'].tolist()} or less"
    if (figures["max"] < sample["max"] - SAME).any():
        yield f"max of {column} is {figures['max'].tolist()} in the statistics", f"{sample['max'].tolist()} or more"
    mean, std = sample["mean"], sample["std"]
    if not (np.abs(figures["mean"] - mean) <= MEAN_LEVELS / 255).all():
        statement = f"mean of {column} is {figures['mean'].tolist()} in the statistics"
        yield statement, f"{mean.tolist()} within {MEAN_LEVELS:g} of 255 levels"
    low, high = std / DEVIATION - SAME, std * DEVIATION + SAME
    if not ((low <= figures["std"]) & (figures["std"] <= high)).all():
        statement = f"std of {column} is {figures['std'].tolist()} in the statistics"
        yield statement, f"{std.tolist()} within a factor of {DEVIATION:g}"
    yield from disordered(column, stored)


def wrong_depth(column: str, stored: Stored, maps_m: NDArray[Any], steps: int, quantiles: Sequence[str]) -> Wrong:
    """Compare an episode's statistics of depth with its maps (T, H, W) in m.

    If these are fewer than its steps, the range must contain them, and nothing else is compared.
    """
    if np.ravel(stored["count"]).tolist() != [steps]:
        yield f"count of {column} is {np.ravel(stored['count']).tolist()} in the statistics", f"[{steps}]"
    least, largest = (float(np.ravel(stored[name])[0]) for name in ("min", "max"))
    if least > maps_m.min() + SAME or largest < maps_m.max() - SAME:
        statement = f"the range of {column} is {least:g} to {largest:g} m in the statistics"
        yield statement, f"{maps_m.min():g} to {maps_m.max():g} m or more"
    yield from disordered(column, stored)
    if len(maps_m) == steps:
        wanted = {name: getattr(maps_m, name)() for name in ("mean", "std", "min", "max")}
        shares = [int(name[1:]) / 100 for name in quantiles]
        wanted |= dict(zip(quantiles, np.quantile(maps_m, shares, method="inverted_cdf"), strict=True))
        for name, expected in wanted.items():
            yield from unlike_figures(f"{name} of {column}", np.ravel(stored[name]), np.array([expected]))


def _of_levels(levels: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
    """Compute mean, deviation and range in [0, 1] of pixels from the counts of their levels, (3, 256)."""
    values, pixels = np.arange(256) / 255, levels.sum(axis=1)
    mean = levels @ values / pixels
    deviations = values - mean[:, None]
    return {
        "mean": mean,
        "std": np.sqrt((levels * deviations**2).sum(axis=1) / pixels),
        "min": np.array([values[channel > 0].min() for channel in levels]),
        "max": np.array([values[channel > 0].max() for channel in levels]),
    }


def disordered(column: str, stored: Stored) -> Wrong:
    """Compare the order of the range and the quantiles."""
    names = [name for name in ("min", *QUANTILE_NAMES, "max") if name in stored]
    figures = np.array([np.ravel(stored[name]) for name in names])
    if (np.diff(figures, axis=0) < -SAME).any():
        yield f"{', '.join(names)} of {column} are not in order: {figures.tolist()}", "each at least the one before"


def unlike_figures(what: str, stored: Any, expected: NDArray[Any]) -> Wrong:
    """Compare stored figures with expected ones, within ``SAME_SHARE`` and ``SAME``."""
    values = np.asarray(stored, float)
    if values.shape != expected.shape or not np.allclose(values, expected, rtol=SAME_SHARE, atol=SAME):
        yield f"{what} is {values.tolist()} in the statistics", f"{expected.tolist()}"
