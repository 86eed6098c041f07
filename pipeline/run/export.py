"""Update of a dataset: finished pieces stay, also the pieces that a killed run finished.

Pieces are written into ``data/<run>/.work/<format>/<identity>/``, each under a temporary name that is renamed once the
piece is whole. Then the earlier dataset is moved into ``.work``, the finished one takes its place, and its record is
written. Nothing is deleted before that, so the same command resumes after a kill at any moment.
"""

import json
import os
from collections.abc import Collection, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from pipeline.compute.pool import Workers
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
    unused_name,
    write_json,
)
from pipeline.formats.base import AnyFormat, DatasetRecord
from pipeline.formats.episodes import Episodes, Load, Piece
from pipeline.identity import require_remake_permission
from pipeline.run.dataset_basis import compute_basis, episodes_of, is_up_to_date, outdated
from pipeline.run.dataset_files import (
    PUT_AWAY,
    RECORD_FILE,
    edited_to_move,
    foreign_to_move,
    is_unchanged,
    list_records_of_moved_datasets,
    put_away_record,
    reject_edited,
    reject_foreign,
)
from pipeline.run.layout import DATASETS
from pipeline.run.run import Run

BEFORE = "before"
"""Folder of a format's work folder: the replaced dataset, until the new one has its record."""


def export_run(kind: type[AnyFormat], run: Run) -> None:
    """Bring a run's dataset of one format up to date, and print the result.

    A dataset that the configuration does not request stays unchanged.
    """
    if kind.name not in run.config.export.formats:
        print(f"{kind.title} is not requested: export.{kind.name} is null")
        return
    for dataset in (*run.datasets, *run.failure_datasets):
        if dataset.name == kind.name:
            _bring_up_to_date(dataset, episodes_of(dataset, run), run)


def _bring_up_to_date(dataset: AnyFormat, episodes: Episodes, run: Run) -> None:
    # The stage may run without the stage `inputs`, which notices changes, too.
    notice_changes(dataset)
    reject_foreign(dataset, episodes)
    reject_edited(dataset)
    if not episodes.ids and dataset.content.is_of_failures:
        _move_aside(dataset, edited_to_move(dataset, dataset.record_file))
        remove(dataset.folder)
        dataset.record_file.unlink(missing_ok=True)
        print(f"no replay missed its goal, so {dataset.folder} was not written")
        return
    if is_up_to_date(dataset, episodes):
        remove_unneeded_files(dataset)
        print(f"{dataset.folder} is up to date, with {len(episodes.ids)} episodes: see {dataset.record_file}")
        return
    require_remake_permission(outdated(dataset, episodes), dataset.folder)
    with run.workers() as workers:
        export(dataset, episodes, workers)
    print(f"wrote {len(episodes.ids)} episodes to {dataset.folder}")


def _move_aside(dataset: AnyFormat, files: Collection[Path]) -> None:
    """Move foreign and edited files out of a dataset's folder, into ``<folder>.edited_<number>``.

    The permission to replace them may have been given for other work, so they are not deleted.
    """
    if not files:
        return
    aside = unused_name(dataset.folder, "edited")
    for file in files:
        place = aside / file.relative_to(dataset.folder)
        place.parent.mkdir(parents=True, exist_ok=True)
        os.replace(file, place)
    print(f"{len(files)} edited or foreign files of {dataset.folder} are now in {aside}")


def remove_unneeded_files(dataset: AnyFormat) -> None:
    """Delete statistics that a client stored in the sets of a finished dataset, and the work folder of killed calls."""
    keep_below(dataset.folder, {dataset.folder / name for name in dataset.record().files})
    _clear_work(dataset)


def list_records(run: Run) -> None:
    """Write ``DATASETS``: each record of the requested datasets to its SHA-256, so that DVC depends on one file."""
    records = [dataset.record_file for dataset in run.recorded_datasets if dataset.record_file.exists()]
    write_json(run.path(DATASETS), {record.relative_to(run.folder).as_posix(): checksum(record) for record in records})


def unlist_lost_records(run: Run) -> None:
    """Delete ``DATASETS`` if it lists a record that is missing, so that DVC starts the exports."""
    listing = run.path(DATASETS)
    if listing.exists() and not all(run.path(record).exists() for record in read_json(listing)):
        listing.unlink()


def notice_changes(dataset: AnyFormat) -> None:
    """Put the record of a finished dataset with missing or edited files away, so that it counts as missing.

    The record returns if all files have their content again.

    Raises:
        PipelineError: when the record is unreadable, because edited files would not be found without it.
    """
    _finish_replacement(dataset)
    put_away = put_away_record(dataset)
    if not dataset.record_file.exists() and put_away.is_file():
        os.replace(put_away, dataset.record_file)
    if not dataset.record_file.exists() or is_unchanged(dataset):
        return
    try:
        record = dataset.record()
    except PipelineError as error:
        raise PipelineError(
            f"the record of the dataset cannot be read, so that edited files would not be found ({error.what})",
            where=dataset.record_file,
            expected="the record that the export wrote",
            remedy=f"restore it from a copy, or move it and {dataset.folder} to another place",
        ) from error
    try:
        same = all(checksum(dataset.folder / name) == sha256 for name, sha256 in record.files.items())
    except OSError:
        same = False
    if same:  # A copy has other times.
        dataset.record_file.touch()
        return
    put_away.parent.mkdir(parents=True, exist_ok=True)
    os.replace(dataset.record_file, put_away)


