"""What every writer rejects of an episode, in words that name the field, and what was written before stays."""

import io
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from synthetic import IDS, episode, files, with_extras, write_lerobot, write_rlds

from pipeline.episode_check import check
from pipeline.episode_schema import MOTION, SCHEMA
from pipeline.errors import PipelineError
from pipeline.types import Episode, Jpeg


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
def test_a_frame_that_is_no_whole_jpeg_is_rejected(change: Callable[[bytes], bytes], message: str) -> None:
    whole = episode(IDS[0])
    check(whole)
    frames = list(whole.frames["image"])
    frames[3] = Jpeg(change(frames[3]))
    with pytest.raises(PipelineError, match=message):
        check(replace(whole, frames={**whole.frames, "image": frames}))


def truncated(source: Episode, steps: int) -> Episode:
    frames = {view: frames[:steps] for view, frames in source.frames.items()}
    arrays = {name: getattr(source, name)[:steps] for name in MOTION}
    return replace(source, frames=frames, **arrays)


def cut(jpeg: Jpeg) -> Jpeg:
    return Jpeg(jpeg[:-99])


BAD: dict[str, tuple[str, Callable[[Episode], Episode]]] = {
    "empty text": ("instruction", lambda e: replace(e, instruction=" ")),
    "file name": ("instruction", lambda e: replace(e, instruction="put_the_bowl_on_the_plate")),
    "too short": ("action", lambda e: truncated(e, SCHEMA.min_steps - 1)),
    "nan": ("state", lambda e: replace(e, state=np.full_like(e.state, np.nan))),
    "wrong shape": ("joint_state", lambda e: replace(e, joint_state=e.joint_state[:, :6])),
    "wrong dtype": ("state", lambda e: replace(e, state=e.state.astype(np.float64))),
    "out of range": ("action", lambda e: replace(e, action=e.action * 2)),
    "lost frame": (
        "wrist_image",
        lambda e: replace(e, frames={**e.frames, "wrist_image": e.frames["wrist_image"][1:]}),
    ),
    "lost camera": ("geometry", lambda e: replace(e, geometry={})),
    "depth unasked": ("image maps", lambda e: replace(e, geometry=with_extras(e.episode_id).geometry)),
    "lost view": ("frames", lambda e: replace(e, frames={"image": e.frames["image"]})),
    "no image": ("image", lambda e: replace(e, frames={**e.frames, "image": [Jpeg(b"noise")] * len(e)})),
    "cut image": ("image", lambda e: replace(e, frames={**e.frames, "image": [cut(f) for f in e.frames["image"]]})),
    "lost column": ("provenance", lambda e: replace(e, provenance={"episode_id": e.episode_id})),
    "wrong id": ("provenance", lambda e: replace(e, provenance={**e.provenance, "episode_id": "other"})),
    "no number": ("provenance", lambda e: replace(e, provenance={**e.provenance, "seed": "7"})),
}


def load_spoilt(episode_id: str, spoil: Callable[[Episode], Episode]) -> Episode:
    return spoil(episode(episode_id)) if episode_id == IDS[-1] else episode(episode_id)


@pytest.mark.parametrize("fault", BAD)
def test_rlds_rejects_a_bad_episode(fault: str, tmp_path: Path) -> None:
    field, spoil = BAD[fault]
    with pytest.raises(PipelineError, match=rf"episode {IDS[-1]}: {field} "):
        write_rlds(tmp_path, load=partial(load_spoilt, spoil=spoil))
    assert not (tmp_path / "rlds").exists()
    assert not (tmp_path / "rlds.json").exists()


@pytest.mark.slow
def test_lerobot_rejects_a_bad_episode_and_keeps_what_was_there(tmp_path: Path) -> None:
    write_lerobot(tmp_path, frames="images")
    earlier = files(tmp_path / "lerobot")
    field, spoil = BAD["nan"]
    with pytest.raises(PipelineError, match=rf"episode {IDS[-1]}: {field} "):
        write_lerobot(tmp_path, load=partial(load_spoilt, spoil=spoil))
    assert files(tmp_path / "lerobot") == earlier
    # Of the three pieces the two that are whole stay, for the next time.
    assert [path.name for path in sorted((tmp_path / ".work").rglob("0000*"))] == ["00000", "00001"]
    write_lerobot(tmp_path)
    assert files(tmp_path / "lerobot") != earlier
    assert sorted(path.name for path in tmp_path.iterdir()) == ["lerobot", "lerobot.json"]
