"""Search for the view, orientation and start that a user's picture shows.

The search begins with likely differences, and stops at a match that fits (``picture_fit.FITTING``). All causes of one
group are tried before one of them is reported.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np

from pipeline.errors import RejectedError
from pipeline.evaluation.first_observation.picture_fit import Fit, Smooth, Variant, fit, smooth_picture, variants
from pipeline.evaluation.first_observation.picture_points import find_transformation
from pipeline.evaluation.first_observation.start_frames import CAMERA_OF_VIEW, LastStartFrames, Start, StartFrames
from pipeline.libero import bddl
from pipeline.libero import tasks as libero_tasks
from pipeline.libero.starts import SETTLING_STEPS
from pipeline.types import Frame, Task

UNSETTLED = range(SETTLING_STEPS - 2)
"""Numbers of settling steps whose frames differ from the settled frame."""

GRIPPERS = (1.0, 0.0)
"""Other commands of the gripper while settling: close, and none."""

SEEDS = (0, 7, 42, 1000)
"""Seeds of resets in evaluations: OpenVLA's 0, openpi's 7, lerobot-eval's 1000."""

ZOOMS = np.geomspace(0.6, 1.7, 53)
"""Sizes of things in a picture, in multiples of their sizes in our frame."""

FINER = np.linspace(0.98, 1.02, 9)
"""Further sizes to try, in multiples of the best one of ``ZOOMS``."""

CLEAR = 0.8
"""Largest error of a match, in multiples of the next one's, from which it counts as the better one."""

IN_PLACE = 3.0
"""Largest mean difference of an object's pixels if the object is in its place."""

FEWEST_PX = 30
"""Smallest number of pixels of a thing that is compared."""

FEW_TASKS = 10
"""Largest number of a suite's tasks that are all searched; of larger suites, one task of each scene is searched."""


@dataclass(frozen=True)
class Match:
    """A picture, undone as ``variant`` states, next to our frame of a start.

    Attributes:
        srgb: True if the frame has the textures of MuJoCo 3.3.3 and later.
        zoom: size of things in the picture, in multiples of their size in the frame.
        frame: (256, 256, 3) our frame.
    """

    variant: Variant
    task: Task
    camera: str
    start: Start
    srgb: bool
    frame: Frame
    fit: Fit
    zoom: float = 1.0


@dataclass(frozen=True)
class SearchResult:
    """Result of a search.

    Attributes:
        task: the task that the picture should show.
        match: the best match.
        equal_matches: matches of the other starts of the same group that fit as well.
        expected_frame: our frame of the expected view and start.
        version_frames: our frame of the match with the textures of MuJoCo 3.2.7, and of 3.3.3.
        is_clear: True if no other view, orientation or order of channels comes close to the match.
    """

    task: Task
    match: Match
    equal_matches: tuple[Match, ...]
    expected_frame: Frame
    version_frames: tuple[Frame, Frame]
    is_clear: bool


def search(
    picture: Frame, task: Task, start: Start, view: str, opened: LastStartFrames, note: Callable[[str], None]
) -> SearchResult:
    """Search for the match of a picture.

    Args:
        start: the start that the picture should show.
        view: the view that it should show, ``agentview`` or ``wrist``.
        note: function that reports progress.

    Raises:
        PipelineError: if the task cannot be rebuilt on this machine.
    """
    frames, view_cameras = opened.of(task), list(CAMERA_OF_VIEW.values())
    candidates = list(_match_appearances(picture, frames, start, view_cameras))
    expected_frame = next(
        match.frame for match in candidates if match.camera == CAMERA_OF_VIEW[view] and not match.srgb
    )
    match, is_clear = _find_best_appearance(candidates)
    if not is_clear:
        note("none of the two views fits: searching other cameras")
        other_cameras = [camera for camera in frames.cameras if camera not in view_cameras]
        candidates += _match_appearances(picture, frames, start, other_cameras)
        match, is_clear = _find_best_appearance(candidates)
    if not match.fit.fits:
        best_zoom = _find_best(_match_zooms(match, ZOOMS.tolist())).zoom
        match = _find_best([match, *_select_fitting(_match_zooms(match, (best_zoom * FINER).tolist()))])
    equal_matches: tuple[Match, ...] = ()
    if match.fit.fits:
        return SearchResult(task, match, equal_matches, expected_frame, _render_versions(frames, match), is_clear)
    transformation = find_transformation(match.variant.pixels, match.frame)
    camera_moved = transformation is not None and transformation.moved
    objects_in_place = False
    if is_clear and not camera_moved:
        objects_in_place = _are_objects_in_place(match, frames)
        match, equal_matches = _search_starts(match, frames, objects_in_place, note)
    if match.fit.fits or camera_moved or objects_in_place:
        return SearchResult(task, match, equal_matches, expected_frame, _render_versions(frames, match), is_clear)
    for other_task in _list_other_tasks(task):
        note(f"searching {other_task}")
        other_frames = opened.of(other_task)
        appearances = list(_match_appearances(picture, other_frames, start, view_cameras))
        other_match, other_is_clear = _find_best_appearance(appearances)
        if other_match.fit.fits:
            version_frames = _render_versions(other_frames, other_match)
            return SearchResult(task, other_match, (), expected_frame, version_frames, other_is_clear)
    return SearchResult(task, match, equal_matches, expected_frame, _render_versions(opened.of(task), match), is_clear)


def _find_best_appearance(candidates: list[Match]) -> tuple[Match, bool]:
    """Return the best match, and whether no other camera, orientation or order of channels comes close."""
    match = _find_best(candidates)
    next_error = min(candidate.fit.error for candidate in candidates if _differs(candidate, match))
    return match, match.fit.error <= CLEAR * next_error


