"""Contact sheets: captioned pictures in rows; for each axis of a run, its episodes next to their clean twins."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from PIL import Image, ImageDraw, ImageFont

from pipeline.axes import from_json, task_of
from pipeline.axes.base import Layer, Perturbation
from pipeline.files import replaced
from pipeline.images.jpeg import decode
from pipeline.run.counts import by_axis, twins
from pipeline.run.foreign import reject_foreign_files
from pipeline.types import Episode, Frame, Task

Font = ImageFont.ImageFont | ImageFont.FreeTypeFont

LINE_PX = 16
LETTER_PX = 22
"""Height of the letters of a rewritten instruction that stands in place of a picture."""

GAP_PX = 8
COLUMNS = 4
UNSHOWN = {"sha256", "licence", "attribution", "category"}
"""Parameters that captions leave out."""

NO_BREAK = "\N{NO-BREAK SPACE}"

UNITS = {"deg": "°", "m": f"{NO_BREAK}m", "rad": f"{NO_BREAK}rad", "s": f"{NO_BREAK}s", "px": f"{NO_BREAK}px"}
"""Last part of a parameter's name to the unit that captions write behind its value."""

LONGEST_CAPTION = 10
"""Largest number of lines; further text is left out, and the manifest has all of it."""

PAIR_SIDE_PX = 192
HEADER = "in each pair, the clean twin on the left and the perturbed episode on the right"
MOMENT = 0.35
"""Share of the episode after which it is shown: the arm is in view, and the objects are not moved together yet."""

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
        folder: folder of the pictures, one ``<axis>.png`` for each axis with a kept episode whose clean twin is stored.

    Raises:
        PipelineError: if the folder has files that no stage generated; they stay.
    """
    twin_ids = twins(manifest).keys()
    perturbed = [row for row in manifest if row["kept"] and row["role"] == "perturbed" and row["twin_id"] in twin_ids]
    with replaced(folder) as temporary:
        temporary.mkdir()
        for axis, rows in by_axis(perturbed).items():
            tiles = [_pair(row, load) for row in spread(rows, 4 * COLUMNS)]
            sheet(f"{axis}; {HEADER}", tiles).save(temporary / f"{axis}.png")
        reject_foreign_files(folder.parent, [folder.name])  # Stored since the stage began.


def spread(rows: Sequence[Mapping[str, Any]], most: int) -> list[Mapping[str, Any]]:
    """Choose at most ``most`` rows, so that all components, suites, levels and tasks occur about equally often.

    Each row is the one whose component was chosen least often so far; then suite, level and task decide, then the
    order.
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
    pair = []
    for episode_id in (row["twin_id"], row["episode_id"]):
        frames = load(episode_id).frames["image"]
        pair.append(decode(frames[_moment(perturbations, len(frames))]))
    return Tile(side_by_side(pair, PAIR_SIDE_PX), f"{name_episode(row)}: {describe_episode(row)}")


def _moment(perturbations: Sequence[Perturbation], steps: int) -> int:
    """Return the step at which an episode of ``steps`` steps is shown."""
    for change in perturbations:
        if change.acts_until is not None:
            return min(change.acts_until, steps - 1)
    # The arm is back on the demonstration's path soon after another start.
    return 0 if any(change.layer is Layer.PHYSICS for change in perturbations) else int(MOMENT * steps)


def side_by_side(frames: Sequence[Frame], side_px: int) -> Image.Image:
    """Join frames into one picture, each ``side_px`` wide and high."""
    picture = Image.new("RGB", (len(frames) * side_px, side_px))
    for column, frame in enumerate(frames):
        scaled = Image.fromarray(frame).resize((side_px, side_px), Image.Resampling.LANCZOS)
        picture.paste(scaled, (column * side_px, 0))
    return picture


def name_episode(row: Mapping[str, Any]) -> str:
    """Return the suite, the task and the identifier of an episode, which lead from a picture to its data."""
    task = row["task"].replace("_", " ")  # Lines break at spaces.
    return f"{row['suite']}, {task}, episode {row['episode_id']}"


