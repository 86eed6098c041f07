"""Update of a dataset: finished pieces stay, also the pieces that a killed run finished.

Pieces are written into ``data/<run>/.work/<format>/<identity>/``, each under a temporary name that is renamed once the
piece is whole. Then the earlier dataset is moved into ``.work``, the finished one takes its place, and its record is
written. Nothing is deleted before that, so the same command resumes after a kill at any moment.
"""

import json
import os
import re
from collections import Counter
from collections.abc import Collection, Sequence
from contextlib import suppress
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

from pipeline.axes import task_of
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
    unused_name,
    write_json,
)
from pipeline.formats.base import AnyFormat, DatasetRecord
from pipeline.formats.episodes import EpisodeFacts, Episodes, Load, Piece
from pipeline.identity import ALLOW, reject_unasked, remake_allowed
from pipeline.record import Basis
from pipeline.run.layout import DATASETS, WORK
from pipeline.run.outcome import shuffled
from pipeline.run.rewrites import list_episode_rewrites
from pipeline.run.run import Run
from pipeline.seeding import digest

OFT_STATISTICS = re.compile(r"dataset_statistics_[0-9a-f]+\.json")
"""Name of the statistics that OpenVLA-OFT's loader stores next to the shards, and reuses even for a later dataset."""

RECORD_FILE = "record.json"
"""File of a work folder: the record of its whole dataset; later the record next to the dataset."""

BEFORE = "before"
"""Folder of a format's work folder: the replaced dataset, until the new one has its record."""

CHANGED = "changed"
"""Folder of a format's work folder: the record of a dataset with missing or changed files, until it is replaced.

The record shows which other files in the dataset's folder are the user's.
"""


def export_run(kind: type[AnyFormat], run: Run) -> None:
    """Bring a run's dataset of one format up to date, and print the result.

    A dataset that the configuration does not request stays unchanged.
    """
    if kind.name not in run.config.export.formats:
        print(f"{kind.title} is not requested: export.{kind.name} is null")
        return
    for target in (*run.formats, *run.failure_formats):
        if target.name == kind.name:
            _bring_up_to_date(target, episodes_of(target, run), run)


def _bring_up_to_date(target: AnyFormat, episodes: Episodes, run: Run) -> None:
    # The stage may run without the stage `inputs`, which notices changes, too.
    notice_changes(target)
    reject_foreign(target, episodes)
    reject_changed(target)
    if not episodes.ids and "outcome" in target.content.extras:
        _set_aside(target, _edits_to_replace(target, target.record_file))
        remove(target.folder)
        target.record_file.unlink(missing_ok=True)
        print(f"no replay missed its goal, so {target.folder} was not written")
        return
    if is_up_to_date(target, episodes):
        remove_leftovers(target)
        print(f"{target.folder} is up to date, with {len(episodes.ids)} episodes: see {target.record_file}")
        return
    reject_unasked(outdated(target, episodes), target.folder)
    with run.workers() as workers:
        export(target, episodes, workers)
    print(f"wrote {len(episodes.ids)} episodes to {target.folder}")


def reject_foreign(target: AnyFormat, episodes: Episodes) -> None:
    """Stop if the format's folder has entries that no export wrote, as a dataset is replaced as a whole.

    Raises:
        PipelineError: when an entry is no set of the stored dataset or of the dataset to write, or when a set has a
            file that its record does not list.
    """
    sets = target.sets(target.pieces(episodes)) if episodes.ids else set()
    recorded = _recorded(target)
    sets |= {name.partition("/")[0] for name in recorded}
    foreign = sorted(entry for entry in target.folder.glob("*") if entry.name not in sets)
    if recorded and not foreign:
        foreign = _unrecorded(target.folder, recorded)
    if foreign:
        raise _foreign_entries_error(target, foreign, sets)


