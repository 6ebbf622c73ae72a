"""Effects of filter, lattice, losses and clock of the logger against their closed forms."""

from __future__ import annotations

import gzip
from itertools import pairwise

import numpy as np
import pytest
from scipy.signal import butter, sosfreqz
from scipy.stats import kurtosis, norm

from gyrostab.errors import OptionError
from gyrostab.noise import sampled_psd
from gyrostab.physics.base import Setup
from gyrostab.physics.registry import make_effect
from gyrostab.simulate import simulate
from tests.support.effect_bench import avar, band_powers, build_effect, run, windows_of

# --------------------------------------------------------------------------------
# logger


def test_a_low_pass_has_the_response_of_its_design():
    effect = build_effect("logger_filter", cutoff=12.0, order=3)
    signal = np.random.default_rng(1).normal(size=(3, 100_000))
    edges = np.array([0.5, 4.0, 8.0, 12.0, 16.0, 20.0, 30.0, 45.0])
    response_measured = band_powers(
        run(effect, size=100_000, rate=100.0, signal=signal), 100.0, edges
    ) / band_powers(signal, 100.0, edges)
    fine = np.stack([np.linspace(low, high, 50) for low, high in pairwise(edges)])
    _, response = sosfreqz(butter(3, 12.0, fs=100.0, output="sos"), fine.ravel(), fs=100.0)
    expected = (np.abs(response) ** 2).reshape(fine.shape).mean(axis=1)
    np.testing.assert_allclose(response_measured, expected, rtol=0.05)
    steady = run(effect, size=50, rate=100.0, signal=3.0)
    np.testing.assert_allclose(steady, 3.0, rtol=1e-12)


def test_moving_average_reduces_noise_at_short_times_only():
    noise = np.random.default_rng(6).normal(size=(1, 200_000))
    done = run(
        build_effect("logger_filter", length=0.08),
        size=200_000,
        rate=100.0,
        axes="x",
        signal=noise,
    )
    np.testing.assert_allclose(
        done[0, 7:], np.convolve(noise[0], np.full(8, 1 / 8), "valid"), rtol=1e-9, atol=1e-12
    )
    ratio = avar(done, 100.0, [0.01, 0.08, 4.0])[0] / avar(noise, 100.0, [0.01, 0.08, 4.0])[0]
    # difference of neighbours: 2 / 64 instead of 2
    np.testing.assert_allclose(ratio[0], 1 / 64, rtol=0.03)
    weights = np.convolve(np.repeat([1.0, -1.0], 8), np.full(8, 1 / 8))
    assert ratio[1] == pytest.approx((weights**2).sum() / 16, rel=0.03)
    assert ratio[2] == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize("samples", [1.0, 1.4, 1.5, 2.0, 7.3])
def test_moving_average_may_have_a_part_of_a_sample(samples):
    """The average over the last `samples` intervals of a signal that holds each sample."""
    noise = np.random.default_rng(6).normal(size=(1, 2000))
    effect = build_effect("logger_filter", length=samples / 10.0)
    done = run(effect, size=2000, axes="x", signal=noise, cuts=(1, 2, 9, 700))[0]
    ends = np.arange(1, 2001.0)
    integral = np.concatenate([[0.0], noise[0].cumsum()])
    expected = integral[1:] - np.interp(ends - samples, np.arange(2001.0), integral)
    known = ends >= samples
    np.testing.assert_allclose(done[known], expected[known] / samples, rtol=0, atol=1e-9)


def test_point_sampling_aliases_and_averaging_does_not():
    common = {
        "noise": {"N": 0.01},
        "log": {"rate": 20, "duration": "1000s", "oversampling": 8, "axes": ["x"]},
    }
    means = simulate(common).rate.values
    picked = simulate(common | {"effect": [{"name": "logger_filter", "pick": 1}]}).rate.values
    taus = [0.05, 0.5, 5.0]
    np.testing.assert_allclose(avar(means, 20, taus)[0][:2] * taus[:2] / 3600, 1e-4, rtol=0.08)
    np.testing.assert_allclose(avar(picked, 20, taus)[0][:2] * taus[:2] / 3600, 8e-4, rtol=0.08)
    line = {"name": "spectral_line", "amplitude": 1.0, "frequency": 53.0}
    folded = simulate(
        common | {"noise": {}, "effect": [line, {"name": "logger_filter", "pick": 1}]}
    ).rate.values[0]
    f = np.fft.rfftfreq(folded.size, 0.05)
    spectrum = np.abs(np.fft.rfft(folded)) / folded.size * 2
    assert f[spectrum.argmax()] == pytest.approx(7.0)  # 53 - 3 * 20
    # the instrument averages over a 160th of a second
    assert spectrum.max() == pytest.approx(np.sinc(53 / 160), rel=1e-3)


