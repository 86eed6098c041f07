"""Report of the differences between a user's first observation and ours, each with its remedy."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipeline.evaluation.first_observation.frame_search import (
    CLEAR,
    FEWEST_PX,
    Match,
    SearchResult,
    crop_middle,
    search,
)
from pipeline.evaluation.first_observation.picture_fit import (
    FITTING,
    SIZE_PX,
    UPRIGHT,
    Orientation,
    Smooth,
    Variant,
    difference,
    fit,
    read_picture,
    smooth_picture,
    variants,
)
from pipeline.evaluation.first_observation.picture_points import find_transformation
from pipeline.evaluation.first_observation.start_frames import CAMERA_OF_VIEW, LastStartFrames, Start, first_start
from pipeline.images.jpeg import encode_exactly, resized
from pipeline.libero.starts import SETTLING_STEPS
from pipeline.outputs import written
from pipeline.rendering.geometry import COMMON, FLOOR, GRIPPER, NOTHING, ROBOT, ROOM, TABLE, WALL
from pipeline.rendering.srgb import FIRST_VERSION
from pipeline.types import Frame, Task

Cause = Literal[
    "size", "shape", "orientation", "channels", "view", "zoom", "mujoco", "brightness", "not_settled", "gripper",
    "reset_seed", "initial_state", "task", "camera_pose", "things", "colours", "unknown",
]  # fmt: skip
"""Kind of a difference."""

BRIGHTNESS = 0.04
"""Largest difference of a brightness from 1 that JPEG files and renderers cause."""

DECODED_PX = 40
"""Smallest number of pixels that show the textures of another MuJoCo."""

DECODED_LEVELS = 4
"""Smallest difference of such a pixel between the two versions, after smoothing."""

SAME_RESIZING = 1.5
"""Largest mean difference from our frame, resized by the same method."""

RAMEKIN = "pick_up_the_black_bowl_on_the_ramekin_and_place_it_on_the_plate"
"""Task whose bowl slides off the ramekin from MuJoCo 3.4.0 on (huggingface/lerobot#4390)."""

BACKGROUND = tuple(COMMON[number] for number in (NOTHING, FLOOR, WALL, ROOM, TABLE))
"""Instances that do not move."""

PIN = "install mujoco==3.2.7 (docs/evaluation.md has the command for each evaluation code)"
SETTLE = f"take {SETTLING_STEPS} steps with the action [0, 0, 0, 0, 0, 0, -1] before the first observation"

OPENCV_RESIZING = {
    "OpenCV's INTER_NEAREST": cv2.INTER_NEAREST,
    "OpenCV's INTER_LINEAR": cv2.INTER_LINEAR,
    "OpenCV's INTER_AREA": cv2.INTER_AREA,
    "OpenCV's INTER_CUBIC": cv2.INTER_CUBIC,
    "OpenCV's INTER_LANCZOS4": cv2.INTER_LANCZOS4,
}
PILLOW_RESIZING = {
    "Pillow's BILINEAR": Image.Resampling.BILINEAR,
    "Pillow's BICUBIC": Image.Resampling.BICUBIC,
    "Pillow's LANCZOS": Image.Resampling.LANCZOS,
}
"""Methods of resizing; Pillow's smooth before they reduce."""


class Finding(NamedTuple):
    """A difference.

    Attributes:
        what: the difference and its measured size, one or more sentences.
        remedy: the change to the user's environment.
    """

    cause: Cause
    what: str
    remedy: str


@dataclass(frozen=True)
class Report:
    """Result of a comparison.

    Attributes:
        difference: mean absolute difference of the picture from our frame in grey levels; the picture is resized to
            the frame's size, and not changed in any other way.
    """

    difference: float
    findings: tuple[Finding, ...]
    search_result: SearchResult

    @property
    def equal(self) -> bool:
        """Return whether nothing differs."""
        return not self.findings

    def lines(self) -> list[str]:
        """Return the report in sentences."""
        match = self.search_result.match
        text = [f"mean difference from our frame: {self.difference:.1f} of 255 grey levels"]
        for finding in self.findings:
            text += [f"{finding.cause}: {finding.what}", f"  try: {finding.remedy}"]
        if self.equal:
            text.append("equal: view, orientation, size, colours and start are those of our frame")
        elif match.fit.fits:
            text.append(f"with all of this undone, the mean difference is {match.fit.error:.1f}")
        if match.fit.fits and _find_decoded_pixels(self.search_result).sum() < DECODED_PX:
            text.append("this picture cannot tell MuJoCo 3.2.7 from later versions; a picture of libero_object can")
        return text

    def as_json(self) -> dict[str, Any]:
        """Return the report for ``json.dumps``."""
        match = self.search_result.match
        return {
            "equal": self.equal,
            "difference": round(self.difference, 2),
            "findings": [finding._asdict() for finding in self.findings],
            "match": {
                "fits": match.fit.fits,
                "difference": round(match.fit.error, 2),
                "largest_in_patch": round(match.fit.worst, 1),
                "task": str(match.task),
                "camera_name": match.camera,
                "orientation": match.variant.orientation.words,
                "start": match.start._asdict(),
                "zoom": round(match.zoom, 3),
            },
        }


def compare_frame(
    file: Path, task: Task, number: int, view: str, opened: LastStartFrames, note: Callable[[str], None]
) -> Report:
    """Compare a picture of the first observation with our frame of an initial state of LIBERO.

    Args:
        number: number of the initial state.
        view: ``agentview`` or ``wrist``.
        note: function that reports progress.

    Raises:
        PipelineError: if the file is no picture that can be compared, or if there is no such initial state.
    """
    picture, start = read_picture(file), first_start(task, number)
    search_result = search(picture, task, start, view, opened, note)
    findings = (
        *_find_picture_differences(picture, search_result),
        *_find_scene_differences(search_result, start, view, opened),
    )
    return Report(_measure_raw_difference(picture, search_result.expected_frame), findings, search_result)


def write_sheet(report: Report, file: Path) -> None:
    """Write the picture, our frame and their difference side by side as a PNG file.

    The picture is undone as the report states; the difference is four times as bright.

    Raises:
        PipelineError: if a file would be overwritten that no command wrote.
    """
    match = report.search_result.match
    picture = resized(match.variant.pixels, SIZE_PX, SIZE_PX)
    level_difference = np.abs(picture.astype(np.int16) - match.frame.astype(np.int16))
    panels = [picture, match.frame, np.minimum(4 * level_difference, 255).astype(np.uint8)]
    with written(file) as unfinished:
        unfinished.write_bytes(encode_exactly(np.hstack(panels)[..., ::-1]))


def _measure_raw_difference(picture: Frame, frame: Frame) -> float:
    """Return the mean absolute difference of a picture from a frame, resized and otherwise unchanged."""
    return difference(_find_variant(picture, UPRIGHT, swapped=False).pixels, frame)


def _find_variant(picture: Frame, orientation: Orientation, swapped: bool, shape: str | None = None) -> Variant:
    """Return a variant of a picture; by default of the first shape that it may have."""
    for variant in variants(picture):
        if (variant.orientation, variant.swapped) == (orientation, swapped) and shape in (None, variant.shape):
            return variant
    raise ValueError(f"the picture has no shape {shape}")


def _find_picture_differences(picture: Frame, search_result: SearchResult) -> Iterator[Finding]:
    """Yield the differences of the picture itself: size, shape, orientation, channels, crop."""
    match = search_result.match
    height, width, _ = picture.shape
    if (height, width) != (SIZE_PX, SIZE_PX):
        resizing = _name_resizing(picture, match)
        yield Finding(
            "size",
            f"the picture has {width} x {height} pixels, our frame {SIZE_PX} x {SIZE_PX}{resizing}",
            f"set camera_heights and camera_widths to {SIZE_PX}, or resize as in training",
        )
    if not (search_result.is_clear or match.fit.fits):
        return
    variant = match.variant
    if variant.shape != "square":
        content = {"stretched": "its content is stretched", "widened": "it shows more on two sides"}[variant.shape]
        yield Finding("shape", f"the picture is not square: {content}", "set equal heights and widths")
    if variant.orientation is not UPRIGHT:
        error_before = fit(_find_variant(picture, UPRIGHT, variant.swapped, variant.shape).smooth, match.frame).error
        yield Finding(
            "orientation",
            f"the picture is {variant.orientation.words} ({_state_change(error_before, match)})",
            f"give the policy {variant.orientation.code}",
        )
    if variant.swapped:
        error_before = fit(_find_variant(picture, variant.orientation, False, variant.shape).smooth, match.frame).error
        yield Finding(
            "channels",
            f"red and blue are exchanged ({_state_change(error_before, match)})",
            "give the policy image[..., ::-1]; nothing if only the file is wrong, as cv2.imwrite expects BGR",
        )
    if match.zoom != 1:
        percent = 100 * min(match.zoom, 1 / match.zoom)
        shown_part = f"the middle {percent:.0f} % of our frame" if match.zoom > 1 else "more than our frame"
        error_before = fit(variant.smooth, match.frame).error
        yield Finding(
            "zoom",
            f"things are {match.zoom:.2f} times as large ({_state_change(error_before, match)}): the picture shows "
            f"{shown_part}, by a crop or another field of view",
            "crop as in training, or not at all, and keep LIBERO's field of view",
        )


def _state_change(error_before: float, match: Match) -> str:
    """State the difference that a cause explains.

    Args:
        error_before: mean difference while the cause is not undone.
    """
    return f"mean difference {match.fit.error:.1f} instead of {error_before:.1f} grey levels with this undone"


def _name_resizing(picture: Frame, match: Match) -> str:
    """Name the resizing of our frame that gives the picture, if exactly one does."""
    if not match.fit.fits or match.variant.shape != "square" or match.zoom != 1:
        return ""
    undone = match.variant.orientation.undo(picture[..., ::-1] if match.variant.swapped else picture).astype(np.int16)
    side = len(undone)
    errors: dict[str, float] = {}
    for name, method in OPENCV_RESIZING.items():
        errors[name] = float(np.abs(undone - cv2.resize(match.frame, (side, side), interpolation=method)).mean())
    for name, filter_ in PILLOW_RESIZING.items():
        resized_frame = np.asarray(Image.fromarray(match.frame).resize((side, side), filter_))
        errors[name] = float(np.abs(undone - resized_frame).mean())
    best, second = sorted(errors, key=lambda name: errors[name])[:2]
    if errors[best] <= SAME_RESIZING and errors[best] <= CLEAR * errors[second]:
        return f", resized by {best} ({errors[best]:.1f} grey levels)"
    return ", resized or rendered in this size"


def _find_scene_differences(
    search_result: SearchResult, start: Start, view: str, opened: LastStartFrames
) -> Iterator[Finding]:
    """Yield the differences of the scene: camera, MuJoCo, light, start, task."""
    match = search_result.match
    is_trusted = search_result.is_clear or match.fit.fits
    if is_trusted and match.camera != CAMERA_OF_VIEW[view]:
        view_of_camera = {camera: name for name, camera in CAMERA_OF_VIEW.items()}
        yield Finding(
            "view",
            f"the picture shows the camera {match.camera}"
            + (f", the view {view_of_camera[match.camera]}" if match.camera in view_of_camera else "")
            + f", not {CAMERA_OF_VIEW[view]} (mean difference {match.fit.error:.1f} grey levels)",
            f"give the policy {CAMERA_OF_VIEW[view]}_image",
        )
    if not match.fit.fits:
        yield from _explain_unmatched(search_result, opened)
        return
    yield from _find_version_difference(search_result)
    if abs(match.fit.brightness - 1) > BRIGHTNESS:
        yield Finding(
            "brightness",
            f"the whole picture has {match.fit.brightness:.2f} times the brightness of our frame",
            "leave out changes of brightness, gamma and light",
        )
    yield from _find_start_differences(search_result, start)


def _find_version_difference(search_result: SearchResult) -> Iterator[Finding]:
    """Report the MuJoCo whose textures the picture shows, from the pixels that differ between versions."""
    match = search_result.match
    plain_frame, decoded_frame = (_smooth_like(match, frame) for frame in search_result.version_frames)
    decoded_pixels = _find_decoded_pixels(search_result)
    if decoded_pixels.sum() < DECODED_PX:
        return
    picture = match.variant.smooth / match.fit.brightness
    from_plain = float(np.abs(picture - plain_frame)[decoded_pixels].mean())
    from_decoded = float(np.abs(picture - decoded_frame)[decoded_pixels].mean())
    if from_decoded <= from_plain / 2:
        darker = float((plain_frame - picture)[decoded_pixels].mean())
        yield Finding(
            "mujoco",
            f"{100 * decoded_pixels.mean():.1f} % of the pixels, most of them floor, are darker by {darker:.0f} grey "
            f"levels. They differ by {from_decoded:.1f} from MuJoCo {FIRST_VERSION} and later, and by {from_plain:.1f} "
            "from MuJoCo 3.2.7",
            PIN,
        )


def _find_decoded_pixels(search_result: SearchResult) -> NDArray[np.bool_]:
    """Return a mask (S, S) of the pixels that show the textures' version."""
    plain_frame, decoded_frame = (_smooth_like(search_result.match, frame) for frame in search_result.version_frames)
    return np.asarray(np.abs(plain_frame - decoded_frame).max(axis=2) > DECODED_LEVELS)


def _smooth_like(match: Match, frame: Frame) -> Smooth:
    """Return our frame smoothed, in the size of the picture."""
    side = len(match.variant.pixels)
    shown = crop_middle(frame, 1 / match.zoom) if match.zoom > 1 else frame
    return smooth_picture(resized(shown, side, side))


def _find_start_differences(search_result: SearchResult, start: Start) -> Iterator[Finding]:
    """Yield the differences of the start and of the task."""
    match = search_result.match
    measured = f"mean difference {match.fit.error:.1f} grey levels"
    starts = [match.start, *(equal_match.start for equal_match in search_result.equal_matches)]
    possible_steps = sorted(possible.steps for possible in starts if possible.gripper == start.gripper)
    if match.start.gripper != start.gripper:
        command = {1.0: "closed", 0.0: "without a command"}[match.start.gripper]
        yield Finding("gripper", f"the gripper was {command} while the scene settled ({measured})", SETTLE)
    elif match.start.steps != start.steps:
        steps = " or ".join(map(str, possible_steps))
        yield Finding("not_settled", f"the scene has settled for {steps} of {start.steps} steps ({measured})", SETTLE)
    if match.start.number != start.number:
        yield Finding(
            "initial_state",
            f"the picture shows LIBERO's initial state {match.start.number}, not {start.number} ({measured})",
            f"env.set_init_state(states[{start.number}]) after env.reset()",
        )
    if match.start.seed != start.seed:
        yield Finding(
            "reset_seed",
            f"the fixtures stand as after a reset with seed {match.start.seed}, not {start.seed} ({measured})",
            f"nothing, as LIBERO's demonstrations vary likewise; our frame needs env.seed({start.seed})",
        )
    if match.task.name != search_result.task.name:
        yield Finding(
            "task", f"the picture shows the task {match.task.name} ({measured})", f"open {search_result.task.name}"
        )


def _explain_unmatched(search_result: SearchResult, opened: LastStartFrames) -> Iterator[Finding]:
    """Report a picture that no start of the scene fits: a moved camera, moved things, other colours, or nothing."""
    match = search_result.match
    remainder = (
        f"the best match leaves {match.fit.error:.1f} grey levels, {match.fit.worst:.0f} in a patch of 16 pixels"
    )
    transformation = find_transformation(match.variant.pixels, match.frame)
    if transformation is None or not (search_result.is_clear or transformation.still or transformation.moved):
        yield Finding("unknown", f"nothing explains the picture; {remainder}", "check the task and the camera")
        return
    if not transformation.still:
        carrier = " or of the hand, which carries it" if match.camera == CAMERA_OF_VIEW["wrist"] else ""
        yield Finding(
            "camera_pose",
            f"{transformation.points} points of our frame are elsewhere: shifted by {transformation.shift_px:.0f} "
            f"pixels of {SIZE_PX}, {transformation.scale:.2f} times as large, rotated by "
            f"{transformation.rotation_deg:.0f} degrees. The pose of the camera{carrier} differs; {remainder}",
            "keep LIBERO's camera agentview and its field of view",
        )
        return
    things, background_level = _find_differing_things(match, opened)
    if match.task.name == RAMEKIN and things and not {COMMON[ROBOT], COMMON[GRIPPER]} & things.keys():
        yield Finding(
            "mujoco",
            f"{_list_things(things)} lie elsewhere. From MuJoCo 3.4.0 on, the bowl slides off the ramekin "
            f"(huggingface/lerobot#4390); no other start fits, {remainder}",
            PIN,
        )
    elif things and background_level <= FITTING:
        yield Finding(
            "things",
            f"the camera is ours ({transformation.points} points), but {_list_things(things)} differ. None of LIBERO's "
            f"initial states, numbers of settling steps and tried seeds fits; {remainder}",
            f"env.set_init_state after env.reset(), then {SETTLE}",
        )
    else:
        yield Finding(
            "colours",
            f"the camera is ours ({transformation.points} points), but light or textures differ; {remainder}",
            "use LIBERO's own scene files, light and textures",
        )


def _list_things(level_of_thing: dict[str, float]) -> str:
    """List things with their differences."""
    return ", ".join(f"{name} ({level:.0f} grey levels)" for name, level in level_of_thing.items())


def _find_differing_things(match: Match, opened: LastStartFrames) -> tuple[dict[str, float], float]:
    """Find the robot and the movable things that differ, with the mean difference of their pixels, largest first.

    Returns:
        The things, and the mean difference of the pixels of floor, walls and table.
    """
    side = len(match.fit.residual)
    pixels_of_thing = opened.of(match.task).things(match.start, match.camera)
    level_of_thing: dict[str, float] = {}
    background = np.zeros((side, side), np.bool_)
    for name, pixels in pixels_of_thing.items():
        mask = cv2.resize(pixels.astype(np.uint8), (side, side), interpolation=cv2.INTER_NEAREST) > 0
        if name in BACKGROUND:
            background |= mask
        elif mask.sum() >= FEWEST_PX:
            level = float(match.fit.residual[mask].mean())
            if level > FITTING:
                level_of_thing[name] = level
    background_level = float(match.fit.residual[background].mean()) if background.any() else 0.0
    return dict(sorted(level_of_thing.items(), key=lambda item: -item[1])), background_level
