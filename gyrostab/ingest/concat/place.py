"""Place each log on the grid of the first: by stamps, by shared samples, or after a clock step.

The rules are the same as for raw rows: rows in two files count once; files whose clocks merely
cover the same hours are not copies of each other; after a step of the clock the length of the pause
is unknown, and one sample is taken as missing.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gyrostab.arrays import Floats
from gyrostab.ingest.concat.grid import PlacedLog, SourceLog, read_log_slice, runs_of
from gyrostab.ingest.gap_table import break_cause, describe_break
from gyrostab.time.durations import format_measured_duration
from gyrostab.time.grid import grid_index, grid_times
from gyrostab.time.stamps import format_stamp
from gyrostab.wording import list_some

#: Largest distance from the grid that is not noted [samples].
NOTED_OFFSET_SAMPLES = 0.01
#: Largest overlap of different values that is not taken as a step of the clock [samples], as for
#: raw rows.
MAX_OVERLAP_SAMPLES = 16
#: Largest displacement of the grids of two logs with common samples, by the jitter of their first
#: stamps [samples].
MAX_SHIFT_SAMPLES = 64

_MAX_NAMED = 5  # events of one kind that are listed one by one


def _match_logs(held: SourceLog, new: SourceLog, lag: int) -> Match:
    """Compare both ends of the overlap by the clock: `new` begins at sample `lag` of `held`."""
    axes = [axis for axis in held.axes if axis in new.axes]
    low, high = max(lag, 0), min(lag + new.size, held.size)
    ends = [(low, min(high, low + COMPARED_SAMPLES)), (max(low, high - COMPARED_SAMPLES), high)]
    rows_held, rows_new = ([source.axes.index(axis) for axis in axes] for source in (held, new))
    return match_ends(
        (
            read_log_slice(held, begin - MAX_SHIFT_SAMPLES, end + MAX_SHIFT_SAMPLES)[rows_held],
            read_log_slice(new, begin - lag, end - lag)[rows_new],
        )
        for begin, end in (dict.fromkeys(ends) if axes and high > low else ())
    )


def place_logs(
    sources: Sequence[SourceLog], *, max_gap: float
) -> tuple[list[PlacedLog], list[str]]:
    """Place logs, in the order of their first stamps, on the grid of the first.

    A pause longer than `max_gap` [s] is taken as a step of the clock. The first sample of all is
    sample 0. Also return notes on logs between the samples of the grid, overlaps and clock steps.
    """
    rate = sources[0].rate
    pieces: list[PlacedLog] = []
    overlaps: list[str] = []
    breaks: list[str] = []
    for source in sources:
        piece, match = _place_next(pieces, source, rate, max_gap)
        if match is not None:
            overlaps.append(_overlap_note(piece, *match, rate))
        elif piece.cause >= 0:
            last = _last_stamp(pieces)
            text = describe_break("", piece.cause, last, source.start, "samples")
            breaks.append(f"{source.name}: {text}")
        pieces.append(piece)
    notes = [
        *_grid_notes(pieces, rate),
        *_first_notes(breaks, "steps of the clock are in the table of gaps"),
        *_first_notes(overlaps, "overlaps"),
    ]
    lowest = min(piece.first for piece in pieces)
    shifted = [
        replace(
            piece,
            runs=piece.runs - np.array([lowest, 0, 0]),
            clock=(piece.clock[0], piece.clock[1] - lowest),
        )
        for piece in pieces
    ]
    return shifted, notes


def _first_notes(notes: Sequence[str], subject: str) -> list[str]:
    """Return the first of many notes of one kind, and how many more there are."""
    more = len(notes) - _MAX_NAMED
    return [*notes[:_MAX_NAMED], *([f"{more} more {subject}"] if more > 0 else [])]


def _place_next(
    pieces: list[PlacedLog], source: SourceLog, rate: float, max_gap: float
) -> tuple[PlacedLog, tuple[PlacedLog, Match] | None]:
    """Place the next log on the grid; also return the log that it overlaps, if any."""
    if not pieces:
        return _place_at(0, source, rate, (source.start, 0)), None
    differing: tuple[PlacedLog, Match] | None = None
    silent: tuple[PlacedLog, Match] | None = None
    for held in reversed(pieces):
        if held.source.end < source.start or not set(held.source.axes) & set(source.axes):
            continue  # other axes over the same time do not overlap
        lag = int(np.rint(grid_index(held.source.start, held.source.rate, source.start)))
        match = _match_logs(held.source, source, lag)
        if match.alike:
            first = int(held.on_grid(lag + match.shift))
            return _place_at(first, source, rate, held.clock), (held, match)
        if match.common:
            differing = differing or (held, match)
        else:
            silent = silent or (held, match)
    clock = pieces[-1].clock
    position = float(grid_index(clock[0], rate, source.start)) + clock[1]
    first, end = int(np.rint(position)), max(piece.end for piece in pieces)
    back = end - first > MAX_OVERLAP_SAMPLES and differing is not None
    if back or first - end > max_gap * rate:
        began, last = pieces[0].source.start, _last_stamp(pieces)
        cause = break_cause(began, clock[0], last, source.start)
        return _place_at(end + 1, source, rate, (source.start, end + 1), cause), None
    overlapped = (differing or silent) if first < end else None
    return _place_at(position, source, rate, clock), overlapped


def _place_at(
    position: float, source: SourceLog, rate: float, clock: tuple[int, int], cause: int = -1
) -> PlacedLog:
    """Place a log whose first sample lies at a position of the grid of `rate` [Hz]."""
    first = int(np.rint(position))
    off = position - first
    runs = runs_of(first, off, source.size, rate / source.rate)
    return PlacedLog(source, runs, off, clock, cause)


def _last_stamp(pieces: Sequence[PlacedLog]) -> int:
    """Return the latest stamp of the clock of the last log [ns since 1970]."""
    return max(piece.source.end for piece in pieces if piece.clock == pieces[-1].clock)


def _grid_notes(pieces: Sequence[PlacedLog], rate: float) -> list[str]:
    """Return notes on logs between the samples of the grid or with a slightly different rate."""
    notes = []
    between = [piece for piece in pieces if abs(piece.off) > NOTED_OFFSET_SAMPLES]
    if between:
        largest = max(abs(piece.off) for piece in between)
        names = list_some([piece.source.name for piece in between])
        notes.append(
            f"{names}: begin between two samples of the grid of {pieces[0].source.name}; their "
            "samples were put on the nearest ones, "
            f"at most {largest:.2g} of a sample ({format_measured_duration(largest / rate)}) away"
        )
    deviating = [piece for piece in pieces if piece.source.rate != rate]
    if deviating:
        largest = max(abs(piece.source.rate / rate - 1) for piece in deviating)
        notes.append(
            f"{list_some([piece.source.name for piece in deviating])}: the sampling rate is up to "
            f"{1e6 * largest:.3g} parts per million from the "
            f"{rate:.10g} Hz of {pieces[0].source.name}; each sample was put on the nearest one "
            "of its grid"
        )
    return notes


def _overlap_note(piece: PlacedLog, held: PlacedLog, match: Match, rate: float) -> str:
    name, holder = piece.source.name, held.source.name
    first, end = max(piece.first, held.first), min(piece.end, held.end)
    if not match.alike:
        difference = "hold other values" if match.common else "are missing in one of them"
        return (
            f"{name}: {max(end - first, 0)} samples lie on samples of {holder} and {difference}; "
            f"those of {holder} are kept where it has them"
        )
    begin = format_stamp(int(grid_times(*held.clock[:1], rate, first - held.clock[1])))
    extent = (
        "all of it is"
        if end >= piece.end
        else f"{format_measured_duration((end - first) / rate)} from {begin} are"
    )
    differ = (
        f"; {match.common - match.same} of {match.common} compared samples differ"
        if match.same < match.common
        else ""
    )
    return (
        f"{name}: {extent} in {holder} too, and counted once{differ}; the samples of {holder} "
        "are kept where it has them"
    )


#: Samples that are compared at each end of an overlap.
COMPARED_SAMPLES = 2**13

#: Smallest share of equal samples in a copy, which may be damaged; below the second share at one
#: end, the other end is not compared.
_MIN_ALIKE_SHARE, _MIN_HOPEFUL_SHARE = 0.9, 0.5
#: Largest ratio of the difference of equal samples to the median one of neighbours: files may be
#: rounded differently. Independent noise is that near in 5 % of the samples.
_MAX_ROUNDING = 0.1
_PROBED_SAMPLES = 64  # compared samples that are tried at every displacement
_MIN_COMMON_SAMPLES = 32  # common samples needed to find a displacement


@dataclass(frozen=True)
class Match:
    """Samples compared in two files, samples that are equal, and displacement of the later file."""

    common: int
    same: int
    shift: int = 0

    @property
    def alike(self) -> bool:
        """Whether so many equal samples among those in common show a copy."""
        return self.common >= 2 and self.same >= _MIN_ALIKE_SHARE * self.common


def count_alike(held: Floats, new: Floats) -> tuple[Any, Any]:
    """Count samples known in both arrays (axis, ..., sample), and those equal but for rounding."""
    is_known = np.isfinite(held) & np.isfinite(new)
    has_values = is_known.any(axis=0)
    rounding = np.zeros((len(new), *[1] * (new.ndim - 1)))
    if new.shape[-1] > 1:
        steps = np.abs(np.diff(np.nan_to_num(new), axis=-1)).reshape(len(new), -1)
        rounding += _MAX_ROUNDING * np.median(steps, axis=1).reshape(rounding.shape)
    with np.errstate(invalid="ignore"):
        is_near = np.abs(held - new) <= np.maximum(rounding, 1e-6 * np.abs(new))
    same = (is_near | ~is_known).all(axis=0) & has_values
    return has_values.sum(axis=-1), same.sum(axis=-1)


def match_ends(ends: Iterable[tuple[Floats, Floats]]) -> Match:
    """Compare two files at the ends of their overlap.

    `ends` yields the samples (axis, sample) of both files at each end; if those of the earlier file
    have a margin on both sides, the later ones are tried at every displacement in it.
    """
    matches: list[Match] = []
    for held, new in ends:
        match = _find_shift(held, new)
        matches.append(match)
        is_long = match.common >= COMPARED_SAMPLES // 2
        if is_long and match.same < _MIN_HOPEFUL_SHARE * match.common:
            break
    surest = max(matches, key=lambda match: (match.alike, match.same), default=Match(0, 0))
    return Match(
        sum(match.common for match in matches), sum(match.same for match in matches), surest.shift
    )


def _find_shift(held: Floats, new: Floats) -> Match:
    """Compare `new` with `held` at the displacement at which they are alike, or without one."""
    size, margin = new.shape[1], (held.shape[1] - new.shape[1]) // 2
    unshifted = Match(*count_alike(held[:, margin : margin + size], new))
    if margin == 0 or unshifted.alike or unshifted.common < _MIN_COMMON_SAMPLES:
        return unshifted
    probe = np.flatnonzero(np.isfinite(new).any(axis=0))[:_PROBED_SAMPLES]
    shifts = np.array(sorted(range(-margin, margin + 1), key=abs))
    common, same = count_alike(held[:, margin + shifts[:, None] + probe], new[:, None, probe])
    for shift in shifts[
        (common >= _MIN_COMMON_SAMPLES) & (same >= _MIN_ALIKE_SHARE * common)
    ].tolist():
        begin = margin + shift
        shifted = Match(*count_alike(held[:, begin : begin + size], new), shift)
        if shifted.alike and shifted.common >= _MIN_COMMON_SAMPLES:
            return shifted
    return unshifted
