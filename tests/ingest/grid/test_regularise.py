"""Regularise raw rows, compared with known samples and a reference implementation."""

from __future__ import annotations

import sys
import tracemalloc
from fractions import Fraction

import dask.array as da
import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st

from gyrostab.errors import FormatError, OptionError, TimeError
from gyrostab.ingest.grid.gaps import gap_table
from gyrostab.ingest.grid.place import place_by_stamp
from gyrostab.ingest.grid.regularise import regularise, rows_on_grid
from gyrostab.ingest.reading import read_log
from gyrostab.ingest.uniform import as_uniform
from gyrostab.schema import check_log
from tests.support.raw_rows import START, expected, raw_log, regularise_in_parts, stamps_of

RATES = [99.3, 300.0, 1 / 7, 248.7, 100.0021]


def slow_placement(stamps, rate):
    """Place every row at the nearest sample by exact fractions; first rows count."""
    filled, placement = set(), []
    for stamp in stamps.tolist():
        sample = round((stamp - START) * Fraction(rate) / 10**9)
        placement.append(-1 if sample in filled else sample)
        filled.add(sample)
    return placement


@st.composite
def patterns(draw):
    """Return rate, true sample of every row, stamps."""
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    rate = draw(st.sampled_from(RATES))
    n = draw(st.integers(400, 1500))
    keep = random.random(n) >= draw(st.sampled_from([0.0, 0.001, 0.02, 0.1]))
    for _ in range(draw(st.integers(0, 3))):
        at = random.integers(250, n)
        keep[at : at + random.integers(1, 60)] = False
    keep[0] = True
    samples = np.flatnonzero(keep)
    if draw(st.booleans()) and len(samples) > 300:
        samples[random.integers(250, len(samples)) :] += draw(st.integers(1, 300))
    jitter = draw(st.sampled_from([0.0, 0.05, 0.2]))
    position = samples + random.uniform(-jitter, jitter, len(samples))
    position[0] = 0.0
    stamps = stamps_of(position, rate)
    if draw(st.booleans()) and jitter == 0.0 and rate < 301:
        stamps = START + np.rint((stamps - START) / 1e6).astype(np.int64) * 1_000_000
    return rate, samples, stamps, random


@given(patterns())
def test_rows_land_on_their_samples(pattern):
    rate, samples, stamps, _ = pattern
    log = regularise(raw_log(stamps))
    assert abs(log.attrs["sampling_rate_hz"] / rate - 1) * samples[-1] < 0.5
    np.testing.assert_array_equal(log.rate.values[0], expected(samples))
    assert slow_placement(stamps, rate) == samples.tolist()
    holes = gap_table(log)
    assert holes.samples.sum() == samples[-1] + 1 - len(samples)
    check_log(log)