def _recorded(target: AnyFormat) -> set[str]:
    """Return the paths of the files that exports have put into a dataset's folder: empty without any record."""
    recorded: set[str] = set()
    for file in _records_in(target.work):
        recorded |= DatasetRecord.from_json(read_json(file)).files.keys()
    with suppress(PipelineError):  # The dataset has no record, or has changed since.
        recorded |= target.record().files.keys()
    return recorded


def _records_in(work: Path) -> list[Path]:
    """List the records in a format's work folder of datasets that are in place: killed calls, and changed datasets.

    A dataset that is still in the work folder is left out: its record lists none of the files that it would replace.
    """
    return [file for file in work.glob(f"*/{RECORD_FILE}") if not (file.parent / "dataset").is_dir()]


def _foreign_entries_error(target: AnyFormat, foreign: Sequence[Path], sets: Collection[str]) -> PipelineError:
    """Return the error about entries of a dataset's folder that no export wrote."""
    return PipelineError(
        f"the entry is not of this run's {target.title} and would be deleted ({len(foreign)} such entries)",
        where=foreign[0],
        expected=f"only {', '.join(sorted(sets))}",
        remedy=f"move it out of {target.folder}; to train on both, create a folder of links to both",
    )


def reject_changed(target: AnyFormat) -> None:
    """Stop before a changed file of a finished dataset is replaced; a missing file is generated again.

    Raises:
        PipelineError: naming the file, unless ``REMAKE=1`` allows it.
    """
    _edits_to_replace(target, target.work / CHANGED / RECORD_FILE)


def _edits_to_replace(target: AnyFormat, record_file: Path) -> list[Path]:
    """Return the files of a dataset whose content differs from a record: none if the record does not exist.

    Raises:
        PipelineError: naming such a file, unless ``REMAKE=1`` allows the replacement.
    """
    if not record_file.is_file():
        return []
    recorded = DatasetRecord.from_json(read_json(record_file)).files
    changed: list[Path] = []
    for name, sha256 in recorded.items():
        file = target.folder / name
        if file.is_file() and checksum(file) != sha256:
            changed.append(file)
    if changed and not remake_allowed():
        raise PipelineError(
            f"the file was edited or damaged, and would be replaced ({len(changed)} such files)",
            where=changed[0],
            expected=f"the content that {record_file} lists",
            remedy=f"move it to another place, and it is generated again; or let the export move it: {ALLOW}",
        )
    return changed


def _unknown_to_replace(target: AnyFormat, work: Path) -> list[Path]:
    """Return the files that no earlier export recorded, and that the new dataset has with other content.

    Such a file is the user's, or of a dataset whose record was deleted.

    Args:
        work: folder with the record of the finished dataset.

    Raises:
        PipelineError: naming such a file, unless ``REMAKE=1`` allows the replacement; or naming an unrecorded file that
            the new dataset does not have.
    """
    recorded = _recorded(target)
    new = DatasetRecord.from_json(read_json(work / RECORD_FILE)).files
    foreign: list[Path] = []
    replaced_files: list[Path] = []
    for file in _unrecorded(target.folder, recorded):
        sha256 = new.get(file.relative_to(target.folder).as_posix())
        if sha256 is None:
            foreign.append(file)
        elif not file.is_file() or checksum(file) != sha256:
            replaced_files.append(file)
    if foreign:
        raise _foreign_entries_error(target, foreign, {name.partition("/")[0] for name in (*recorded, *new)})
    if replaced_files and not remake_allowed():
        raise PipelineError(
            f"no record of an export lists the file, and it would be replaced ({len(replaced_files)} such files)",
            where=replaced_files[0],
            expected=f"only files that {target.record_file} lists",
            remedy=f"move it to another place, and run the command again; or let the export move it: {ALLOW}",
        )
    return replaced_files


def _set_aside(target: AnyFormat, files: Collection[Path]) -> None:
    """Move a user's files out of a dataset's folder, into ``<folder>.edited_<number>``.

    The permission to replace them may have been given for other work, so they are not deleted.
    """
    if not files:
        return
    aside = unused_name(target.folder, "edited")
    for file in files:
        place = aside / file.relative_to(target.folder)
        place.parent.mkdir(parents=True, exist_ok=True)
        os.replace(file, place)
    print(f"{len(files)} files of {target.folder} that no export wrote are now in {aside}")


