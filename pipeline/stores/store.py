"""Folder of files that one stage writes, and a table of their contents.

A file is complete or absent, and is named after its inputs. A changed plan therefore never uses a file of another
perturbation, and still finds every file that it shares with the earlier plan. A file is missing if it does not exist or
has the fingerprint of other recipes, packages or settings. A file that cannot be read is an error, so no work is
silently repeated.

The table has a row for each file, so stages need not open every file to learn a verdict or a length. A row is valid
while its file has the recorded size and is older than the table. Any other file is opened and read. The metadata of the
table describes the fingerprints in words: recipes, packages and settings.
"""

import json
import re
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from pipeline.errors import RUN_AGAIN, PipelineError
from pipeline.files import keep_below, replaced
from pipeline.identity import Step, fingerprint, made_with
from pipeline.record import Basis, Record
from pipeline.seeding import digest
from pipeline.stores.sealed_file import BrokenSealError, SealedFile, seal, unsealed
from pipeline.tables import read_table, write_table

TABLE = "index.parquet"

ID = "[0-9a-f]{16}"
"""Pattern of the ids in the names of files."""

_NAME = re.compile(rf"{ID}(/{ID})?")

SUFFIX = ".npz"

EARLIER_SUFFIX = ".h5"
"""Suffix of the HDF5 files of version 0.3 and earlier, which this version does not read."""

_MADE_WITH = b"made_with"
"""Key of the table's metadata: JSON of each fingerprint to the recipes, packages and settings of its files."""


class _TableState(NamedTuple):
    """Table of a store, compared with the files.

    Attributes:
        valid: name to row, of any fingerprint, for each file that has not changed since the table was written.
        stale: names of all other files: new, changed and deleted ones.
    """

    valid: dict[str, dict[str, Any]]
    stale: set[str]


