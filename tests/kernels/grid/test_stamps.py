"""The placement kernel against the samples from which the stamps were made."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from gyrostab.kernels.grid import stamps as kernel
from gyrostab.kernels.grid.stamps import DUPLICATE, NO_STAMP, OUT_OF_ORDER, RESTART, STEP

PERIOD = 10_000_000.0


def place(samples, *, max_gap=1e9, hold=0.75, pieces=None):
    """Place rows with stamps at `samples` (may be fractions; None: no stamp): runs and events."""
    stamps = np.array(
        [NO_STAMP if s is None else round(s * PERIOD) for s in samples], dtype=np.int64
    )
    rows = np.arange(len(stamps))
    state, ring = kernel.new_state()
    runs, events = [], []
    for a, b in pairwise([0, *(pieces or []), len(rows)]):
        end = min(len(rows), b + kernel.LOOK_AHEAD)
        run, event = kernel.place(
            rows[a:end], stamps[a:end], b - a, PERIOD, hold, max_gap, state, ring
        )
        runs.append(run)
        events.append(event)
    runs.append(state[kernel.OPEN_RUN][None])
    placed = np.full(len(rows), -1)
    for sample, row, length in np.concatenate(runs):
        placed[row : row + length] = np.arange(sample, sample + length)
    return placed.tolist(), np.concatenate(events)


def test_unbroken_rows_are_one_run():
    assert place(range(1000))[0] == list(range(1000))


def test_missing_samples_are_left_out():
    samples = [0, 1, 2, 6, 7, 8, 20, 21, 22, 23]
    assert place(samples)[0] == samples


def test_first_of_two_rows_of_one_sample_is_kept():
    placed, events = place([0, 1, 2, 2, 3, 4])
    assert placed == [0, 1, 2, -1, 3, 4]
    assert events[:, [0, 1, 2]].tolist() == [[DUPLICATE, 2, 3]]


def test_out_of_order_row_takes_its_free_sample():
    placed, events = place([0, 1, 2, 4, 3, 5, 6])
    assert placed == [0, 1, 2, 4, 3, 5, 6]
    assert events[:, [0, 1, 2]].tolist() == [[OUT_OF_ORDER, 3, 4]]


def test_late_row_is_placed_in_a_log_longer_than_the_memory_of_the_kernel():
    samples = np.sort(np.random.default_rng(5).choice(50_000, 49_900, replace=False))
    samples -= samples[0]
    samples[30_000:30_006] = samples[[*range(30_001, 30_006), 30_000]]
    assert samples[124] - samples[122] == 2
    placed, events = place([None if row == 123 else s for row, s in enumerate(samples)])
    assert placed == samples.tolist()
    assert events[:, [0, 1, 2]].tolist() == [[OUT_OF_ORDER, samples[30_005], 30_005]]


def test_out_of_order_row_without_a_free_sample_is_dropped():
    placed, events = place([0, 1, 2, 3, 1, 4, 5])
    assert placed == [0, 1, 2, 3, -1, 4, 5]
    assert events[:, [0, 2]].tolist() == [[OUT_OF_ORDER, 4]]


def test_one_damaged_stamp_does_not_move_its_row():
    assert place([0, 1, 2, 9e5, 4, 5, 6])[0] == list(range(7))
    assert place([500, 501, 502, 3, 504, 505, 506])[0] == list(range(7))


@pytest.mark.parametrize("pieces", [[], [21], [25]])
@pytest.mark.parametrize("apart", [1, 2, 3, 5, 16])
def test_two_exchanged_rows_take_their_samples(apart, pieces):
    samples = np.arange(60)
    samples[[20, 20 + apart]] = samples[[20 + apart, 20]]
    placed, events = place(samples, pieces=pieces)
    assert placed == samples.tolist()
    assert events[:, 0].tolist() == [OUT_OF_ORDER] * apart
    if apart > 1:  # a stray stamp alone does not move its row
        samples[20 + apart] = 20 + apart
        assert place(samples)[0] == list(range(60))


def test_one_late_stamp_does_not_move_its_row():
    assert place([0, 1, 2, 3.9, 4, 5, 6, 7])[0] == list(range(8))


def test_rows_without_stamp_are_kept_where_they_fit_exactly():
    assert place([0, 1, None, None, 4, 5])[0] == [0, 1, 2, 3, 4, 5]
    assert place([0, 1, None, None, 5, 6])[0] == [0, 1, -1, -1, 5, 6]
    assert place([None, 0, 1, 2, None])[0] == [-1, 0, 1, 2, -1]


@pytest.mark.parametrize(("restart", "cause"), [(0, RESTART), (30, RESTART), (75, STEP)])
def test_time_set_back_appends_after_one_missing_sample(restart, cause):
    placed, events = place([*range(100), *range(restart, restart + 50)], hold=0.75)
    assert placed == [*range(100), *range(101, 151)]
    assert events.tolist() == [[cause, 100, 100, round(99 * PERIOD), round(restart * PERIOD)]]


def test_long_step_ahead_is_a_step_of_the_clock():
    placed, events = place([0, 1, 2, 1000, 1001, 1002], max_gap=500.0)
    assert placed == [0, 1, 2, 4, 5, 6]
    assert events[0, 0] == STEP
    assert place([0, 1, 2, 1000, 1001, 1002], max_gap=2000.0)[0] == [0, 1, 2, 1000, 1001, 1002]


def test_jitter_of_the_first_stamp_does_not_shift_the_log():
    random = np.random.default_rng(3)
    samples = np.flatnonzero(random.random(3000) > 0.1)
    samples -= samples[0]
    jitter = random.uniform(-0.2, 0.2, len(samples))
    jitter[0] = 0.2
    assert place((samples + jitter).tolist())[0] == samples.tolist()


def test_result_does_not_depend_on_blocks():
    random = np.random.default_rng(7)
    samples = np.sort(random.choice(4000, 3000, replace=False)).astype(float)
    samples += random.uniform(-0.2, 0.2, len(samples))
    swap = np.arange(100, 2900, 211)
    samples[swap], samples[swap + 1] = samples[swap + 1], samples[swap]
    values = [None if i % 97 == 5 else s for i, s in enumerate(samples.tolist())]
    values = [*values, *(s for s in values[:500])]
    whole, events = place(values)
    for cuts in ([1], [700, 701, 702, 1500], list(range(13, 3500, 13))):
        placed, happened = place(values, pieces=cuts)
        assert placed == whole
        assert happened.tolist() == events.tolist()


def test_last_stamp_after_200_hours_at_300_hertz():
    """Rows are 200 h apart in the kernel's arithmetic, so any accumulated error would show."""
    period = 1e9 / 300
    last = 200 * 3600 * 300
    samples = np.concatenate([np.arange(1000), np.arange(last - 1000, last + 1)])
    stamps = np.rint(samples * (1e9 / 300)).astype(np.int64)
    state, ring = kernel.new_state()
    runs, _ = kernel.place(
        np.arange(len(samples)), stamps, len(samples), period, 0.75, 1e12, state, ring
    )
    assert runs.tolist() == [[0, 0, 1000]]
    assert state[kernel.OPEN_RUN].tolist() == [last - 1000, 1000, 1001]


