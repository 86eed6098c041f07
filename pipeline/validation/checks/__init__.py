"""Checks of an episode in all places that store it: each is a function that yields the faults it finds."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

from pipeline.formats.read_back import Fault
from pipeline.validation.case import Case
from pipeline.validation.checks.geometry import check_boxes, check_depth, check_geometry
from pipeline.validation.checks.labels import (
    check_instruction,
    check_labels,
    check_place,
    check_provenance,
    check_results,
    check_wording,
)
from pipeline.validation.checks.motion import check_clock, check_flags, check_gripper, check_length, check_motion
from pipeline.validation.checks.pictures import check_alive, check_cameras, check_jpeg, check_video
from pipeline.validation.checks.statistics import check_statistics


@dataclass(frozen=True)
class Check:
    """A check, and the condition under which it has anything to compare.

    Attributes:
        find: yields the faults of an episode.
        applies: returns whether the episode has the content that the check compares; only some runs request it.
    """

    find: Callable[[Case], Iterable[Fault]]
    applies: Callable[[Case], bool] = lambda case: True


def _has_video(case: Case) -> bool:
    return any(shown_view.video for shown_view in case.shown_views)


def _has_depth_video(case: Case) -> bool:
    return any(copy.depth_m for copy in case.comparable_copies)


def _has_boxes_and_masks(case: Case) -> bool:
    views = case.episode.geometry.values()
    return any(geometry.boxes is not None and "segmentation" in geometry.maps for geometry in views)


CHECKS: Mapping[str, Check] = {
    "length": Check(check_length),
    "motion": Check(check_motion),
    "instruction": Check(check_instruction),
    "labels": Check(check_labels),
    "wording": Check(check_wording),
    "provenance": Check(check_provenance),
    "results": Check(check_results),
    "place": Check(check_place),
    "jpeg": Check(check_jpeg),
    "geometry": Check(check_geometry),
    "depth": Check(check_depth, _has_depth_video),
    "boxes": Check(check_boxes, _has_boxes_and_masks),
    "video": Check(check_video, _has_video),
    "cameras": Check(check_cameras),
    "alive": Check(check_alive),
    "gripper": Check(check_gripper),
    "flags": Check(check_flags),
    "clock": Check(check_clock),
    "statistics": Check(check_statistics),
}
"""Name of a check, as reports state it, to the check."""
