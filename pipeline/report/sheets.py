"""Contact sheets: captioned pictures in rows; and for each axis of a run its episodes beside their clean twins."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from PIL import Image, ImageDraw, ImageFont

from pipeline.axes import from_json
from pipeline.axes.base import Layer, Perturbation
from pipeline.axes.disturbance import DisturbancePerturbation
from pipeline.files import replaced
from pipeline.images.jpeg import decode
from pipeline.run.counts import by_axis, twins
from pipeline.types import Episode, Frame

LINE_PX = 16
GAP_PX = 8
COLUMNS = 4
UNSHOWN = {"sha256", "licence", "attribution", "category"}
"""Parameters that captions leave out."""

LONGEST_CAPTION = 10
"""Lines; what does not fit is left out; the manifest has the full text."""

PAIR_SIDE_PX = 192
HEADER = "in each pair: the clean twin on the left, the perturbed episode on the right"
MOMENT = 0.35
"""Share of the episode after which it is shown: the arm is in view and the objects have not been moved together yet."""

SPREAD = ("component", "suite", "level", "task")
"""Columns over which the episodes of a sheet are spread, the most important first."""


@dataclass(frozen=True)
class Tile:
    """One captioned picture of a sheet; all pictures of a sheet have the same size."""

    picture: Image.Image
    caption: str


def write(manifest: Sequence[Mapping[str, Any]], load: Callable[[str], Episode], folder: Path) -> None:
    """Write one sheet for each perturbed axis of a run.

    Args:
        folder: where the pictures go, one ``<axis>.png`` for each axis with a kept episode that has a twin to show.
    """
    shown = twins(manifest)
    perturbed = [row for row in manifest if row["kept"] and row["role"] == "perturbed" and row["twin_id"] in shown]
    with replaced(folder) as temporary:
        temporary.mkdir()
        for axis, rows in by_axis(perturbed).items():
            tiles = [_pair(row, load) for row in spread(rows, 4 * COLUMNS)]
            sheet(f"{axis}; {HEADER}", tiles).save(temporary / f"{axis}.png")


def spread(rows: Sequence[Mapping[str, Any]], most: int) -> list[Mapping[str, Any]]:
    """At most so many rows, chosen so that each component, suite, level and task is among them as often as others.

    Each is the row whose component was chosen least often so far; then suite, level and task decide, then the order.
    """
    chosen: list[Mapping[str, Any]] = []
    left = list(rows)
    counts = {column: Counter[Any]() for column in SPREAD}
    while left and len(chosen) < most:
        row = min(left, key=lambda row: [counts[column][row[column]] for column in SPREAD])
        left.remove(row)
        chosen.append(row)
        for column in SPREAD:
            counts[column][row[column]] += 1
    return chosen


def _pair(row: Mapping[str, Any], load: Callable[[str], Episode]) -> Tile:
    perturbations = from_json(row["perturbations"])
    shown = []
    for episode_id in (row["twin_id"], row["episode_id"]):
        frames = load(episode_id).frames["image"]
        shown.append(decode(frames[_moment(perturbations, len(frames))]))
    changes = "; ".join(map(describe, perturbations))
    return Tile(side_by_side(shown, PAIR_SIDE_PX), f"{row['suite']}: {changes}")


def _moment(perturbations: Sequence[Perturbation], steps: int) -> int:
    """The step at which episodes of so many steps are shown."""
    for push in perturbations:
        if isinstance(push, DisturbancePerturbation):
            return min(push.first_step + push.steps, steps - 1)
    # The arm is back on the demonstration's path soon after another start.
    return 0 if any(one.layer is Layer.PHYSICS for one in perturbations) else int(MOMENT * steps)


def side_by_side(frames: Sequence[Frame], side_px: int) -> Image.Image:
    """Frames as one picture, each ``side_px`` wide and high."""
    picture = Image.new("RGB", (len(frames) * side_px, side_px))
    for column, frame in enumerate(frames):
        scaled = Image.fromarray(frame).resize((side_px, side_px), Image.Resampling.LANCZOS)
        picture.paste(scaled, (column * side_px, 0))
    return picture


def describe(perturbation: Perturbation) -> str:
    """What was drawn, in one line: component, level and the parameters that are not at their defaults."""
    parameters = perturbation.model_dump(exclude={"axis", "component", "level", "seed"}, exclude_defaults=True)
    # A space that does not break lines keeps a value with its name; a wording needs no name.
    values = ", ".join(
        f"{name}\N{NO-BREAK SPACE}{value}".removeprefix("text\N{NO-BREAK SPACE}") for name, value in _flat(parameters)
    )
    return f"{perturbation.component}, level {perturbation.level}: {values}".removesuffix(": ")


def _flat(parameters: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Names and values for people: in one level whatever their nesting, figures rounded."""
    for name, value in parameters.items():
        if isinstance(value, Mapping):
            yield from _flat(value)
        elif name not in UNSHOWN:
            yield name, _shown(value)


def _shown(value: Any) -> str:
    if isinstance(value, Mapping):
        return " ".join(shown for _, shown in _flat(value))
    if isinstance(value, Sequence) and not isinstance(value, str):
        return " ".join(map(_shown, value))
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def sheet(title: str, tiles: Sequence[Tile], columns: int = COLUMNS) -> Image.Image:
    """Captioned pictures in rows of ``columns``; each row is as high as its longest caption needs."""
    width, height = tiles[0].picture.size
    columns = min(columns, len(tiles))
    sheet_width = columns * (width + GAP_PX) + GAP_PX
    heading = _wrapped(title, sheet_width - 2 * GAP_PX)
    captions = [_wrapped(tile.caption, width)[:LONGEST_CAPTION] for tile in tiles]
    rows = [range(first, min(first + columns, len(tiles))) for first in range(0, len(tiles), columns)]
    row_heights = [height + LINE_PX * (max(len(captions[i]) for i in row) + 1) for row in rows]
    top = LINE_PX * (len(heading) + 1)
    page = Image.new("RGB", (sheet_width, top + sum(row_heights)), "white")
    _write(page, heading, GAP_PX, GAP_PX)
    for row, row_height in zip(rows, row_heights, strict=True):
        for column, i in enumerate(row):
            left = GAP_PX + column * (width + GAP_PX)
            page.paste(tiles[i].picture, (left, top))
            _write(page, captions[i], left, top + height + 2)
        top += row_height
    return page


def _write(page: Image.Image, lines: Sequence[str], left: int, top: int) -> None:
    pen = ImageDraw.Draw(page)
    for number, line in enumerate(lines):
        pen.text((left, top + number * LINE_PX), line, fill="black", font=_font())


def _wrapped(text: str, width_px: int) -> list[str]:
    """Lines of ``text``, none wider than ``width_px`` unless a single word is."""
    lines: list[str] = []
    for word in text.split(" "):
        # The font has no glyph for the space that does not break lines.
        word = word.replace("\N{NO-BREAK SPACE}", " ")
        longer = f"{lines[-1]} {word}" if lines else word
        if lines and _font().getlength(longer) <= width_px:
            lines[-1] = longer
        else:
            lines.append(word)
    return lines


@cache
def _font() -> ImageFont.ImageFont | ImageFont.FreeTypeFont:
    return ImageFont.load_default(12)
