"""Reader of single episodes of LeRobot v3.0 by PyArrow and PyAV; lerobot itself reads in ``check.py``."""

import base64
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from pipeline.episode_schema import MATRICES, SCHEMA
from pipeline.errors import MAKE_AGAIN, PipelineError
from pipeline.files import Edition, edition
from pipeline.formats.lerobot.columns import (
    EPISODE_ID,
    EVENTS,
    INSTANCES,
    IS_SUCCESS,
    LANGUAGE,
    OBJECT_POSES,
    Layout,
    camera_column,
    matrix,
)
from pipeline.formats.lerobot.depth import PIXEL_FORMAT, metres_of
from pipeline.formats.lerobot.video import frames_at
from pipeline.formats.read_back import Copy, Statistics, sampled, subtasks_of
from pipeline.formats.stated_statistics import QUANTILE_NAMES
from pipeline.types import Episode, Geometry

UNREADABLE = (
    AssertionError,
    AttributeError,
    IndexError,
    KeyError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
    av.error.FFmpegError,
    pa.ArrowException,
)
"""Exceptions on files that are damaged, missing or do not belong together."""

MARKS = ("frame_index", "timestamp", IS_SUCCESS)
"""Columns of ``Copy.step_marks``; only datasets of failures have the last one."""

NUMBERS = ("float32", "int64")
"""Types of the columns that have statistics, in addition to frames."""


def read(root: Path, episode_id: str, layout: Layout) -> Copy | None:
    """Read an episode of this layout; ``None`` when the dataset does not have it.

    Raises:
        PipelineError: when the episode cannot be read.
    """
    with readable(root):
        row = rows(root).get(episode_id)
        return None if row is None else copy_of(root, row, layout)


@contextmanager
def readable(root: Path, version: str = "v3.0", also: tuple[type[Exception], ...] = ()) -> Iterator[None]:
    """Convert the exceptions of damaged or missing files, ``UNREADABLE`` and ``also``, to an error that names them."""
    try:
        yield
    except (*UNREADABLE, *also) as error:
        raise PipelineError(
            f"{type(error).__name__}: {error}", where=root, expected=f"a LeRobot {version} dataset", remedy=MAKE_AGAIN
        ) from error


def rows(root: Path) -> dict[str, dict[str, Any]]:
    """Read the rows of ``meta/episodes`` and of ``meta/provenance.parquet``, merged, by episode id."""
    return _opened(edition(root / "meta" / "info.json"))[1]


@lru_cache(maxsize=1)
def _opened(info_file: Edition) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """Read ``meta/info.json``, with the tasks by number, and the result of ``rows``."""
    meta = info_file.path.parent
    info: dict[str, Any] = json.loads(info_file.path.read_text())
    info["tasks"] = {row["task_index"]: row["task"] for row in pq.read_table(meta / "tasks.parquet").to_pylist()}
    files = episode_files(meta.parent)
    names = [name for name in pq.read_schema(files[0]).names if not name.startswith("stats/")]
    episodes: list[dict[str, Any]] = []
    for file in files:
        episodes += pq.read_table(file, columns=names).to_pylist()
    provenance = pq.read_table(meta / "provenance.parquet").to_pylist()
    firsts: dict[tuple[int, int], int] = {}
    for row in episodes:
        first_of_file = firsts.setdefault(_file(row), row["dataset_from_index"])
        row["first_row"] = row["dataset_from_index"] - first_of_file
    by_id = {}
    for row, labels in zip(episodes, provenance, strict=True):
        by_id[labels[EPISODE_ID]] = row | labels
    return info, by_id


def _file(row: Mapping[str, Any], kind: str = "data") -> tuple[int, int]:
    return row[f"{kind}/chunk_index"], row[f"{kind}/file_index"]


