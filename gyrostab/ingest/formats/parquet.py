"""Parquet logs: one column per channel, units in square brackets or in the field metadata."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.errors import FormatError
from gyrostab.ingest.columns.headers import describe_cells, split_header
from gyrostab.ingest.columns.plan import Plan
from gyrostab.ingest.columns.plan_roles import plan_columns
from gyrostab.ingest.columns.typed import (
    batch_rows,
    float32_note,
    read_column_batches,
    summarise_columns,
)
from gyrostab.ingest.formats.recognise import make_matcher
from gyrostab.ingest.limits import check_stored
from gyrostab.ingest.options import FileSummary, ReadOptions

#: Bytes of a column that are read at one time; without a buffer a whole row group is read, which
#: may be the whole log.
_BUFFER_BYTES = 2**20

matches = make_matcher(b"PAR1", ".parquet", ".pq")


def scan(path: Path, options: ReadOptions) -> FileSummary:
    """Summarise schema and row count from the footer, and first and last stamps."""
    import pyarrow as pa

    file, plan = _open_parquet(path, options)
    groups, rows = range(file.num_row_groups), file.metadata.num_rows
    filled = [group for group in groups if file.metadata.row_group(group).num_rows > 0]

    def fetch(source: int, start: int, stop: int) -> Any:
        is_whole = stop - start == rows
        batches: Iterable[Any] = file.iter_batches(
            batch_size=batch_rows(1),
            row_groups=filled if is_whole else filled[:1] if start == 0 else filled[-1:],
            columns=[file.schema_arrow.names[source]],
        )
        if not is_whole:  # rows of the first or of the last batch are enough
            batches = islice(batches, 1) if start == 0 else deque(batches, maxlen=1)
        columns = [batch.column(0) for batch in batches]
        if not columns:
            raise FormatError(
                f"{path.name}: a row group holds fewer rows than the file says; copy it again"
            )
        values = _to_numpy(pa.chunked_array(columns))
        return values[: stop - start] if start == 0 else values[start - stop :]

    return summarise_columns("parquet", plan, rows, fetch)


def read(path: Path, options: ReadOptions) -> xr.Dataset:
    """Return the raw log of a Parquet file; see `gyrostab.ingest.read_log`."""
    file, plan = _open_parquet(path, options)
    names = file.schema_arrow.names
    check_stored(path, file.metadata.num_rows, len(plan.columns), options.limits)
    columns = [names[column.source] for column in plan.columns]

    def take(batch: Any) -> dict[int, Any]:
        arrays = dict(zip(batch.schema.names, batch.columns, strict=True))
        return {c.source: _to_numpy(arrays[names[c.source]]) for c in plan.columns}

    return read_column_batches(
        plan,
        file.iter_batches(batch_size=batch_rows(len(columns)), columns=columns),
        take,
        notes=float32_note(plan, file.schema_arrow.types),
        parallel=True,
    )


def _open_parquet(path: Path, options: ReadOptions) -> tuple[Any, Plan]:
    import pyarrow as pa
    from pyarrow import parquet

    file = parquet.ParquetFile(path, buffer_size=_BUFFER_BYTES, pre_buffer=False)
    schema = file.schema_arrow
    head = next(file.iter_batches(batch_size=50), None)
    columns = []
    for index, entry in enumerate(schema):
        stored = (entry.metadata or {}).get(b"units")
        header, unit = entry.name, None if stored is None else stored.decode(errors="replace")
        if pa.types.is_duration(entry.type):
            header, unit = split_header(entry.name)[0], entry.type.unit
        cells = [] if head is None else _read_cells(head.column(index))
        columns.append(describe_cells(header, unit, cells))
    return file, plan_columns(path, columns, options)


def _read_cells(column: Any) -> list[str]:
    """Return the values of an arrow column as text; missing ones are empty, zoned stamps in UTC."""
    import pyarrow as pa

    values = _to_numpy(column)
    if values.dtype.kind == "M":
        is_zoned = pa.types.is_timestamp(column.type) and column.type.tz is not None
        texts = np.datetime_as_string(values, timezone="UTC" if is_zoned else "naive")
        return ["" if text == "NaT" else str(text) for text in texts]
    return ["" if value is None else str(value) for value in values.tolist()]


def _to_numpy(column: Any) -> Any:
    """Convert an arrow column to numpy; nulls are masked if the type has no NaN."""
    import pyarrow as pa

    column = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    kind = column.type
    if pa.types.is_timestamp(kind):
        # in UTC; `to_stamps` converts the unit
        return column.cast(pa.timestamp(kind.unit)).to_numpy(zero_copy_only=False)
    if pa.types.is_duration(kind):
        column, kind = column.cast(pa.int64()), pa.int64()
    if pa.types.is_integer(kind) and column.null_count:
        return np.ma.array(
            column.fill_null(0).to_numpy(zero_copy_only=False),
            mask=column.is_null().to_numpy(zero_copy_only=False),
        )
    if pa.types.is_decimal(kind):
        return np.array(
            [None if value is None else str(value) for value in column.to_pylist()], dtype=object
        )
    return column.to_numpy(zero_copy_only=False)