def reject_unrecorded(folder: Path) -> None:
    """Stop before the folder of a format's datasets is deleted if it has files that no record of an export lists.

    The format need not be requested.

    Raises:
        PipelineError: naming such a file, or the record if it is damaged.
    """
    record_file = folder.with_name(f"{folder.name}.json")
    further_records = _records_in(folder.parent / WORK / folder.name)
    recorded: set[str] = set()
    for file in (record_file, *further_records):
        if file.is_file():
            content = read_json(file, "restore the file, or move the folder of the dataset elsewhere")
            recorded |= content.get("files", {}).keys()
    foreign = _unrecorded(folder, recorded)
    if foreign:
        raise PipelineError(
            f"no record of an export lists the file, and it would be deleted ({len(foreign)} such files)",
            where=foreign[0],
            expected=f"only the files that {record_file} lists",
            remedy=f"move it out of {folder}",
        )


def unrecorded_files(target: AnyFormat) -> list[Path]:
    """List the files of a finished dataset's folder that its record does not list.

    Raises:
        PipelineError: when there is no record, or it cannot be read.
    """
    return _unrecorded(target.folder, target.record().files.keys())


def _unrecorded(folder: Path, recorded: Collection[str]) -> list[Path]:
    """List the files of a dataset's folder whose paths in it are not in ``recorded``."""
    return [path for path in _files(folder) if path.relative_to(folder).as_posix() not in recorded]


def _files(folder: Path) -> list[Path]:
    """List files and links below a dataset's folder, without the statistics that OpenVLA-OFT stores when it trains."""
    paths = (path for path in folder.rglob("*") if path.is_symlink() or not path.is_dir())
    return sorted(path for path in paths if not OFT_STATISTICS.fullmatch(path.name))


def episodes_of(target: AnyFormat, run: Run) -> Episodes:
    """Return the episodes of a dataset in the order they are written: the kept episodes of a run, or its failures.

    Each episode has all rewrites that the run's language axis may sample for it. Without this axis, its default ranges
    decide.
    """
    failures = "outcome" in target.content.extras
    rewrites: dict[str, tuple[str, ...]] = {}
    outcome, language = run.outcome, run.config.plan.axes.language
    facts: dict[str, EpisodeFacts] = {}
    for episode_id in shuffled(outcome.failures) if failures else outcome.kept:
        row = outcome.row_of[episode_id]
        rewrites[episode_id] = list_episode_rewrites(language, row.suite, row.task, row.perturbations)
        task = task_of(row.suite, row.task, row.perturbations)
        facts[episode_id] = EpisodeFacts(
            row.suite,
            content=digest(outcome.content(episode_id), rewrites[episode_id])[:16],
            demo=row.demo_id,
            instruction=row.instruction,
            steps=outcome.trajectories[row.trajectory_id]["steps"],
            origin=row.demo_origin_sha256,
            scene=task.bddl_file.stem if task.goal_file else "",
        )
    load = run.episodes(failures=failures, rewrites=rewrites, replays=target.stores_replay)
    return Episodes(facts, load)


def compute_basis(target: AnyFormat, episodes: Episodes) -> Basis:
    """Return everything that the bytes of a dataset depend on. Its request consists of episodes and options."""
    contents = [episode.content for episode in episodes.facts.values()]
    identity = digest(
        "export",
        target.name,
        target.recipe,
        {package: version(package) for package in target.packages},
        SCHEMA.model_dump(mode="json"),
        _options(target),
        *target.content.stated(),
        [[piece.path, piece.ids] for piece in target.pieces(episodes)],
        contents,
    )
    requested = digest(_options(target), *target.content.stated(), contents)[:16]
    schema = digest(SCHEMA.model_dump(mode="json"))[:8]
    return Basis(identity[:16], requested, {**target.made_with(), "episode schema": schema})