@pytest.mark.parametrize(
    "table",
    [
        {"cutoff": 6.0, "order": 2},
        {"cutoff": 14.0, "pick": 1},
        {"cutoff": 10.0, "order": 1, "pick": 1},
        {"length": 0.04, "pick": 1},
        {"length": 0.1},
        {"length": 0.0044, "pick": 1},
    ],
)
@pytest.mark.parametrize("term", ["N", "Q", "K"])
def test_filter_has_the_predicted_responses(table, term):
    effect = {"name": "logger_filter", **table}
    common = {
        "noise": {term: 0.01},
        "log": {"rate": 20, "duration": "20000s", "oversampling": 16, "axes": ["x"]},
    }
    rates = simulate(common | {"effect": [effect]}).rate.values
    rates = rates * np.hanning(rates.size) / np.sqrt(3.0 / 8.0)  # else the random walk leaks
    edges = np.array([1.0, 2.0, 4.0, 6.0, 8.0, 9.9])
    centre = [np.linspace(low, high, 100) for low, high in pairwise(edges)]
    filtered = [
        make_effect(effect).explain(windows_of(100, 20.0, 1.0, f)).response[term]
        * sampled_psd(term, f, 20.0)
        for f in centre
    ]
    np.testing.assert_allclose(
        band_powers(rates, 20.0, edges), 1e-4 * np.mean(filtered, axis=1), rtol=0.02
    )


@pytest.mark.parametrize(
    "table",
    [
        {"cutoff": 0.02, "order": 1},
        {"cutoff": 0.05, "order": 3},
        {"length": 10.0},
        {"length": 10.0, "cutoff": 0.1, "instrument": 1},
    ],
)
def test_a_filtered_log_begins_with_no_more_noise_than_it_has_later(table):
    """An ensemble of axes; the filter has followed the constant rate before the log."""
    filtering = {"name": "logger_filter", **table}
    offset = {"name": "bias_jump", "step": 30.0, "at": 0.0}
    axes = [f"a{number}" for number in range(40)]
    tables = {
        "noise": {"N": 0.01},
        "bias": dict.fromkeys(axes, 20.0),
        "effect": [offset, filtering],
        "log": {"axes": axes, "rate": 10.0, "duration": "150s", "oversampling": 2},
    }
    error = simulate(tables).rate.values - 50.0
    later = np.sqrt(np.mean(error[:, 1000:] ** 2))
    assert np.sqrt(np.mean(error[:, :100] ** 2, axis=0)).max() < 1.5 * later


@pytest.mark.parametrize(
    "table", [{"length": 0.3}, {"cutoff": 2.0, "order": 3}, {"length": 0.16, "pick": 1}]
)
def test_a_filter_at_the_rate_of_the_log_is_the_same_for_any_oversampling(table):
    effect = {"name": "logger_filter", "instrument": 1, **table}
    log = {"rate": 10.0, "duration": "100s", "axes": ["x"], "oversampling": 8}
    plain = simulate({"noise": {"N": 0.01}, "log": log}).rate.values
    tables = {"noise": {"N": 0.01}, "log": log, "effect": [effect]}
    filtered = simulate(tables).rate.values
    expected = run(make_effect(effect), size=1000, axes="x", signal=plain)
    np.testing.assert_allclose(filtered[:, 100:], expected[:, 100:], rtol=0, atol=1e-9)
    np.testing.assert_array_equal(simulate(tables, chunk=77).rate.values, filtered)


