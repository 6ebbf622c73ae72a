"""Effects of optics and supply, and predicted means and densities, against closed forms."""

from __future__ import annotations

import gzip
import math

import numpy as np
import pytest
from scipy.stats import norm

from gyrostab.errors import OptionError
from gyrostab.physics.phase import lorentz_density
from gyrostab.physics.registry import make_effect
from gyrostab.simulate import simulate
from tests.support.effect_bench import (
    avar,
    band_powers,
    build_effect,
    means_and_prediction,
    run,
    said_density,
    windows_of,
)

NRAD_PER_S = math.degrees(1e-9) * 3600.0  # deg/h


# --------------------------------------------------------------------------------
# optics


def test_dead_zone_removes_rates_near_zero():
    signal = np.array([[-0.5, -0.2, -0.05, 0.0, 0.15, 0.5]])
    rates = run(build_effect("dead_zone", width=0.2), size=6, axes="x", signal=signal)
    np.testing.assert_allclose(rates, [[-0.3, 0.0, 0.0, 0.0, 0.0, 0.3]], atol=1e-15)
    jump = run(
        build_effect("dead_zone", width=0.2, edge="jump", centre=0.1),
        size=6,
        axes="x",
        signal=signal,
    )
    np.testing.assert_allclose(jump, [[-0.5, -0.2, 0.1, 0.1, 0.1, 0.5]], atol=1e-15)
    prediction = build_effect("dead_zone", width=0.2).explain(
        windows_of(30, 1.0, 10.0, own={"x": np.array([-3.0, 0.0, 3.0])})
    )
    np.testing.assert_array_equal(prediction.mean["width"], [[1.0, 0.0, -1.0]])


def test_noise_dithers_a_dead_zone_unless_the_loop_is_slow():
    noise = np.random.default_rng(2).normal(0.0, 2.0, (1, 40_000))
    options = {"size": 40_000, "rate": 100.0, "axes": "x", "signal": noise + 0.1}
    each_sample = run(build_effect("dead_zone", width=0.2), **options)
    lost = 0.1 * (2 * norm.cdf(0.2 / 2.0) - 1)  # of a mean far inside of the noise
    assert (noise + 0.1).mean() - each_sample.mean() == pytest.approx(lost, rel=0.15)
    slow = run(build_effect("dead_zone", width=0.2, bandwidth=0.01), **options)
    assert abs(slow.mean()) < 0.2 * 0.1
    assert slow.std() == pytest.approx(noise.std(), rel=0.01)


def test_a_sweep_through_a_dead_zone_has_odd_harmonics():
    wave = np.sin(2 * np.pi * np.arange(4000) / 400.0)[None]
    amplitude = (
        np.abs(
            np.fft.rfft(
                run(
                    build_effect("dead_zone", width=0.3),
                    size=4000,
                    axes="x",
                    signal=wave,
                )[0]
            )
        )
        / 2000
    )
    assert amplitude[30] > 0.03
    assert amplitude[50] > 0.005
    assert amplitude[[20, 40, 60]].max() < 1e-12
    first = 1 - 2 / math.pi * (math.asin(0.3) + 0.3 * math.sqrt(1 - 0.09))  # describing function
    assert amplitude[10] == pytest.approx(first, rel=1e-4)


def reset_truth(effect, w, rate, size, fine=400):
    """Sum the error impulse by impulse, at a rate given for each sample [deg/h]."""
    turn, step = effect.turn * NRAD_PER_S, 1.0 / (rate * fine)  # deg/h s
    angle = np.concatenate([[0.0], np.cumsum(np.repeat(w, fine)) * step / turn])
    resets = np.diff(np.floor(angle))
    t = np.arange(resets.size) * step
    rates = resets * effect.kick * NRAD_PER_S / step
    for place in np.flatnonzero(resets):
        after = t[place:] - t[place]
        rates[place:] += (
            resets[place] * effect.tail * NRAD_PER_S / effect.decay * np.exp(-after / effect.decay)
        )
    phase = angle[:-1] % 1.0
    return (rates + effect.sawtooth * (1 - 2 * phase)).reshape(size, fine).mean(axis=1)


