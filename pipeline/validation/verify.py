"""Comparison of all stored files of a run with the checksums that were recorded when they were written."""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from itertools import chain
from typing import Any

from pipeline import generated
from pipeline.compute.pool import Workers
from pipeline.errors import MAKE_AGAIN, RUN_AGAIN, PipelineError
from pipeline.files import checksum, read_json
from pipeline.formats.base import AnyFormat
from pipeline.formats.read_back import Written
from pipeline.planning import plan
from pipeline.run import manifest
from pipeline.run.dataset_files import foreign_files
from pipeline.run.layout import COUNTS, DATASETS, LEAKAGE, STATISTICS
from pipeline.run.run import Run
from pipeline.stores.store import TABLE, Store
from pipeline.tables import read_table


def verify(run: Run, workers: Workers) -> dict[str, dict[str, Any]]:
    """Read every stored file of a finished run: trajectories, frames, datasets, tables and generated folders.

    Files that no record lists count as damage, too: a client may read them.

    Returns:
        JSON-serialisable: the part of the run to the number of ``checked`` files, and to the ``damaged`` or missing
        files, each with a remedy.
    """
    results: dict[str, dict[str, Any]] = {}
    stores: dict[str, Store] = {"trajectories": run.trajectories, "frames": run.frames}
    for name, store in stores.items():
        there = store.names()
        damages = [*workers(partial(_damaged, store), there, name), *_gone(store, there)]
        results[name] = _result(damages)
    records: Mapping[str, str] = {}
    if run.path(DATASETS).exists():
        with suppress(PipelineError):  # Reading the tables reports the fault.
            records = read_json(run.path(DATASETS))
    for dataset in (*run.datasets, *_failure_datasets(run, records)):
        name = dataset.folder.relative_to(run.folder).as_posix()
        results[name] = _verify_dataset(dataset, records.get(_record_of(dataset, run)), workers)
    results["tables"] = _result(_unreadable(read) for read in _readers(run))
    if not any(result["damaged"] for result in results.values()):
        # A file and the table that lists it may both be gone; the plan still needs the file.
        results["episodes"] = _result([_unreadable(lambda: run.outcome)])
    results["validation"] = _result([_unreadable(partial(read_json, run.validation_file))])
    for name in generated.FOLDERS:
        folder = run.path(name)
        checked = sum(path.is_file() for path in folder.rglob("*"))
        if checked:
            damaged = _unreadable(partial(generated.unchanged, folder))
        else:
            damaged = [f"{folder}: the folder is missing or empty; `{MAKE_AGAIN}` generates it again"]
        results[name] = {"checked": checked, "damaged": damaged}
    return results


def _record_of(dataset: AnyFormat, run: Run) -> str:
    """Return the path of a dataset's record below the folder of the run."""
    return dataset.record_file.relative_to(run.folder).as_posix()


def _failure_datasets(run: Run, records: Collection[str]) -> list[AnyFormat]:
    """List the datasets of failures that were written, or of which something is left. A run without failures has none.

    Args:
        records: paths of the records that the exports listed.
    """
    written = []
    for dataset in run.failure_datasets:
        if dataset.folder.exists() or dataset.record_file.exists() or _record_of(dataset, run) in records:
            written.append(dataset)
    return written


def _verify_dataset(dataset: AnyFormat, record_sha256: str | None, workers: Workers) -> dict[str, Any]:
    """Compare the files of a dataset with its record.

    Args:
        record_sha256: SHA-256 of the record when the export ended; `None` if it is not known.
    """
    try:
        files = dataset.written()
        foreign = foreign_files(dataset)
    except PipelineError as error:
        return {"checked": 0, "damaged": [str(error)]}
    damages = []
    for faults in workers(Written.faults, files, dataset.title):
        damages.append([f"{fault.what}: {fault.expected}" for fault in faults])
    damages.append([f"{file}: no record of an export lists it; move it to another place" for file in foreign])
    if record_sha256 is not None and checksum(dataset.record_file) != record_sha256:
        remedy = f"restore it, or move it and {dataset.folder} to another place"
        damages.append([f"{dataset.record_file}: not the record that the export wrote; {remedy}"])
    return _result(damages)


def _gone(store: Store, there: Sequence[str]) -> list[list[str]]:
    """Find the missing files that a store's table lists; without a table, the list is empty."""
    file = store.root / TABLE
    if not file.exists():
        return []
    try:
        listed = {str(row["file"]) for row in read_table(file, ["file"], RUN_AGAIN).to_pylist()}
    except PipelineError as error:
        return [[str(error)]]
    what = f"{file} lists it, but it is missing; `{MAKE_AGAIN}` generates it again"
    return [[f"{store.path(name)}: {what}"] for name in sorted(listed - {*there})]


def _readers(run: Run) -> list[Callable[[], object]]:
    """Return functions that read the tables of a run, which have no checksums."""
    readers: list[Callable[[], object]] = [
        partial(plan.read, run.plan_file),
        partial(manifest.read, run.manifest_file),
    ]
    names = [COUNTS, LEAKAGE, *([STATISTICS] if "rlds" in run.config.export.formats else [])]
    if run.path(DATASETS).exists():
        names.append(DATASETS)
    return [*readers, *(partial(read_json, run.path(name)) for name in names)]


def _unreadable(read: Callable[[], object]) -> list[str]:
    try:
        read()
    except (PipelineError, OSError) as error:
        return [str(error)]
    return []


def _damaged(store: Store, file: str) -> list[str]:
    try:
        with store.opened(file) as opened:
            for array in opened.checksums:
                opened.array(array)
    except (PipelineError, OSError) as error:
        return [str(error)]
    return []


def _result(findings: Iterable[Sequence[str]]) -> dict[str, Any]:
    """Summarize the findings of each checked file."""
    of_files = list(findings)
    return {"checked": len(of_files), "damaged": list(chain.from_iterable(of_files))}