def test_impossible_filter_is_refused():
    setup = Setup(rate=10.0, size=100, axes=("x",))
    rng = np.random.default_rng(1)
    with pytest.raises(
        OptionError,
        match="a cutoff of 5 Hz is not below half of the instrument's 10 Hz; raise oversampling",
    ):
        build_effect("logger_filter", cutoff=5).begin(setup, rng)
    with pytest.raises(OptionError, match="20000 samples of the instrument; give at most 10000"):
        build_effect("logger_filter", length=2000).begin(setup, rng)
    for length in (0.04, 0.0999):
        with pytest.raises(OptionError, match="shorter than a sample of the instrument's 10 Hz"):
            build_effect("logger_filter", length=length).begin(setup, rng)
    build_effect("logger_filter", length=0.1).begin(setup, rng)
    with pytest.raises(OptionError, match=r"instrument = 16 is not the oversampling of .* is 1; "):
        build_effect("logger_filter", cutoff=1, instrument=16).begin(setup, rng)
    with pytest.raises(OptionError, match=r"'order': 2\.5 is not a whole number"):
        build_effect("logger_filter", cutoff=1, order=2.5)


def test_quantization_adds_a_twelfth_of_its_square_or_hides_all():
    signal = np.random.default_rng(7).normal(0.3, 1.0, (1, 100_000))
    done = run(
        build_effect("rate_quantization", step=2.0),
        size=100_000,
        axes="x",
        signal=signal,
    )
    assert set(np.unique(done / 2.0 % 1.0)) == {0.0}
    added = avar(done - signal, 10.0, [0.1, 1.0, 10.0])[0]
    np.testing.assert_allclose(added[:2], [4 / 12, 4 / 120], rtol=0.06)
    assert not run(
        build_effect("rate_quantization", step=20.0),
        size=100_000,
        axes="x",
        signal=signal,
    ).any()
    below = run(
        build_effect("rate_quantization", step=2.0, mode="floor"),
        size=100_000,
        axes="x",
        signal=signal,
    )
    assert (below - signal).mean() == pytest.approx(-1.0, abs=0.02)
    assert (
        build_effect("rate_quantization", step=2.0, mode="floor")
        .explain(windows_of(9, 1.0, 3.0))
        .mean["step"][0]
        == -0.5
    )


def test_real_gyro_has_a_quantization_grid(recordings):
    with gzip.open(recordings("mems-static-53min/ch104.csv.gz"), "rt") as file:
        measured = (
            np.loadtxt(file, delimiter=",", skiprows=1, usecols=(0, 1, 2), max_rows=5000).T * 3600
        )
    for step, stands in ((36.0, True), (72.0, False)):
        done = run(
            build_effect("rate_quantization", step=step),
            size=5000,
            rate=100.0,
            signal=measured,
        )
        assert np.allclose(done, measured, atol=1e-6) == stands


def test_bit_errors_are_bits():
    counts = np.random.default_rng(8).integers(-100, 100, (2, 50_000)).astype(float)
    effect = build_effect("spikes", per_hour=3600, lsb=0.25, bits=8)
    done = run(effect, size=50_000, rate=20.0, axes="xy", signal=counts * 0.25) / 0.25
    wrong = done != counts
    assert wrong.sum() == pytest.approx(2 * 2500, rel=0.06)
    sizes = np.abs(done - counts)[wrong]
    bits, number = np.unique(sizes, return_counts=True)
    np.testing.assert_array_equal(bits, 2.0 ** np.arange(8))
    assert number.max() / number.min() < 1.5
    assert done.min() >= -128
    assert done.max() <= 127
    before, after = counts[wrong].astype(int) & 255, done[wrong].astype(int) & 255
    assert set(np.bitwise_count(before ^ after).tolist()) == {1}
    assert (wrong[0] & wrong[1]).sum() == pytest.approx(125, abs=45)  # by chance only
    assert kurtosis((done - counts)[0]) > 20


