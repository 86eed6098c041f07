"""A folder of HDF5 files that one stage makes, and the table that says what is in them.

A file is whole or not there, and named after what it holds, so that a changed plan never picks up a file that was made
for something else, and still finds every file that it shares with the plan before it.

The table has a row for each file. It spares the stages from opening every file to learn a verdict or a length. It is
rebuilt where it is missing or doubted: a row is believed while its file has the recorded size and is older than the
table; any other file is opened and read. For people, the table's metadata says what fingerprints stand for.
"""

import json
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar

import h5py
import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.errors import PipelineError
from pipeline.files import keep_below, replaced
from pipeline.identity import Step, differences, fingerprint, made_with
from pipeline.seeding import digest
from pipeline.stores.sealed_file import BrokenSealError, SealedFile, sealed, unsealed
from pipeline.tables import read_table, write_table

TABLE = "index.parquet"

_MADE_WITH = b"made_with"
"""The table's metadata that has, as JSON, a fingerprint to what files of it were made with."""


class Store(ABC):
    """The files of one stage.

    Args:
        settings: JSON-serialisable, those of the user that the bytes depend on; files with others count as missing.
        form: what else of this project they depend on, by its name for people.
    """

    step: ClassVar[Step]
    """What makes the files, in ``pipeline/identity.py``."""
    stage: ClassVar[str]
    """Which stage makes them anew, for messages."""
    columns: ClassVar[Mapping[str, pa.DataType]]
    """Of the table, beside ``file``, ``made_by`` and ``bytes``."""
    pattern: ClassVar[str] = "*.h5"
    """How the files lie below ``root``."""

    def __init__(self, root: Path, settings: object = None, form: Mapping[str, object] = MappingProxyType({})):
        self.root = root
        parts = [settings, *form.values()] if settings is not None else []
        self.made_by = fingerprint(self.step, *parts)
        here = {**made_with(self.step), **{name: digest(value)[:8] for name, value in form.items()}}
        self._made_with: dict[str, Any] = {"made_with": here, "settings": settings}
        common = {"file": pa.string(), "made_by": pa.string(), "bytes": pa.int64()}
        self._schema = pa.schema(list((common | dict(self.columns)).items()))

    @staticmethod
    @abstractmethod
    def describe(file: SealedFile) -> dict[str, Any]:
        """A file's values of ``columns``."""

    def path(self, name: str) -> Path:
        """Where a file lies; its name may have folders in it, and has no suffix."""
        return self.root / f"{name}.h5"

    def names(self) -> list[str]:
        """Of all files, current or not."""
        return sorted(path.relative_to(self.root).with_suffix("").as_posix() for path in self.root.glob(self.pattern))

    @contextmanager
    def created(self, name: str, attributes: Mapping[str, Any]) -> Iterator[h5py.File]:
        """A new file to fill with arrays, with ``attributes`` as JSON; it takes its place when the block ends."""
        with (
            replaced(self.path(name)) as temporary,
            sealed(temporary, {**attributes, "made_by": self.made_by}) as file,
        ):
            yield file

    @contextmanager
    def opened(self, name: str) -> Iterator[SealedFile]:
        """A file to read.

        Raises:
            PipelineError: when it is missing, damaged, or not current.
        """
        path, remedy = self.path(name), f"run the {self.stage} stage again"
        if not path.exists():
            raise PipelineError("missing", where=path, remedy=remedy)
        try:
            with unsealed(path) as file:
                if file.attributes.get("made_by") != self.made_by:
                    raise PipelineError("made by another version or with other settings", where=path, remedy=remedy)
                yield file
        except BrokenSealError as error:
            # The stage believes its table, and does not read every file again.
            raise PipelineError(f"damaged ({error})", where=path, remedy=f"delete the file and {remedy}") from error

    def rows(self) -> dict[str, dict[str, Any]]:
        """Name of a file to its row, for every current one that can be read."""
        return self._rows()[0]

    def _rows(self) -> tuple[dict[str, dict[str, Any]], bool]:
        """The rows, and whether the table on disk is these rows and is believed in every one."""
        believed, doubted = self._believed()
        read = {name: self.row(name) for name in doubted}
        rows = {name: row for name, row in (believed | read).items() if row and row["made_by"] == self.made_by}
        return dict(sorted(rows.items())), not doubted and len(rows) == len(believed)

    def _believed(self) -> tuple[dict[str, dict[str, Any]], set[str]]:
        """The table's rows of files that have not changed since, and the names of all other files, also of those gone.

        The rows are whatever fingerprint they have.
        """
        told, written_ns = self._table()
        believed = {}
        for name in self.names():
            status = self.path(name).stat()
            if name in told and told[name]["bytes"] == status.st_size and status.st_mtime_ns < written_ns:
                believed[name] = told[name]
            else:
                told.setdefault(name, {})
        return believed, told.keys() - believed.keys()

    def row(self, name: str) -> dict[str, Any] | None:
        """One row, read from the file; None when that is missing, damaged or not current."""
        try:
            with self.opened(name) as file:
                described = self.describe(file)
        except PipelineError:
            return None
        return {"file": name, "made_by": self.made_by, "bytes": self.path(name).stat().st_size, **described}

    def _table(self) -> tuple[dict[str, dict[str, Any]], int]:
        """The rows that were written last, and when; none when the table is missing or damaged."""
        path = self.root / TABLE
        try:
            table = read_table(path, self._schema.names, "")
            return {row["file"]: row for row in table.to_pylist()}, path.stat().st_mtime_ns
        except PipelineError:
            return {}, 0

    def untouched(self) -> bool:
        """Whether the table tells of every file that is there, and none has changed since."""
        return self._rows()[1]

    def notice_changes(self) -> None:
        """Where files are gone or have changed since the table was written, have it tell so."""
        if (self.root / TABLE).exists() and self._believed()[1]:
            self.refresh()

    def refresh(self) -> dict[str, dict[str, Any]]:
        """``rows``, written as the table; only for the stage that makes the files."""
        rows, written = self._rows()
        known = self._known()
        if not written or self.made_by not in known:
            self._write(rows, known | {self.made_by: self._made_with})
        return rows

    def keep(self, names: Iterable[str]) -> None:
        """Delete every other file, and what a killed worker left; write the table anew."""
        keep_below(self.root, {self.root / TABLE, *map(self.path, names)})
        rows = self.refresh()
        if self._known().keys() - {self.made_by} and len(rows) == len(self.names()):
            self._write(rows, {self.made_by: self._made_with})

    def _write(self, rows: Mapping[str, Mapping[str, Any]], known: Mapping[str, Any]) -> None:
        listed = [row for _, row in sorted(rows.items())]
        schema = self._schema.with_metadata({_MADE_WITH: json.dumps(known, sort_keys=True)})
        write_table(pa.Table.from_pylist(listed, schema=schema), self.root / TABLE)

    def _known(self) -> dict[str, dict[str, Any]]:
        """Fingerprint to what files with it were made with, as far as the table says so."""
        try:
            known: dict[str, dict[str, Any]] = json.loads(pq.read_schema(self.root / TABLE).metadata[_MADE_WITH])
        except (OSError, pa.ArrowException, LookupError, TypeError, ValueError):
            return {}
        return known

    def outdated(self, names: Iterable[str]) -> Counter[str]:
        """Why finished files count as missing, to how many do for this reason.

        Those that are damaged are not counted, nor those with other settings: whoever changed these wants new files.
        """
        current, known = self.rows(), self._known()
        reasons: Counter[str] = Counter()
        for name in names:
            if name in current or not self.path(name).exists():
                continue
            try:
                with unsealed(self.path(name)) as file:
                    then = known.get(str(file.attributes["made_by"]))
            except (BrokenSealError, KeyError):
                continue
            if then is None:
                reasons["something that was not written down"] += 1
            elif then["settings"] == self._made_with["settings"]:
                reasons[differences(then["made_with"], self._made_with["made_with"])] += 1
        return reasons
