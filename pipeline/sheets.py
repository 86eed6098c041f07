"""Contact sheets: for each axis one picture of its episodes, each beside its clean twin."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from PIL import Image, ImageDraw, ImageFont

from pipeline.axes import from_json
from pipeline.files import replaced
from pipeline.frames import decode
from pipeline.types import Episode

SIDE_PX = 192
LINE_PX = 16
HEADER = "in each pair: the clean twin on the left, the perturbed episode on the right"
COLUMNS = 4
MOMENT = 0.35
"""Share of the episode after which it is shown: the arm is in view and the objects still stand apart."""


def draw(manifest: Sequence[Mapping[str, Any]], load: Callable[[str], Episode], folder: Path) -> dict[str, Path]:
    """Draw one sheet for each perturbed axis of a run.

    Args:
        manifest: rows of the manifest.
        load: reads an episode by its id.
        folder: where the pictures go, one ``<axis>.png`` each.

    Returns:
        Axis to picture, for the axes with a kept episode.
    """
    kept = {row["episode_id"]: row for row in manifest if row["kept"]}
    by_axis: dict[str, list[Mapping[str, Any]]] = {}
    for row in kept.values():
        if row["role"] == "perturbed":
            by_axis.setdefault(row["axis"], []).append(row)
    drawn = {}
    with replaced(folder) as temporary:
        temporary.mkdir()
        for axis, rows in by_axis.items():
            # One of each component in turn, so that a sheet shows them all.
            rows = sorted(rows, key=lambda row: (_before(rows, row), row["component"]))
            shown = [(_pair(row, load), _caption(row)) for row in rows[: 4 * COLUMNS]]
            _sheet(f"{axis}; {HEADER}", shown).save(temporary / f"{axis}.png")
            drawn[axis] = folder / f"{axis}.png"
    return drawn


def _before(rows: Sequence[Mapping[str, Any]], row: Mapping[str, Any]) -> int:
    """How many of ``rows`` that stand before ``row`` have its component."""
    return sum(other["component"] == row["component"] for other in rows[: rows.index(row)])


def _pair(row: Mapping[str, Any], load: Callable[[str], Episode]) -> Image.Image:
    """The twin and the perturbed episode beside it, at the same step."""
    pair = Image.new("RGB", (2 * SIDE_PX, SIDE_PX), "white")
    for column, episode_id in enumerate((row["twin_id"], row["episode_id"])):
        frames = load(episode_id).frames["image"]
        frame = Image.fromarray(decode(frames[int(MOMENT * len(frames))]))
        pair.paste(frame.resize((SIDE_PX, SIDE_PX), Image.Resampling.LANCZOS), (column * SIDE_PX, 0))
    return pair


def _caption(row: Mapping[str, Any]) -> list[str]:
    return textwrap.wrap(f"{row['suite']}: {_described(row)}", 62)


def _described(row: Mapping[str, Any]) -> str:
    described = []
    for perturbation in from_json(row["perturbations"]):
        parameters = perturbation.model_dump(exclude={"axis", "component", "seed"}, exclude_defaults=True)
        values = ", ".join(f"{name} {value}".removeprefix("text ") for name, value in _flat(parameters))
        described.append(f"{perturbation.component}: {values}")
    return "; ".join(described)


def _flat(parameters: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """Parameters in one level, whatever their nesting."""
    flat: list[tuple[str, Any]] = []
    for name, value in parameters.items():
        flat += _flat(value) if isinstance(value, Mapping) else [(name, value)]
    return flat


def _sheet(title: str, shown: Sequence[tuple[Image.Image, list[str]]]) -> Image.Image:
    """Captioned pictures in rows of ``COLUMNS``; each row is as high as its longest caption needs."""
    gap = 8
    width, height = shown[0][0].size
    rows = [shown[start : start + COLUMNS] for start in range(0, len(shown), COLUMNS)]
    heights = [height + LINE_PX * (max(len(lines) for _, lines in row) + 1) for row in rows]
    columns = min(COLUMNS, len(shown))
    sheet = Image.new("RGB", (columns * (width + gap) + gap, sum(heights) + 2 * LINE_PX), "white")
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(12)
    pen.text((gap, gap), title, fill="black", font=font)
    top = 2 * LINE_PX
    for row, row_height in zip(rows, heights, strict=True):
        for column, (picture, lines) in enumerate(row):
            left = gap + column * (width + gap)
            sheet.paste(picture, (left, top))
            for number, line in enumerate(lines):
                pen.text((left, top + height + 2 + number * LINE_PX), line, fill="black", font=font)
        top += row_height
    return sheet
