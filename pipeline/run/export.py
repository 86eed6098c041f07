"""Bring a dataset up to date: what is finished stays, what a killed run had finished of it stays too.

Pieces are written into ``data/<run>/.work/<format>/<identity>/``, each under a temporary name that is renamed once it
is whole. Then the dataset before is moved into ``.work``, the finished one takes its place, and its record is written.
Only then is anything deleted, so that a kill at any moment leaves what the same command takes up again.
"""

import json
import os
import re
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict
from functools import cache, partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

from pipeline.axes.language import LanguageAxis
from pipeline.compute.pool import Workers
from pipeline.episode_schema import SCHEMA
from pipeline.errors import PipelineError
from pipeline.files import (
    checksum,
    keep_below,
    put_in_place,
    read_json,
    remove,
    remove_if_empty,
    replaced,
    sync,
    write_json,
)
from pipeline.formats.base import Export, Format
from pipeline.formats.episodes import Episodes, Known, Load, Piece
from pipeline.identity import PACKAGES, RECIPES, differences, made_with, refuse_unasked
from pipeline.libero.tasks import find_task
from pipeline.run.outcome import shuffled
from pipeline.run.run import Run
from pipeline.seeding import digest
from pipeline.testset import benchmark
from pipeline.types import Extra

AnyFormat = Format[Any]

OFT_STATISTICS = re.compile(r"dataset_statistics_[0-9a-f]+\.json")
"""File that OpenVLA-OFT's loader stores next to the shards; it would take it for those of a later dataset."""

FINISHED = "record.json"
"""File of a work folder: the record of its dataset, which is whole; later the record beside the dataset."""

BEFORE = "before"
"""Folder of a format's work folder: the dataset that was replaced, until the new one has its record."""


def export_run(kind: type[AnyFormat], run: Run) -> None:
    """Bring a run's dataset of one format up to date, and say what was done.

    One that is not asked for is left as it is: where there is none, its record is an empty one.
    """
    options = run.config.export.formats.get(kind.name)
    if options is None:
        record = run.path(f"{kind.name}.json")
        if not record.exists():
            write_json(record, {})
        print(f"{kind.title} is not asked for: export.{kind.name} is null")
        return
    for target in (*run.formats, *run.failure_formats):
        if target.name == kind.name:
            _bring_up_to_date(target, episodes_of(target, run), run)


def _bring_up_to_date(target: AnyFormat, episodes: Episodes, run: Run) -> None:
    refuse_foreign(target, episodes)
    if not episodes.ids and "outcome" in target.extras:
        remove(target.folder)
        target.record_file.unlink(missing_ok=True)
        print(f"no replay missed its goal: nothing is in {target.folder}")
        return
    if is_current(target, episodes):
        print(f"{target.folder} has these {len(episodes.ids)} episodes already, see {target.record_file}")
        return
    refuse_unasked(outdated(target, episodes), target.folder)
    with run.workers() as workers:
        export(target, episodes, workers)
    print(f"wrote {len(episodes.ids)} episodes to {target.folder}")


def refuse_foreign(target: AnyFormat, episodes: Episodes) -> None:
    """Stop where the format's folder has entries that no export wrote, as a dataset is replaced as a whole.

    Raises:
        PipelineError: when an entry is no set of the dataset there and none of the dataset to write, or when a set has
            a file that its record does not list.
    """
    own = target.sets(target.pieces(episodes)) if episodes.ids else set()
    records = [Export(**read_json(file)) for file in target.work.glob(f"*/{FINISHED}")]  # of killed calls
    with suppress(PipelineError):  # There is none, or the dataset has changed since.
        records.append(target.record())
    for record in records:
        own |= {name.partition("/")[0] for name in record.files}
    foreign = sorted(entry for entry in target.folder.glob("*") if entry.name not in own)
    if records and not foreign:
        written = {name for record in records for name in record.files}
        foreign = [path for path in _files(target.folder) if path.relative_to(target.folder).as_posix() not in written]
    if foreign:
        raise PipelineError(
            f"not of this run's {target.title}, and would be deleted ({len(foreign)} such)",
            where=foreign[0],
            expected=f"only {', '.join(sorted(own))}",
            remedy=f"move it out of {target.folder}; to train on both, make a folder of links to them",
        )


