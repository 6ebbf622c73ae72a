"""Clock steps, restarts, and repeated rows."""

from __future__ import annotations

import numpy as np
import pytest

from gyrostab.ingest.columns.stamps import read_stamps
from gyrostab.ingest.grid.gaps import gap_table
from gyrostab.ingest.grid.regularise import regularise
from tests.support.raw_rows import START, raw_log, regularise_in_parts, stamps_of


def test_long_step_is_a_step_of_the_clock_unless_allowed():
    raw = raw_log(stamps_of(np.r_[0:300, 100_000_000:100_000_300], 100.0))
    log = regularise(raw)
    assert log.sizes["time"] == 601
    assert gap_table(log).cause.tolist() == ["clock_step"]
    assert any("raise max_gap" in note for note in log.attrs["notes"])
    assert regularise(raw, max_gap="20D").sizes["time"] == 100_000_300


def test_clock_set_back_in_the_middle():
    log = regularise(raw_log(stamps_of(np.r_[0:9000, 8500:12_000], 100.0)))
    assert gap_table(log).cause.tolist() == ["clock_step"]
    np.testing.assert_array_equal(log.rate.values[0], np.r_[1:9001, np.nan, 9001:12_501])


REPEATED = {
    "at once": np.r_[0:3000, 2000:3000, 3000:6000],
    "much later": np.r_[0:5000, 1000:2500, 5000:6000],
    "at the end": np.r_[0:6000, 4500:6000],
    "as a whole": np.r_[0:6000, 0:6000],
    "three times": np.r_[0:3000, 2000:3000, 2000:3000, 3000:6000],
    "two stretches": np.r_[0:2000, 1500:2000, 2000:4000, 2500:4000, 4000:6000],
}


@pytest.mark.parametrize("rows", REPEATED.values(), ids=REPEATED)
@pytest.mark.parametrize("block", [64, 1 << 20])
def test_repeated_rows_are_duplicates(rows, block):
    samples = np.r_[0:1200, 1300:3100, 3101:6101]  # with gaps, which the repetitions have too
    values = np.random.default_rng(1).standard_normal(6000)
    raw = raw_log(stamps_of(samples, 300.0)[rows], values[rows])
    log = regularise_in_parts(raw, block=block)
    once = regularise(raw_log(stamps_of(samples, 300.0), values))
    assert np.array_equal(log.rate.values, once.rate.values, equal_nan=True)
    assert np.array_equal(log.time.values, once.time.values)
    table = gap_table(log)
    twice = table[table.cause == "duplicate"]
    assert twice.rows.sum() == len(rows) - 6000
    assert set(table.cause) == {"missing", "duplicate"}
    first = samples[rows[np.flatnonzero(np.diff(rows) < 0)[0] + 1]]
    assert (
        first
        in np.rint((twice.start - once.time.values[0]) / np.timedelta64(1, "ns") * 300e-9)
        .astype(int)
        .tolist()
    )
    assert any(
        f"because another row holds their sample: {len(rows) - 6000} rows" in note
        for note in log.attrs["notes"]
    )


def test_damaged_copy_is_recognised():
    values = np.random.default_rng(1).standard_normal(6000)
    rows = REPEATED["at once"]
    copied = values[rows]
    copied[3100:3150], copied[3200:3220] = np.nan, 7.0
    log = regularise(raw_log(stamps_of(np.arange(6000), 300.0)[rows], copied))
    assert np.array_equal(log.rate.values[0], values)


@pytest.mark.parametrize(
    "values",
    [np.random.default_rng(2).standard_normal(9000), np.zeros(9000)],
    ids=["other values", "values that never change"],
)
def test_restarted_clock_is_not_a_repetition(values):
    log = regularise(raw_log(stamps_of(np.r_[0:6000, 0:3000], 300.0), values))
    assert log.sizes["time"] == 9001
    assert gap_table(log).cause.tolist() == ["restart"]


def test_few_rows_are_compared_at_each_of_many_restarts(monkeypatch):
    rows_read = []

    def count_rows(raw, begin, end):
        rows_read.append(end - begin)
        return read_stamps(raw, begin, end)

    monkeypatch.setattr("gyrostab.ingest.grid.place_rows.read_stamps", count_rows)
    n = 20_000
    values = np.random.default_rng(0).standard_normal(n)
    log = regularise(raw_log(START + np.arange(n) % 100 * 10_000_000, values))
    assert (gap_table(log).cause == "restart").sum() == n // 100 - 1
    assert sum(rows_read) < 100 * n


WRITTEN_TWICE = {
    "every row": np.repeat(np.arange(1000), 2),
    "every tenth row": np.repeat(np.arange(1000), 1 + (np.arange(1000) % 10 == 0)),
    "a stretch, sorted": np.sort(np.r_[0:1000, 400:600]),
    "three times": np.repeat(np.arange(1000), 3),
    "and a stretch again": np.repeat(np.r_[0:600, 400:1000], 2),
}


@pytest.mark.parametrize("rows", WRITTEN_TWICE.values(), ids=WRITTEN_TWICE)
@pytest.mark.parametrize("block", [64, 1 << 20])
def test_rows_written_twice_are_duplicates(rows, block):
    samples = np.r_[0:700, 750:1050]
    values = np.round(np.random.default_rng(1).standard_normal((2, 1000)), 3)
    values[1, 300:310] = np.nan
    once = regularise(raw_log(stamps_of(samples, 10.0), values))
    raw = raw_log(stamps_of(samples[rows], 10.0), values[:, rows])
    for rate in (None, 10.0):
        log = regularise_in_parts(raw, block=block, rate=rate)
        assert log.attrs["sampling_rate_hz"] == 10.0
        assert np.array_equal(log.rate.values, once.rate.values, equal_nan=True)
        assert np.array_equal(log.time.values, once.time.values)
        table = gap_table(log)
        twice = table[table.cause == "duplicate"]
        assert twice.rows.sum() == len(rows) - 1000
        first = samples[rows[np.flatnonzero(np.diff(rows) == 0)[0]]]
        assert twice.start.min() == log.time.values[first]
        assert not any("Hz" in note for note in log.attrs["notes"])


@pytest.mark.parametrize("digits", [3, 0, -9], ids=["values change", "coarse", "constant"])
def test_rows_of_a_coarse_clock_are_not_duplicates(digits):
    values = np.round(np.random.default_rng(1).standard_normal(3000), digits)
    stamps = START + np.arange(3000) // 10 * 1_000_000_000
    log = regularise(raw_log(stamps, values))
    assert log.attrs["sampling_rate_hz"] == 10.0
    assert np.array_equal(log.rate.values[0], values)
