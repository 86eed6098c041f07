"""The Parquet tables of a run, with a checksum on each page: made when it is written, checked when it is read."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.errors import PipelineError
from pipeline.files import replaced


def write_table(table: pa.Table, path: Path) -> None:
    with replaced(path) as temporary:
        pq.write_table(table, temporary, write_page_checksum=True)


def read_table(path: Path, columns: Collection[str], remedy: str) -> pa.Table:
    """A table as it was written.

    Args:
        path: of the file.
        columns: what it must have at least.
        remedy: how it is made again.

    Raises:
        PipelineError: when it is missing or damaged, or lacks columns.
    """
    if not path.is_file():
        raise PipelineError("not there", where=path, remedy=remedy)
    try:
        # Without threads: the first fault of several is always the same.
        table = pq.read_table(path, page_checksum_verification=True, use_threads=False)
        table.validate(full=True)
    except (OSError, ValueError, TypeError, LookupError, RuntimeError, MemoryError, pa.ArrowException) as error:
        raise PipelineError(f"damaged ({error})", where=path, remedy=f"delete it, and {remedy}") from error
    if lacking := sorted(set(columns) - set(table.column_names)):
        raise PipelineError(
            f"lacks the columns {', '.join(lacking)}", where=path, expected="a file of this version", remedy=remedy
        )
    return table
