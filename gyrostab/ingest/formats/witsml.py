"""Logs in WITSML 1.3 and 1.4 documents (XML): curves by their mnemonics, with the units there.

The index of a log must be of dates and times; a document may hold several logs.

References
----------
Energistics, WITSML data schema 1.4.1.1, object log.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from io import StringIO
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pandas as pd

from gyrostab.errors import FormatError
from gyrostab.ingest.formats.recognise import make_matcher
from gyrostab.ingest.formats.tables import (
    Table,
    TableColumn,
    TablesOfFile,
    first_texts,
    make_reader,
)
from gyrostab.ingest.options import ReadOptions
from gyrostab.ingest.text.layout import split_line

#: Column of stamps, named as no curve is.
_STAMPS = "\0time"

matches = make_matcher(rb"(?is)(?:\xef\xbb\xbf)?\s*<.*witsml")  # an XML document


def _read_logs(path: Path, options: ReadOptions) -> TablesOfFile:
    """Return a table for each log with data and an index of dates and times."""
    tables: list[Table] = []
    for _, log in ElementTree.iterparse(path):
        if str(log.tag).rpartition("}")[2] == "log":
            table = _make_table(log)
            log.clear()
            if table is not None:
                tables.append(table)
    if not tables:
        raise FormatError(
            f"{path.name}: this WITSML document has no log of version 1 with values over dates "
            "and times; export the log by time as WITSML 1.4.1.1, LAS or CSV"
        )
    return tables, ()


def _make_table(log: Any) -> Table | None:
    if "date" not in _child_text(log, "indexType").lower():
        return None
    curves = {
        _child_text(curve, "mnemonic"): curve
        for curve in sorted(log.iterfind(".//{*}logCurveInfo"), key=_curve_place)
    }
    blocks = (_read_block(log, block, curves) for block in log.iterfind(".//{*}logData"))
    filled = [block for block in blocks if block is not None]
    if not filled:
        return None
    cells = pd.concat(filled, ignore_index=True)

    def make_column(name: str, column: str, unit: str = "") -> TableColumn:
        values = cells[column].to_numpy()
        return TableColumn((name,), values, unit, cells=first_texts(values))

    columns = [
        make_column(name, name, _child_text(curves.get(name), "unit"))
        for name in cells.columns.drop(_STAMPS)
    ]
    return Table(len(cells), columns, make_column("time", _STAMPS))


def _curve_place(curve: Any) -> int:
    """Return the position of a curve in the rows of version 1.3; 0 in 1.4, which gives none."""
    number = _child_text(curve, "columnIndex")
    return int(number) if number.isdecimal() else 0


def _read_block(log: Any, block: Any, curves: Mapping[str, Any]) -> pd.DataFrame | None:
    """Read a block of rows by its list of mnemonics, which may differ from that of another."""
    delimiter = log.findtext("{*}dataDelimiter") or ","
    delimiter = delimiter.strip() or delimiter[0]
    listed = _child_text(block, "mnemonicList")
    parts = listed.split("," if "," in listed else delimiter)
    names = [name.strip() for name in parts] if listed else list(curves)
    texts = (data.text or "" for data in block.iterfind("{*}data"))
    lines = [line.strip() for text in texts for line in text.split("\n") if line.strip()]
    if not lines or not names:
        return None
    missing: dict[Any, list[str]] = {
        number: [_child_text(curves.get(name), "nullValue") or _child_text(log, "nullValue")]
        for number, name in enumerate(names)
    }
    cells = pd.read_csv(
        StringIO("\n".join(_fit_row(line, delimiter, len(names)) for line in lines)),
        # pandas takes more than one character for a regular expression
        sep=delimiter if len(delimiter) == 1 else re.escape(delimiter),
        header=None,
        names=range(len(names)),
        index_col=False,
        na_values=missing,
        skip_blank_lines=False,  # those in place of too many cells are unreadable
    ).set_axis(names, axis="columns")
    index = _child_text(log, "indexCurve")
    return cells.rename(columns={index if index in names else names[0]: _STAMPS})


def _fit_row(line: str, delimiter: str, width: int) -> str:
    """Return a row without a delimiter at its end; an empty one in place of too many cells."""
    fitting = (
        text
        for text in (line, line.removesuffix(delimiter))
        if len(split_line(text, delimiter)) <= width
    )
    return next(fitting, "")


def _child_text(parent: Any, name: str) -> str:
    """Return the text of a child, in any namespace; empty without it."""
    return (parent.findtext(f"{{*}}{name}") or "").strip() if parent is not None else ""


scan, read = make_reader("witsml", _read_logs)