class Store(ABC):
    """Files of one stage.

    Args:
        root: folder of the files.
        settings: JSON-serialisable settings of the user that the bytes depend on. Files with other settings count as
            missing.
        form: other parts of this project that the bytes depend on, by their names for people.
    """

    step: ClassVar[Step]
    """Step of ``pipeline/identity.py`` that generates the files."""
    columns: ClassVar[Mapping[str, pa.DataType]]
    """Columns of the table in addition to ``file``, ``made_by`` and ``bytes``."""
    pattern: ClassVar[str] = f"*{SUFFIX}"
    """Glob pattern of the files below ``root``."""

    def __init__(self, root: Path, settings: object = None, form: Mapping[str, object] = MappingProxyType({})):
        self.root = root
        parts = [settings, *form.values()] if settings is not None else []
        form_digests = {name: digest(value)[:8] for name, value in form.items()}
        self.basis = Basis(fingerprint(self.step, *parts), settings, {**made_with(self.step), **form_digests})
        common = {"file": pa.string(), "made_by": pa.string(), "bytes": pa.int64()}
        self._schema = pa.schema(list((common | dict(self.columns)).items()))

    @property
    def fingerprint(self) -> str:
        """Return the fingerprint of the files that this store writes: their attribute and column ``made_by``."""
        return self.basis.identity

    @staticmethod
    @abstractmethod
    def describe(file: SealedFile) -> dict[str, Any]:
        """Return a file's values of ``columns``."""

    def path(self, name: str) -> Path:
        """Return the path of a file; its name may contain folders, and has no suffix.

        Raises:
            PipelineError: if the name leaves the folder. A manifest of other origin may have such a name.
        """
        if name.startswith("/") or ".." in name.split("/"):
            raise PipelineError(
                f"the file {name!r} would be outside this folder",
                where=self.root,
                expected="an id of a trajectory or of frames",
                remedy="use a manifest that a run wrote",
            )
        return self.root / f"{name}{SUFFIX}"

    def names(self) -> list[str]:
        """List all files, up to date or not."""
        return self._names(self.pattern)

    def names_of_all_versions(self) -> list[str]:
        """List all files, also files that this version does not read."""
        return sorted({*self.names(), *self._names(self.pattern.replace(SUFFIX, EARLIER_SUFFIX))})

    def _names(self, pattern: str) -> list[str]:
        """List the names of the files that match a glob pattern; files whose names are no ids are the user's."""
        names = (path.relative_to(self.root).with_suffix("").as_posix() for path in self.root.glob(pattern))
        return sorted(name for name in names if _NAME.fullmatch(name))

    def write(self, name: str, arrays: Mapping[str, NDArray[Any]], attributes: Mapping[str, Any]) -> None:
        """Write a file of arrays, with ``attributes`` as JSON; it is complete or absent."""
        with replaced(self.path(name)) as temporary:
            seal(temporary, arrays, {**attributes, "made_by": self.fingerprint})

    @contextmanager
    def opened(self, name: str) -> Iterator[SealedFile]:
        """Open a file for reading.

        Raises:
            PipelineError: when the file is missing, damaged, or not up to date.
            OSError: when the system does not open or read it.
        """
        with self._readable(name) as file:
            if file.attributes["made_by"] != self.fingerprint:
                raise PipelineError(
                    "the file was generated by another version or with other settings",
                    where=self.path(name),
                    remedy=f"{RUN_AGAIN}, which generates it again",
                )
            yield file

    @contextmanager
    def _readable(self, name: str) -> Iterator[SealedFile]:
        path = self.path(name)
        if not path.exists():
            raise PipelineError("the file is missing", where=path, remedy=f"{RUN_AGAIN}, which generates it again")
        try:
            with unsealed(path) as file:
                yield file
        except BrokenSealError as error:
            raise PipelineError(
                f"the file is damaged ({error})",
                where=path,
                expected="content with the recorded SHA-256",
                remedy="check the disk for errors; then move the file to another place, "
                f"and {RUN_AGAIN}, which generates it again",
            ) from error

    def rows(self) -> dict[str, dict[str, Any]]:
        """Map the name of each up-to-date file to its row.

        Raises:
            PipelineError: when a file is damaged.
            OSError: when the system does not open or read a file.
        """
        return self._up_to_date_rows(self._compare_table_with_files())

    def _up_to_date_rows(self, state: _TableState) -> dict[str, dict[str, Any]]:
        """Map the name of each up-to-date file to its row, which is read from the file if the table lacks it."""
        candidates = state.valid | {name: self.row(name) for name in state.stale}
        rows = {name: row for name, row in candidates.items() if row and row["made_by"] == self.fingerprint}
        return dict(sorted(rows.items()))

    def _compare_table_with_files(self) -> _TableState:
        """Compare the table with the files. A file without a row of its size, or no older than the table, is stale."""
        listed, written_ns = self._table()
        valid = {}
        names = self.names()
        for name in names:
            status = self.path(name).stat()
            row = listed.get(name)
            if row is not None and row["bytes"] == status.st_size and status.st_mtime_ns < written_ns:
                valid[name] = row
        return _TableState(valid, stale={*listed, *names} - valid.keys())

    def rows_of_all_settings(self) -> dict[str, dict[str, Any]]:
        """Map the name of each file to its row, also for files of other settings or versions.

        Raises:
            PipelineError: as ``rows``.
        """
        state = self._compare_table_with_files()
        rows = dict(state.valid)
        for name in sorted(state.stale):
            if self.path(name).exists():
                # A file of an earlier version may lack attributes; `outdated` counts it.
                with self._readable(name) as file, suppress(LookupError):
                    rows[name] = self._row_of(name, file)
        return rows

    def settings_by_fingerprint(self) -> dict[str, object]:
        """Map each fingerprint of the table's metadata to the settings that its files were written with."""
        return {fingerprint: record.basis.requested for fingerprint, record in self._records().items()}

    def row(self, name: str) -> dict[str, Any] | None:
        """Read one row from its file; `None` if the file is missing or not up to date.

        Raises:
            PipelineError: when the file is damaged.
            OSError: when the system does not open or read it.
        """
        if not self.path(name).exists():
            return None
        with self._readable(name) as file:
            return self._row_of(name, file) if file.attributes["made_by"] == self.fingerprint else None

    def _row_of(self, name: str, file: SealedFile) -> dict[str, Any]:
        size = self.path(name).stat().st_size
        return {"file": name, "made_by": file.attributes["made_by"], "bytes": size, **self.describe(file)}

    def _table(self) -> tuple[dict[str, dict[str, Any]], int]:
        """Read the table's rows and the time when it was written, in ns; no rows if it is missing or damaged."""
        path = self.root / TABLE
        try:
            table = read_table(path, self._schema.names, "")
            return {row["file"]: row for row in table.to_pylist()}, path.stat().st_mtime_ns
        except PipelineError:
            return {}, 0

    def changed_file(self) -> Path | None:
        """Return a file that has changed or is missing since the table was written, or that the table lacks.

        Returns:
            The first such file; the table if it only lists files that are not up to date; `None` if all files are
            unchanged and up to date.

        Raises:
            PipelineError: as ``rows``.
        """
        state = self._compare_table_with_files()
        rows = self._up_to_date_rows(state)
        if state.stale:
            return self.path(min(state.stale))
        return None if rows == state.valid else self.root / TABLE

    def notice_changes(self) -> None:
        """Update the table if files were deleted or changed since it was written."""
        if (self.root / TABLE).exists() and self._compare_table_with_files().stale:
            self.refresh()

    def refresh(self) -> dict[str, dict[str, Any]]:
        """Return ``rows`` and write them as the table; only for the stage that generates the files.

        Unchanged files of other fingerprints stay listed until ``keep``, so that ``run/dropped.py`` can measure them.
        """
        state = self._compare_table_with_files()
        rows = self._up_to_date_rows(state)
        records = self._records()
        table_is_up_to_date = not state.stale and rows == state.valid
        if not table_is_up_to_date or self.fingerprint not in records:
            self._write(state.valid | rows, records | {self.fingerprint: Record(self.basis)})
        return rows

    def keep(self, names: Iterable[str]) -> None:
        """Delete every other file of the store and the leftovers of killed workers; write the table again.

        Files whose names are no ids stay: the user may have stored them.
        """

        def is_of_store(file: Path) -> bool:
            name = file.relative_to(self.root).with_suffix("").as_posix()
            return file.suffix in (SUFFIX, EARLIER_SUFFIX) and _NAME.fullmatch(name) is not None

        keep_below(self.root, {self.root / TABLE, *map(self.path, names)}, is_of_store)
        rows = self.refresh()
        if self._records().keys() - {self.fingerprint} and len(rows) == len(self.names()):
            self._write(rows, {self.fingerprint: Record(self.basis)})

    def _write(self, rows: Mapping[str, Mapping[str, Any]], records: Mapping[str, Record]) -> None:
        listed = [row for _, row in sorted(rows.items())]
        made_with_of = {
            fingerprint: {"made_with": dict(record.basis.made_with), "settings": record.basis.requested}
            for fingerprint, record in records.items()
        }
        schema = self._schema.with_metadata({_MADE_WITH: json.dumps(made_with_of, sort_keys=True)})
        write_table(pa.Table.from_pylist(listed, schema=schema), self.root / TABLE)

    def _records(self) -> dict[str, Record]:
        """Map the fingerprints in the table's metadata to the records of their files."""
        try:
            metadata = pq.read_schema(self.root / TABLE).metadata
            made_with_of: dict[str, dict[str, Any]] = json.loads(metadata[_MADE_WITH])
            return {
                fingerprint: Record(Basis(fingerprint, content["settings"], content["made_with"]))
                for fingerprint, content in made_with_of.items()
            }
        except (OSError, pa.ArrowException, LookupError, TypeError, ValueError):
            return {}

    def outdated(self, names: Iterable[str]) -> Counter[str]:
        """Count, by reason, the finished files that count as missing.

        Files with other settings are not counted: ``run/dropped.py`` measures the work that a changed configuration
        drops.

        Raises:
            PipelineError: when a file is damaged.
        """
        up_to_date, records = self.rows(), self._records()
        reasons: Counter[str] = Counter()
        for name in names:
            if name in up_to_date:
                continue
            if not self.path(name).exists():
                if self.path(name).with_suffix(EARLIER_SUFFIX).exists():
                    reasons["the HDF5 container of an earlier version"] += 1
                continue
            with self._readable(name) as file:
                record = records.get(str(file.attributes["made_by"]))
            if record is None:
                reasons["unrecorded versions and settings"] += 1
            elif record.same_request(self.basis):
                reasons[str(record.describe_mismatch(self.basis))] += 1
        return reasons
