"""Search for the view, orientation and start that a user's picture shows.

The search begins with likely differences, and stops at a match that fits (``picture_fit.FITTING``). All causes of one
group are tried before one of them is reported.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np

from pipeline.errors import RejectedError
from pipeline.evaluation.first_observation.picture_fit import Fit, Smooth, Variant, fit, smoothed, variants
from pipeline.evaluation.first_observation.picture_points import place
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
class Found:
    """Result of a search.

    Attributes:
        task: the task that the picture should show.
        match: the best match.
        others: the other starts of the same group that fit as well.
        expected: our frame of the expected view and start.
        versions: our frame of the match with the textures of MuJoCo 3.2.7, and of 3.3.3.
        clear: True if no other view, orientation or order of channels comes close to the match.
    """

    task: Task
    match: Match
    others: tuple[Match, ...]
    expected: Frame
    versions: tuple[Frame, Frame]
    clear: bool


def search(
    picture: Frame, task: Task, start: Start, view: str, opened: LastStartFrames, note: Callable[[str], None]
) -> Found:
    """Search for the match of a picture.

    Args:
        start: the start that the picture should show.
        view: the view that it should show, ``agentview`` or ``wrist``.
        note: function that reports progress.

    Raises:
        PipelineError: if the task cannot be rebuilt on this machine.
    """
    frames = opened.of(task)
    candidates = list(_appearances(picture, frames, start, list(CAMERA_OF_VIEW.values())))
    expected = next(match.frame for match in candidates if match.camera == CAMERA_OF_VIEW[view] and not match.srgb)
    match, clear = _clear_best(candidates)
    if not clear:
        note("none of the two views fits: searching other cameras")
        rest = [camera for camera in frames.cameras if camera not in CAMERA_OF_VIEW.values()]
        candidates += _appearances(picture, frames, start, rest)
        match, clear = _clear_best(candidates)
    if not match.fit.fits:
        coarse = _best(_zooms(match, ZOOMS.tolist()))
        finer = (coarse.zoom * FINER).tolist()
        match = _best([match, *_fitting(_zooms(match, finer))])
    others: tuple[Match, ...] = ()
    if match.fit.fits:
        return Found(task, match, others, expected, _versions(frames, match), clear)
    placed = place(match.variant.pixels, match.frame)
    moved = placed is not None and placed.moved
    right_state = False
    if clear and not moved:
        right_state = _objects_in_place(match, frames)
        match, others = _search_starts(match, frames, right_state, note)
    if match.fit.fits or moved or right_state:
        return Found(task, match, others, expected, _versions(frames, match), clear)
    for task_of_suite in _others(task):
        note(f"searching {task_of_suite}")
        frames = opened.of(task_of_suite)
        other, distinct = _clear_best(list(_appearances(picture, frames, start, list(CAMERA_OF_VIEW.values()))))
        if other.fit.fits:
            return Found(task, other, (), expected, _versions(frames, other), distinct)
    return Found(task, match, others, expected, _versions(opened.of(task), match), clear)


def _clear_best(candidates: list[Match]) -> tuple[Match, bool]:
    """Return the best match, and whether no other camera, orientation or order of channels comes close."""
    match = _best(candidates)
    another = min(other.fit.error for other in candidates if _differs(other, match))
    return match, match.fit.error <= CLEAR * another


def _objects_in_place(match: Match, frames: StartFrames) -> bool:
    """Return whether half of the movable objects are where they are in our frame: then the initial state is right."""
    objects = bddl.read(match.task.bddl_file).objects
    side = len(match.fit.residual)
    residuals: list[float] = []
    for name, pixels in frames.things(match.start, match.camera).items():
        seen = cv2.resize(pixels.astype(np.uint8), (side, side), interpolation=cv2.INTER_NEAREST) > 0
        if name in objects and seen.sum() >= FEWEST_PX:
            residuals.append(float(match.fit.residual[seen].mean()))
    return bool(residuals) and float(np.median(residuals)) <= IN_PLACE


def _search_starts(
    match: Match, frames: StartFrames, right_state: bool, note: Callable[[str], None]
) -> tuple[Match, tuple[Match, ...]]:
    """Search other starts of the task; return the best match, and the others of its group that fit.

    Args:
        right_state: True if other initial states need no search.
    """
    best = match
    for group, starts in _starts(match.start, 0 if right_state else frames.count):
        note(f"searching {group}")
        tried = list(_matches(match, frames, starts))
        best = _best([best, *tried])
        if best.fit.fits:
            return best, tuple(other for other in _fitting(tried) if other.start != best.start)
    if best.start.number != match.start.number:
        seeds = [best.start._replace(seed=seed) for seed in (best.start.number, *SEEDS)]
        best = _best([best, *_matches(match, frames, seeds)])
    return best, ()


def _versions(frames: StartFrames, match: Match) -> tuple[Frame, Frame]:
    """Return our frame of a match with the textures of MuJoCo 3.2.7, and of 3.3.3."""
    plain, decoded = (frames.render(match.start, [match.camera], srgb)[match.camera] for srgb in (False, True))
    return plain, decoded


def _others(task: Task) -> list[Task]:
    """List the other tasks of a suite; of a large suite, one task of each other scene."""
    listed = [other for other in libero_tasks.tasks(task.suite) if other.name != task.name]
    if len(listed) < FEW_TASKS:
        return listed
    by_scene = {libero_tasks.common_key(other, "scene"): other for other in reversed(listed)}
    by_scene.pop(libero_tasks.common_key(task, "scene"), None)
    return list(reversed(by_scene.values()))


def _appearances(picture: Frame, frames: StartFrames, start: Start, cameras: list[str]) -> Iterator[Match]:
    """Yield a match for each camera, version of textures and variant of the picture."""
    undone = list(variants(picture))
    for srgb in (False, True):
        for camera, frame in frames.render(start, cameras, srgb).items():
            for variant in undone:
                yield Match(variant, frames.task, camera, start, srgb, frame, fit(variant.smooth, frame))


def _starts(start: Start, count: int) -> Iterator[tuple[str, list[Start]]]:
    """Yield groups of other starts, each with its name."""
    unsettled = [start._replace(steps=steps) for steps in UNSETTLED]
    grippers = [start._replace(gripper=gripper) for gripper in GRIPPERS]
    yield "starts before the end of settling, and with another gripper", [*unsettled, *grippers]
    yield "resets with other seeds", [start._replace(seed=seed) for seed in SEEDS if seed != start.seed]
    yield "other initial states", [start._replace(number=number) for number in range(count) if number != start.number]


def _matches(like: Match, frames: StartFrames, starts: Iterable[Start]) -> Iterator[Match]:
    """Yield the match of each start in the camera and variant of another match; skip starts that do not settle."""
    for start in starts:
        try:
            frame = frames.render(start, [like.camera], like.srgb)[like.camera]
        except RejectedError:
            continue
        yield replace(like, start=start, frame=frame, fit=fit(like.variant.smooth, frame))


def _zooms(match: Match, zooms: list[float]) -> Iterator[Match]:
    """Yield the match at other sizes of things: the picture is a part of the frame, or the frame is a part of it."""
    for zoom in zooms:
        if zoom > 1:
            yield replace(match, zoom=zoom, fit=fit(match.variant.smooth, middle(match.frame, 1 / zoom)))
        else:
            part: Smooth = smoothed(middle(match.variant.pixels, zoom))
            yield replace(match, zoom=zoom, fit=fit(part, match.frame))


def middle(image: Frame, share: float) -> Frame:
    """Return the middle of a square image, enlarged to the image's size.

    Args:
        share: side of the middle in multiples of the image's.
    """
    side = len(image)
    part = round(side * share)
    first = (side - part) // 2
    cut = image[first : first + part, first : first + part]
    return np.asarray(cv2.resize(cut, (side, side), interpolation=cv2.INTER_LINEAR), np.uint8)


def _best(matches: Iterable[Match]) -> Match:
    """Return the match with the smallest error, a fitting one if there is any; of equal ones the first."""
    return min(matches, key=lambda match: (not match.fit.fits, match.fit.error))


def _fitting(matches: Iterable[Match]) -> list[Match]:
    """List the matches that fit."""
    return [match for match in matches if match.fit.fits]


def _differs(other: Match, match: Match) -> bool:
    """Return whether a match has another camera, orientation or order of channels."""
    seen = (other.camera, other.variant.orientation, other.variant.swapped)
    return seen != (match.camera, match.variant.orientation, match.variant.swapped)
