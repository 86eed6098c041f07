"""Statistics that LeRobot datasets state, compared with the columns and with each other."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

FIGURES = ("count", "mean", "std", "min", "max")
"""lerobot's statistics."""

QUANTILES = ("q01", "q10", "q50", "q90", "q99")
"""Those of v3.0 in addition; pi0.5 normalises by them."""

SAME_SHARE, SAME = 1e-4, 1e-6
"""Largest relative and absolute difference between stored statistics and those of the columns."""

MEAN_LEVELS, DEVIATION = 25.0, 1.5
"""How far the mean (in 255 levels) and the deviation (as a quotient) of an episode's three sampled frames may be from
those of all of its frames. Of 47 episodes of ``configs/starter.yaml`` the most was 10.0 and 1.12, in wrist views."""

ENTRIES = 16
"""Entries of a column that are in memory at a time."""

Stored = Mapping[str, Any]
"""Statistics of one column as they are stored, by name."""

Wrong = Iterator[tuple[str, str]]
"""Differences, each as the stored and the expected value in words."""


def matrix(table: pa.Table, column: str) -> NDArray[Any]:
    """Values (T, D) of a column of numbers or of vectors."""
    values = table[column].combine_chunks()
    is_list = pa.types.is_list(values.type) or pa.types.is_fixed_size_list(values.type)
    flat = values.flatten() if is_list else values
    return np.asarray(flat.to_numpy(zero_copy_only=False).reshape(len(values), -1))


def complete(column: str, stored: Stored, names: Sequence[str], channels: int) -> Wrong:
    """Compare which statistics of a column are stored with those that are to be, and their number of entries."""
    sizes = {name: np.size(values) for name, values in stored.items()}
    wanted = {name: 1 if name == "count" else channels for name in names}
    if sizes != wanted:
        yield f"the statistics of {column} have the entries {sizes}", f"{wanted}"


def wrong_numbers(column: str, stored: Stored, values: NDArray[Any], quantiles: Sequence[str]) -> Wrong:
    """Compare the stored statistics of a column, which are complete, with its values (N, D)."""
    exact = values.astype(float)
    wanted = {name: getattr(exact, name)(axis=0) for name in ("mean", "std", "min", "max")}
    shares = [int(name[1:]) / 100 for name in quantiles]
    wanted |= dict(zip(quantiles, np.quantile(exact, shares, axis=0), strict=True))
    for name, expected in (wanted | {"count": np.array([len(exact)])}).items():
        yield from _unlike(f"{name} of {column}", stored[name], expected)


def wrong_in_dataset(stored: Mapping[str, Stored], files: Sequence[Path], columns: Mapping[str, Any]) -> Wrong:
    """Compare the statistics of all steps with what the data files hold, for every column of numbers.

    Args:
        columns: as ``meta/info.json`` is to describe them.
    """
    numbers = {name: of["shape"][0] for name, of in columns.items() if of["dtype"] in ("float32", "int64")}
    frames = {name for name, of in columns.items() if of["dtype"] in ("image", "video")}
    if stored.keys() != numbers.keys() | frames:
        yield f"the statistics have the columns {sorted(stored)}", f"{sorted(numbers.keys() | frames)}"
    for column, width in (numbers | dict.fromkeys(frames, 3)).items():
        yield from complete(column, stored.get(column, {}), (*FIGURES, *QUANTILES), width)
    for column, width in numbers.items():
        if any(complete(column, stored.get(column, {}), (*FIGURES, *QUANTILES), width)):
            continue
        for first in range(0, width, ENTRIES):
            entries = slice(first, first + ENTRIES)
            read = [
                matrix(pq.ParquetFile(file).read([column], use_threads=False), column)[:, entries] for file in files
            ]
            part = {name: value if name == "count" else value[entries] for name, value in stored[column].items()}
            yield from wrong_numbers(column, part, np.concatenate(read), QUANTILES)


def _entries(file: Path, column: str) -> NDArray[Any]:
    return matrix(pq.ParquetFile(file).read([column], use_threads=False), column)


