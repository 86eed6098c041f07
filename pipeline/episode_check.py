"""The check of an episode against ``schemas/episode.json``."""

import io
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from pipeline.episode_schema import MATRICES, MOTION, SCHEMA, STANDARD, Content, MatrixSpec, VectorSpec, labels_of
from pipeline.errors import PipelineError
from pipeline.types import Episode

JPEG_SCAN, JPEG_END = b"\xff\xda", b"\xff\xd9"
"""Bytes at which the scan of a JPEG file begins, and its last ones."""

SCAN_HEADER_BYTES = 14
"""Length of the header of a scan with three components."""


def label_faults(labels: Mapping[str, Sequence[Any]], steps: int) -> Iterator[tuple[str, str]]:
    """Yield each fault of an episode's labels, and the expected content.

    Args:
        labels: the lists of ``SCHEMA.labels``.
        steps: number of the episode's steps.
    """
    starts, texts, rewrites = (labels[name] for name in ("subtask_starts", "subtask_texts", "rewrites"))
    if len(starts) != len(texts):
        yield f"{len(starts)} subtask_starts and {len(texts)} subtask_texts", "a text for each start"
    if starts and starts[0] != 0:
        yield f"the first of subtask_starts is {starts[0]}", "0"
    if any(later <= earlier for earlier, later in pairwise(starts)):
        yield f"subtask_starts {list(starts)} are not in order", "each start after the one before it"
    if starts and max(starts) >= steps:
        yield f"subtask_starts {list(starts)} leave the episode", f"starts below {steps}, the number of steps"
    for text in (*texts, *rewrites):
        if not text.strip() or "\n" in text:
            yield f"the label {text!r}", "words in one line"
    if len({*rewrites}) != len(rewrites):
        yield f"{len(rewrites)} rewrites, of which some are equal", "each text once"


def check(episode: Episode, content: Content = STANDARD) -> None:
    """Reject an episode that training code would misread or fail on.

    Args:
        content: the content that the episode must have.

    Raises:
        PipelineError: naming the episode and the field.
    """
    steps = len(episode)
    if steps < SCHEMA.min_steps:
        expected = f"at least {SCHEMA.min_steps} steps, the length of the chunks that policies predict"
        raise _fault(episode, "action", f"has {steps} steps", expected)
    for name in MOTION:
        _check_array(episode, name, getattr(episode, name), getattr(SCHEMA, name), steps)
    low, high = SCHEMA.action.range
    if episode.action.min() < low or episode.action.max() > high:
        span = f"spans [{episode.action.min():g}, {episode.action.max():g}]"
        raise _fault(episode, "action", span, f"[{low:g}, {high:g}], as the controller clips it")
    for what, expected in label_faults(labels_of(episode), steps):
        raise _fault(episode, "labels", f"have a fault: {what}", expected)
    _check_frames(episode, steps, content)
    _check_geometry(episode, steps, content)
    if not episode.instruction.strip() or "_" in episode.instruction:
        # OpenVLA-OFT's loader never returns on an empty text; an underscore indicates a file name.
        raise _fault(episode, "instruction", f"is {episode.instruction!r}", "words without underscores")
    columns = content.provenance
    if set(episode.provenance) != set(columns):
        wrong = sorted(set(episode.provenance) ^ set(columns))
        raise _fault(episode, "provenance", f"lacks or adds {wrong}", f"exactly {list(columns)}")
    types = {"string": str, "int64": int, "float32": float, "bool": bool}
    mistyped = sorted(key for key, value in episode.provenance.items() if not isinstance(value, types[columns[key]]))
    if mistyped:
        expected = ", ".join(f"{columns[key]} in {key}" for key in mistyped)
        raise _fault(episode, "provenance", f"has another type in {mistyped}", expected)
    if episode.provenance["episode_id"] != episode.episode_id:
        raise _fault(episode, "provenance", f"names episode {episode.provenance['episode_id']!r}", "its own episode_id")


def _check_frames(episode: Episode, steps: int, content: Content) -> None:
    if set(episode.frames) != set(content.views):
        raise _fault(episode, "frames", f"has the views {sorted(episode.frames)}", f"{sorted(content.views)}")
    expected = (SCHEMA.frame.encoding.upper(), "RGB", (content.size_px, content.size_px))
    for view, frames in episode.frames.items():
        if len(frames) != steps:
            raise _fault(episode, view, f"has {len(frames)} frames", f"{steps}, one per action")
        for index, data in enumerate(frames):
            try:
                scan = data.find(JPEG_SCAN)
                properties = _look(data[: scan + SCAN_HEADER_BYTES] if scan >= 0 else data)
            except UnidentifiedImageError:
                raise _fault(episode, view, f"frame {index} is not an image", f"{expected}") from None
            if properties != expected:
                raise _fault(episode, view, f"frame {index} is {properties}", f"{expected}")
            if not data.endswith(JPEG_END):
                raise _fault(episode, view, f"frame {index} is cut short", "a whole JPEG file")


@lru_cache
def _look(header: bytes) -> tuple[str | None, str, tuple[int, int]]:
    """Read format, mode and size of an image.

    Calls are cached by the header: frames of one encoder begin with equal headers.
    """
    with Image.open(io.BytesIO(header)) as image:
        return image.format, image.mode, image.size


def _check_geometry(episode: Episode, steps: int, content: Content) -> None:
    if set(episode.geometry) != set(content.views):
        raise _fault(episode, "geometry", f"has the views {sorted(episode.geometry)}", f"{sorted(content.views)}")
    for view, geometry in episode.geometry.items():
        for name in MATRICES:
            _check_array(episode, f"{view}_{name}", getattr(geometry, name), getattr(SCHEMA, name))
        lengths = {name: len(files) for name, files in geometry.maps.items()}
        wanted = dict.fromkeys(content.maps, steps)
        if lengths != wanted:
            raise _fault(episode, f"{view} maps", f"have the lengths {lengths}", f"{steps} for each requested map")
        if ("boxes" in content.extras) != (geometry.boxes is not None):
            expected = "boxes if, and only if, render.extras lists them"
            raise _fault(episode, f"{view} boxes", "are missing or not requested", expected)
        if geometry.boxes is not None:
            _check_array(episode, f"{view}_boxes", geometry.boxes, SCHEMA.boxes, steps)
    if ("object_poses" in content.extras) != (episode.object_poses is not None):
        expected = "poses if, and only if, render.extras lists them"
        raise _fault(episode, "object_poses", "are missing or not requested", expected)
    if episode.object_poses is not None:
        _check_array(episode, "object_poses", episode.object_poses, SCHEMA.object_poses, steps)
    if content.has_names != bool(episode.instances):
        expected = "names if, and only if, render.extras lists segmentation, object_poses or boxes"
        raise _fault(episode, "instances", f"has {len(episode.instances)} names", expected)


def _check_array(
    episode: Episode, field: str, values: NDArray[np.float32], spec: VectorSpec | MatrixSpec, *steps: int
) -> None:
    if values.shape != (*steps, *spec.shape) or values.dtype != np.dtype(spec.dtype):
        expected = f"{(*steps, *spec.shape)} of {spec.dtype}"
        raise _fault(episode, field, f"is {values.shape} of {values.dtype}", expected)
    if not np.isfinite(values).all():
        raise _fault(episode, field, "contains NaN or infinity", "finite numbers")


def _fault(episode: Episode, field: str, what: str, expected: str) -> PipelineError:
    return PipelineError(
        f"{field} {what}",
        where=f"episode {episode.episode_id}",
        expected=expected,
        remedy="correct the source of this episode, or drop it from the plan",
    )
