"""Parts of a run's folder that stages can generate again: their sizes, their deletion, and stale datasets."""

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from pipeline.export_config import FAILURES
from pipeline.files import keep_below, remove, remove_if_empty
from pipeline.formats.registry import GROUPS, formats_in
from pipeline.generated import reject_edits
from pipeline.run.claim import locked, reject_unmarked
from pipeline.run.dataset_files import list_put_away_records, reject_deleting_foreign
from pipeline.run.foreign import reject_foreign_files
from pipeline.run.layout import (
    CARD,
    COUNTS,
    DATASETS,
    FINETUNE,
    FINISHED,
    FRAMES,
    INPUTS,
    LEAKAGE,
    MANIFEST,
    PLAN,
    PREVIEWS,
    REPLAY,
    REPORT,
    SETTINGS,
    SHEETS,
    STATISTICS,
    TRAJECTORIES,
    VALIDATION,
    WORK,
)
from pipeline.run.run import Run


class Part(NamedTuple):
    """Files and folders of a run's folder that belong together.

    Attributes:
        made_by: the stages that generate them, in words.
    """

    names: tuple[str, ...]
    made_by: str


def _datasets(group: str) -> Part:
    """Return the datasets and records of a group of formats, those of failures included."""
    names: list[str] = []
    for kind in formats_in(group):
        names += [kind.name, f"{kind.name}.json"]
    of_failures = [f"{FAILURES}/{name}" for name in names]
    return Part((*names, *of_failures), f"export_{group}, from the frames")


UNFINISHED = "unfinished"
"""Part of the unfinished files."""

PARTS = {
    UNFINISHED: Part((WORK, f"{FAILURES}/{WORK}"), "no stage (unfinished files of stopped stages)"),
    "pictures": Part((SHEETS, PREVIEWS, REPORT), "summary and report"),
    "uploads": Part((CARD, FINETUNE), "card and recipe"),
    **{group: _datasets(group) for group in GROUPS},
    "frames": Part((FRAMES,), "render, from the trajectories (most of a run's time)"),
    "trajectories": Part((TRAJECTORIES, REPLAY), "replay, from the demonstrations"),
    "tables": Part(
        (PLAN, DATASETS, MANIFEST, COUNTS, STATISTICS, LEAKAGE, VALIDATION, INPUTS, SETTINGS, FINISHED),
        "plan, manifest, validate and other stages",
    ),
}
"""Name to part. The parts are in the order of the work to generate them again, least work first."""


def say_stale(part: str, run: Run) -> None:
    """Print the datasets of a part of ``PARTS`` that exist although the configuration does not request them."""
    asked = {dataset.folder for dataset in (*run.datasets, *run.failure_datasets)}
    for folder in map(run.path, PARTS[part].names):
        if folder.is_dir() and folder not in asked:
            print(
                f"{folder} is from an earlier run and not requested; it stays until `python -m pipeline clean --only "
                f"{part} CONFIG` deletes all datasets of {part}, of which a run generates the requested ones again"
            )


def found(run: Run, parts: Iterable[str]) -> dict[str, float]:
    """Map each part that exists to its size in MB."""
    sizes_mb = {}
    for part in parts:
        paths = [path for path in map(run.path, PARTS[part].names) if path.exists()]
        if paths:
            sizes_mb[part] = sum(map(size_mb, paths))
    return sizes_mb


def reject_foreign(run: Run, parts: Iterable[str]) -> None:
    """Stop before parts are deleted that hold files of the user.

    Raises:
        PipelineError: naming files that no stage generated, or that were edited.
    """
    for part in parts:
        if part == "uploads":
            reject_edits(run.folder)
        reject_foreign_files(run.folder, PARTS[part].names)
        if part in GROUPS:
            for folder in filter(Path.is_dir, map(run.path, PARTS[part].names)):
                reject_deleting_foreign(folder)


def delete(run: Run, parts: Iterable[str]) -> None:
    """Delete parts of a run's folder.

    The records of edited datasets stay with their datasets, because a run finds edited files by them.

    Raises:
        PipelineError: when the folder has no mark of a run, a stage of the run is running, or a part holds files that
            no stage generated, or edited files.
    """
    reject_unmarked(run.folder)
    with locked(run.folder):
        chosen = [*parts]
        reject_foreign(run, chosen)
        # Unfinished files come last, as they include records of datasets that other parts delete.
        for part in sorted(chosen, key=lambda part: part == UNFINISHED):
            for path in map(run.path, PARTS[part].names):
                if part == UNFINISHED:
                    keep_below(path, list_put_away_records(path))
                    remove_if_empty(path)
                else:
                    remove(path)


def size_mb(path: Path) -> float:
    """Return the size of a file, or of all files in a folder, in MB; 0 if the path does not exist."""
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.lstat().st_size for file in files if file.is_file()) / 1e6
