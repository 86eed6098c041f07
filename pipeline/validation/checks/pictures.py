"""Checks of frames: equality with the stored frames, and faulty views, such as blank or exchanged ones."""

from collections.abc import Callable, Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.episode_schema import SCHEMA
from pipeline.errors import PipelineError
from pipeline.formats.read_back import Copy, Fault
from pipeline.images.jpeg import decode
from pipeline.types import Frame
from pipeline.validation.case import Case

VIDEO_PSNR_DB = 32.0
"""Least PSNR, in grey, of a video's frame to the stored JPEG; the least of pans over 30 procedural maps was 37.0.

In colour it can be 20: a video stores colours at half the resolution, which shows on fine, colourful surfaces."""

COLOURS_OFF = 0.5
"""Share of a stored frame's colourfulness by which a video's colours may differ; the most of 3,843 frames was 0.14.
Grey frames differ by 1, and frames with red and blue exchanged differ by more."""

PALE_LEVELS = 4.0
"""Least colourfulness assumed of a frame: mean distance of Cb and Cr from grey, in levels, over 16 by 16 fields."""

STILL_LEVELS = 0.5
"""Mean difference in grey levels up to which two frames count as equal; the least of 532 episodes was 1.2."""

FAR_STILL_LEVELS = 0.1
"""``STILL_LEVELS`` of further views; in the gallery view, which is far from the robot, the least of seven episodes was
0.6."""

BLANK_LEVELS = 5.0
"""Standard deviation in grey levels below which a frame counts as blank; the least of 532 episodes, which
have up to seven perturbed axes, was 19."""


def check_jpeg(case: Case) -> Iterator[Fault]:
    """Check that the image files of a dataset have the bytes of the stored frames, and lossless frames their pixels."""
    for copy in case.copies:
        for view, files in copy.episode.frames.items():
            pairs = zip(files, case.episode.frames[view], strict=False)
            wrong = [step for step, (file, stored) in enumerate(pairs) if file != stored]
            if wrong:
                what = f"{view} differs at {len(wrong)} steps, first at {wrong[0]}"
                yield case.finding(copy.dataset, what, "the stored JPEG")
        if copy.lossless_frames is not None:
            yield from _compare_pixels(case, copy, copy.lossless_frames)


def _compare_pixels(case: Case, copy: Copy, frames_of: Callable[[str], Iterator[Frame]]) -> Iterator[Fault]:
    """Compare every frame of a copy with the decoded JPEG file of its step."""
    for view, files in case.episode.frames.items():
        try:
            pairs = zip(frames_of(view), files, strict=False)
            wrong = [step for step, (frame, file) in enumerate(pairs) if not np.array_equal(frame, decode(file))]
        except PipelineError as error:
            yield case.finding(copy.dataset, f"{view}: {error}", "frames that can be read")
            continue
        if wrong:
            what = f"{view} has other pixels at {len(wrong)} steps, first at {wrong[0]}"
            yield case.finding(copy.dataset, what, "the pixels of the stored JPEG")


def check_video(case: Case) -> Iterator[Fault]:
    """Check that frames of videos are within ``VIDEO_PSNR_DB`` and ``COLOURS_OFF`` of the stored frames."""
    for shown_view in case.shown_views:
        stored, within = case.sampled_views[shown_view.view], f"{VIDEO_PSNR_DB} or more"
        for step, frame in shown_view.frames.items() if shown_view.video else ():
            name = f"{shown_view.view} of step {step}"
            psnr_db = cv2.PSNR(shown_view.grey[step], stored.grey[step])
            if psnr_db < VIDEO_PSNR_DB:
                yield case.finding(shown_view.dataset, f"{name} has {psnr_db:.1f} dB", within)
                continue
            difference = _colour_difference(frame, stored.frames[step])
            if difference > COLOURS_OFF:
                yield case.finding(shown_view.dataset, f"{name} has other colours ({difference:.2f})", f"{COLOURS_OFF}")


def _chroma(frame: Frame) -> NDArray[np.float64]:
    """Return Cb and Cr relative to grey, in levels, over 16 by 16 fields: (16, 16, 2)."""
    fields = cv2.resize(frame, (16, 16), interpolation=cv2.INTER_AREA)
    return cv2.cvtColor(fields, cv2.COLOR_RGB2YCrCb)[..., 1:].astype(float) - 128


def _colour_difference(frame: Frame, stored: Frame) -> float:
    """Return the mean difference of Cb and Cr, as a share of the stored frame's mean distance from grey."""
    chroma, expected = _chroma(frame), _chroma(stored)
    return float(np.abs(chroma - expected).mean() / max(np.abs(expected).mean(), PALE_LEVELS))


def check_cameras(case: Case) -> Iterator[Fault]:
    """Check that no view shows the picture of another camera."""
    for shown_view in case.shown_views:
        for step, frame in shown_view.grey.items():
            for view in case.sampled_views.keys() - {shown_view.view}:
                if cv2.PSNR(frame, case.sampled_views[view].grey[step]) > VIDEO_PSNR_DB:
                    yield case.finding(
                        shown_view.dataset, f"{shown_view.view} of step {step} shows {view}", "its own camera"
                    )


def check_alive(case: Case) -> Iterator[Fault]:
    """Check that no view has a blank frame or stays constant."""
    for shown_view in case.shown_views:
        first, *_ = frames = [*shown_view.frames.values()]
        still_levels = STILL_LEVELS if shown_view.view in SCHEMA.views else FAR_STILL_LEVELS
        if min(cv2.meanStdDev(frame.reshape(-1))[1].item() for frame in frames) < BLANK_LEVELS:
            yield case.finding(
                shown_view.dataset, f"{shown_view.view} has a blank frame", f"more than {BLANK_LEVELS} grey levels"
            )
        elif max(cv2.norm(frame, first, cv2.NORM_L1) / frame.size for frame in frames) < still_levels:
            yield case.finding(
                shown_view.dataset, f"{shown_view.view} is constant", "a camera that sees the robot move"
            )
