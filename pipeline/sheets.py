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
TEXT_PX = 84
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
            rows = sorted(rows, key=lambda row: (rows_before(rows, row), row["component"]))
            cells = [_cell(row, load) for row in rows[: 4 * COLUMNS]]
            _sheet(cells).save(temporary / f"{axis}.png")
            drawn[axis] = folder / f"{axis}.png"
    return drawn


def rows_before(rows: Sequence[Mapping[str, Any]], row: Mapping[str, Any]) -> int:
    """How many of ``rows`` that stand before ``row`` have its component."""
    return sum(other["component"] == row["component"] for other in rows[: rows.index(row)])


def _cell(row: Mapping[str, Any], load: Callable[[str], Episode]) -> Image.Image:
    """The twin, the perturbed episode beside it, and under both what was done to it."""
    cell = Image.new("RGB", (2 * SIDE_PX, SIDE_PX + TEXT_PX), "white")
    for column, episode_id in enumerate((row["twin_id"], row["episode_id"])):
        frames = load(episode_id).frames["image"]
        frame = Image.fromarray(decode(frames[int(MOMENT * len(frames))]))
        cell.paste(frame.resize((SIDE_PX, SIDE_PX), Image.Resampling.LANCZOS), (column * SIDE_PX, 0))
    pen = ImageDraw.Draw(cell)
    font = ImageFont.load_default(12)
    lines = textwrap.wrap(f"{row['suite']}: {_described(row)}", 62)
    pen.multiline_text((4, SIDE_PX + 4), "\n".join(lines[:5]), fill="black", font=font, spacing=3)
    return cell


def _described(row: Mapping[str, Any]) -> str:
    described = []
    for perturbation in from_json(row["perturbations"]):
        parameters = perturbation.model_dump(exclude={"axis", "component", "seed"}, exclude_defaults=True)
        values = ", ".join(f"{name} {value}" for name, value in _flat(parameters))
        described.append(f"{perturbation.component} ({values})")
    return "; ".join(described)


def _flat(parameters: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """Parameters in one level, whatever their nesting."""
    flat: list[tuple[str, Any]] = []
    for name, value in parameters.items():
        flat += _flat(value) if isinstance(value, Mapping) else [(name, value)]
    return flat


def _sheet(cells: Sequence[Image.Image]) -> Image.Image:
    width, height = cells[0].size
    gap = 8
    rows = -(-len(cells) // COLUMNS)
    columns = min(COLUMNS, len(cells))
    sheet = Image.new("RGB", (columns * (width + gap) + gap, rows * (height + gap) + gap), "white")
    for index, cell in enumerate(cells):
        row, column = divmod(index, COLUMNS)
        sheet.paste(cell, (gap + column * (width + gap), gap + row * (height + gap)))
    return sheet