def _options(target: AnyFormat) -> dict[str, Any]:
    """Return a format's options under the field names of the first version that wrote them."""
    dumped: dict[str, Any] = target.options.model_dump(mode="json", by_alias=True)
    return dumped


def outdated(target: AnyFormat, episodes: Episodes) -> Counter[str]:
    """Count, by reason, the files of a finished dataset that would be generated again although the request is equal."""
    try:
        record = target.record()
    except PipelineError:
        return Counter()
    basis = compute_basis(target, episodes)
    if record.matches(basis) or not record.same_request(basis):
        return Counter()
    return Counter({f"files, generated with {record.why_not(basis)}": len(record.files)})


def is_up_to_date(target: AnyFormat, episodes: Episodes) -> bool:
    """Return whether the dataset exists, is complete and has these episodes.

    Every file must exist and be no younger than the record.
    """
    return untouched(target) and target.record().matches(compute_basis(target, episodes))


def remove_leftovers(target: AnyFormat) -> None:
    """Delete statistics that a client stored in the sets of a finished dataset, and the work folder of killed calls."""
    keep_below(target.folder, {target.folder / name for name in target.record().files})
    _clear_work(target)


def untouched(target: AnyFormat) -> bool:
    """Return whether all files of a finished dataset exist, and none has changed since it was recorded."""
    return changed_file(target) is None


def changed_file(target: AnyFormat) -> Path | None:
    """Return a file of a finished dataset that is missing or has changed since it was recorded.

    Returns:
        The first such file; the record if it is missing or unreadable; `None` if all files are unchanged.
    """
    try:
        recorded = target.record_file.stat().st_mtime_ns
        record = target.record()
    except (PipelineError, OSError):
        return target.record_file
    for name in record.files:
        file = target.folder / name
        try:
            found = file.stat()
        except OSError:
            return file
        # A file that was copied over another one may have an earlier time.
        if found.st_mtime_ns > recorded or found.st_size != record.sizes.get(name, found.st_size):
            return file
    return None


def list_records(run: Run) -> None:
    """Write ``DATASETS``: each record of the requested datasets to its SHA-256, so that DVC depends on one file."""
    records = [dataset.record_file for dataset in run.recorded_formats if dataset.record_file.exists()]
    write_json(run.path(DATASETS), {record.relative_to(run.folder).as_posix(): checksum(record) for record in records})


def unlist_lost_records(run: Run) -> None:
    """Delete ``DATASETS`` if it lists a record that is missing, so that DVC starts the exports."""
    listing = run.path(DATASETS)
    if listing.exists() and not all(run.path(record).exists() for record in read_json(listing)):
        listing.unlink()


def notice_changes(target: AnyFormat) -> None:
    """Put the record of a finished dataset whose files are missing or changed away, so that it counts as missing.

    The record returns if all files have their content again.

    Raises:
        PipelineError: when the record is unreadable, because edited files would not be found without it.
    """
    _finish_replacement(target)
    put_away = target.work / CHANGED / RECORD_FILE
    if not target.record_file.exists() and put_away.is_file():
        os.replace(put_away, target.record_file)
    if not target.record_file.exists() or untouched(target):
        return
    try:
        record = target.record()
    except PipelineError as error:
        raise PipelineError(
            f"the record of the dataset cannot be read, so that edited files would not be found ({error.what})",
            where=target.record_file,
            expected="the record that the export wrote",
            remedy=f"restore it from a copy, or move it and {target.folder} to another place",
        ) from error
    try:
        same = all(checksum(target.folder / name) == sha256 for name, sha256 in record.files.items())
    except OSError:
        same = False
    if same:  # A copy has other times.
        target.record_file.touch()
        return
    put_away.parent.mkdir(parents=True, exist_ok=True)
    os.replace(target.record_file, put_away)