def _are_objects_in_place(match: Match, frames: StartFrames) -> bool:
    """Return whether half of the movable objects are where they are in our frame: then the initial state is right."""
    objects = bddl.read(match.task.bddl_file).objects
    side = len(match.fit.residual)
    residuals: list[float] = []
    for name, pixels in frames.things(match.start, match.camera).items():
        mask = cv2.resize(pixels.astype(np.uint8), (side, side), interpolation=cv2.INTER_NEAREST) > 0
        if name in objects and mask.sum() >= FEWEST_PX:
            residuals.append(float(match.fit.residual[mask].mean()))
    return bool(residuals) and float(np.median(residuals)) <= IN_PLACE


def _search_starts(
    match: Match, frames: StartFrames, objects_in_place: bool, note: Callable[[str], None]
) -> tuple[Match, tuple[Match, ...]]:
    """Search other starts of the task; return the best match, and the other matches of its group that fit.

    Args:
        objects_in_place: True if other initial states need no search.
    """
    best = match
    for group, starts in _group_starts(match.start, 0 if objects_in_place else frames.count):
        note(f"searching {group}")
        matches = list(_match_starts(match, frames, starts))
        best = _find_best([best, *matches])
        if best.fit.fits:
            return best, tuple(fitting for fitting in _select_fitting(matches) if fitting.start != best.start)
    if best.start.number != match.start.number:
        resets = [best.start._replace(seed=seed) for seed in (best.start.number, *SEEDS)]
        best = _find_best([best, *_match_starts(match, frames, resets)])
    return best, ()


def _render_versions(frames: StartFrames, match: Match) -> tuple[Frame, Frame]:
    """Return our frame of a match with the textures of MuJoCo 3.2.7, and of 3.3.3."""
    plain, decoded = (frames.render(match.start, [match.camera], srgb)[match.camera] for srgb in (False, True))
    return plain, decoded


def _list_other_tasks(task: Task) -> list[Task]:
    """List the other tasks of a suite; of a large suite, one task of each other scene."""
    other_tasks = [other for other in libero_tasks.tasks(task.suite) if other.name != task.name]
    if len(other_tasks) < FEW_TASKS:
        return other_tasks
    by_scene = {libero_tasks.common_key(other, "scene"): other for other in reversed(other_tasks)}
    by_scene.pop(libero_tasks.common_key(task, "scene"), None)
    return list(reversed(by_scene.values()))


def _match_appearances(picture: Frame, frames: StartFrames, start: Start, cameras: list[str]) -> Iterator[Match]:
    """Yield a match for each camera, version of textures and variant of the picture."""
    picture_variants = list(variants(picture))
    for srgb in (False, True):
        for camera, frame in frames.render(start, cameras, srgb).items():
            for variant in picture_variants:
                yield Match(variant, frames.task, camera, start, srgb, frame, fit(variant.smooth, frame))


def _group_starts(start: Start, count: int) -> Iterator[tuple[str, list[Start]]]:
    """Yield groups of other starts, each with its name."""
    unsettled = [start._replace(steps=steps) for steps in UNSETTLED]
    grippers = [start._replace(gripper=gripper) for gripper in GRIPPERS]
    yield "starts before the end of settling, and with another gripper", [*unsettled, *grippers]
    yield "resets with other seeds", [start._replace(seed=seed) for seed in SEEDS if seed != start.seed]
    yield "other initial states", [start._replace(number=number) for number in range(count) if number != start.number]


def _match_starts(match: Match, frames: StartFrames, starts: Iterable[Start]) -> Iterator[Match]:
    """Yield the match of each start in the camera and variant of another match; skip starts that do not settle."""
    for start in starts:
        try:
            frame = frames.render(start, [match.camera], match.srgb)[match.camera]
        except RejectedError:
            continue
        yield replace(match, start=start, frame=frame, fit=fit(match.variant.smooth, frame))


def _match_zooms(match: Match, zooms: list[float]) -> Iterator[Match]:
    """Yield the match at other sizes of things: the picture is a part of the frame, or the frame is a part of it."""
    for zoom in zooms:
        if zoom > 1:
            yield replace(match, zoom=zoom, fit=fit(match.variant.smooth, crop_middle(match.frame, 1 / zoom)))
        else:
            middle: Smooth = smooth_picture(crop_middle(match.variant.pixels, zoom))
            yield replace(match, zoom=zoom, fit=fit(middle, match.frame))


def crop_middle(image: Frame, share: float) -> Frame:
    """Return the middle of a square image, enlarged to the image's size.

    Args:
        share: side of the middle in multiples of the image's.
    """
    side = len(image)
    middle_side = round(side * share)
    first = (side - middle_side) // 2
    middle = image[first : first + middle_side, first : first + middle_side]
    return np.asarray(cv2.resize(middle, (side, side), interpolation=cv2.INTER_LINEAR), np.uint8)


def _find_best(matches: Iterable[Match]) -> Match:
    """Return the match with the smallest error, a fitting one if there is any; of equal ones the first."""
    return min(matches, key=lambda match: (not match.fit.fits, match.fit.error))


def _select_fitting(matches: Iterable[Match]) -> list[Match]:
    """List the matches that fit."""
    return [match for match in matches if match.fit.fits]


def _differs(first: Match, second: Match) -> bool:
    """Return whether two matches differ in camera, orientation or order of channels."""
    first_appearance = (first.camera, first.variant.orientation, first.variant.swapped)
    return first_appearance != (second.camera, second.variant.orientation, second.variant.swapped)