def test_samples_between_stamps_are_rounded_counts():
    rng = np.random.default_rng(4)
    steps = rng.choice([0, 3, 4, 5, 6, 8, 10, 12, 14, 15, 16, 20, 25, 35, -5, -15, 400, -400], 3000)
    stamps = np.cumsum(steps)
    for gain in (
        0.0,
        0.1,
        0.5,
    ):  # without gain the phase stays whole, and many stamps lie between samples
        count, piece, phase = [0], [0], 0.0
        for step in np.diff(stamps).tolist():
            new = abs(step) > 300
            k = 0 if new else round((step + phase) / 10.0)  # half to even
            count.append(0 if new else count[-1] + k)
            piece.append(piece[-1] + new)
            phase = 0.0 if new else (1.0 - gain) * (step + phase - k * 10.0)
        result = kernel.track(stamps, 10.0, gain, 300.0)
        assert result[0].tolist() == count
        assert result[1].tolist() == piece


def test_sample_count_tolerates_jitter_and_a_wrong_period():
    random = np.random.default_rng(1)
    samples = np.flatnonzero(random.random(20_000) > 0.1)
    stamps = np.rint((samples + random.uniform(-0.2, 0.2, len(samples))) * PERIOD).astype(np.int64)
    count, piece = kernel.track(stamps, PERIOD * 1.002, 0.1, 500 * PERIOD)
    assert piece.max() == 0
    assert count[-1] == samples[-1] - samples[0]


@pytest.mark.parametrize("off", [1e-3, -1e-3])
def test_drifting_clock_skips_or_drops_single_samples(off):
    """Jitter of a fifth of a sample must not change the decision back and forth."""
    random = np.random.default_rng(5)
    n = 20_000
    stamps = np.arange(n) * (1 + off) + random.uniform(-0.2, 0.2, n)
    placed, events = place(stamps.tolist())
    rows = np.flatnonzero(np.array(placed) >= 0)
    assert np.abs(np.array(placed)[rows] - stamps[rows]).max() < 1.05
    if off > 0:
        assert len(events) == 0
        assert np.sum(np.diff(placed) == 2) == pytest.approx(n * off, abs=1)
    else:
        assert set(events[:, 0]) == {DUPLICATE}
        assert len(events) == pytest.approx(-n * off, abs=1)
        assert np.all(np.diff(np.array(placed)[rows]) == 1)