@pytest.mark.parametrize("part", [{"kick": 12.0}, {"tail": 18.0, "decay": 0.03}, {"sawtooth": 0.5}])
def test_resets_add_their_angles_in_both_directions(part):
    effect = build_effect("feedback_reset", diameter=0.2, **part)
    turn = effect.turn * NRAD_PER_S
    assert effect.turn == pytest.approx(1.45 * 1550e-9 / 0.2 * 1e9)
    t = np.arange(300) / 50.0
    # up to eleven resets in a second, forth and back
    w = turn * (9.3 * np.cos(2 * np.pi * t / 4.1) + 1.7)
    error = run(effect, size=300, rate=50.0, axes="x", signal=w)[0] - w
    truth = reset_truth(effect, w, 50.0, 300)
    np.testing.assert_allclose(error, truth, atol=0.012 * np.abs(truth).max())
    assert error.min() < 0 < error.max()


def test_resets_faster_than_samples_are_a_scale_factor():
    effect = build_effect("feedback_reset", kick=5.0, tail=8.0, decay=0.001, sawtooth=1.0)
    w = 1e6 * effect.turn * NRAD_PER_S  # a million resets in a second
    error = run(effect, size=2000, rate=100.0, axes="x", signal=w)[0] - w
    np.testing.assert_allclose(error[5:], w * 13.0 / effect.turn, rtol=1e-4)
    prediction = effect.explain(windows_of(2000, 100.0, 10.0, own={"x": np.full(2, w)})).mean
    np.testing.assert_allclose(
        5 * prediction["kick"] + 8 * prediction["tail"], w * 13 / effect.turn, rtol=1e-12
    )


def test_comb_of_resets_follows_the_rate():
    effect = build_effect("feedback_reset", sawtooth=0.4, kick=3.0)
    places = []
    for w in (10.0, 25.0):
        rates = run(effect, size=20_000, rate=100.0, axes="x", signal=w)[0]
        spectrum = np.abs(np.fft.rfft((rates - rates.mean()) * np.hanning(rates.size))) ** 2
        f = np.fft.rfftfreq(rates.size, 0.01)
        edges = np.geomspace(1.0, 40.0, 60)
        prediction = effect.explain(
            windows_of(20_000, 100.0, 200.0, edges, own={"x": np.full(1, w)})
        )
        places.append(f[spectrum.argmax()])
        assert places[-1] == pytest.approx(prediction.line[0, 0], rel=0.01)
        total = sum(
            size**2 * prediction.spectrum[name][0]
            for name, size in (("sawtooth", 0.4), ("kick", 3.0))
        )
        assert edges[total.argmax()] == pytest.approx(places[-1], rel=0.07)
    assert places[1] / places[0] == pytest.approx(2.5, rel=0.01)


def test_comb_has_the_predicted_power():
    for part in ({"kick": 3.0}, {"tail": 3.0}, {"sawtooth": 0.4}):
        effect = build_effect("feedback_reset", **part)
        rates = run(effect, size=60_000, rate=100.0, axes="x", signal=11.15)[0]
        f = np.fft.rfftfreq(rates.size, 0.01)
        power = 2 * np.abs(np.fft.rfft(rates)) ** 2 / rates.size**2
        line = 11.15 / (effect.turn * NRAD_PER_S)
        is_near_line = np.abs(f - line) < 0.1
        bands = np.array([line / 1.05, line, line * 1.05])
        prediction = effect.explain(
            windows_of(60_000, 100.0, 600.0, bands, own={"x": np.full(1, 11.15)})
        )
        (name, size) = next(iter(part.items()))
        width = line * (math.sqrt(1.05) - 1 / math.sqrt(1.05))
        assert power[is_near_line].sum() == pytest.approx(
            2 * width * size**2 * prediction.spectrum[name][0, 1], rel=0.02
        )