def copy_of(root: Path, row: Mapping[str, Any], layout: Layout) -> Copy:
    """Read an episode with LIBERO's gripper, given its row of ``rows``."""
    index, steps = row["episode_index"], row["length"]
    info, _ = _opened(edition(root / "meta" / "info.json"))
    chunk, number = _file(row)
    stored = _steps(root / info["data_path"].format(chunk_index=chunk, file_index=number), row["first_row"], steps)
    reject_others(stored, row, row["dataset_from_index"])
    table = v30_columns(stored, layout)
    instructions = [info["tasks"][task] for task in table["task_index"].to_pylist()]
    if row["dataset_to_index"] != row["dataset_from_index"] + steps or row["tasks"] != [instructions[0]]:
        stated = f"ends before step {row['dataset_to_index']} and has the tasks {row['tasks']}"
        raise ValueError(f"episode {index} of {steps} steps, {instructions[0]!r}, {stated}")
    depth_columns = layout.depth_videos
    videos, depth_videos = {}, {}
    views = layout.views
    for view, column in views.items():
        if info["features"][column]["dtype"] == "video":
            videos[view] = _video_place(root, info, row, column)
        if view in depth_columns:
            depth_videos[view] = _video_place(root, info, row, depth_columns[view])
    times_s = table["timestamp"].to_pylist()
    codes = decoded(times_s, depth_videos, PIXEL_FORMAT)
    return Copy(
        dataset="lerobot",
        episode=episode(table, row, instructions[0], layout),
        instructions=instructions,
        decoded=decoded(times_s, videos),
        step_marks=read_step_marks(table),
        place={"lerobot_episode_index": index},
        persistent_language=table[LANGUAGE].to_pylist() if LANGUAGE in table.column_names else None,
        events=table[EVENTS].to_pylist() if EVENTS in table.column_names else None,
        train=index < int(info["splits"]["train"].partition(":")[2]),
        statistics=Statistics(
            stored=_statistics(root, row),
            numbers={name: matrix(stored, name) for name, of in info["features"].items() if of["dtype"] in NUMBERS},
            views=views,
            quantiles=QUANTILE_NAMES,
            depth=depth_columns,
        ),
        depth_m={place: metres_of(each) for place, each in codes.items()},
    )


def _video_place(root: Path, info: Mapping[str, Any], row: Mapping[str, Any], column: str) -> tuple[Path, float]:
    """Return the video of an episode's column, and the time (s) at which the episode begins in it.

    Raises:
        ValueError: when the stated times do not fit the episode's length.
    """
    chunk, number = _file(row, f"videos/{column}")
    path = root / info["video_path"].format(video_key=column, chunk_index=chunk, file_index=number)
    first_s, end_s = row[f"videos/{column}/from_timestamp"], row[f"videos/{column}/to_timestamp"]
    index, steps = row["episode_index"], row["length"]
    if round((end_s - first_s) * SCHEMA.fps_hz) != steps:
        raise ValueError(f"episode {index} of {steps} steps has {first_s} to {end_s} s of {path.name}")
    return path, first_s


def episode_files(root: Path) -> list[Path]:
    """List the files of ``meta/episodes``."""
    return sorted((root / "meta" / "episodes").rglob("*.parquet"))


