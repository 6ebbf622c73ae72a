"""Logs in WITSML 1.3 and 1.4 documents (XML): curves by their mnemonics, with the units there.

The index of a log must be of dates and times; a document may hold several logs.

References
----------
Energistics, WITSML data schema 1.4.1.1, object log.
"""

from __future__ import annotations

from io import StringIO
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pandas as pd

from gyrostab.errors import FormatError
from gyrostab.ingest.columns.stamps import texts_to_ns
from gyrostab.ingest.formats.recognise import make_matcher
from gyrostab.ingest.formats.tables import Table, TableColumn, TablesOfFile, make_reader
from gyrostab.ingest.options import ReadOptions

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
    curves = {_child_text(curve, "mnemonic"): curve for curve in log.iterfind(".//{*}logCurveInfo")}
    lists = [names.text for names in log.iterfind(".//{*}mnemonicList") if names.text]
    names = [name.strip() for name in lists[-1].split(",")] if lists else list(curves)
    lines = [data.text.strip() for data in log.iterfind(".//{*}data") if data.text]
    if not lines or not names:
        return None
    cells = pd.read_csv(  # type: ignore[call-overload]
        StringIO("\n".join(lines)),
        header=None,
        names=range(len(names)),
        index_col=False,
        na_values={
            number: [_child_text(curves.get(name), "nullValue") or _child_text(log, "nullValue")]
            for number, name in enumerate(names)
        },
        on_bad_lines="skip",
    )
    index = _child_text(log, "indexCurve")
    place = names.index(index) if index in names else 0
    stamps = texts_to_ns(cells[place].astype(str).tolist()).view("datetime64[ns]")
    columns = [
        TableColumn((name,), cells[number].to_numpy(), _child_text(curves.get(name), "unit"))
        for number, name in enumerate(names)
        if number != place
    ]
    return Table(len(cells), columns, TableColumn(("time",), stamps))


def _child_text(parent: Any, name: str) -> str:
    """Return the text of a child, in any namespace; empty without it."""
    return (parent.findtext(f"{{*}}{name}") or "").strip() if parent is not None else ""


scan, read = make_reader("witsml", _read_logs)
