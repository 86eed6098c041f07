"""What every writer refuses of an episode's frames, in words that say what they are."""

import io
from collections.abc import Callable
from dataclasses import replace

import pytest
from PIL import Image
from synthetic import IDS, episode

from pipeline.episode_schema import check
from pipeline.errors import PipelineError


def as_png(jpeg: bytes) -> bytes:
    packed = io.BytesIO()
    Image.open(io.BytesIO(jpeg)).save(packed, "PNG")
    return packed.getvalue()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (as_png, r"frame 3 is \('PNG', 'RGB', \(256, 256\)\)"),
        (lambda jpeg: b"no picture", "frame 3 is not an image"),
        (lambda jpeg: jpeg[:-2], "frame 3 is cut short"),
    ],
)
def test_a_frame_that_is_no_whole_jpeg_is_refused(change: Callable[[bytes], bytes], message: str) -> None:
    whole = episode(IDS[0])
    check(whole)
    frames = list(whole.frames["image"])
    frames[3] = change(frames[3])
    with pytest.raises(PipelineError, match=message):
        check(replace(whole, frames={**whole.frames, "image": frames}))
