"""The Parquet tables of a run, with checksums: made when they are written, checked when they are read.

Parquet has one for each page of values. It has none for the footer, which says where columns lie and how they are
encoded, so there is one of the values too.
"""

import json
from collections.abc import Collection
from dataclasses import fields
from hashlib import sha256
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.errors import PipelineError
from pipeline.files import replaced

SEAL = b"sha256"
"""The table's metadata that has the checksum of its values."""


_TYPES = {str: pa.string(), int: pa.int64(), float: pa.float64(), bool: pa.bool_()}


def column(name: str, values: pa.DataType, meaning: str) -> pa.Field:
    """A column, and what is in it."""
    return pa.field(name, values, metadata={"meaning": meaning})


def columns_of(record: type[Any]) -> list[pa.Field]:
    """A column for each field of a dataclass of ``Annotated[type, meaning]``; the type may be optional."""
    hints = get_type_hints(record, include_extras=True)
    columns = []
    for each in fields(record):
        declared, meaning = get_args(hints[each.name])
        kind = next(one for one in get_args(declared) or (declared,) if one is not type(None))
        columns.append(column(each.name, _TYPES[kind], meaning))
    return columns


def write_table(table: pa.Table, path: Path) -> None:
    metadata = {**(table.schema.metadata or {}), SEAL: _digest(table)}
    with replaced(path) as temporary:
        pq.write_table(table.replace_schema_metadata(metadata), temporary, write_page_checksum=True)


def read_table(path: Path, columns: Collection[str], remedy: str) -> pa.Table:
    """A table as it was written, with these columns at least; ``remedy`` tells how it is made again.

    Raises:
        PipelineError: when it is missing or damaged, or lacks columns.
    """
    if not path.is_file():
        raise PipelineError("not there", where=path, remedy=remedy)
    try:
        # Without threads: of several faults, always the same is told. Unlike pq.read_table, it imports no pandas.
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            table = file.read(use_threads=False)
        if (table.schema.metadata or {}).get(SEAL) != _digest(table):
            raise ValueError("it does not hold what was written")
    except MemoryError:
        raise
    except (OSError, ValueError, TypeError, LookupError, RuntimeError, pa.ArrowException) as error:
        raise PipelineError(f"damaged ({error})", where=path, remedy=f"move it away, and {remedy}") from error
    if lacking := sorted(set(columns) - set(table.column_names)):
        raise PipelineError(
            f"lacks the columns {', '.join(lacking)}", where=path, expected="a file of this version", remedy=remedy
        )
    return table


def _digest(table: pa.Table) -> bytes:
    return sha256(json.dumps(table.to_pydict()).encode()).hexdigest().encode()
