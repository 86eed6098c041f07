"""Files in the folder of a format's datasets, compared with the records of exports.

A *foreign* file is listed by no record. An *edited* file is listed, and has other content. A *missing* file is listed,
and does not exist. Foreign and edited files are the user's: they are never deleted, and only moved with permission.
"""

import re
from collections.abc import Collection, Sequence
from contextlib import suppress
from pathlib import Path

from pipeline.errors import PipelineError
from pipeline.files import checksum, read_json
from pipeline.formats.base import AnyFormat, DatasetRecord
from pipeline.formats.episodes import Episodes
from pipeline.identity import ALLOW, remake_allowed
from pipeline.run.layout import WORK

OFT_STATISTICS = re.compile(r"dataset_statistics_[0-9a-f]+\.json")
"""Name of the statistics that OpenVLA-OFT's loader stores next to the shards, and reuses even for a later dataset."""

RECORD_FILE = "record.json"
"""File of a work folder: the record of its whole dataset; later the record next to the dataset."""

PUT_AWAY = "changed"
"""Folder of a format's work folder: the record of a dataset with missing or edited files, until it is replaced.

The record shows which files in the dataset's folder are foreign.
"""


def put_away_record(dataset: AnyFormat) -> Path:
    """Return the file of the record of a dataset with missing or edited files; it need not exist."""
    return dataset.work / PUT_AWAY / RECORD_FILE


def list_put_away_records(work: Path) -> set[Path]:
    """List the records of datasets with missing or edited files, which ``notice_changes`` put into a work folder.

    Args:
        work: folder with the work folders of all formats.
    """
    records: set[Path] = set()
    for record in work.glob(f"*/{PUT_AWAY}/{RECORD_FILE}"):
        name_of_format = record.relative_to(work).parts[0]
        if (work.parent / name_of_format).is_dir():
            records.add(record)
    return records


def list_records_of_moved_datasets(work: Path) -> list[Path]:
    """List the records in a format's work folder whose datasets are in place: of killed exports, and put-away records.

    A dataset that is still in the work folder is left out: its record lists none of the files that it would replace.
    """
    return [file for file in work.glob(f"*/{RECORD_FILE}") if not (file.parent / "dataset").is_dir()]


def is_unchanged(dataset: AnyFormat) -> bool:
    """Return whether a finished dataset has no missing file, and none that was edited, by its size and time."""
    return changed_file(dataset) is None


def changed_file(dataset: AnyFormat) -> Path | None:
    """Return a file of a finished dataset that is missing, or was edited since it was recorded, by its size and time.

    Returns:
        The first such file; the record if it is missing or unreadable; `None` if all files are unchanged.
    """
    try:
        recorded = dataset.record_file.stat().st_mtime_ns
        record = dataset.record()
    except (PipelineError, OSError):
        return dataset.record_file
    for name in record.files:
        file = dataset.folder / name
        try:
            found = file.stat()
        except OSError:
            return file
        # A file that was copied over another one may have an earlier time.
        if found.st_mtime_ns > recorded or found.st_size != record.sizes.get(name, found.st_size):
            return file
    return None


def first_changed_file(datasets: Sequence[AnyFormat]) -> Path | None:
    """Return the ``changed_file`` of the first dataset that has one; `None` if all datasets are unchanged."""
    for dataset in datasets:
        file = changed_file(dataset)
        if file is not None:
            return file
    return None


def foreign_files(dataset: AnyFormat) -> list[Path]:
    """List the foreign files in the folder of a finished dataset.

    Raises:
        PipelineError: when there is no record, or it cannot be read.
    """
    return _list_foreign(dataset.folder, dataset.record().files.keys())


def reject_foreign(dataset: AnyFormat, episodes: Episodes) -> None:
    """Stop if the format's folder has foreign entries, as a dataset is replaced as a whole.

    Raises:
        PipelineError: when an entry is no set of the stored dataset or of the dataset to write, or when a set has a
            foreign file.
    """
    sets = dataset.sets(dataset.pieces(episodes)) if episodes.ids else set()
    recorded = _recorded_paths(dataset)
    sets |= {name.partition("/")[0] for name in recorded}
    foreign = sorted(entry for entry in dataset.folder.glob("*") if entry.name not in sets)
    if recorded and not foreign:
        foreign = _list_foreign(dataset.folder, recorded)
    if foreign:
        raise _foreign_error(dataset, foreign, sets)


