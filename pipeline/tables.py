"""Parquet tables of a run, with checksums that are written with the table and checked when it is read.

Parquet has a checksum for each page of values, but none for the footer, which states the places and encodings of the
columns. These tables therefore also have a checksum of all values.
"""

import json
from collections.abc import Collection
from dataclasses import fields
from hashlib import sha256
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, get_args, get_origin, get_type_hints

import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.errors import PipelineError
from pipeline.files import replaced

SEAL = b"sha256"
"""Key of the table's metadata for the checksum of its values."""


_TYPES = {str: pa.string(), int: pa.int64(), float: pa.float64(), bool: pa.bool_()}


def column(name: str, values: pa.DataType, meaning: str) -> pa.Field:
    """Return a column with its meaning as metadata."""
    return pa.field(name, values, metadata={"meaning": meaning})


def columns_of(record: type[Any]) -> list[pa.Field]:
    """Return a column for each field of a dataclass of ``Annotated[type, meaning]``; it may be optional or a list."""
    hints = get_type_hints(record, include_extras=True)
    columns = []
    for each in fields(record):
        declared, meaning = get_args(hints[each.name])
        columns.append(column(each.name, _arrow_type(declared), meaning))
    return columns


def _arrow_type(declared: Any) -> pa.DataType:
    """Return the type of a column's values, given the type ``X``, ``list[X]``, or one of these ``| None``."""
    alternatives = get_args(declared) if isinstance(declared, UnionType) else (declared,)
    kind = next(alternative for alternative in alternatives if alternative is not NoneType)
    if get_origin(kind) is list:
        return pa.list_(_TYPES[get_args(kind)[0]])
    return _TYPES[kind]


def write_table(table: pa.Table, path: Path) -> None:
    metadata = {**(table.schema.metadata or {}), SEAL: _digest(table)}
    with replaced(path) as temporary:
        pq.write_table(table.replace_schema_metadata(metadata), temporary, write_page_checksum=True)


def read_table(path: Path, columns: Collection[str], remedy: str) -> pa.Table:
    """Read a table, and check that it is as written and has at least these columns.

    Args:
        remedy: command that generates the table again, for errors.

    Raises:
        PipelineError: when the table is missing or damaged, or lacks columns.
    """
    if not path.is_file():
        raise PipelineError("the file is missing", where=path, remedy=remedy)
    try:
        # Without threads, the reported error is always the same. pq.read_table would import pandas.
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            table = file.read(use_threads=False)
        if (table.schema.metadata or {}).get(SEAL) != _digest(table):
            raise ValueError("its values differ from its checksum")
    except MemoryError:
        raise
    except (OSError, ValueError, TypeError, LookupError, RuntimeError, pa.ArrowException) as error:
        raise PipelineError(
            f"the file is damaged ({error})", where=path, remedy=f"move it to another place, and {remedy}"
        ) from error
    lacking = sorted(set(columns) - set(table.column_names))
    if lacking:
        raise PipelineError(
            f"the file lacks the columns {', '.join(lacking)}",
            where=path,
            expected="a file of this version",
            remedy=remedy,
        )
    return table


def _digest(table: pa.Table) -> bytes:
    return sha256(json.dumps(table.to_pydict()).encode()).hexdigest().encode()
