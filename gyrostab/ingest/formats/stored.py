"""Columns that NetCDF, Zarr and HDF5 (MATLAB 7.3) files store with CF attributes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.ingest.columns.headers import FileColumn
from gyrostab.ingest.columns.plan import Plan, plan_columns
from gyrostab.ingest.columns.typed import float32_note, read_columns, summarise_columns
from gyrostab.ingest.formats.packing import Decoder, attribute_text, fold_packing
from gyrostab.ingest.limits import check_stored
from gyrostab.ingest.options import FileSummary, ReadOptions
from gyrostab.store.rows import LibraryRows, Rows


@dataclass(frozen=True)
class StoredColumn:
    """A column of a file: its name, its stored numbers, and the CF attributes that decode them."""

    header: str
    dtype: np.dtype[Any]
    attributes: Mapping[str, Any]
    rows: Rows = field(repr=False)


@dataclass(frozen=True)
class StoredTable:
    """The columns of a file with their plan; the file must be open for columns of a library."""

    columns: Sequence[StoredColumn]
    rows: int
    plan: Plan
    decoders: Mapping[int, Decoder]
    notes: Sequence[str]

    def fetch(self, source: int, start: int, stop: int) -> Any:
        """Return the decoded values of a column."""
        return self.decoders[source](self.columns[source].rows.read(start, stop))

    def scan(self, form: str) -> FileSummary:
        """Summarise columns, number of rows, and first and last stamps."""
        return summarise_columns(form, self.plan, self.rows, self.fetch, self.notes)

    def read(self) -> xr.Dataset:
        """Return the raw log."""
        plan, columns = self.plan, self.columns
        check_stored(plan.path, self.rows, len(plan.columns), plan.options.limits)
        sources = [columns[column.source].rows for column in plan.columns]
        return read_columns(
            plan,
            self.rows,
            self.fetch,
            notes=[*self.notes, *float32_note(plan, [column.dtype for column in columns])],
            parallel=not any(isinstance(rows, LibraryRows) for rows in sources),
        )


def plan_stored(
    path: Path,
    columns: Sequence[StoredColumn],
    rows: int,
    options: ReadOptions,
    *,
    notes: Sequence[str] = (),
    coded: Mapping[int, str] | None = None,
) -> StoredTable:
    """Determine roles and units of stored columns, with their packing folded into the factors."""
    file_columns = [
        FileColumn(
            column.header,
            attribute_text(column.attributes.get("units")) or None,
            attribute_text(column.attributes.get("calendar")) or None,
            target=(coded or {}).get(place),
        )
        for place, column in enumerate(columns)
    ]
    attributes = [column.attributes for column in columns]
    plan = plan_columns(path, file_columns, options)
    plan, decoders = fold_packing(plan, [column.dtype for column in columns], attributes)
    return StoredTable(columns, rows, plan, decoders, notes)