@given(patterns(), st.integers(0, 12), st.integers(0, 6))
def test_doubled_and_swapped_rows(pattern, doubled, swapped):
    rate, samples, stamps, random = pattern
    stamps = stamps.copy()
    # swap neighbours, far from each other and from the doubled rows
    places = 20 + 8 * random.permutation((len(stamps) - 40) // 8)
    order = np.arange(len(stamps))
    for at in places[:swapped]:
        order[at], order[at + 1] = order[at + 1], order[at]
    repeated = places[swapped : swapped + doubled]
    order = np.insert(order, repeated + 1, order[repeated])
    log = regularise(raw_log(stamps[order]))
    truth = samples[order]
    truth[np.sort(repeated) + 1 + np.arange(len(repeated))] = -1
    np.testing.assert_array_equal(log.rate.values[0], expected(truth))
    table = gap_table(log)
    assert table[table.cause == "duplicate"].rows.sum() == len(repeated)
    assert table[table.cause == "out_of_order"].rows.sum() == len(places[:swapped])
    assert slow_placement(stamps[order], rate) == truth.tolist()


@given(patterns(), st.lists(st.integers(40, 400), min_size=1, max_size=3))
def test_restarts_append_after_one_missing_sample(pattern, pieces):
    rate, samples, stamps, _ = pattern
    truth, all_stamps = [samples], [stamps]
    for length in pieces:
        all_stamps.append(stamps_of(np.arange(length) + 1, rate))
        truth.append(truth[-1][-1] + 2 + np.arange(length))
    log = regularise(raw_log(np.concatenate(all_stamps)))
    np.testing.assert_array_equal(log.rate.values[0], expected(np.concatenate(truth)))
    table = gap_table(log)
    restarts = table[table.cause == "restart"]
    assert restarts.samples.tolist() == [1] * len(pieces)
    assert sum("time restarts at row" in note for note in log.attrs["notes"]) == len(pieces)


@given(patterns(), st.integers(64, 700))
def test_block_and_chunk_sizes_do_not_matter(pattern, block):
    _, _, stamps, _ = pattern
    stamps = np.concatenate([stamps, stamps[:200]])
    raw = raw_log(stamps, temperature=np.where(np.arange(len(stamps)) % 7, np.nan, 20.0))
    whole, parts = regularise(raw), regularise_in_parts(raw, block=block, chunk=97)
    for log in (whole, parts):
        del log.attrs["history"]
    xr.testing.assert_identical(whole, parts)


@pytest.mark.parametrize("chunk", [200, 820])
def test_lazy_arrays_equal_those_in_memory(chunk, monkeypatch):
    random = np.random.default_rng(2)
    samples = np.sort(random.choice(8000, 1800, replace=False))
    samples -= samples[0]
    samples[800:] += 10_000
    values = random.normal(size=(2, 1800))
    raw = raw_log(stamps_of(samples, 300.0), values)
    truth = np.full((2, samples[-1] + 1), np.nan)
    truth[:, samples] = values
    monkeypatch.setattr(sys.modules["gyrostab.ingest.grid.regularise"], "MAX_PLAIN_NUMBERS", 10)
    for signal in (values, da.from_array(values, chunks=(1, 247))):
        log = regularise_in_parts(raw.assign(rate=raw.rate.copy(data=signal)), chunk=chunk)
        assert isinstance(log.rate.data, da.Array)
        np.testing.assert_array_equal(log.rate.values, truth)
        np.testing.assert_array_equal(log.rate[:, 8800:12_200].values, truth[:, 8800:12_200])


def test_gap_of_200_hours_takes_almost_no_time_or_memory():
    gap = 200 * 3600 * 400
    raw = raw_log(stamps_of(np.r_[0:5000, gap : gap + 5000], 400.0))
    regularise(raw)  # compiles the kernels
    tracemalloc.start()
    log = regularise(raw)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert log.sizes["time"] == gap + 5000
    assert peak < 8e6
    assert len(log.rate.data.dask) < 2000
    assert np.isnan(log.rate[0, gap // 2 : gap // 2 + 1000].values).all()
    assert log.rate[0, -1].compute().item() == 10_000.0
    assert (
        "200.0 h without samples from 2026-03-11T11:00:12.500 (after row 4999)"
        in log.attrs["notes"][-1]
    )


def test_increments_become_rates():
    log = regularise(
        raw_log(stamps_of([0, 1, 2, 4], 100.0), [1e-6, 2e-6, 3e-6, 4e-6], kind="increment")
    )
    np.testing.assert_allclose(log.rate.values[0], [0.36, 0.72, 1.08, np.nan, 1.44])
    assert log.rate.attrs["units"] == "degree hour-1"
    assert log.attrs["kind"] == "rate"


def test_cumulative_angle_stays_an_angle():
    log = regularise(raw_log(stamps_of([0, 1, 2, 4], 100.0), [1.0, 2.0, 3.0, 4.0], kind="angle"))
    np.testing.assert_array_equal(log.angle.values[0], [1.0, 2.0, 3.0, np.nan, 4.0])
    assert log.attrs["kind"] == "angle"


@pytest.mark.parametrize("seed", range(5))
def test_increments_that_are_read_as_cumulative_angles_get_a_note(seed):
    increments = np.random.default_rng(seed).standard_normal((2, 300)) + 0.2
    increments[0, 7] = np.nan
    stamps = stamps_of(np.arange(300), 100.0)
    note = "if each row is an increment, give --kind rate"
    for values, is_noted in ((increments, True), (np.nancumsum(increments, axis=1), False)):
        log = regularise(raw_log(stamps, values, kind="angle"))
        assert any(note in text for text in log.attrs["notes"]) == is_noted


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("degree_per_second", "noise"), [(15 / 3600, 2e-5), (0.1, 5e-4), (300.0, 1e-3), (-3.0, 0.01)]
)
def test_cumulative_angles_that_are_read_as_increments_get_a_note(degree_per_second, noise, seed):
    random = np.random.default_rng(seed)
    increments = degree_per_second / 100 + noise * random.standard_normal((2, 3000))
    increments[1] = noise * random.standard_normal(3000)  # an axis at rest
    moving = increments + np.sin(np.arange(3000) / 500)
    stamps = stamps_of(np.arange(3000), 100.0)
    note = "they are, give --kind angle"
    for values, is_noted in (
        (increments, False),
        (moving, False),
        (np.cumsum(increments, axis=1) % 360, True),
    ):
        log = regularise(raw_log(stamps, values, kind="increment"))
        assert any(note in text for text in log.attrs["notes"]) == is_noted


def test_unreadable_cells_infinite_values_and_lost_stamps():
    values = np.arange(400.0).reshape(2, 200)
    values[0, 50:53] = np.nan  # one axis
    values[:, 80] = np.nan  # a whole row
    values[1, 120] = np.inf
    stamps = stamps_of(np.arange(200), 100.0)
    stamps[150:152] = np.iinfo(np.int64).min
    log = regularise(raw_log(stamps, values))
    truth = np.where(np.isinf(values), np.nan, values)
    np.testing.assert_array_equal(log.rate.values, truth)
    table = gap_table(log).set_index("start")
    gaps = [
        (round((when.value - START) / 1e7), row.samples, row.cause)
        for when, row in table.iterrows()
    ]
    assert gaps == [(50, 3, "unreadable"), (80, 1, "unreadable"), (120, 1, "outside_range")]
    assert log.attrs["notes"][0] == "read"
    assert any("infinite" in note for note in log.attrs["notes"])


def test_rows_without_any_number_that_count_are_listed():
    values = np.ones((2, 6000))
    values[:, 500:505] = np.nan
    values[1, 505:507] = np.nan
    log = regularise(raw_log(None, values), rate=100.0)
    assert np.isnan(log.rate.values).any(axis=0).sum() == 7
    table = gap_table(log)
    assert set(table.cause) == {"unreadable"}
    assert table.samples.sum() == table.rows.sum() == 7


def test_unreadable_span_that_begins_with_a_dropped_row_is_listed():
    samples = np.r_[0:500, 499:1000]
    values = np.ones((2, len(samples)))
    values[1, 500:700] = np.nan
    log = regularise(raw_log(stamps_of(samples, 100.0), values))
    table = gap_table(log)
    unreadable = table[table.cause == "unreadable"]
    assert unreadable.samples.tolist() == [np.isnan(log.rate.values[1]).sum()] == [199]


def test_late_row_in_its_place_leaves_no_gap():
    samples = np.r_[0:100, 101:140, 100, 140:1000]
    log = regularise(raw_log(stamps_of(samples, 100.0)))
    np.testing.assert_array_equal(log.rate.values[0], expected(samples))
    assert gap_table(log).cause.tolist() == ["out_of_order"]


@pytest.mark.parametrize("lost", [0, 3])
def test_packets_in_the_wrong_order_take_their_places(lost):
    """Also if elsewhere a few rows repeat a stamp and are dropped."""
    samples = np.arange(12_000)
    for begin in range(1000, 10_000, 300):
        samples[begin : begin + 20] = np.roll(samples[begin : begin + 20], 10)
    samples = np.insert(samples, 11_000, samples[10_999 - lost : 10_999])
    log = regularise(raw_log(stamps_of(samples, 50.0)))
    truth = samples.copy()
    truth[11_000 : 11_000 + lost] = -1
    np.testing.assert_array_equal(log.rate.values[0], expected(truth))
    table = gap_table(log)
    assert table[table.cause == "out_of_order"].rows.sum() == 300 + lost
    assert any("300 were put in their place" in note for note in log.attrs["notes"])


def test_channels_on_time_and_slow_channels_on_their_own():
    n = 300
    stamps = np.concatenate([stamps_of(np.arange(n), 100.0), stamps_of(np.arange(n), 100.0)])
    slow = np.full(2 * n, np.nan)
    slow[::50] = np.arange(12.0)
    raw = raw_log(stamps, temperature=slow, vibration=np.arange(2.0 * n))
    other = np.array(["2026-03-11T11:00:01", "2026-03-11T11:00:02"], "datetime64[ns]")
    raw = raw.assign_coords(time_pressure=other).assign(
        pressure=("time_pressure", [1.0, 2.0], {"units": "Pa"})
    )
    log = regularise(raw)
    assert log.vibration.dims == ("time",)
    np.testing.assert_array_equal(log.vibration.values, np.r_[0:n, np.nan, n : 2 * n])
    samples = np.r_[0:n:50, n + 1 : 2 * n + 1 : 50]
    np.testing.assert_array_equal(log.time_temperature.values, log.time.values[samples])
    np.testing.assert_array_equal(log.temperature.values, np.arange(12.0))
    assert log.temperature.attrs["units"] == "degree_Celsius"
    np.testing.assert_array_equal(log.time_pressure.values, other)


def test_rows_with_only_a_slow_channel_are_not_samples():
    samples = np.arange(1000)
    stamps = stamps_of(np.sort(np.r_[samples, samples[5::10] + 0.4]), 100.0)
    other = np.flatnonzero(
        np.isin(
            np.arange(len(stamps)), np.searchsorted(stamps, stamps_of(samples[5::10] + 0.4, 100.0))
        )
    )
    values = np.full(len(stamps), np.nan)
    gyro = np.setdiff1d(np.arange(len(stamps)), other)
    values[gyro] = samples
    temperature = np.full(len(stamps), np.nan)
    temperature[other] = 20.0
    log = regularise(raw_log(stamps, values, temperature=temperature))
    assert log.attrs["sampling_rate_hz"] == 100.0
    np.testing.assert_array_equal(log.rate.values[0], samples)
    np.testing.assert_array_equal(log.time_temperature.values.astype(np.int64), stamps[other])


def test_channel_in_rows_without_a_gyro_value_keeps_its_values():
    n = 600
    other = np.arange(n) % 2 == 1
    values = np.where(other, np.nan, np.arange(n))
    log = regularise(
        raw_log(stamps_of(np.arange(n), 200.0), values, force=np.where(other, np.arange(n), np.nan))
    )
    assert log.attrs["sampling_rate_hz"] == 100.0
    np.testing.assert_array_equal(log.force.values, np.arange(n)[other])
    np.testing.assert_array_equal(
        log.time_force.values.astype(np.int64), stamps_of(np.arange(n)[other], 200.0)
    )


def test_many_gaps_are_merged():
    samples = np.flatnonzero(np.random.default_rng(0).random(90_000) > 0.2)
    samples -= samples[0]
    holes = int((np.diff(samples) > 1).sum())
    log = regularise(raw_log(stamps_of(samples, 100.0)))
    assert holes > 12_000
    assert 9_000 < log.sizes["gap"] <= 10_000
    assert gap_table(log).samples.sum() == samples[-1] + 1 - len(samples)
    note = log.attrs["notes"][-1]
    assert f"in {holes} places" in note
    assert not any("without samples from" in note for note in log.attrs["notes"])


def test_a_long_table_of_gaps_of_several_kinds_is_valid():
    n = 60_000
    values = np.ones((2, n))
    values[:, np.arange(n) % 10 == 3] = np.nan
    values[1, np.arange(n) % 10 == 6] = np.nan
    log = regularise(raw_log(stamps_of(np.arange(n), 100.0), values))
    table = gap_table(log)
    assert len(table) <= 10_000
    assert (table.end > table.start).all()
    assert table.samples.sum() == 12_000
    assert as_uniform(log).sizes["gap"] == len(table)


def test_names_of_several_files():
    raw = raw_log(stamps_of(np.r_[0:500, 1000:1500], 100.0))
    raw.attrs |= {"source_files": ["a.csv", "b.csv"], "row_start": [0, 400]}
    notes = regularise(raw).attrs["notes"]
    assert any(
        note.startswith("b.csv: 5.0 s without samples from 2026-03-11T11:00:05.000 (after row 99)")
        for note in notes
    )


def test_unusable_logs_are_errors():
    with pytest.raises(FormatError, match=r"tool\.csv"):
        regularise(raw_log(stamps_of(np.arange(10), 100.0), np.full(10, np.nan)))
    with pytest.raises(TimeError, match="only one sample"):
        regularise(raw_log(stamps_of([0], 100.0)))
    with pytest.raises(TimeError, match="backwards"):
        regularise(raw_log(stamps_of(np.arange(100)[::-1], 100.0)))
    with pytest.raises(TimeError, match="the same"):
        regularise(raw_log(stamps_of(np.zeros(100), 100.0)))
    with pytest.raises(TimeError):
        regularise(raw_log(np.full(100, np.iinfo(np.int64).min)))
    for wrong in (
        {"rate": -1.0},
        {"max_gap": "soon"},
        {"max_gap": 0},
    ):
        with pytest.raises(OptionError):
            regularise(raw_log(stamps_of(np.arange(10), 100.0)), **wrong)


def test_one_sample_with_a_given_rate_and_a_constant_axis():
    assert regularise(raw_log(stamps_of([0], 100.0)), rate=100.0).sizes["time"] == 1
    log = regularise(raw_log(stamps_of(np.arange(100), 100.0), np.ones(100)))
    assert any("axis x never changes" in note for note in log.attrs["notes"])


def test_a_regular_log_passes_through():
    log = regularise(raw_log(stamps_of(np.arange(10), 100.0)))
    assert regularise(log) is log
    assert regularise(log, rate=100.0) is log
    with pytest.raises(OptionError, match=r"tool.csv is a regular log of 100 Hz, not of 200 Hz"):
        regularise(log, rate=200.0)
    for wrong in ({"max_gap": "soon"}, {"limits": {"rows": 1}}):
        with pytest.raises(OptionError, match=r"soon|rows"):
            regularise(log, **wrong)


def test_arrays_keep_every_bit():
    values = (
        np.random.default_rng(0).normal(size=(3, 1000)) * 10.0 ** np.arange(-200, 100, 100)[:, None]
    )
    log = regularise(raw_log(stamps_of(np.arange(1000) * 2, 50.0), values))
    assert log.rate.values.tobytes() == values.tobytes()


def test_rows_of_a_single_run_are_returned_unchanged():
    placement = place_by_stamp(
        lambda: iter([(np.arange(50), stamps_of(np.arange(50), 10.0))]),
        10.0,
        max_gap=1e9,
        where="x",
    )
    np.testing.assert_array_equal(
        rows_on_grid(np.arange(50.0), placement, chunk=7), np.arange(50.0)
    )


def test_channel_of_another_day_or_zone_is_noted():
    raw = raw_log(stamps_of(np.arange(100), 10.0))
    for hours, says in (
        (0, ""),
        (72, "check its time column"),
        (-5, "about 5 hours early: is one"),
    ):
        stamps = raw.time.values[:5] + np.timedelta64(hours, "h")
        other = raw.assign_coords(time_temperature=("time_temperature", stamps)).assign(
            temperature=("time_temperature", np.full(5, 20.0), {"units": "degree_Celsius"})
        )
        notes = regularise(other).attrs["notes"]
        named = [note for note in notes if "channel temperature: none of its 5 values" in note]
        assert len(named) == (1 if says else 0)
        assert all(says in note for note in named)


def test_notes_on_the_whole_record_do_not_name_one_of_its_files(tmp_path):
    for number, name in enumerate("ab"):
        rows = [
            f"{(n + 100 * number) / 10:.1f},{n % 7}\n" for n in range(100) if n not in (40, 41, 70)
        ]
        late = rows.pop(20)
        rows.insert(22, late)
        (tmp_path / f"{name}.csv").write_text(f"time [s],gyro_x [deg/h]\n{''.join(rows)}")
    notes = regularise(read_log(sorted(tmp_path.glob("*.csv")))).attrs["notes"]
    (missing,) = [note for note in notes if "missing:" in note]
    assert missing.startswith("a.csv and 1 more file: missing: 6 samples")
    (late,) = [note for note in notes if "out of order" in note]
    assert late.startswith("a.csv and 1 more file: out of order: 2 rows, first row 22 of a.csv; ")
