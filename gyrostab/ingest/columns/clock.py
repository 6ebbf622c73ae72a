"""Continue the stamps of a clock of the day, or of the GPS week, where it begins again."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gyrostab.ingest.columns.stamps import NAT
from gyrostab.units import DAY

#: Periods after which a clock of the time of day, and one of the GPS week, begin again [ns].
CLOCK_PERIODS = (int(DAY) * 10**9, 7 * int(DAY) * 10**9)
#: Steps from which the typical one follows.
_TYPICAL_STEPS = 4096


class TurningClock:
    """Continue the stamps of successive blocks, and count the periods that are added to them."""

    def __init__(self) -> None:
        self.last: int | None = None
        self.turns: list[int] = []

    def continue_stamps(self, stamps: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the stamps of the next block, continued where the clock begins again."""
        places = np.flatnonzero(stamps != NAT)
        if not places.size:
            return stamps
        good = stamps[places] + sum(self.turns)
        steps = np.diff(good)
        rises = steps[:_TYPICAL_STEPS]
        rises = rises[rises > 0]
        typical = float(np.median(rises)) if rises.size else 0.0  # 0 if all stamps are equal
        backward = np.flatnonzero(steps < -CLOCK_PERIODS[0] // 2) + 1
        turns = [] if self.last is None else [(0, find_turn(int(good[0]) - self.last, typical))]
        for row in backward.tolist():
            turn = find_turn(int(steps[row - 1]), typical)
            if not (row < steps.size and steps[row] > turn // 2):  # one wrong stamp
                turns.append((row, turn))
        for row, turn in turns:
            if turn:
                good[row:] += turn
                self.turns.append(turn)
        self.last = int(good[-1])
        if not self.turns:
            return stamps
        continued = stamps.copy()
        continued[places] = good
        return continued

    def describe(self) -> list[str]:
        """Return a note if a period was added."""
        if not self.turns:
            return []
        period = "a day" if max(self.turns) == CLOCK_PERIODS[0] else "a week"
        times = f"{len(self.turns)} time{'s' * (len(self.turns) > 1)}"
        return [
            f"the clock begins again after {period} ({times}) "
            "without a pause; the stamps are continued"
        ]


def find_turn(step: int, typical: float) -> int:
    """Return the period after which a clock began again at a step, if no row is lost there, or 0.

    `typical` is a typical step of the stamps [ns].

    Examples
    --------
    >>> find_turn(-86_399_950_000_000, 5e7), find_turn(-86_000_000_000_000, 5e7)
    (86400000000000, 0)
    """
    return next((turn for turn in CLOCK_PERIODS if 0 < step + turn <= 2 * typical < turn / 2), 0)