def test_held_samples_are_runs_that_raise_n_at_long_times():
    noise = np.random.default_rng(9).normal(size=(2, 400_000))
    # at 10 Hz: every 50 samples, for 4
    effect = build_effect("held_samples", per_hour=720, length=0.4)
    done = run(effect, size=400_000, axes="xy", signal=noise)
    same = np.diff(done, axis=1) == 0
    np.testing.assert_array_equal(same[0], same[1])
    share = 4 / 54
    assert same.mean() == pytest.approx(share, rel=0.05)
    starts = np.flatnonzero(same[0][1:] & ~same[0][:-1]).size
    assert same[0].sum() / starts == pytest.approx(4.0, rel=0.05)
    ratio = (avar(done, 10.0, [0.1, 20.0]) / avar(noise, 10.0, [0.1, 20.0])).mean(axis=0)
    assert ratio[0] == pytest.approx(1 - share, rel=0.02)
    # E[(1 + h)^2] / E[1 + h], h geometric of mean 4 with the chance 1/50
    exact = (1 + 0.02 * (2 * 4 + 28)) / (1 + 0.02 * 4)
    assert ratio[1] == pytest.approx(exact, rel=0.08)
    growth = effect.explain(windows_of(1000, 10.0, 10.0)).level[("N", "per_hour")][0]
    assert 720 * growth == pytest.approx(2 * 0.02 * 16, rel=1e-9)
    assert exact - 1 == pytest.approx(720 * growth, rel=0.1)


def test_zero_filled_samples_bias_the_mean():
    effect = build_effect("held_samples", per_hour=720, length=0.4, fill="zero")
    done = run(effect, size=200_000, axes="x", signal=15.0)
    assert set(np.unique(done)) == {0.0, 15.0}
    assert done.mean() == pytest.approx(15 * (1 - 4 / 54), rel=0.01)
    bias = effect.explain(windows_of(100, 10.0, 10.0, own={"x": np.full(1, 15.0)})).mean["per_hour"]
    assert 720 * bias[0, 0] == pytest.approx(-15 * 4 / 50, rel=1e-9)


def test_clipping_cuts_the_tails():
    noise = np.random.default_rng(10).normal(2.0, 1.0, (1, 200_000))
    done = run(
        build_effect("clipping", limit=1.5, centre=2.0),
        size=200_000,
        axes="x",
        signal=noise,
    )
    assert done.min() == 0.5
    assert done.max() == 3.5
    assert (done == 3.5).mean() == pytest.approx(norm.sf(1.5), rel=0.03)
    inside = norm.cdf(1.5) - norm.cdf(-1.5) - 2 * 1.5 * norm.pdf(1.5)
    assert done.var() == pytest.approx(inside + 2 * 1.5**2 * norm.sf(1.5), rel=0.01)


# --------------------------------------------------------------------------------
# clock


def test_a_fast_clock_reads_too_little_on_all_axes():
    effect = build_effect("clock_error", error=100)
    w = np.array([[3.888e6], [-1e6], [0.0]])
    done = run(effect, size=1000, signal=w)
    # 100 ppm of 180 r/min: 388.8 deg/h
    np.testing.assert_allclose(done - w, -1e-4 * np.broadcast_to(w, done.shape), rtol=1e-9)
    own = {axis: np.full(10, value) for axis, value in zip("xyz", w[:, 0], strict=True)}
    prediction = effect.explain(windows_of(1000, 10.0, 10.0, axes=("x", "y", "z"), own=own)).mean[
        "error"
    ]
    np.testing.assert_allclose(100 * prediction[:, 0], -1e-4 * w[:, 0])
    rated = run(build_effect("clock_error", error=100, output="rate"), size=1000, signal=w)
    np.testing.assert_allclose(rated - w, 0.0, atol=1e-9)


@pytest.mark.parametrize("reading", ["latest", "average"])
@pytest.mark.parametrize(
    ("error", "drift"), [(2000, 0), (-2000, 0), (-3000, 1e4), (0, 8000), (1000, -1e4)]
)
def test_log_holds_the_signal_at_the_time_of_the_clock(error, drift, reading):
    def motion(t):
        return 50.0 * np.sin(2 * np.pi * t / 60.0) + 0.2 * t

    rate, size = 100.0, 180_000  # half an hour
    effect = build_effect("clock_error", error=error, drift=drift, output="rate", reading=reading)
    t = np.arange(size) / rate
    done = run(effect, size=size, rate=rate, axes="x", signal=motion(t))[0]
    ahead = (error * t + drift * t**2 / 7200) * 1e-6
    ahead -= min(ahead.min(), 0.0)
    known = t > ahead
    off = done - motion(t - ahead)
    assert np.abs(off[known]).max() < 5.5 * 0.011  # a sample at the steepest place
    assert np.abs(ahead).max() > 0.6
    np.testing.assert_array_equal(done[~known][:-1], motion(0.0))
    assert known.mean() > 0.99


