"""Language columns of LeRobot sets, as ``datasets/language.py`` of lerobot 0.6.1 defines them."""

from typing import Any

import datasets
import pyarrow as pa

from pipeline.formats.annotations import event_annotations, persistent_annotations
from pipeline.formats.lerobot.columns import EVENTS, LANGUAGE
from pipeline.types import Episode

_TEXT = datasets.Value("string")
_NOTE = {"role": _TEXT, "content": _TEXT, "style": _TEXT}
_SOURCE = {"camera": _TEXT, "tool_calls": datasets.List(datasets.Json())}
FEATURES = {
    LANGUAGE: datasets.List(_NOTE | {"timestamp": datasets.Value("float32")} | _SOURCE),
    EVENTS: datasets.List(_NOTE | _SOURCE),
}
"""``language_persistent_column_feature`` and ``language_events_column_feature`` of lerobot's module."""


def language_columns(episode: Episode, size_px: int, *, train: bool) -> dict[str, pa.Array]:
    """Return both language columns of an episode as text; pyarrow creates JSON by a cast to the schema.

    The persistent texts are the same in every frame, as in lerobot's own annotations. An event is in its own frame.
    """
    persistent = []
    for note in persistent_annotations(episode, train=train):
        row = {"role": note.role, "content": note.text, "style": note.style, "timestamp": note.time_s}
        persistent.append(row)
    events: list[list[dict[str, Any]]] = [[] for _ in range(len(episode))]
    for note in event_annotations(episode, size_px):
        row = {"role": note.role, "content": note.text, "style": note.style, "camera": note.camera}
        events[note.step].append(row)
    once = pa.array([persistent], _text_type(LANGUAGE))
    return {
        LANGUAGE: pa.concat_arrays([once] * len(episode)),
        EVENTS: pa.array(events, _text_type(EVENTS)),
    }


def _text_type(column: str) -> pa.DataType:
    """Return the type of a column whose tool calls are text."""
    kinds = {name: pa.string() for name in FEATURES[column].feature}
    kinds |= {"tool_calls": pa.list_(pa.string())}
    if "timestamp" in kinds:
        kinds["timestamp"] = pa.float32()
    return pa.list_(pa.struct(list(kinds.items())))