def _files(folder: Path) -> list[Path]:
    """List files and links below a dataset's folder, without the statistics that OpenVLA-OFT stores when it trains."""
    paths = (path for path in folder.rglob("*") if path.is_symlink() or not path.is_dir())
    return sorted(path for path in paths if not OFT_STATISTICS.fullmatch(path.name))


def episodes_of(target: AnyFormat, run: Run) -> Episodes:
    """What a dataset is made of: the kept episodes of a run, or its failures, in the order they are written.

    Where the format takes ``language``, they come with subtasks and with the rewrites that the run's language axis may
    draw for them, or its default ranges.
    """
    failures = "outcome" in target.extras
    rewrites: dict[str, tuple[str, ...]] | None = {} if target.language else None
    outcome, language = run.outcome, run.config.plan.axes.language
    known: dict[str, Known] = {}
    for one in shuffled(outcome.missed) if failures else outcome.kept:
        row, content = outcome.row_of[one], outcome.content(one)
        if rewrites is not None:
            rewrites[one] = wordings(language, row.suite, row.task, row.axis)
            content = digest(content, rewrites[one])[:16]
        steps = outcome.trajectories[row.trajectory_id]["steps"]
        known[one] = Known(row.suite, content, row.demo_id, row.instruction, steps, row.demo_origin_sha256)
    extras: tuple[Extra, ...] = ("outcome",) if failures else ()
    return Episodes(known, run.episodes(extras=extras, rewrites=rewrites))


@cache
def wordings(axis: LanguageAxis | None, suite: str, task: str, axes: str) -> tuple[str, ...]:
    """The rewrites that a run's language axis, or its default ranges, may draw for an episode of these axes."""
    return (axis or LanguageAxis()).wordings(find_task(suite, task), axes.split("+"), benchmark.load())


def identity(target: AnyFormat, episodes: Episodes) -> str:
    """A short digest of everything that the bytes of a dataset depend on."""
    return digest(
        "export",
        target.name,
        RECIPES[target.name],
        {package: version(package) for package in PACKAGES[target.name]},
        SCHEMA.model_dump(mode="json"),
        _options(target),
        target.extras,
        [[piece.path, piece.ids] for piece in target.pieces(episodes)],
        [known.content for known in episodes.known.values()],
    )[:16]


def request(target: AnyFormat, episodes: Episodes) -> str:
    """A short digest of what of it was asked for: the episodes with all that they are, and the options."""
    content = [known.content for known in episodes.known.values()]
    return digest(_options(target), target.extras, content)[:16]


def _options(target: AnyFormat) -> dict[str, Any]:
    """By the names that the fields had when they were first written."""
    dumped: dict[str, Any] = target.options.model_dump(mode="json", by_alias=True)
    return dumped


def outdated(target: AnyFormat, episodes: Episodes) -> Counter[str]:
    """Why the finished dataset would be made anew although the same was asked for, to its number of files."""
    try:
        record = target.record()
    except PipelineError:
        return Counter()
    if record.asked != request(target, episodes) or record.identity == identity(target, episodes):
        return Counter()
    return Counter({f"files, made with {differences(record.made_with, _made_with(target))}": len(record.files)})


def _made_with(target: AnyFormat) -> dict[str, str]:
    return {**made_with(target.name), "episode schema": digest(SCHEMA.model_dump(mode="json"))[:8]}


def is_current(target: AnyFormat, episodes: Episodes) -> bool:
    """Whether the dataset is there, whole and of these episodes.

    Every file must be there and no younger than the record. Statistics that a client stored in its sets are removed
    then.
    """
    if not untouched(target) or target.record().identity != identity(target, episodes):
        return False
    keep_below(target.folder, {target.folder / name for name in target.record().files})
    _clear_work(target)
    return True


