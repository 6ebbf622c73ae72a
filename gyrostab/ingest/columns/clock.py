"""Continue the stamps of a clock of the day, or of the GPS week, where it begins again."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gyrostab.ingest.columns.stamps import NAT
from gyrostab.units import DAY

#: Periods after which a clock of the time of day, and one of the GPS week, begin again [ns].
CLOCK_PERIODS = (int(DAY) * 10**9, 7 * int(DAY) * 10**9)
#: Steps from which the typical one follows.
_TYPICAL_STEPS = 4096


class ClockBlock(NamedTuple):
    """Stamps of a block whose clock may begin again after a day or a week [ns]."""

    first: int
    last: int  # continued within the block
    typical: float  # step
    turns: list[int]  # periods that were added within the block


class TurningClock:
    """Stamps of successive blocks, and the periods that were added to them."""

    def __init__(self) -> None:
        self.last: int | None = None
        self.turns: list[int] = []

    def continue_from(self, block: ClockBlock) -> int:
        """Return what to add to the stamps of the next block, so that they follow the last [ns]."""
        shift = sum(self.turns)
        turn = 0 if self.last is None else find_turn(block.first + shift - self.last, block.typical)
        shift += turn
        self.turns += [*([turn] if turn else []), *block.turns]
        self.last = block.last + shift
        return shift

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


def continue_block(
    stamps: NDArray[np.int64],
) -> tuple[NDArray[np.int64], ClockBlock | None]:
    """Continue the readable stamps of a block; the block is None without any."""
    is_good = stamps != NAT
    good = stamps if is_good.all() else stamps[is_good]
    if not good.size:
        return stamps, None
    continued, turns, typical = _continue_clock(good)
    clock = ClockBlock(int(good[0]), int(continued[-1]), typical, turns)
    if turns and good is not stamps:
        stamps = stamps.copy()
        stamps[is_good] = continued
        return stamps, clock
    return continued if turns else stamps, clock


def find_turn(step: int, typical: float) -> int:
    """Return the period after which a clock began again at a step, if no row is lost there, or 0.

    `typical` is a typical step of the stamps [ns].

    Examples
    --------
    >>> find_turn(-86_399_950_000_000, 5e7), find_turn(-86_000_000_000_000, 5e7)
    (86400000000000, 0)
    """
    return next((turn for turn in CLOCK_PERIODS if 0 < step + turn <= 2 * typical < turn / 2), 0)


def _continue_clock(stamps: NDArray[np.int64]) -> tuple[NDArray[np.int64], list[int], float]:
    """Continue readable stamps where a clock of the day or week begins again.

    Return the stamps (a copy if any changed), the periods that were added, and the typical step
    between different stamps, 0 if all are equal [ns].
    """
    steps = np.diff(stamps)
    rises = steps[:_TYPICAL_STEPS]
    rises = rises[rises > 0]
    typical = float(np.median(rises)) if rises.size else 0.0
    turns: list[int] = []
    if steps.size and steps.min() < -CLOCK_PERIODS[0] // 2:
        for row in (np.flatnonzero(steps < -CLOCK_PERIODS[0] // 2) + 1).tolist():
            turn = find_turn(int(steps[row - 1]), typical)
            if turn and not (row < steps.size and steps[row] > turn // 2):  # not one wrong stamp
                stamps = stamps if turns else stamps.copy()
                stamps[row:] += turn
                turns.append(turn)
    return stamps, turns, typical