def wrong_frames(column: str, stored: Stored, episodes: Mapping[str, NDArray[Any]]) -> Wrong:
    """Compare a camera's statistics over all frames with those of the episodes, which say what they come to.

    Mean, deviation and range follow from them. A quantile lies between the least and the largest of the episodes', and
    where these are not stated, as in version 2.1, within the bounds of Cantelli's inequality.
    Nothing is compared where one of them is not complete, which is told elsewhere.

    Args:
        episodes: name to the statistics of all episodes, (episodes, 3), of the count (episodes, 1).
    """
    if any(complete(column, stored, (*FIGURES, *QUANTILES), 3)):
        return
    frames = episodes["count"]
    mean = (frames * episodes["mean"]).sum(axis=0) / frames.sum()
    spread = episodes["std"] ** 2 + (episodes["mean"] - mean) ** 2
    wanted = {
        "count": frames.sum(axis=0),
        "mean": mean,
        "std": np.sqrt((frames * spread).sum(axis=0) / frames.sum()),
        "min": episodes["min"].min(axis=0),
        "max": episodes["max"].max(axis=0),
    }
    for name, expected in wanted.items():
        yield from _unlike(f"{name} of {column}", np.ravel(stored[name]), expected)
    mean, std = wanted["mean"], wanted["std"]
    for name in QUANTILES:
        levels, share = np.ravel(stored[name]), int(name[1:]) / 100
        least, most = mean - std * np.sqrt((1 - share) / share), mean + std * np.sqrt(share / (1 - share))
        if name in episodes:
            least, most = episodes[name].min(axis=0), episodes[name].max(axis=0)
        if not ((levels >= least - SAME) & (levels <= most + SAME)).all():
            what = f"{name} of {column} is {levels.tolist()} in the statistics"
            yield what, f"from {least.tolist()} to {most.tolist()}, as follows from those of the episodes"
    yield from _disordered(column, stored)


def wrong_pixels(column: str, stored: Stored, levels: NDArray[np.int64], quantiles: Sequence[str]) -> Wrong:
    """Compare a camera's statistics of an episode with how often each level occurs in its frames, (3, 256)."""
    wanted = _of_levels(levels)
    values, shares = np.arange(256) / 255, levels.cumsum(axis=1) / levels.sum(axis=1, keepdims=True)
    for name in quantiles:
        wanted[name] = np.array([values[np.argmax(channel >= int(name[1:]) / 100)] for channel in shares])
    for name, expected in wanted.items():
        yield from _unlike(f"{name} of {column}", np.ravel(stored[name]), expected)


def wrong_sample(column: str, stored: Stored, levels: NDArray[np.int64], steps: int) -> Wrong:
    """Compare a camera's statistics of an episode with how often each level occurs in some of its frames, (3, 256).

    The range holds all levels of the frames. Mean and deviation are as near to those of the frames as the frames of an
    episode are alike: see ``MEAN_LEVELS`` and ``DEVIATION``.
    """
    figures = {name: np.ravel(stored[name]) for name in FIGURES}
    seen = _of_levels(levels)
    if figures["count"].tolist() != [steps]:
        yield f"count of {column} is {figures['count'].tolist()} in the statistics", f"[{steps}]"
    if (figures["min"] > seen["min"] + SAME).any():
        yield f"min of {column} is {figures['min'].tolist()} in the statistics", f"{seen['min'].tolist()} or less"
    if (figures["max"] < seen["max"] - SAME).any():
        yield f"max of {column} is {figures['max'].tolist()} in the statistics", f"{seen['max'].tolist()} or more"
    mean, std = seen["mean"], seen["std"]
    if not (np.abs(figures["mean"] - mean) <= MEAN_LEVELS / 255).all():
        what = f"mean of {column} is {figures['mean'].tolist()} in the statistics"
        yield what, f"{mean.tolist()} within {MEAN_LEVELS:g} of 255 levels"
    if not ((figures["std"] * DEVIATION >= std) & (figures["std"] <= std * DEVIATION)).all():
        what = f"std of {column} is {figures['std'].tolist()} in the statistics"
        yield what, f"{std.tolist()} within a factor of {DEVIATION:g}"
    yield from _disordered(column, stored)


def _of_levels(levels: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
    """Mean, deviation and range in [0, 1] of pixels whose levels occur so often, (3, 256)."""
    values, pixels = np.arange(256) / 255, levels.sum(axis=1)
    mean = levels @ values / pixels
    return {
        "mean": mean,
        "std": np.sqrt(levels @ values**2 / pixels - mean**2),
        "min": np.array([values[channel > 0].min() for channel in levels]),
        "max": np.array([values[channel > 0].max() for channel in levels]),
    }


def _disordered(column: str, stored: Stored) -> Wrong:
    """Range, quantiles and mean in their order."""
    names = [name for name in ("min", *QUANTILES, "max") if name in stored]
    figures = np.array([np.ravel(stored[name]) for name in names])
    if (np.diff(figures, axis=0) < -SAME).any():
        yield f"{', '.join(names)} of {column} are not in order: {figures.tolist()}", "each at least the one before"


def _unlike(what: str, found: Any, expected: NDArray[Any]) -> Wrong:
    stored = np.asarray(found, float)
    if stored.shape != expected.shape or not np.allclose(stored, expected, rtol=SAME_SHARE, atol=SAME):
        yield f"{what} is {stored.tolist()} in the statistics", f"{expected.tolist()}"