def test_resets_of_a_real_gyro_match_the_model(recordings):
    with gzip.open(recordings("fog-blueseis-ramp/fog_ramp.csv.gz"), "rt") as file:
        columns = np.loadtxt(file, delimiter=",", skiprows=1)
    measured, ramp = columns[:, 1] * NRAD_PER_S, columns[:, 2]
    effect = build_effect(
        "feedback_reset", kick=11.5, tail=18, decay=0.012, phase="channel", full=-32768
    )
    assert effect.needs() == ("ramp",)
    model = run(effect, size=ramp.size, rate=200.0, axes="z", drivers={"ramp": ramp})[0]
    moved = -np.diff(ramp) / 32768
    turns = (moved - np.round(moved)).sum() / 359.995  # a second
    assert measured.mean() / NRAD_PER_S / turns == pytest.approx(effect.turn, rel=0.002)
    assert (11.5 + 18) * turns * NRAD_PER_S == pytest.approx(model.mean(), rel=0.01)
    parts = []
    for name in ("kick", "tail"):
        unit_effect = build_effect(
            "feedback_reset", **{name: 1.0}, decay=0.012, phase="channel", full=-32768
        )
        parts.append(
            run(unit_effect, size=ramp.size, rate=200.0, axes="z", drivers={"ramp": ramp})[0]
        )
    design = np.column_stack([*parts, np.ones(ramp.size)])
    kick, tail, _ = np.linalg.lstsq(design, measured, rcond=None)[0]
    assert kick == pytest.approx(11.5, rel=0.06)
    assert tail == pytest.approx(18.0, rel=0.08)
    before, after = avar([measured, measured - model], 200.0, [0.005, 0.02, 0.1, 1.0])
    # the rest of the first is noise of its own
    np.testing.assert_allclose((after / before)[:2], [0.69, 0.18], rtol=0.05)

    def by_phase(rates):
        return np.array(
            [rates[(ramp >= low) & (ramp < low + 2048)].mean() for low in range(0, 32768, 2048)]
        )

    assert np.ptp(by_phase(measured)) > 0.2
    assert np.ptp(by_phase(measured - model)) < 0.02
    saw = np.linspace(-1.0, 1.0, 16)
    assert abs(np.polyfit(saw, by_phase(measured - model), 1)[0]) < 0.003


@pytest.mark.parametrize("full", [7.0, -7.0])
@pytest.mark.parametrize("direction", [1.0, -1.0])
@pytest.mark.parametrize("decay", [0.0005, 0.01, 0.3])
@pytest.mark.parametrize("other", [1.0, -3.0])
def test_profile_over_the_ramp_is_the_generated_one(decay, direction, full, other):
    """Decays much shorter than a sample, of one, and of many: each bin is averaged exactly.

    The ramp may be that of another axis.
    """
    bins, turns = 16, direction * 0.0137 * np.arange(1, 60_001)
    phase = turns % 1.0 if full > 0.0 else 1.0 - turns % 1.0
    for part in ("kick", "tail", "sawtooth"):
        effect = build_effect(
            "feedback_reset", **{part: 3.0}, decay=decay, phase="channel", full=full
        )
        rate = direction * 0.0137 * 100.0 * effect.turn * NRAD_PER_S
        drivers = {"ramp": phase * abs(full)}
        error = run(effect, size=turns.size, rate=100.0, axes="x", drivers=drivers)[0]
        place = np.minimum((phase[20_000:] * bins).astype(int), bins - 1)
        profile = np.bincount(place, error[20_000:], bins) / np.bincount(place, minlength=bins)
        windows = windows_of(
            1000,
            100.0,
            10.0,
            own={"x": np.array([other * rate])},
            phase=(np.arange(bins) + 0.5) / bins,
            turns=np.array([math.copysign(1.37, rate * full)]),
        )
        expected = 3.0 * effect.explain(windows).phase_locked[part]
        np.testing.assert_allclose(profile, expected, atol=0.02 * np.abs(expected).max())


