"""Messages that are read one after the other, collected as the columns of a table."""

from __future__ import annotations

from array import array
from collections.abc import Mapping, Sequence

import numpy as np

from gyrostab.ingest.columns.stamps import NAT
from gyrostab.ingest.formats.tables import Table, sliced

__all__ = ["Messages"]


class Messages:
    """Stamps and numbers of messages of one kind, a row each.

    Examples
    --------
    >>> found = Messages()
    >>> found.add(0, {"x": 1.0})
    >>> found.add(10, {"x": 2.0, "t": 20.5})
    >>> table = found.make_table(time_unit="ms")
    >>> table.names, table.columns[1](0, 2)
    (('x', 't'), array([ nan, 20.5]))
    """

    def __init__(self) -> None:
        self.stamps: array[int] = array("q")
        self.columns: dict[str, array[float]] = {}

    def add(self, stamp: int, values: Mapping[str, float]) -> None:
        """Add a message; fields that it lacks are NaN, and a stamp beyond 64 bits is NaT."""
        for name, value in values.items():
            column = self.columns.setdefault(name, array("d"))
            self._fill_column(column)
            column.append(value)
        self.stamps.append(stamp if abs(stamp) < 2**63 else NAT)

    def make_table(
        self,
        names: Sequence[str] | None = None,
        *,
        time_unit: str | None = None,
        meanings: Mapping[str, str] | None = None,
    ) -> Table:
        """Return the columns under other names.

        Without `time_unit` the stamps are nanoseconds since 1970. `meanings` are targets of fields
        in the form of ``--map``.
        """
        for column in self.columns.values():
            self._fill_column(column)
        stamps = np.frombuffer(self.stamps, dtype=np.int64)
        return Table(
            len(stamps),
            tuple(names or self.columns),
            (None,) * len(self.columns),
            tuple(sliced(np.frombuffer(column)) for column in self.columns.values()),
            sliced(stamps if time_unit else stamps.view("datetime64[ns]")),
            time_unit,
            tuple((meanings or {}).get(name) for name in self.columns),
        )

    def _fill_column(self, column: array[float]) -> None:
        if len(column) < len(self.stamps):
            column.extend([np.nan] * (len(self.stamps) - len(column)))