def describe_episode(row: Mapping[str, Any]) -> str:
    """Describe the perturbations of an episode in one line."""
    task = task_of(row["suite"], row["task"], row["perturbations"])
    return describe_all(from_json(row["perturbations"]), task)


def describe_all(perturbations: Sequence[Perturbation], task: Task) -> str:
    """Describe perturbations of one episode of ``task`` in one line."""
    return "; ".join(describe(perturbation, task) for perturbation in perturbations)


def describe(perturbation: Perturbation, task: Task) -> str:
    """Describe a perturbation in one line: component, level and the parameters that are not at their defaults.

    Parts that the scene of ``task`` does not show are left out.
    """
    parameters = perturbation.visible_part(task).model_dump(
        exclude={"axis", "component", "level", "seed"}, exclude_defaults=True
    )
    heading = f"{perturbation.component.replace('_', ' ')}, level {perturbation.level}"
    return f"{heading}: {', '.join(_describe_parameters(parameters))}".removesuffix(": ")


def _describe_parameters(parameters: Mapping[str, Any]) -> Iterator[str]:
    """Yield each parameter with its value and unit, such as ``yaw -5.2°``; nested parameters in one level."""
    for name, value in parameters.items():
        if isinstance(value, Mapping):
            yield from _describe_parameters(value)
        elif name == "text":
            yield f"“{value}”"
        elif name == "name":
            yield str(value)
        elif name not in UNSHOWN:
            label, unit = _label_and_unit(name)
            yield f"{label}{NO_BREAK}{_in_words(value)}{unit}"


def _label_and_unit(name: str) -> tuple[str, str]:
    label, _, unit = name.rpartition("_")
    if label and unit in UNITS:
        return label.replace("_", " "), UNITS[unit]
    return name.replace("_", " "), ""


def _in_words(value: Any) -> str:
    if isinstance(value, Mapping):
        return " ".join(_describe_parameters(value))
    if isinstance(value, Sequence) and not isinstance(value, str):
        return f"({', '.join(map(_in_words, value))})"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def sheet(title: str, tiles: Sequence[Tile], columns: int = COLUMNS) -> Image.Image:
    """Arrange captioned pictures in rows of ``columns``; the longest caption of a row determines its height."""
    width, height = tiles[0].picture.size
    columns = min(columns, len(tiles))
    sheet_width = columns * (width + GAP_PX) + GAP_PX
    heading = _wrapped(title, sheet_width - 2 * GAP_PX)
    captions = [_wrapped(tile.caption, width)[:LONGEST_CAPTION] for tile in tiles]
    rows = [range(first, min(first + columns, len(tiles))) for first in range(0, len(tiles), columns)]
    row_heights = []
    for row in rows:
        longest = max(len(captions[i]) for i in row)
        row_heights.append(height + LINE_PX * (longest + 1))
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


def lettering(text: str, side_px: int) -> Image.Image:
    """Return a square picture of a text in large letters."""
    page = Image.new("RGB", (side_px, side_px), "whitesmoke")
    font = ImageFont.load_default(LETTER_PX)
    lines = _wrapped(f"“{text}”", side_px - 4 * GAP_PX, font)
    ImageDraw.Draw(page).multiline_text(
        (side_px / 2, side_px / 2), "\n".join(lines), fill="black", font=font, anchor="mm", align="center"
    )
    return page


def _write(page: Image.Image, lines: Sequence[str], left: int, top: int) -> None:
    pen = ImageDraw.Draw(page)
    for number, line in enumerate(lines):
        pen.text((left, top + number * LINE_PX), line, fill="black", font=_font())


def _wrapped(text: str, width_px: int, font: Font | None = None) -> list[str]:
    """Break ``text`` into lines of at most ``width_px``; only a single word may be wider."""
    lines: list[str] = []
    font = font or _font()
    for word in text.split(" "):
        # The font has no glyph for the no-break space.
        word = word.replace(NO_BREAK, " ")
        longer = f"{lines[-1]} {word}" if lines else word
        if lines and font.getlength(longer) <= width_px:
            lines[-1] = longer
        else:
            lines.append(word)
    return lines


@cache
def _font() -> Font:
    return ImageFont.load_default(12)