def untouched(target: AnyFormat) -> bool:
    """Whether all files of a finished dataset are there, and none has changed since it was recorded."""
    try:
        recorded = target.record_file.stat().st_mtime_ns
        return all((target.folder / name).stat().st_mtime_ns <= recorded for name in target.record().files)
    except (PipelineError, OSError):
        return False


def notice_changes(target: AnyFormat) -> None:
    """Delete the record of a finished dataset whose files are gone or have changed, so that it counts as not there."""
    if not target.record_file.exists() or untouched(target):
        return
    try:
        same = all(checksum(target.folder / name) == sha256 for name, sha256 in target.record().files.items())
    except (PipelineError, OSError):
        same = False
    if same:  # Such as in a copy.
        target.record_file.touch()
    else:
        target.record_file.unlink()


def export(target: AnyFormat, episodes: Episodes, workers: Workers) -> None:
    """Write a dataset, replacing the one before, and go on where a killed call with the same episodes was.

    The bytes depend on the episodes, their order, the options and the format's packages alone: not on ``workers``, and
    not on how often the work was interrupted.

    Args:
        workers: do the work; one call for each piece.

    Raises:
        PipelineError: when an episode breaks the schema or the ids are unfit. The dataset before stays; the pieces that
            are whole stay in the work folder.
    """
    pieces = target.pieces(episodes)
    work = target.work / identity(target, episodes)
    keep_below(target.work, {work})
    finished = work / FINISHED
    if not finished.is_file():
        _write_pieces(target, work, pieces, episodes.load, workers)
        # In a worker, which has the format's packages loaded already.
        (places,) = workers(partial(_assembled, target, work), [pieces], f"{target.title} assembly")
        dataset = work / "dataset"
        sync(dataset)
        paths = sorted(file for file in dataset.rglob("*") if file.is_file())
        checksums = workers(checksum, paths, f"{target.title} checksums")
        files = {path.relative_to(dataset).as_posix(): sha256 for path, sha256 in zip(paths, checksums, strict=True)}
        with replaced(finished) as temporary:
            record = Export(work.name, files, places, request(target, episodes), _made_with(target))
            temporary.write_text(json.dumps(asdict(record), indent=0) + "\n")
    _replace(target, work)


def _replace(target: AnyFormat, work: Path) -> None:
    """Put a finished dataset and its record in the place of the ones before.

    Nothing is deleted until the record is written: a folder that is half deleted would have sets of no record.

    Args:
        work: has the folder ``dataset``, unless a killed call moved it, and the record of it.
    """
    if (work / "dataset").is_dir():
        if target.folder.exists():
            os.replace(target.folder, target.work / BEFORE)
        target.record_file.unlink(missing_ok=True)  # It is about the dataset before.
        put_in_place(work / "dataset", target.folder)
    (work / FINISHED).touch()  # No file of the dataset is younger than its record.
    put_in_place(work / FINISHED, target.record_file)
    _clear_work(target)


def _write_pieces(target: AnyFormat, work: Path, pieces: Sequence[Piece], load: Load, workers: Workers) -> None:
    paths = {work / piece.path: piece for piece in pieces}
    whole = {path for path in paths if path.exists()}
    keep_below(work, whole)
    for folder in {path.parent for path in paths}:
        folder.mkdir(parents=True, exist_ok=True)
    todo = [(path, piece) for path, piece in paths.items() if path not in whole]
    workers(partial(_write_piece, target, load), todo, f"{target.title} pieces")


def _write_piece(target: AnyFormat, load: Load, todo: tuple[Path, Piece]) -> None:
    path, piece = todo
    with replaced(path) as temporary:
        target.write_piece(temporary, piece, load)


def _assembled(target: AnyFormat, work: Path, pieces: Sequence[Piece]) -> dict[str, dict[str, Any]]:
    # Without what a worker made that was lost in the middle of it.
    keep_below(work, {work / piece.path for piece in pieces})
    return target.assemble(work, pieces)


def _clear_work(target: AnyFormat) -> None:
    remove(target.work)
    remove_if_empty(target.work.parent)
