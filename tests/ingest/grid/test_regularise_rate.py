"""Estimate the sampling rate: drift, bursts, coarse clocks, declared rates, recurring losses."""

from __future__ import annotations

from fractions import Fraction
from itertools import product

import numpy as np
import pytest

from gyrostab import davar, fit_noise, open_log, to_netcdf
from gyrostab.allan.judgement import judge_product
from gyrostab.errors import TimeError
from gyrostab.ingest.grid.gaps import gap_table
from gyrostab.ingest.grid.place import place_by_stamp
from gyrostab.ingest.grid.rate import estimate_rate
from gyrostab.ingest.grid.regularise import regularise
from gyrostab.ingest.grid.starting_period import losses_accumulate, sample_stretches
from gyrostab.ingest.uniform import cut_log
from gyrostab.kernels.grid.stamps import NO_STAMP
from gyrostab.time.grid import time_coordinate
from tests.support.raw_rows import START, expected, raw_log, stamps_of
from tests.support.repetitions import first_of


@pytest.mark.parametrize("rate", [300.0, 99.3])
def test_no_drift_over_200_hours(rate):
    """Stretches with one of 64 rows of 200 h, with stamps to the microsecond."""
    last, block = int(200 * 3600 * rate), 1 << 22
    step = 1e9 / rate

    def stamps():
        for begin in range(0, last + 1, block * 8):
            rows = np.arange(begin, min(begin + block // 8, last + 1))
            yield rows, START + np.rint(rows * (step / 1000)).astype(np.int64) * 1000
        yield (
            np.array([last]),
            START + np.rint(np.array([last]) * (step / 1000)).astype(np.int64) * 1000,
        )

    estimate = estimate_rate(stamps, where="long.csv")
    assert estimate.rate == rate
    placement = place_by_stamp(stamps, rate, max_gap=1e9, where="long.csv")
    assert placement.size == last + 1
    assert np.all(placement.runs[:, 0] == placement.runs[:, 1])  # row numbers equal true samples
    exact = START + round(last * Fraction(10**9) / Fraction(repr(rate)))
    end = time_coordinate(placement.start, rate, placement.size)["time"][-1].values.astype(np.int64)
    assert abs(int(end) - exact) <= 1


@pytest.mark.parametrize(
    ("step", "cause"), [(-14.0, "restart"), (-5.0, "clock_step"), (20 * 86400.0, "clock_step")]
)
def test_a_step_of_the_clock_between_bursts_is_one_missing_sample(step, cause):
    n, random = 3000, np.random.default_rng(1)
    begins = np.append(0, np.cumsum(random.integers(2, 40, n)))  # first row of each packet
    begins = begins[begins < n]
    packet = np.searchsorted(begins, np.arange(n), side="right") - 1
    sent = np.append(begins[1:], n)[packet] / 100.0 + random.uniform(0, 0.15, n)[packet]
    arrival = sent + (np.arange(n) - begins[packet]) * random.uniform(5e-5, 3e-4, n)[packet]
    arrival[n // 2 :] += step
    log = regularise(raw_log(START + np.rint(arrival * 1e9).astype(np.int64)))
    assert any("placed by their count" in note for note in log.attrs["notes"])
    assert gap_table(log)[["samples", "cause"]].values.tolist() == [[1, cause]]
    assert np.isfinite(log.rate.values).sum() == n


def test_bursts_are_placed_by_count_and_a_loss_shows_as_a_lasting_delay():
    random = np.random.default_rng(4)
    n, lost = 20_000, 450
    samples = np.arange(n)
    samples[12_000:] += lost
    sent = samples / 100.0
    packet = np.ceil(sent / 0.07)  # one every 70 ms, unpacked row by row
    arrival = (
        packet * 0.07
        + 0.002 * (np.arange(n) - np.searchsorted(packet, packet))
        + random.uniform(0, 0.0005, n)
    )
    log = regularise(raw_log(START + np.rint(arrival * 1e9).astype(np.int64)))
    assert log.attrs["sampling_rate_hz"] == pytest.approx(100.0, rel=1e-6)
    assert any("bursts" in note for note in log.attrs["notes"])
    assert abs(gap_table(log).samples.max() - lost) <= 10
    assert abs(gap_table(log).samples.sum() - lost) <= 10
    present = np.flatnonzero(np.isfinite(log.rate.values[0]))
    assert len(present) == n
    assert np.abs(present - samples).max() <= 10


@pytest.mark.parametrize(
    "readable", [[1, 0], [1, 0, 0, 0], [1, 1, 0], [1, 1, 0, 0], [1, 1, 1, 0, 0]], ids=str
)
@pytest.mark.parametrize("jitter", [0.0, 0.05])
def test_stamps_in_some_rows_of_each_packet_say_the_rate_of_all_rows(readable, jitter):
    n = 4000
    samples = np.arange(n) + jitter * np.random.default_rng(4).normal(size=n)
    stamps = np.where(np.resize(readable, n), stamps_of(samples, 100.0), NO_STAMP)
    log = regularise(raw_log(stamps))
    assert log.attrs["sampling_rate_hz"] == pytest.approx(100.0, rel=1e-5)
    present = np.isfinite(log.rate.values[0])
    assert present.all()
    assert n - 3 <= present.size <= n  # the last rows have no stamp
    assert abs(log.time.values[0].astype(np.int64) - stamps[0]) <= 5_000_000
    assert "rate_changes" not in log.attrs
    assert not any("Hz" in note for note in log.attrs["notes"])


def test_short_log_with_rows_without_a_number_has_the_rate_of_its_rows():
    random = np.random.default_rng(1)
    for n in (60, 150, 300, 500):
        for share in (0.2, 0.3, 0.4):
            values = np.where(random.random(n) < share, np.nan, np.arange(n) + 1.0)
            present = np.flatnonzero(np.isfinite(values))
            stamps = stamps_of(np.arange(n), 100.0)
            stamps[present[-1] + 1 :] = NO_STAMP
            log = regularise(raw_log(stamps, values))
            assert log.attrs["sampling_rate_hz"] == 100.0
            inside = values[present[0] : present[-1] + 1]
            assert np.array_equal(log.rate.values[0], inside, equal_nan=True)


@pytest.mark.parametrize("period", [2, 10])
def test_rows_without_a_number_between_all_others_do_not_count(period):
    values = np.where(np.arange(300) % period, np.nan, np.arange(300) + 1.0)
    log = regularise(raw_log(stamps_of(np.arange(300), 100.0), values))
    assert log.attrs["sampling_rate_hz"] == 100.0 / period


@pytest.mark.parametrize("share", first_of(0.2, 0.05))
@pytest.mark.parametrize("clock", ["bursts", "tenths", "jitter"])
def test_rows_without_a_readable_stamp_count(clock, share):
    """They are present samples, so that neither the rate nor a loss depends on their number."""
    random = np.random.default_rng(4)
    n, lost = 40_000, 3000
    samples = np.arange(n) + lost * (np.arange(n) >= n // 2)
    sent = samples / 100.0
    packet = np.ceil(sent / 0.07)
    stamps = {
        "bursts": packet * 0.07
        + 0.002 * (np.arange(n) - np.searchsorted(packet, packet))
        + random.uniform(0, 0.0005, n),
        "tenths": np.floor(sent * 10) / 10,
        "jitter": sent + random.normal(0, 0.005, n),
    }[clock]
    readable = START + np.rint(stamps * 1e9).astype(np.int64)
    log = regularise(raw_log(np.where(random.random(n) < share, NO_STAMP, readable)))
    assert log.attrs["sampling_rate_hz"] == 100.0
    present = np.flatnonzero(np.isfinite(log.rate.values[0]))
    rows = log.rate.values[0, present].astype(int) - 1
    assert len(rows) >= n - 1
    far = np.abs(present - present[0] - samples[rows]) > 10
    assert far.sum() <= 5  # next to the loss


def test_whole_seconds_shared_by_many_rows_are_not_duplicates():
    samples = np.arange(60_000)
    stamps = START + (samples / 99.3 // 1 * 1e9).astype(np.int64)
    log = regularise(raw_log(stamps))
    assert log.attrs["sampling_rate_hz"] == 99.3
    np.testing.assert_array_equal(log.rate.values[0], samples + 1.0)
    assert abs((log.time.values[0] - np.datetime64(START, "ns")) / np.timedelta64(1, "ms")) < 11


@pytest.mark.parametrize(("first", "pause"), [(0, 200), (3, 200), (5, 200), (9, 200), (0, 10)])
def test_log_that_begins_between_two_changes_of_a_shared_stamp_has_no_gap(first, pause):
    count = np.arange(first, first + 5000)
    samples = np.where(count < pause, count, count + 1000)
    log = regularise(raw_log(stamps_of(samples // 10, 10.0)))
    assert log.attrs["sampling_rate_hz"] == 100.0
    assert np.array_equal(log.rate.values[0], expected(samples - first), equal_nan=True)


def test_declared_rate_without_time():
    raw = raw_log(None, np.arange(6.0), temperature=[20.0, np.nan, np.nan, np.nan, 21.0, np.nan])
    raw.attrs |= {"declared_rate_hz": 2.0, "start": "2026-03-11T11:00:00"}
    log = regularise(raw)
    assert log.time.values[-1] == np.datetime64("2026-03-11T11:00:02.5")
    np.testing.assert_array_equal(
        log.time_temperature.values,
        np.array(["2026-03-11T11:00:00", "2026-03-11T11:00:02"], "datetime64[ns]"),
    )
    np.testing.assert_array_equal(log.temperature.values, [20.0, 21.0])
    with pytest.raises(TimeError, match="--rate"):
        regularise(raw.assign_attrs(declared_rate_hz=None))


def test_wrong_declared_rate_is_an_error_with_both_figures():
    raw = raw_log(stamps_of(np.arange(500), 100.0))
    assert regularise(raw, rate=100.0).attrs["sampling_rate_hz"] == 100.0
    with pytest.raises(TimeError, match=r"tool\.csv: .*200 Hz.*100 Hz.*--rate"):
        regularise(raw, rate=200.0)


def test_stretch_at_another_rate_is_noted():
    log = regularise(raw_log(stamps_of(np.r_[0:9000, 9000 + np.arange(4000) * 1.25], 100.0)))
    assert log.attrs["sampling_rate_hz"] == pytest.approx(100.0, rel=1e-4)
    (note,) = [note for note in log.attrs["notes"] if "split the log" in note]
    assert "80 Hz" in note
    assert abs(log.sizes["time"] - 9000 - 3999 * 1.25) < 3


def test_change_of_the_rate_by_one_percent_is_noted():
    steps = np.repeat([1 / 100, 1 / 101], 10_240)
    log = regularise(raw_log(stamps_of(np.cumsum(steps), 1.0)))
    notes = [note for note in log.attrs["notes"] if "split the log" in note]
    assert ["at 100 Hz" in notes[0], "(row 10240)" in notes[1], "at 101 Hz" in notes[1]] == [
        True
    ] * 3
    assert "rate_changes" not in log.attrs  # too small to change N


@pytest.mark.parametrize(("deviation", "is_noted"), [(0.0, False), (0.001, False), (0.01, True)])
def test_rate_that_wanders_has_one_note(deviation, is_noted):
    wave = 1 + deviation * np.sin(np.arange(40_000) / 40_000 * 2 * np.pi)
    jitter = 0.0005 * np.random.default_rng(1).standard_normal(40_000)
    log = regularise(raw_log(stamps_of(np.cumsum(0.01 * wave) + jitter, 1.0)))
    notes = [note for note in log.attrs["notes"] if "at these rows" in note or "wanders" in note]
    assert len(notes) == is_noted
    assert all("wanders from 99." in note for note in notes)


def test_three_rows_are_enough():
    log = regularise(raw_log(stamps_of([0, 1, 5], 10.0)))
    assert log.attrs["sampling_rate_hz"] == 10.0
    np.testing.assert_array_equal(log.rate.values[0], [1, 2, np.nan, np.nan, np.nan, 3])


def test_arrival_at_random_times_loses_no_row():
    stamps = START + np.rint(
        np.sort(np.random.default_rng(0).uniform(0, 100, 10_000)) * 1e9
    ).astype(np.int64)
    log = regularise(raw_log(stamps))
    assert log.attrs["sampling_rate_hz"] == pytest.approx(100.0, rel=0.02)
    assert np.isfinite(log.rate.values).sum() == 10_000


@pytest.mark.parametrize(
    ("rate", "n"),
    [(700.0, 2000), (700.0, 50_000), pytest.param(300.0, 50_000, marks=pytest.mark.full)],
)
def test_stamps_coarser_than_the_jitter_of_a_sample(rate, n):
    """At 700 Hz in whole milliseconds the steps are 1 ms and 2 ms; neither is the period."""
    keep = np.random.default_rng(1).random(n) > 0.03
    keep[:50] = True
    samples = np.flatnonzero(keep)
    log = regularise(raw_log(START + np.floor(samples * 1e3 / rate).astype(np.int64) * 1_000_000))
    assert log.attrs["sampling_rate_hz"] == pytest.approx(rate, rel=1e-4 if n < 10_000 else 1e-6)
    assert np.isfinite(log.rate.values).sum() > 0.98 * len(samples)
    assert abs(log.sizes["time"] - 1 - samples[-1]) <= 1


@pytest.mark.parametrize(
    "pattern", [[1, 1, 1, 0, 0], [1, 0, 1, 1, 0], [1, 1, 0], [1, 1, 0, 0, 0, 0, 0]]
)
@pytest.mark.parametrize("rate", first_of(248.7, 100.0, 300.0))
@pytest.mark.parametrize("jitter", [0.0, 0.03])
def test_rows_missing_in_a_fixed_pattern_leave_the_declared_grid(pattern, rate, jitter):
    samples = np.flatnonzero(np.resize(pattern, 6000))
    stamps = stamps_of(
        samples + np.random.default_rng(3).uniform(-jitter, jitter, len(samples)), rate
    )
    log = regularise(raw_log(stamps), rate=rate)
    assert log.attrs["sampling_rate_hz"] == rate
    assert np.array_equal(log.rate.values[0], expected(samples), equal_nan=True)


@pytest.mark.parametrize("pattern", [[1, 1, 1, 0, 0], [1, 1, 0, 0], [1, 1, 1, 0, 1, 1, 0, 0]])
@pytest.mark.parametrize("rate", [10.0, 248.7])
@pytest.mark.parametrize("jitter", [0.0, 0.03])
def test_recurring_steps_give_the_rate_of_the_unit_step_and_a_note_on_the_other(
    pattern, rate, jitter
):
    samples = np.flatnonzero(np.resize(pattern, 6000))
    samples = samples[
        (np.arange(samples.size) < 40) | (np.random.default_rng(5).random(samples.size) > 0.002)
    ]  # a few further losses
    stamps = stamps_of(
        samples + np.random.default_rng(3).uniform(-jitter, jitter, len(samples)), rate
    )
    log = regularise(raw_log(stamps))
    assert log.attrs["sampling_rate_hz"] == pytest.approx(rate, rel=1e-6)
    assert np.array_equal(log.rate.values[0], expected(samples), equal_nan=True)
    (note,) = (note for note in log.attrs["notes"] if "recur" in note)
    even = float(note.split("give --rate ")[1])
    assert even == pytest.approx(rate * np.mean(pattern), rel=0.01)
    log = regularise(raw_log(stamps), rate=even)  # as if rows were read in groups
    assert log.attrs["sampling_rate_hz"] == even
    assert np.isfinite(log.rate.values).sum() >= 0.995 * len(samples)
    assert not any("recur" in note for note in log.attrs["notes"])


@pytest.mark.parametrize(
    ("rows", "kind"), [*product([2, 4, 10], ["even", "uneven"]), (10, "jitter")]
)
def test_rows_in_packets_are_counted_if_uneven_and_noted_if_even(rows, kind):
    random = np.random.default_rng(2)
    count = np.arange(6000)
    inside = (count % rows) * 1e-4  # after the first row of a packet [s]
    if kind == "jitter":
        inside += random.normal(0.0, 2e-5, count.size)
    if kind == "uneven":
        steps = np.where(count % rows, random.exponential(5e-5, count.size) + 1e-5, 0.0)
        inside = np.concatenate([np.cumsum(part) for part in np.split(steps, count.size // rows)])
    arrival = random.exponential(0.005, count.size // rows).repeat(rows)
    stamps = stamps_of((count // rows * rows / 100.0 + arrival + inside) * 1e6, 1e6)
    log = regularise(raw_log(stamps))
    if kind != "even":
        assert log.attrs["sampling_rate_hz"] == pytest.approx(100.0, rel=0.001)
        assert log.sizes["time"] == pytest.approx(count.size, rel=0.001)
    else:
        (note,) = (note for note in log.attrs["notes"] if "packets" in note)
        assert float(note.split("give --rate ")[1]) == pytest.approx(100.0, rel=0.01)
    log = regularise(raw_log(stamps), rate=100.0)
    assert log.attrs["sampling_rate_hz"] == 100.0
    assert np.isfinite(log.rate.values).sum() >= 0.99 * count.size


@pytest.mark.parametrize(
    "stamps",
    [
        START
        + np.floor(np.arange(6000) * 1e3 / 700.0).astype(np.int64)
        * 1_000_000,  # 700 Hz, written to the millisecond
        START + np.floor(np.arange(6000) * 1e3 / 60.0).astype(np.int64) * 1_000_000,
        stamps_of(
            np.flatnonzero(np.random.default_rng(7).random(6000) > 0.4), 100.0
        ),  # two of five lost, at random
    ],
)
def test_even_samples_have_no_recurring_steps(stamps):
    notes = " ".join(regularise(raw_log(stamps)).attrs["notes"])
    assert "recur" not in notes
    assert "as if rows" not in notes


@pytest.mark.parametrize(
    ("samples", "rate", "even"),
    [
        # each on time, or late by 0.1 s
        (2 * np.arange(6000) + np.random.default_rng(6).integers(0, 2, 6000), 10.0, 5.0),
        # even for a clock that ticks twice in three samples
        (np.flatnonzero(np.resize([1, 1, 0], 6000)), 150.0, 100.0),
        # one in five lost, with jitter
        (
            np.flatnonzero(np.resize([1, 1, 1, 1, 0], 6000))
            + np.random.default_rng(8).normal(0.0, 0.1, 4800),
            50.0,
            40.0,
        ),
    ],
)
def test_even_samples_that_may_be_a_finer_grid_with_losses_are_noted(samples, rate, even):
    log = regularise(raw_log(stamps_of(samples, rate)))
    assert log.attrs["sampling_rate_hz"] == pytest.approx(even, rel=1e-6)
    (note,) = (note for note in log.attrs["notes"] if "as if rows" in note)
    assert note.endswith(f"give --rate {rate:g}")
    log = regularise(raw_log(stamps_of(samples, rate)), rate=rate)
    assert log.sizes["time"] == pytest.approx(np.ptp(samples) + 1, abs=1)


def lose_samples(kind, share, rows, random):
    """Return the samples that are left of `rows`: single losses, or bursts of 20 on average."""
    if kind == "single":
        return np.flatnonzero(random.random(rows) >= share)
    begins = np.cumsum(random.geometric(1 / 20, (rows, 2)) * [(1 - share) / share, 1], dtype=int)
    pairs = np.diff(begins.ravel(), prepend=0)
    return np.flatnonzero(np.repeat(np.arange(pairs.size) % 2 == 0, pairs)[:rows])


@pytest.mark.parametrize(
    ("kind", "share", "jitter", "unit"),
    [
        pytest.param("single", 0.5, 0.2, 1, marks=pytest.mark.full),
        ("single", 0.6, 0.2, 1000),
        ("single", 0.8, 0.1, 1000),
        pytest.param("single", 0.3, 0.3, 100_000, marks=pytest.mark.slow),
        ("bursts", 0.8, 0.2, 1_000_000),
        ("bursts", 0.4, 0.3, 1_000_000),
    ],
)
def test_random_losses_with_jitter_do_not_change_the_rate(kind, share, jitter, unit):
    random = np.random.default_rng(9)
    samples = lose_samples(kind, share, 10_000, random)
    stamps = stamps_of(samples + random.normal(0.0, jitter, samples.size), 400.0)
    log = regularise(raw_log(stamps // unit * unit))
    assert log.attrs["sampling_rate_hz"] == pytest.approx(400.0, rel=1e-5)
    assert abs(log.sizes["time"] - np.ptp(samples) - 1) <= 1


@pytest.mark.parametrize("share", [0.3, 0.7])
@pytest.mark.parametrize("rows", [600, 2000])
def test_losses_accumulate_and_pauses_between_packets_do_not(share, rows):
    for seed in range(20):
        random = np.random.default_rng(seed)
        samples = lose_samples("single", share, round(rows / (1 - share)), random)
        stamps = stamps_of(samples + random.normal(0.0, 0.2, samples.size), 100.0)
        assert losses_accumulate([stamps])
        arrival = random.exponential(0.5, rows // 10) + 10.0 * np.arange(rows // 10)  # [samples]
        inside = np.sort(random.uniform(0.0, 0.05, (rows // 10, 10)), axis=1)
        assert not losses_accumulate([stamps_of((arrival[:, None] + inside).ravel(), 100.0)])


def test_rows_lost_among_shared_stamps_make_no_rows_of_the_tick():
    random = np.random.default_rng(3)
    samples = lose_samples("single", 0.4, 2000, random)
    stamps = stamps_of(samples, 400.0) // 10_000_000 * 10_000_000
    log = regularise(raw_log(stamps))
    assert log.attrs["sampling_rate_hz"] == pytest.approx(240.0, rel=0.05)
    assert any("may be higher: give it with --rate" in note for note in log.attrs["notes"])
    log = regularise(raw_log(stamps), rate=400.0)
    assert log.sizes["time"] == pytest.approx(2000, abs=3)


@pytest.mark.parametrize("rows", first_of(1000, 5000))
@pytest.mark.parametrize("share", [0.1, 0.2, 0.3])
@pytest.mark.parametrize("group", [4, 5])
@pytest.mark.parametrize("period_ms", [1, 4, 10])
def test_even_stamps_and_then_shared_ones(
    rows: int, share: float, group: int, period_ms: int
) -> None:
    """A logger falls behind: even stamps, then groups with one stamp, at a constant rate."""
    even = round(rows * (1 - share))
    shared = even - 1 + group * (1 + np.arange(rows - even) // group)
    stamps = np.concatenate([np.arange(even), shared]) * period_ms * 1_000_000
    estimate = estimate_rate(lambda: iter([(np.arange(rows), stamps)]), where="tool.csv")
    assert estimate.rate == pytest.approx(1000 / period_ms, rel=2e-3)


@pytest.mark.parametrize(
    "rates",
    [
        (10.0, 50.0),
        pytest.param((10.0, 1.0), marks=pytest.mark.full),
        pytest.param((100.0, 80.0), marks=pytest.mark.full),
    ],
)
def test_noise_is_not_judged_across_a_change_of_the_rate(rates, tmp_path):
    steps = np.repeat([1e9 / rate for rate in rates], 4000)
    stamps = START + np.rint(np.cumsum(steps)).astype(np.int64)
    raw = raw_log(stamps)
    raw["rate"] = raw["rate"].copy(data=np.random.default_rng(1).standard_normal((1, 8000)))
    log = regularise(raw)
    path = tmp_path / "log.nc"
    to_netcdf(log, path)
    for record in (log, open_log(path)):
        judgement = judge_product(fit_noise(davar(record, window="60s", step="30s")))[0]
        assert "N cannot be judged: from " in judgement
        assert "split the log there" in judgement
    begin, end = map(np.datetime64, log.attrs["rate_changes"])
    is_slow_first = rates[0] < rates[1]
    assert log.attrs["sampling_rate_hz"] == pytest.approx(max(rates), rel=1e-4)
    assert abs((end if is_slow_first else begin) - stamps[4000].astype("datetime64[ns]")) < (
        2000 * np.timedelta64(int(max(steps)), "ns")
    )
    margin = np.timedelta64(10, "s")
    usual = {"time_from": end + margin} if is_slow_first else {"time_to": begin - margin}
    part = cut_log(log, **{side: str(time) for side, time in usual.items()})
    judgement = judge_product(fit_noise(davar(part, window="10s", step="5s")))[0]
    assert "N cannot be judged" not in judgement


def test_sampled_stretches_are_spread_evenly_over_a_long_log():
    blocks = [np.full(1 << 18, number) for number in range(60)]
    stretches = sample_stretches(lambda: ((block, block) for block in blocks))
    counts = np.bincount([stretch[0] for stretch in stretches], minlength=60)
    assert 64 <= len(stretches) <= 128
    assert counts.max() - counts.min() <= 1


@pytest.mark.parametrize("delay_ms", [-4.5, 3.0])
def test_a_late_first_stamp_does_not_move_the_others(delay_ms):
    stamps = stamps_of(np.arange(500), 100.0)
    stamps[0] += int(delay_ms * 1e6)
    log = regularise(raw_log(stamps))
    np.testing.assert_array_equal(log.time.values[1:].astype(np.int64), stamps[1:])


@pytest.mark.parametrize("rate", [300.0, 400.0, 99.3])
@pytest.mark.parametrize("phase", [0.0, 0.3, 0.45, 0.8])
def test_the_first_stamp_in_milliseconds_stays_as_written(rate, phase):
    stamps = stamps_of(np.arange(500) + phase, rate) // 1_000_000 * 1_000_000
    log = regularise(raw_log(stamps))
    assert log.time.values[0].astype(np.int64) == stamps[0]