def export(dataset: AnyFormat, episodes: Episodes, workers: Workers) -> None:
    """Write a dataset, replacing the earlier one; resume the work of a killed call with the same episodes.

    The bytes depend only on the episodes, their order, the options and the format's packages. They do not depend on
    ``workers`` or on interruptions.

    Args:
        workers: get one call for each piece.

    Raises:
        PipelineError: when an episode breaks the schema or the ids are unfit, or when the folder of the earlier
            dataset has foreign or edited files. The earlier dataset and the finished pieces stay.
    """
    pieces, basis = dataset.pieces(episodes), compute_basis(dataset, episodes)
    work = dataset.work / basis.identity
    keep_below(dataset.work, {work, put_away_record(dataset)})
    finished = work / RECORD_FILE
    if not finished.is_file():
        _write_pieces(dataset, work, pieces, episodes.load, workers)
        # A worker has the format's packages loaded already.
        (places,) = workers(partial(_assemble, dataset, work), [pieces], f"{dataset.title} assembly")
        folder = work / "dataset"
        sync(folder)
        paths = sorted(file for file in folder.rglob("*") if file.is_file())
        checksums = workers(checksum, paths, f"{dataset.title} checksums")
        files = {path.relative_to(folder).as_posix(): sha256 for path, sha256 in zip(paths, checksums, strict=True)}
        with replaced(finished) as temporary:
            sizes = {path.relative_to(folder).as_posix(): path.stat().st_size for path in paths}
            record = DatasetRecord(basis, files, places, sizes)
            temporary.write_text(json.dumps(record.to_json(), indent=0) + "\n")
    _replace(dataset, work)


def _replace(dataset: AnyFormat, work: Path) -> None:
    """Replace the earlier dataset and its record with the finished ones.

    Nothing is deleted until the record is written, as a partly deleted folder would have sets without a record.

    Args:
        work: folder with the record, and with the folder ``dataset`` unless a killed call moved it.
    """
    if (work / "dataset").is_dir():
        # The user may have stored or edited files since the export began. An edit may keep size and time of a file.
        new = DatasetRecord.from_json(read_json(work / RECORD_FILE))
        to_move = {*foreign_to_move(dataset, new)}
        for record_file in (dataset.record_file, put_away_record(dataset)):
            to_move |= {*edited_to_move(dataset, record_file)}
        _move_aside(dataset, to_move)
        if dataset.folder.exists():
            os.replace(dataset.folder, dataset.work / BEFORE)
        dataset.record_file.unlink(missing_ok=True)  # This record is of the earlier dataset.
        put_in_place(work / "dataset", dataset.folder)
    _put_record(dataset, work)


def _put_record(dataset: AnyFormat, work: Path) -> None:
    """Put the record of the dataset in place next to it, and delete the work folder."""
    (work / RECORD_FILE).touch()  # No file of the dataset is younger than its record.
    put_in_place(work / RECORD_FILE, dataset.record_file)
    _clear_work(dataset)


def _finish_replacement(dataset: AnyFormat) -> None:
    """Put the record of a dataset in place if the export was killed between the dataset and its record.

    Another dataset may be wanted now, and only this record tells that the files are no user's.
    """
    if dataset.record_file.exists() or not dataset.folder.exists():
        return
    for record_file in list_records_of_moved_datasets(dataset.work):
        if record_file.parent.name != PUT_AWAY:
            _put_record(dataset, record_file.parent)
            return


def _write_pieces(dataset: AnyFormat, work: Path, pieces: Sequence[Piece], load: Load, workers: Workers) -> None:
    paths = {work / piece.path: piece for piece in pieces}
    whole = {path for path in paths if path.exists()}
    keep_below(work, whole)
    for folder in {path.parent for path in paths}:
        folder.mkdir(parents=True, exist_ok=True)
    todo = [(path, piece) for path, piece in paths.items() if path not in whole]
    workers(partial(_write_piece, dataset, load), todo, f"{dataset.title} pieces")


def _write_piece(dataset: AnyFormat, load: Load, todo: tuple[Path, Piece]) -> None:
    path, piece = todo
    with replaced(path) as temporary:
        dataset.write_piece(temporary, piece, load)


def _assemble(dataset: AnyFormat, work: Path, pieces: Sequence[Piece]) -> dict[str, dict[str, Any]]:
    # Delete what a lost worker left unfinished.
    keep_below(work, {work / piece.path for piece in pieces})
    return dataset.assemble(work, pieces)


def _clear_work(dataset: AnyFormat) -> None:
    remove(dataset.work)
    remove_if_empty(dataset.work.parent)