def reject_deleting_foreign(folder: Path) -> None:
    """Stop before the folder of a format's datasets is deleted if it has foreign files.

    The format need not be requested.

    Raises:
        PipelineError: naming such a file, or the record if it is damaged.
    """
    record_file = folder.with_name(f"{folder.name}.json")
    further_records = list_records_of_moved_datasets(folder.parent / WORK / folder.name)
    recorded: set[str] = set()
    for file in (record_file, *further_records):
        if file.is_file():
            content = read_json(file, "restore the file, or move the folder of the dataset elsewhere")
            recorded |= content.get("files", {}).keys()
    foreign = _list_foreign(folder, recorded)
    if foreign:
        raise PipelineError(
            f"no record of an export lists the file, and it would be deleted ({len(foreign)} such files)",
            where=foreign[0],
            expected=f"only the files that {record_file} lists",
            remedy=f"move it out of {folder}",
        )


def foreign_to_move(dataset: AnyFormat, new: DatasetRecord) -> list[Path]:
    """List the foreign files that a new dataset replaces by files of the same names, with other content.

    Such a file is the user's, or of a dataset whose record was deleted.

    Args:
        new: record of the new dataset.

    Raises:
        PipelineError: naming such a file, unless ``REMAKE=1`` allows the replacement; or naming a foreign file whose
            name the new dataset does not have.
    """
    recorded = _recorded_paths(dataset)
    in_the_way: list[Path] = []
    to_move: list[Path] = []
    for file in _list_foreign(dataset.folder, recorded):
        sha256 = new.files.get(file.relative_to(dataset.folder).as_posix())
        if sha256 is None:
            in_the_way.append(file)
        elif not file.is_file() or checksum(file) != sha256:
            to_move.append(file)
    if in_the_way:
        raise _foreign_error(dataset, in_the_way, {name.partition("/")[0] for name in (*recorded, *new.files)})
    if to_move and not remake_allowed():
        raise PipelineError(
            f"no record of an export lists the file, and it would be replaced ({len(to_move)} such files)",
            where=to_move[0],
            expected=f"only files that {dataset.record_file} lists",
            remedy=f"move it to another place, and run the command again; or let the export move it: {ALLOW}",
        )
    return to_move


def reject_edited(dataset: AnyFormat) -> None:
    """Stop before an edited file of a dataset whose record was put away is replaced; a missing file is written again.

    Raises:
        PipelineError: naming the file, unless ``REMAKE=1`` allows the replacement.
    """
    edited_to_move(dataset, put_away_record(dataset))


def edited_to_move(dataset: AnyFormat, record_file: Path) -> list[Path]:
    """List the edited files of a dataset that is about to be replaced, by their checksums.

    Args:
        record_file: record of the dataset; if it does not exist, no file counts as edited.

    Raises:
        PipelineError: naming such a file, unless ``REMAKE=1`` allows the replacement.
    """
    if not record_file.is_file():
        return []
    recorded = DatasetRecord.from_json(read_json(record_file)).files
    edited: list[Path] = []
    for name, sha256 in recorded.items():
        file = dataset.folder / name
        if file.is_file() and checksum(file) != sha256:
            edited.append(file)
    if edited and not remake_allowed():
        raise PipelineError(
            f"the file was edited or damaged, and would be replaced ({len(edited)} such files)",
            where=edited[0],
            expected=f"the content that {record_file} lists",
            remedy=f"move it to another place, and it is generated again; or let the export move it: {ALLOW}",
        )
    return edited


def _recorded_paths(dataset: AnyFormat) -> set[str]:
    """Return the paths of the files that exports have put into a dataset's folder: empty without any record."""
    recorded: set[str] = set()
    for file in list_records_of_moved_datasets(dataset.work):
        recorded |= DatasetRecord.from_json(read_json(file)).files.keys()
    with suppress(PipelineError):  # The dataset has no record, or has changed since.
        recorded |= dataset.record().files.keys()
    return recorded


def _list_foreign(folder: Path, recorded: Collection[str]) -> list[Path]:
    """List the files and links below a dataset's folder whose paths in it are not recorded.

    The statistics that OpenVLA-OFT stores when it trains are left out.
    """
    foreign: list[Path] = []
    for path in sorted(folder.rglob("*")):
        is_file = path.is_symlink() or not path.is_dir()
        is_recorded = path.relative_to(folder).as_posix() in recorded
        if is_file and not is_recorded and not OFT_STATISTICS.fullmatch(path.name):
            foreign.append(path)
    return foreign


def _foreign_error(dataset: AnyFormat, foreign: Sequence[Path], sets: Collection[str]) -> PipelineError:
    """Return the error about foreign entries of a dataset's folder."""
    return PipelineError(
        f"the entry is not of this run's {dataset.title} and would be deleted ({len(foreign)} such entries)",
        where=foreign[0],
        expected=f"only {', '.join(sorted(sets))}",
        remedy=f"move it out of {dataset.folder}; to train on both, create a folder of links to both",
    )
