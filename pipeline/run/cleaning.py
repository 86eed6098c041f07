"""What a run's folder holds that can be made again: found with its sizes, and deleted; and what of it is stale."""

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from pipeline.config import Config
from pipeline.files import remove
from pipeline.formats.registry import FAILURES, failures_of, formats_of
from pipeline.run.finished import FOLDER
from pipeline.run.foreign import refuse_foreign_files
from pipeline.run.stage import locked, refuse_unmarked


class Part(NamedTuple):
    """Files and folders of a run's folder that belong together.

    Attributes:
        made_by: the stages that make them, in words.
    """

    names: tuple[str, ...]
    made_by: str


def _with_failures(*formats: str) -> tuple[str, ...]:
    """Datasets and records of some formats, which one stage makes."""
    names = [name for one in formats for name in (one, f"{one}.json")]
    return (*names, *(f"{FAILURES}/{name}" for name in names))


PARTS = {
    "unfinished": Part((".work",), "nothing: what stopped stages left"),
    "pictures": Part(("sheets", "previews", "report.html"), "summary and report"),
    "uploads": Part(("card", "finetune"), "card and recipe"),
    "rlds": Part(_with_failures("rlds"), "export_rlds, from the frames"),
    "lerobot": Part(_with_failures("lerobot", "lerobot_v21"), "export_lerobot, from the frames"),
    "frames": Part(("frames",), "render, from the trajectories: most of a run's time"),
    "trajectories": Part(("trajectories", "replay.json"), "replay, from the demonstrations"),
    "tables": Part(
        (
            *("plan.parquet", "manifest.parquet", "counts.json", "dataset_statistics.json", "leakage.json"),
            *("validation.json", "inputs.json", "settings.json", FOLDER),
        ),
        "plan, manifest, validate and others",
    ),
}
"""Least to make again first."""


def say_stale(part: str, config: Config) -> None:
    """Say which datasets of a part of ``PARTS`` are there though nothing asks for them now."""
    asked = {one.folder for one in (*formats_of(config.data, config.export), *failures_of(config.data, config.export))}
    for folder in (config.data / name for name in PARTS[part].names):
        if folder.is_dir() and folder not in asked:
            print(
                f"{folder} is of an earlier run, and not asked for: `python -m pipeline clean --only {part} CONFIG` "
                f"deletes all of {part}, and the next run makes again what is asked for"
            )


def found(data: Path, parts: Iterable[str]) -> dict[str, float]:
    """Of some parts, those that are there, to their megabytes."""
    there = {part: [path for name in PARTS[part].names if (path := data / name).exists()] for part in parts}
    return {part: sum(map(size_mb, paths)) for part, paths in there.items() if paths}


def delete(data: Path, parts: Iterable[str]) -> None:
    """Delete parts of a run's folder.

    Raises:
        PipelineError: when the folder is not marked as that of a run, a stage of the run is running, or a part holds
            files that no stage made.
    """
    refuse_unmarked(data)
    with locked(data):
        refuse_foreign_files(data, [name for part in parts for name in PARTS[part].names])
        for part in parts:
            for name in PARTS[part].names:
                remove(data / name)


def size_mb(path: Path) -> float:
    """Megabytes of a file, or of all files in a folder; 0 where nothing is."""
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.lstat().st_size for file in files if file.is_file()) / 1e6