def test_ramp_from_rate_and_from_channel_agree():
    common = {"name": "feedback_reset", "kick": 3.0, "tail": 5.0, "sawtooth": 0.2}
    own = make_effect(common)
    w = np.full(500, 0.013 * 100 * own.turn * NRAD_PER_S)
    expected = run(own, size=500, rate=100.0, axes="x", signal=w)[0] - w
    ramp = 7.0 * ((0.013 * np.arange(1, 501)) % 1.0)
    by_channel = run(
        make_effect(common | {"phase": "channel", "full": 7.0}),
        size=500,
        rate=100.0,
        axes="x",
        signal=w,
        drivers={"ramp": ramp},
    )[0]
    np.testing.assert_allclose(by_channel[1:] - w[1:], expected[1:], atol=1e-9)
    assert make_effect(common | {"phase": "channel"}).needs() == ("ramp",)
    with pytest.raises(OptionError, match="0 is not a ramp"):
        make_effect(common | {"full": 0})


def test_shared_noise_shows_in_the_cross_axis_covariance_only():
    effect = {"name": "shared_source", "N": [0.004, -0.003, 0.0], "axes": ["x", "y", "z"]}
    log = simulate(
        {"effect": [effect], "noise": {"N": 0.005}, "log": {"rate": 20, "duration": "3h"}}, seed=5
    )
    x, y, z = log.rate.values
    taus = np.array([0.05, 0.5, 5.0])
    own = avar([x, y, z], 20.0, taus) * taus / 3600
    np.testing.assert_allclose(
        own[:, :2], np.tile([[0.005**2 + r**2] for r in (0.004, 0.003, 0)], (1, 2)), rtol=0.04
    )
    plus, minus = avar([x + y, x - y], 20.0, taus) * taus / 3600
    # negative: the modulation of y is turned
    np.testing.assert_allclose((plus - minus)[:2] / 4, 0.004 * -0.003, rtol=0.12)
    plus, minus = avar([x + z, x - z], 20.0, taus) * taus / 3600
    assert np.all(np.abs(plus - minus)[:2] / 4 < 0.1 * 0.004 * 0.003)
    assert make_effect(effect).explain(windows_of(100, 20.0, 1.0)).coherent


# --------------------------------------------------------------------------------
# means that are said


@pytest.mark.parametrize(
    "table",
    [
        {"name": "supply_bias", "voltage": 0.02, "power": -0.003},
        {"name": "clock_error", "error": 100, "drift": -400},
        {"name": "bias_jump", "step": -0.2, "at": 33.3},
        {"name": "fringe_hop", "order": -2, "at": 41.7, "hold": 1e9},
        {"name": "dead_zone", "width": 0.3, "centre": 1.0},
        {"name": "dead_zone", "width": 0.3, "bandwidth": 0.05},
        {"name": "feedback_reset", "kick": 20.0, "tail": 30.0},
        {"name": "rate_quantization", "step": 0.01, "mode": "floor"},
    ],
    ids=lambda table: "-".join(map(str, table.values())),
)
def test_window_means_match_the_prediction(table):
    effect, t = make_effect(table), np.arange(6000) / 50.0
    drivers = {"supply_voltage": 25 + np.sin(t / 9), "light_power": 1e-4 + 1e-5 * np.cos(t / 7)}
    signal = np.array([[150.0], [-400.0], [150.0]]) + 0.05 * np.sin(3 * t)
    means, predicted, _ = means_and_prediction(
        effect, rate=50.0, length=500, drivers=drivers, own=dict(zip("xyz", signal, strict=True))
    )
    tolerance = (
        0.04 if effect.name in ("feedback_reset", "rate_quantization", "clock_error") else 1e-6
    )  # parts of a turn, a step, a sample
    np.testing.assert_allclose(
        means, predicted, rtol=1e-3, atol=tolerance * np.abs(predicted).max()
    )


