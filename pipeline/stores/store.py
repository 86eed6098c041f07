"""A folder of HDF5 files that one stage makes, and the table that says what is in them.

A file is whole or not there, and named after what it holds, so that a changed plan never picks up a file that was made
for something else, and still finds every file that it shares with the plan before it.

The table has a row for each file. It spares the stages from opening every file to learn a verdict or a length. It is
rebuilt where it is missing or doubted: a row is believed while its file has the recorded size and is older than the
table; any other file is opened and read.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import pyarrow as pa

from pipeline.errors import PipelineError
from pipeline.files import keep_below, replaced
from pipeline.stores.sealed_file import BrokenSealError, SealedFile, sealed, unsealed
from pipeline.tables import read_table, write_table

TABLE = "index.parquet"


class Store:
    """The files of one stage.

    Args:
        root: the folder.
        made_by: the fingerprint (``pipeline.identity``) of files that are current; others count as missing.
        stage: which stage makes them, for messages.
        columns: of the table, beside ``file``, ``made_by`` and ``bytes``.
        describe: reads those columns from an open file.
        files: how they lie below ``root``, as a pattern.
    """

    def __init__(
        self,
        root: Path,
        made_by: str,
        stage: str,
        columns: Mapping[str, pa.DataType],
        describe: Callable[[SealedFile], dict[str, Any]],
        files: str = "*.h5",
    ):
        self.root = root
        self.made_by = made_by
        self._stage = stage
        self._describe = describe
        self._files = files
        common = {"file": pa.string(), "made_by": pa.string(), "bytes": pa.int64()}
        self._schema = pa.schema(list((common | dict(columns)).items()))

    def path(self, name: str) -> Path:
        """Where a file lies; its name may have folders in it, and has no suffix."""
        return self.root / f"{name}.h5"

    def names(self) -> list[str]:
        """Of all files, current or not."""
        return sorted(path.relative_to(self.root).with_suffix("").as_posix() for path in self.root.glob(self._files))

    @contextmanager
    def created(self, name: str, attributes: Mapping[str, Any]) -> Iterator[h5py.File]:
        """A new file to fill with arrays; it takes its place when the block ends.

        Args:
            name: of the file.
            attributes: JSON-serialisable, what it says beside its arrays.
        """
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
        path, remedy = self.path(name), f"run the {self._stage} stage again"
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

    def check_all(self, name: str) -> None:
        """Compare all of a file with its checksums.

        Raises:
            PipelineError: when it is missing, damaged, or not current.
        """
        with self.opened(name) as file:
            file.check_all()

    def rows(self) -> dict[str, dict[str, Any]]:
        """Name of a file to its row, for every current one that can be read."""
        return self._rows()[0]

    def _rows(self) -> tuple[dict[str, dict[str, Any]], bool]:
        """The rows, and whether the table on disk is these rows and is believed in every one."""
        believed, written_ns = self._table()
        rows, doubted = {}, False
        for name in self.names():
            status = self.path(name).stat()
            row = believed.get(name)
            if row is None or row["bytes"] != status.st_size or status.st_mtime_ns >= written_ns:
                row, doubted = self._read(name, status.st_size), True
            if row is not None and row["made_by"] == self.made_by:
                rows[name] = row
        return rows, not doubted and rows == believed

    def row(self, name: str) -> dict[str, Any] | None:
        """One row, read from the file; None when that is missing, damaged or not current."""
        path = self.path(name)
        return self._read(name, path.stat().st_size) if path.exists() else None

    def _table(self) -> tuple[dict[str, dict[str, Any]], int]:
        """The rows that were written last, and when; none when the table is missing or damaged."""
        path = self.root / TABLE
        try:
            table = read_table(path, self._schema.names, "")
            return {row["file"]: row for row in table.to_pylist()}, path.stat().st_mtime_ns
        except PipelineError:
            return {}, 0

    def _read(self, name: str, size: int) -> dict[str, Any] | None:
        try:
            with self.opened(name) as file:
                described = self._describe(file)
        except PipelineError:
            return None
        return {"file": name, "made_by": self.made_by, "bytes": size, **described}

    def refresh(self) -> dict[str, dict[str, Any]]:
        """``rows``, written as the table; only for the stage that makes the files."""
        rows, written = self._rows()
        if not written:
            listed = [row for _, row in sorted(rows.items())]
            write_table(pa.Table.from_pylist(listed, schema=self._schema), self.root / TABLE)
        return rows

    def keep(self, names: Iterable[str]) -> None:
        """Delete every other file, and what a killed worker left; write the table anew."""
        keep_below(self.root, {self.root / TABLE, *map(self.path, names)})
        self.refresh()