def test_clock_error_shifts_a_line():
    wave = np.sin(2 * np.pi * 7.0 * np.arange(100_000) / 100.0)
    for error in (5000, -5000):
        done = run(
            build_effect("clock_error", error=error),
            size=100_000,
            rate=100.0,
            axes="x",
            signal=wave,
        )[0][1000:]
        spectrum = np.abs(np.fft.rfft(done * np.hanning(done.size)))
        assert np.fft.rfftfreq(done.size, 0.01)[spectrum.argmax()] == pytest.approx(
            7.0 * (1 - error * 1e-6), abs=0.0012
        )


def test_samples_are_skipped_or_repeated_at_the_rate_of_the_error():
    count = np.arange(40_000.0)
    fast = run(
        build_effect("clock_error", error=1000, output="rate"),
        size=40_000,
        axes="x",
        signal=count,
    )[0]
    slow = run(
        build_effect("clock_error", error=-1000, output="rate"),
        size=40_000,
        axes="x",
        signal=count,
    )[0]
    assert (np.diff(fast) == 0).sum() == pytest.approx(40, abs=1)
    assert (np.diff(slow) == 2).sum() == pytest.approx(40, abs=1)
    assert set(np.unique(np.diff(fast))) == {0.0, 1.0}


def test_clock_error_keeps_white_noise():
    noise = np.random.default_rng(11).normal(size=(3, 200_000))
    for reading, share in (("latest", 0.0), ("average", 1.0)):
        done = run(
            build_effect("clock_error", error=300, reading=reading),
            size=200_000,
            signal=noise,
        )
        ratio = (avar(done, 10.0, [0.1, 1.0, 4.0]) / avar(noise, 10.0, [0.1, 1.0, 4.0])).mean(
            axis=0
        )
        # a jump of the weights between two samples, 1, 2 and 1 high, loses its square times f (1 -
        # f), 1 / 6 on average over the place f
        np.testing.assert_allclose(ratio, 1.0 - share / (2 * np.array([1, 10, 40])), rtol=0.02)


def test_large_clock_error_is_refused():
    setup = Setup(rate=400.0, size=400 * 3600 * 200, axes=("x",))
    rng = np.random.default_rng(1)
    with pytest.raises(OptionError, match="slip reaches 28800003 samples; make the log shorter"):
        build_effect("clock_error", error=1e5).begin(setup, rng)
    with pytest.raises(OptionError, match="error reaches 210 %"):
        build_effect("clock_error", error=1e5, drift=1e4).begin(setup, rng)
    assert build_effect("clock_error", error=-50, drift=1).say() == (
        "The sampling clock is slow by 50 ppm, growing by 1 ppm/h, on all axes."
    )


def test_a_frame_sent_twice_repeats_the_samples_before_it():
    effect = build_effect("held_samples", per_hour=60.0, length=0.6, fill="frame")
    size = 200_000
    numbers = np.tile(np.arange(float(size)), (2, 1))
    sent = run(effect, size=size, rate=10.0, axes="xy", signal=numbers)
    np.testing.assert_array_equal(sent[0], sent[1])
    late = numbers[0] - sent[0]
    edges = np.flatnonzero(np.diff(late, prepend=0.0, append=0.0))
    runs = [(low, high) for low, high in pairwise(edges) if late[low] > 0.0]
    assert len(runs) == pytest.approx(333, abs=60)
    as_before = [(late[low:high] == high - low).all() for low, high in runs]
    assert np.mean(as_before) > 0.95  # the others repeat a repeated sample
    assert np.mean([high - low for low, high in runs]) == pytest.approx(6.0, rel=0.2)
    assert "filled with the frame before on all axes" in effect.say()