def test_random_processes_start_in_their_stationary_state():
    many = [f"a{number}" for number in range(2500)]
    first = run(build_effect("telegraph", step=1.0, low=300, high=100), size=1, axes=many)
    assert (first > 0.5).mean() == pytest.approx(0.25, abs=0.03)
    first = run(build_effect("gauss_markov", rms=2.0, correlation_time=50), size=1, axes=many)
    assert first.std() == pytest.approx(2.0, rel=0.05)
    steady = run(build_effect("dead_zone", width=0.3, bandwidth=0.05), size=3, signal=2.0)
    np.testing.assert_allclose(steady, 1.7, rtol=1e-12)
    stuck = run(build_effect("dead_zone", width=0.3, bandwidth=0.05), size=3, signal=0.25)
    np.testing.assert_allclose(stuck, 0.0, atol=1e-15)


# --------------------------------------------------------------------------------
# densities that are said


@pytest.mark.parametrize(
    ("table", "parameter", "size"),
    [
        ({"name": "gauss_markov", "rms": 0.3, "correlation_time": 2.0}, "rms", 0.3),
        ({"name": "gauss_markov", "rms": 0.3, "correlation_time": 0.02}, "rms", 0.3),
        ({"name": "telegraph", "step": 0.3, "low": 1.0, "high": 3.0}, "step", 0.3),
        ({"name": "telegraph", "step": 0.3, "low": 0.05, "high": 0.1}, "step", 0.3),
        ({"name": "shared_source", "N": 0.01}, "N", 0.01),
        ({"name": "shared_source", "N": 0.01, "bandwidth": 1.0}, "N", 0.01),
        ({"name": "rate_quantization", "step": 3.0}, "step", 3.0),
        ({"name": "spikes", "kind": "outlier", "size": 50.0, "per_hour": 1800}, "size", 50.0),
        ({"name": "spikes", "lsb": 0.5, "bits": 8, "per_hour": 3600}, "lsb", 0.5),
    ],
)
def test_what_is_added_has_the_predicted_density(table, parameter, size):
    effect, signal = make_effect(table), np.zeros((3, 60_000))
    if effect.stage == "logger":
        signal = np.random.default_rng(4).normal(0.3, 4.0, signal.shape)
    rates = run(effect, size=60_000, rate=10.0, signal=signal) - signal
    edges = np.array([0.02, 0.1, 0.5, 2.0, 4.0, 4.95])
    predicted = size**2 * said_density(effect, 10.0, edges, parameter)
    np.testing.assert_allclose(band_powers(rates, 10.0, edges), predicted, rtol=0.12)
    f = np.linspace(1e-4, 5.0, 40_000)
    density = effect.explain(windows_of(100, 10.0, 1.0, f)).spectrum[parameter][0]
    total = size**2 * 2 * np.trapezoid(density, f)
    np.testing.assert_allclose(rates.var(), total, rtol=0.06)


def test_lorentz_density_folds_the_continuous_one():
    f, order = np.linspace(0.1, 4.9, 9), np.arange(-4000, 4001)
    for time in (0.003, 0.3, 30.0):
        every = f[:, None] + 10.0 * order
        folded = (
            2 * time / (1 + (2 * np.pi * every * time) ** 2) * np.sinc(every / 10.0) ** 2
        ).sum(axis=1)
        np.testing.assert_allclose(lorentz_density(f, time, 10.0), folded, rtol=1e-3)


# --------------------------------------------------------------------------------
# chunks


def test_a_chain_of_the_electronics_is_the_same_in_any_blocks():
    effects = [
        {"name": "feedback_reset", "kick": 11.5, "tail": 18},
        {"name": "fringe_hop", "per_hour": 100, "hold": 3},
        {"name": "clock_error", "error": 900},
        {"name": "logger_filter", "cutoff": 30, "pick": 1},
        {"name": "rate_quantization", "step": 0.5},
        {"name": "spikes", "per_hour": 1000},
        {"name": "held_samples", "per_hour": 2000},
    ]
    model = {
        "noise": {"N": 0.01},
        "effect": effects,
        "log": {"rate": 50, "duration": "40s", "oversampling": 4},
    }
    whole = simulate(model, seed=9).rate.values
    blocks = simulate(model, seed=9, chunk=173).rate.values
    np.testing.assert_array_equal(blocks, whole)
    assert np.isfinite(whole).all()
