"""Stamps that are times of arrival: rows stay in order, losses and the rate are found."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from gyrostab.errors import TimeError
from gyrostab.ingest.grid.gaps import gap_table
from gyrostab.ingest.grid.regularise import regularise
from tests.support.raw_rows import START, raw_log, regularise_in_parts, stamps_of
from tests.support.stamp_scatter import (
    JITTER,
    LOSSES,
    PACKET,
    lose_samples,
    round_stamps,
    scatter_stamps,
)


def place(jitter, scatter, losses, unit, *, rate=100.0, rows=20_000, seed=0, **options):
    """Regularise scattered stamps; return the log, true samples and placed samples of its rows."""
    random = np.random.default_rng(seed)
    samples = lose_samples(losses, rows, random)
    log = regularise_in_parts(
        raw_log(round_stamps(scatter_stamps(samples, jitter, scatter, random), rate, unit)),
        **options,
    )
    values = log.rate.values[0]
    given = np.flatnonzero(np.isfinite(values))
    assert (np.diff(values[given]) > 0).all()
    return log, samples[values[given].astype(int) - 1], given, samples


@pytest.mark.parametrize(
    ("jitter", "scatter", "losses", "unit"),
    [
        pytest.param("normal", 0.3, "none", "us", marks=pytest.mark.full),
        pytest.param("normal", 0.5, "none", "ms", marks=pytest.mark.full),
        ("normal", 0.6, "single", "ns"),
        pytest.param("normal", 0.6, "bursts", "us", marks=pytest.mark.full),
        pytest.param("normal", 0.5, "gap", "ms", marks=pytest.mark.full),
        ("uniform", 0.3, "single", "us"),
        pytest.param("uniform", 0.6, "bursts", "ms", marks=pytest.mark.full),
        ("sorted", 0.6, "single", "us"),
        # less of both is in `test_jitter_at_random_in_every_way`
        pytest.param("latest", 0.5, "bursts", "us", marks=pytest.mark.full),
        pytest.param("packets", 0.3, "none", "us", marks=pytest.mark.full),
        pytest.param("packets", 0.1, "bursts", "us", marks=pytest.mark.full),
        pytest.param("packets", 0.3, "single", "ms", marks=pytest.mark.full),
        pytest.param("late", 0.0, "none", "ms", marks=pytest.mark.full),
        ("late", 0.3, "single", "us"),
        ("late", 0.3, "gap", "us"),
    ],
)
@pytest.mark.parametrize("rate", [pytest.param(100.0, marks=pytest.mark.full), 99.7])
def test_every_row_is_kept_and_every_loss_found(jitter, scatter, losses, unit, rate):
    log, true, given, samples = place(jitter, scatter, losses, unit, rate=rate)
    assert len(given) == len(samples)
    assert log.attrs["sampling_rate_hz"] == pytest.approx(rate, rel=1e-6)
    reach = PACKET if jitter == "packets" else 0
    assert abs(given[-1] - samples[-1]) <= reach
    assert np.abs(given - true - np.median(given - true)).max() <= max(reach, 3)
    if losses == "gap":
        assert abs(gap_table(log).samples.max() - 123_457) <= reach


def test_a_rate_that_is_not_round_a_clock_that_drifts_and_a_gap():
    random = np.random.default_rng(1)
    samples = lose_samples("gap", 20_000, random)
    course = samples * (1 + 30e-6) + 0.02 * np.sin(2 * np.pi * samples / samples[-1])
    stamps = round_stamps(course + random.normal(0, 0.5, len(samples)), 99.7, "us")
    log = regularise(raw_log(stamps))
    np.testing.assert_array_equal(np.flatnonzero(np.isfinite(log.rate.values[0])), samples)
    assert log.attrs["sampling_rate_hz"] == pytest.approx(99.7 / (1 + 30e-6), rel=3e-6)


@pytest.mark.full
def test_jitter_at_random_in_every_way():
    combinations = list(itertools.product(JITTER, LOSSES))

    @settings(max_examples=15)
    @given(
        st.sampled_from(combinations),
        st.floats(0, 0.6),
        st.sampled_from(["ns", "us", "ms"]),
        st.floats(40, 400),
        st.integers(0, 2**32 - 1),
    )
    @example(how=("latest", "none"), scatter=0.375, unit="ns", rate=40.0, seed=1)
    def check(how, scatter, unit, rate, seed):
        jitter, losses = how
        log, _, given, samples = place(
            jitter, scatter, losses, unit, rate=round(rate, 2), rows=6000, seed=seed
        )
        assert len(given) >= 0.999 * len(samples)
        assert log.attrs["sampling_rate_hz"] == pytest.approx(rate, rel=1e-3)

    check()


@pytest.mark.parametrize(
    ("jitter", "scatter", "rate", "unit", "seed"),
    [
        ("latest", 0.375, 40.0, "ns", 1),
        ("uniform", 0.5, 400.0, "ms", 1635),
    ],
)
def test_few_rows_that_share_a_stamp_may_be_different_samples(jitter, scatter, rate, unit, seed):
    log, _, given, samples = place(jitter, scatter, "none", unit, rate=rate, rows=6000, seed=seed)
    np.testing.assert_array_equal(given, samples)
    assert log.attrs["sampling_rate_hz"] == pytest.approx(rate, rel=1e-6)


@pytest.mark.parametrize("share", [0.01, 0.04])
def test_few_rows_that_share_a_stamp_may_be_the_same_sample(share):
    random = np.random.default_rng(5)
    stamps = round_stamps(scatter_stamps(np.arange(6000), "uniform", 0.5, random), 40.0, "us")
    rows = np.sort(np.append(np.arange(6000), np.flatnonzero(random.random(6000) < share)))
    log = regularise(raw_log(stamps[rows], random.standard_normal(6000)[rows]))
    assert np.isfinite(log.rate.values).all()
    assert log.sizes["time"] - 6000 in (
        0,
        1,
    )  # no row follows that tells whether one of the last rows is given twice
    assert log.attrs["sampling_rate_hz"] == pytest.approx(40.0, rel=1e-6)


@pytest.mark.parametrize("scatter", [0.1, 0.3, 0.5])
def test_the_true_rate_is_accepted_whatever_the_jitter(scatter):
    random = np.random.default_rng(0)
    samples = np.arange(20_000)
    stamps = round_stamps(scatter_stamps(samples, "normal", scatter, random), 100.0, "us")
    log = regularise(raw_log(stamps), rate=100.0)
    assert log.attrs["sampling_rate_hz"] == 100.0
    assert np.isfinite(log.rate.values).sum() >= 0.999 * len(samples)


def test_given_rate_overrules_a_pattern_of_losses_and_is_noted():
    stamps = stamps_of(np.flatnonzero(np.resize([1, 1, 1, 0, 0], 6000)), 100.0)
    log = regularise(raw_log(stamps), rate=60.0)
    assert np.isfinite(log.rate.values).sum() == len(stamps)
    assert any(
        "the stamps alone say 100 Hz" in note and "60 Hz" in note for note in log.attrs["notes"]
    )


@pytest.mark.parametrize("wrong", [50.0, 90.0, 110.0, 200.0])
def test_a_rate_that_no_jitter_explains_is_refused_with_both_figures(wrong):
    stamps = START + np.rint(
        (np.arange(5000) + np.random.default_rng(3).normal(0, 0.4, 5000)) * 1e7
    ).astype(np.int64)
    with pytest.raises(
        TimeError, match=rf"{wrong:g} Hz.*100(\.00\d)? Hz.*lost samples nor jitter.*--rate"
    ):
        regularise(raw_log(stamps), rate=wrong)


def test_jitter_is_noted():
    log, *_ = place("normal", 0.4, "none", "us")
    assert any(
        "scatter by 4." in note and "rows keep their order" in note for note in log.attrs["notes"]
    )


def test_shared_stamps_are_not_said_to_scatter():
    samples = np.delete(np.arange(20_000), [11, 9000])
    log = regularise(raw_log(START + samples // 2 * 20_000_000))
    notes = " ".join(log.attrs["notes"])
    assert "many rows share one stamp: rows are placed in their order at 100 Hz" in notes
    assert "scatter" not in notes


def test_clock_set_back_with_jitter_is_a_restart():
    random = np.random.default_rng(4)
    times = np.concatenate([np.arange(4000), np.arange(4000)]) + random.normal(0, 0.4, 8000)
    log = regularise(raw_log(round_stamps(times, 100.0, "us")))
    assert gap_table(log).cause.tolist() == ["restart"]
    assert log.sizes["time"] == 8001


@pytest.mark.parametrize("block", [64, 1000, 1 << 20])
def test_block_size_does_not_matter_with_jitter(block):
    log, *_ = place("normal", 0.4, "single", "us")
    other, *_ = place("normal", 0.4, "single", "us", block=block)
    np.testing.assert_array_equal(log.rate.values, other.rate.values)
    assert log.time.values[0] == other.time.values[0]


def test_stamps_of_a_broken_frame_make_no_gap_longer_than_allowed():
    """Signed 16-bit stamps read as unsigned 32-bit ones must not make a gap of 50 days."""
    stamps = np.arange(82) * 100_000_000
    stamps[29:] = (np.random.default_rng(3).integers(-2000, 2000, 53) % 2**32) * 1_000_000
    log = regularise(raw_log(stamps), max_gap="1h")
    assert log.sizes["time"] < 36_000


@pytest.mark.slow
def test_every_restart_of_a_clock_within_the_second_is_found():
    random = np.random.default_rng(0)
    stamps = (np.arange(3000) / 30 * 1000 + 10 * random.standard_normal(3000)).astype(int) % 1000
    log = regularise(raw_log(stamps * 1_000_000))
    assert log.attrs["sampling_rate_hz"] == pytest.approx(30.0, rel=0.01)
    assert (gap_table(log).cause == "restart").sum() == 99
