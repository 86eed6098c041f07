"""Frames of a copy that are other files than the stored ones, and files that are no frames at all."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from synthetic import IDS, episode

from pipeline.config import RenderConfig
from pipeline.formats.read_back import Copy
from pipeline.images.jpeg import decode, encode
from pipeline.validation.case import Case
from pipeline.validation.checks import CHECKS

LOOKED_AT = ("jpeg", "video", "cameras", "alive")

STORED: dict[str, list[Any]] = {
    "image": list(episode(IDS[0]).frames["image"]),
    # The disc of the other view is of another grey alone.
    "wrist_image": [
        encode(np.asarray(cv2.rotate(decode(file), cv2.ROTATE_90_CLOCKWISE), np.uint8), RenderConfig().jpeg_quality)
        for file in episode(IDS[0]).frames["image"]
    ],
}


def found(change: Callable[[dict[str, list[Any]]], dict[str, list[Any]]]) -> set[tuple[str, str]]:
    """Check and dataset of what is found in a copy whose frames are changed."""
    made = replace(episode(IDS[0]), frames=STORED)
    copy = Copy("lerobot", replace(made, frames=change(STORED)), [], {}, {}, {})
    replay: Any = None  # None of these checks looks at it.
    case = Case({}, made, replay, [copy], None)
    return {(name, fault.dataset) for name in LOOKED_AT for fault in CHECKS[name].find(case)}


def test_nothing_is_found_in_the_very_files() -> None:
    assert found(lambda frames: frames) == set()


def test_frames_of_the_other_camera_and_of_another_step_are_seen() -> None:
    swapped = found(lambda frames: {"image": frames["wrist_image"], "wrist_image": frames["image"]})
    assert swapped == {("jpeg", "lerobot"), ("cameras", "lerobot")}
    still = found(lambda frames: frames | {"image": frames["image"][:1] * len(frames["image"])})
    assert still == {("jpeg", "lerobot"), ("alive", "lerobot")}


@pytest.mark.parametrize("broken", [b"junk", b"", None])
def test_what_is_no_image_is_another_file(broken: bytes | None) -> None:
    assert found(lambda frames: frames | {"image": [broken] * len(frames["image"])}) == {("jpeg", "lerobot")}


def test_a_view_is_looked_at_where_the_other_has_no_column() -> None:
    """That a column is not there, the check of the whole set says."""
    wrist = STORED["wrist_image"]
    assert found(lambda _: {"wrist_image": wrist[:1] * len(wrist)}) == {("jpeg", "lerobot"), ("alive", "lerobot")}
