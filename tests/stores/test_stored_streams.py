"""What a file holds of some streams, for whoever joins it with what is still to be rendered."""

from pathlib import Path

import numpy as np

from pipeline.config import RenderConfig
from pipeline.stores.frame_store import FrameStore
from pipeline.types import Geometry, Jpeg, Rendered


def test_only_the_streams_asked_for_and_of_the_same_device_are_taken_over(tmp_path: Path) -> None:
    """Frames of two devices differ by some grey levels, and would come into one dataset."""
    store, motion = FrameStore(tmp_path, RenderConfig()), np.zeros((1, 7), np.float32)
    view = Geometry(np.eye(3, dtype=np.float32), np.eye(4, dtype=np.float32))
    rendered = Rendered(
        "open_loop",
        np.zeros((1, 8), np.float32),
        motion,
        motion,
        motion,
        streams={"seen": [Jpeg(b"frame")], "other": [Jpeg(b"other")]},
        rejected={"black": "too_dark", "bright": "blown_out"},
        geometry={"view": view},
    )
    store.save("one", rendered, "a GPU")
    wanted = dict.fromkeys(("seen", "black", "missing"), "view")
    (part,) = store.stored("one", wanted, "a GPU")
    assert (part.streams, part.rejected) == ({"seen": [b"frame"]}, {"black": "too_dark"})
    assert store.stored("one", wanted, "another") == []