def put_away_records(work: Path) -> set[Path]:
    """List the records of edited or incomplete datasets, which ``notice_changes`` put into a work folder.

    Args:
        work: folder with the work folders of all formats.
    """
    records: set[Path] = set()
    for record in work.glob(f"*/{CHANGED}/{RECORD_FILE}"):
        name_of_format = record.relative_to(work).parts[0]
        if (work.parent / name_of_format).is_dir():
            records.add(record)
    return records


def export(target: AnyFormat, episodes: Episodes, workers: Workers) -> None:
    """Write a dataset, replacing the earlier one; resume the work of a killed call with the same episodes.

    The bytes depend only on the episodes, their order, the options and the format's packages. They do not depend on
    ``workers`` or on interruptions.

    Args:
        workers: get one call for each piece.

    Raises:
        PipelineError: when an episode breaks the schema or the ids are unfit, or when the earlier dataset has files
            that the user stored or edited. The earlier dataset stays, and finished pieces stay in the work folder.
    """
    pieces, basis = target.pieces(episodes), compute_basis(target, episodes)
    work = target.work / basis.identity
    keep_below(target.work, {work, target.work / CHANGED / RECORD_FILE})
    finished = work / RECORD_FILE
    if not finished.is_file():
        _write_pieces(target, work, pieces, episodes.load, workers)
        # A worker has the format's packages loaded already.
        (places,) = workers(partial(_assemble, target, work), [pieces], f"{target.title} assembly")
        dataset = work / "dataset"
        sync(dataset)
        paths = sorted(file for file in dataset.rglob("*") if file.is_file())
        checksums = workers(checksum, paths, f"{target.title} checksums")
        files = {path.relative_to(dataset).as_posix(): sha256 for path, sha256 in zip(paths, checksums, strict=True)}
        with replaced(finished) as temporary:
            sizes = {path.relative_to(dataset).as_posix(): path.stat().st_size for path in paths}
            record = DatasetRecord(basis, files, places, sizes)
            temporary.write_text(json.dumps(record.to_json(), indent=0) + "\n")
    _replace(target, work)


def _replace(target: AnyFormat, work: Path) -> None:
    """Replace the earlier dataset and its record with the finished ones.

    Nothing is deleted until the record is written, as a partly deleted folder would have sets without a record.

    Args:
        work: folder with the record, and with the folder ``dataset`` unless a killed call moved it.
    """
    if (work / "dataset").is_dir():
        # The user may have stored or edited files since the export began. An edit may keep size and time of a file.
        to_keep = {*_unknown_to_replace(target, work)}
        for record_file in (target.record_file, target.work / CHANGED / RECORD_FILE):
            to_keep |= {*_edits_to_replace(target, record_file)}
        _set_aside(target, to_keep)
        if target.folder.exists():
            os.replace(target.folder, target.work / BEFORE)
        target.record_file.unlink(missing_ok=True)  # This record is of the earlier dataset.
        put_in_place(work / "dataset", target.folder)
    _put_record(target, work)


def _put_record(target: AnyFormat, work: Path) -> None:
    """Put the record of the dataset in place next to it, and delete the work folder."""
    (work / RECORD_FILE).touch()  # No file of the dataset is younger than its record.
    put_in_place(work / RECORD_FILE, target.record_file)
    _clear_work(target)


def _finish_replacement(target: AnyFormat) -> None:
    """Put the record of a dataset in place if the export was killed between the dataset and its record.

    Another dataset may be wanted now, and only this record tells that the files are no user's.
    """
    if target.record_file.exists() or not target.folder.exists():
        return
    for record_file in _records_in(target.work):
        if record_file.parent.name != CHANGED:
            _put_record(target, record_file.parent)
            return


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


def _assemble(target: AnyFormat, work: Path, pieces: Sequence[Piece]) -> dict[str, dict[str, Any]]:
    # Delete what a lost worker left unfinished.
    keep_below(work, {work / piece.path for piece in pieces})
    return target.assemble(work, pieces)


def _clear_work(target: AnyFormat) -> None:
    remove(target.work)
    remove_if_empty(target.work.parent)