def _statistics(root: Path, row: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Read the statistics of an episode's columns in ``meta/episodes``."""
    chunk, number = _file(row, "meta/episodes")
    table, places = _stated(edition(root / f"meta/episodes/chunk-{chunk:03d}/file-{number:03d}.parquet"))
    (values,) = table.slice(places[row["episode_index"]], 1).to_pylist()
    stated: dict[str, dict[str, Any]] = {}
    for name, value in values.items():
        column, _, figure = name.removeprefix("stats/").rpartition("/")
        stated.setdefault(column, {})[figure] = value
    return stated


@lru_cache(maxsize=2)
def _stated(file: Edition) -> tuple[pa.Table, dict[int, int]]:
    """Read the statistics in a file of ``meta/episodes``, and each episode's number to its place in the file."""
    names = [name for name in pq.read_schema(file.path).names if name.startswith("stats/")]
    table = pq.read_table(file.path, columns=["episode_index", *names])
    places = {index: place for place, index in enumerate(table["episode_index"].to_pylist())}
    return table.select(names), places


def reject_others(table: pa.Table, row: Mapping[str, Any], first_step: int) -> None:
    """Reject steps that are not exactly those of an episode, by the steps' own numbers and id.

    Args:
        table: the steps.
        row: the episode's row of ``rows``.
        first_step: number of preceding steps of the dataset.

    Raises:
        ValueError: naming the column that differs.
    """
    index, steps = row["episode_index"], row["length"]
    wanted = {"episode_index": [index] * steps, EPISODE_ID: [row[EPISODE_ID]] * steps}
    wanted["index"] = [*range(first_step, first_step + steps)]
    for name, expected in wanted.items():
        if table[name].to_pylist() != expected:
            raise ValueError(f"by {name}, these are not the {steps} steps of episode {index}")


def episode(table: pa.Table, row: Mapping[str, Any], instruction: str, layout: Layout) -> Episode:
    """Return an episode with LIBERO's gripper, given v3.0's columns of its steps and its row of the files in ``meta/``.

    The episode has frames only where they are stored as image files.
    """
    frames = {}
    for view, spec in layout.content.cameras.items():
        if spec.lerobot_key in table.column_names:
            frames[view] = [cell["bytes"] for cell in table[spec.lerobot_key].to_pylist()]
    motion = {name: matrix(table, key) for name, key in layout.motion_keys.items()}
    if layout.convention.open_is_one:
        motion |= {name: libero_gripper(motion[name]) for name in ("action", "action_absolute")}
    return Episode(
        episode_id=row[EPISODE_ID],
        frames=frames,
        state=motion["state"],
        joint_state=motion["joint_state"],
        action=motion["action"],
        action_absolute=motion["action_absolute"],
        instruction=instruction,
        provenance=row,
        geometry={view: _geometry(table, row, view, layout) for view in layout.content.views},
        object_poses=_object_poses(table) if "object_poses" in layout.content.extras else None,
        instances=json.loads(row[INSTANCES]) if layout.content.has_names else (),
        rewrites=row["rewrites"],
        subtasks=subtasks_of(row["subtask_starts"], row["subtask_texts"]),
    )


def libero_gripper(action: NDArray[np.float32]) -> NDArray[np.float32]:
    """Convert the gripper command of actions (T, 7) from 1 open, 0 close to LIBERO's -1 open, 1 close."""
    return np.hstack([action[:, :-1], 1 - 2 * action[:, -1:]])


def v30_columns(stored: pa.Table, layout: Layout) -> pa.Table:
    """Return the columns of a data file under the names of v3.0."""
    v30_names = {name: v30_name for v30_name, name in layout.convention.names.items()}
    return stored.rename_columns([v30_names.get(name, name) for name in stored.column_names])


def read_step_marks(table: pa.Table) -> dict[str, NDArray[Any]]:
    """Return the columns of ``MARKS`` that a table has."""
    return {name: table[name].to_numpy() for name in MARKS if name in table.column_names}


def _steps(path: Path, first: int, steps: int) -> pa.Table:
    """Read rows of a data file from the row groups that contain them: a single one in files of our writer."""
    footer, ends = _footer(edition(path))
    with pq.ParquetFile(path, metadata=footer) as file:
        first_group = int(np.searchsorted(ends, first, "right"))
        last_group = int(np.searchsorted(ends, first + steps - 1, "right"))
        groups = range(first_group, last_group + 1)
        before = int(ends[groups[0] - 1]) if groups[0] else 0
        return file.read_row_groups(list(groups), use_threads=False).slice(first - before, steps)


@lru_cache(maxsize=4)
def _footer(data_file: Edition) -> tuple[pq.FileMetaData, NDArray[np.int64]]:
    """Read the metadata of a data file, and the rows at which its row groups end."""
    footer = pq.read_metadata(data_file.path)
    return footer, np.cumsum([footer.row_group(group).num_rows for group in range(footer.num_row_groups)])


def _object_poses(table: pa.Table) -> NDArray[np.float32]:
    return matrix(table, OBJECT_POSES).reshape(-1, *SCHEMA.object_poses.shape)


def _geometry(table: pa.Table, row: Mapping[str, Any], view: str, layout: Layout) -> Geometry:
    matrices = {}
    for name in MATRICES:
        numbers = np.array(row[camera_column(view, name)], np.float32)
        matrices[name] = numbers.reshape(getattr(SCHEMA, name).shape)
    texts = {name: table[camera_column(view, name)].to_pylist() for name in layout.text_maps}
    maps = {name: list(map(base64.b64decode, files)) for name, files in texts.items()}
    boxes = None
    if "boxes" in layout.content.extras:
        boxes = matrix(table, camera_column(view, "boxes")).reshape(-1, *SCHEMA.boxes.shape)
    return Geometry(**matrices, maps=maps, boxes=boxes)


def decoded(
    times_s: Sequence[float], videos: Mapping[str, tuple[Path, float]], pixel_format: str = "rgb24"
) -> dict[tuple[str, int], NDArray[Any]]:
    """Decode the frames at the sampled steps.

    Args:
        times_s: timestamps of the steps, by which lerobot finds a frame.
        videos: view to its video, and the time (s) at which the episode begins in the video.
        pixel_format: format of the frames.

    Returns:
        (view, step) to the frame.
    """
    steps = sampled(len(times_s))
    frames = {}
    for view, (path, begins_s) in videos.items():
        frames_of_view = frames_at(path, [begins_s + times_s[step] for step in steps], pixel_format)
        for step, frame in zip(steps, frames_of_view, strict=True):
            frames[view, step] = frame
    return frames
