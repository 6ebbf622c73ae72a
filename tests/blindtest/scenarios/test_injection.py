"""Injections are sized by the measured noise of the recording, not by five terms."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import fft
from scipy.signal import lfilter

from gyrostab.blindtest.generator.detection_limits import (
    NATS,
    learned_nats,
    mean_size,
    shared_size,
    variance_size,
)
from gyrostab.blindtest.generator.noise import (
    BANDS,
    _fit_slope,
    measure_noise,
    smooth_periodogram,
)
from gyrostab.blindtest.generator.record import make_log
from gyrostab.blindtest.generator.scenario import AXES, draw_scenario
from gyrostab.blindtest.scenarios.case import make_case
from gyrostab.blindtest.scenarios.injection import (
    estimate_noise,
    inject_effect,
    plan_injections,
    quantization_step,
)
from gyrostab.schema import check_log
from tests.support.blind_cases import small

RATE, SECONDS = 20.0, 1500.0


def white(seed: int, *, sd: float = 0.8) -> np.ndarray:
    return np.random.default_rng(seed).normal(0, sd, (3, round(RATE * SECONDS)))


def scenario_of(record: np.ndarray):
    scenario = draw_scenario(np.random.default_rng(1), rate=RATE, seconds=SECONDS)
    noise = tuple(estimate_noise(row, rate=RATE) | {"K": 0.0} for row in record)
    return replace(scenario, noise=noise, missing=np.zeros(scenario.size, dtype=bool))


def draw_both(record: np.ndarray):
    """Draw a scenario with five noise terms, and the same with measured noise."""
    scenario = scenario_of(record)
    return scenario, replace(scenario, measured=measure_noise(record, rate=RATE))


def bursts() -> np.ndarray:
    ratio = np.ones((3, math.ceil(SECONDS) + 1))
    ratio[1, 300:700] = 1.2
    return ratio


def test_the_stop_band_of_an_anti_alias_filter_does_not_count():
    record = white(0)
    lines = fft.rfft(record, axis=1)
    lines[:, round(0.9 * lines.shape[1]) :] *= 1e-3
    plain, real = (draw_both(values)[1] for values in (record, fft.irfft(lines, axis=1)))
    plain, real = (replace(scenario, noise=scenario_of(record).noise) for scenario in (plain, real))
    assert 0.8 < variance_size(real, bursts()) / variance_size(plain, bursts()) < 1.3
    shared = np.array([0.3, -0.2, 0.0]), np.ones(BANDS)
    assert 0.8 < shared_size(real, *shared) / shared_size(plain, *shared) < 1.3


def test_added_noise_passes_through_the_anti_alias_filter():
    record = white(0)
    lines = fft.rfft(record, axis=1)
    lines[:, round(0.9 * lines.shape[1]) :] *= 1e-3
    stop = slice(round(0.96 * lines.shape[1]), None)  # the last of 24 bands
    log = make_log(fft.irfft(lines, axis=1), {}, start=0, rate=RATE)
    copies = inject_effect(log, "temperature_noise", 8.0, np.random.default_rng(5))
    before, after = (
        np.abs(fft.rfft(copies[name][0]["rate"].values, axis=1)[:, stop]) ** 2
        for name in ("untouched", "injected")
    )
    assert 1.0 < after.sum() / before.sum() < 3.0


def test_measured_limits_match_closed_forms_in_white_noise():
    plain, real = draw_both(white(0))
    mean = np.zeros((3, plain.size))
    mean[1, 5000:9000] = 0.1
    assert mean_size(real, mean) == pytest.approx(mean_size(plain, mean), rel=0.25)
    wave = np.zeros((3, plain.size))
    wave[2] = 0.1 * np.sin(np.arange(plain.size))
    assert mean_size(real, wave) == pytest.approx(mean_size(plain, wave), rel=0.25)
    for values in (mean, wave):  # a fit takes some of a slow mean, and little of a wave
        assert learned_nats(real, values) == pytest.approx(learned_nats(plain, values), rel=0.25)
    assert learned_nats(real, mean) < 0.7 * NATS * mean_size(real, mean) ** 2
    assert learned_nats(real, wave) > 0.7 * NATS * mean_size(real, wave) ** 2
    assert variance_size(real, bursts()) == pytest.approx(variance_size(plain, bursts()), rel=0.2)
    shared = np.array([0.3, -0.2, 0.0]), np.ones(BANDS)
    assert shared_size(real, *shared) == pytest.approx(shared_size(plain, *shared), rel=0.1)


@pytest.mark.parametrize("frequency", [0.05, 1.0, 8.0])
def test_size_of_a_wave_in_coloured_noise_is_its_power_over_the_density(frequency):
    record = lfilter(
        [1.0, -0.9], [1.0], white(1)
    )  # nearly angle quantization: hundreds of times stronger at the end of the band
    _, real = draw_both(record)
    wave = np.zeros((3, real.size))
    wave[0] = 0.05 * np.sin(2 * math.pi * frequency * np.arange(real.size) / RATE)
    density = 0.8**2 / RATE * abs(1 - 0.9 * np.exp(-2j * math.pi * frequency / RATE)) ** 2
    assert mean_size(real, wave) == pytest.approx(
        math.sqrt(0.05**2 * SECONDS / 4 / density / NATS), rel=0.2
    )


def test_line_density_is_right_at_the_lowest_lines():
    steps = np.random.default_rng(2).normal(0, 0.01, (200, 4000))
    density = np.mean([smooth_periodogram(np.cumsum(row), rate=1.0)[:4] for row in steps], axis=0)
    k = np.arange(1, 5)
    np.testing.assert_allclose(density, 0.01**2 / (2 * math.pi * k / 8000) ** 2, rtol=0.5)


@pytest.mark.parametrize("strong", [1.0, 1e2, 1e4])
def test_slope_fit_is_the_likelihood_maximum_with_a_strong_line(strong):
    """No combination of white noise, flicker and random walk on a fine grid fits better."""
    rng = np.random.default_rng(2)
    number = np.arange(1.0, 61.0)
    sizes = np.stack(
        np.meshgrid(*[np.exp(np.linspace(-12.0, 12.0, 33))] * 3, indexing="ij"), axis=-1
    ).reshape(-1, 3)
    tried = sizes @ np.stack([number**0, 1.0 / number, number**-2])
    for truth in np.exp(rng.normal(0.0, 3.0, (8, 3))):
        lines = (truth[0] + truth[1] / number + truth[2] / number**2) * rng.exponential(size=60)
        lines[rng.integers(60)] *= strong
        fitted = _fit_slope(lines)(number)
        mine, others = (
            (np.log(density) + lines / density).sum(axis=-1) for density in (fitted, tried)
        )
        assert mine < others.min() + 1e-6


def test_fluctuating_level_hides_slow_changes_only():
    t = np.arange(round(RATE * SECONDS)) / RATE
    rng = np.random.default_rng(3)
    walk = np.cumsum(rng.normal(0, 0.03, math.ceil(SECONDS) + 1))
    plain, real = draw_both(white(3) * np.exp(0.5 * np.interp(t, np.arange(walk.size), walk)))
    quick = np.ones((3, walk.size))
    quick[1] = np.where(np.arange(walk.size) // 40 % 2 == 0, 1.2, 1.0)
    slow = np.ones_like(quick)
    slow[1] = np.linspace(1.0, 1.4, walk.size)
    lost = [variance_size(real, level) / variance_size(plain, level) for level in (slow, quick)]
    assert lost[0] < 0.25 < 0.6 < lost[1]


def test_added_noise_counts_only_in_quiet_bands():
    record = white(4)
    strong = np.zeros_like(record)
    for row in range(3):  # a tenth of the band is a hundred times stronger
        lines = fft.rfft(np.random.default_rng(row).normal(0, 8.0, record.shape[1]))
        lines[: lines.size * 9 // 10] = 0.0
        strong[row] = fft.irfft(lines, record.shape[1])
    (plain, _), (_, real) = draw_both(record), draw_both(record + strong)
    assert variance_size(replace(real, noise=plain.noise), bursts()) == pytest.approx(
        math.sqrt(0.9) * variance_size(plain, bursts()), rel=0.2
    )


def test_size_of_an_injection_refers_to_the_noise_of_the_recording():
    record = lfilter(
        [1.0], [1.0, -0.98], white(5)
    )  # slow noise 50 times that at the shortest times
    log = make_log(record, {}, start=1_700_000_000 * 10**9, rate=RATE)
    made, truth = inject_effect(log, "vibration_rectification", 6.0, np.random.default_rng(6))[
        "injected"
    ]
    mean = np.asarray(made.rate.values) - record
    f = np.arange(1, record.shape[1]) * RATE / 2 / record.shape[1]
    density = 0.8**2 / RATE / abs(1 - 0.98 * np.exp(-2j * math.pi * f / RATE)) ** 2
    nats = sum(
        0.5 * float((fft.dct(row - row.mean(), norm="ortho")[1:] ** 2 / RATE / density).sum())
        for row in mean
    )
    strength = truth["effects"][0]["strength"]
    assert math.sqrt(nats / NATS) == pytest.approx(strength, rel=0.3)
    assert truth["effects"][0]["size"] == strength


def test_injected_shared_source_has_its_signs_and_axes():
    record = white(7)
    log = make_log(record, {}, start=1_700_000_000 * 10**9, rate=RATE)
    two = 0
    for seed in range(12):
        made, truth = inject_effect(log, "shared_source", 8.0, np.random.default_rng(seed))[
            "injected"
        ]
        added = np.asarray(made.rate.values) - record
        has = added.std(axis=1) > 0
        assert [str(axis) for axis in made.axis.values[has]] == truth["effects"][0]["axes"]
        tied = np.corrcoef(added[has])
        assert np.abs(tied).min() > 0.999  # one source
        correlation = truth["effects"][0]["parameters"]["correlation"]["value"]
        shares = np.sort((added.std(axis=1) / 0.8)[has])
        assert shares[-1] * shares[-2] == pytest.approx(correlation, rel=0.1)
        two += has.sum() == 2 or bool((tied < 0).any())
    assert two > 0


def test_injected_spike_exceeds_outliers_of_the_recording():
    wild = white(8)
    wild[:, ::997] += 9.0  # eleven standard deviations
    usual, strong = (measure_noise(record, rate=RATE).outlier_sigma for record in (white(8), wild))
    np.testing.assert_allclose(usual, 0.8, rtol=0.1)
    assert (strong > 1.8).all()
    _, truth = inject_effect(
        make_log(wild, {}, start=1_700_000_000 * 10**9, rate=RATE),
        "spikes",
        4.0,
        np.random.default_rng(9),
    )["injected"]
    assert truth["effects"][0]["parameters"]["spike"]["value"] > 9.0


@pytest.mark.parametrize("effect", ["spikes", "clipping", "spectral_line"])
def test_an_injection_stays_on_the_grid_of_the_recording(effect: str) -> None:
    step = 0.003
    log = make_log(step * np.rint(white(4) / step), {}, start=0, rate=RATE)
    values = inject_effect(log, effect, 8.0, np.random.default_rng(2))["injected"][0]["rate"].values
    assert np.abs(values / step - np.rint(values / step)).max() < 1e-6


@pytest.mark.full
def test_truth_of_an_injection_has_the_axes_of_the_log() -> None:
    log = make_log(white(3)[:1], {}, start=0, rate=RATE).assign_coords(axis=["z"])
    copies = inject_effect(log, "vibration_rectification", 8.0, np.random.default_rng(4))
    (effect,) = copies["injected"][1]["effects"]
    assert effect["axes"] == list(effect["waveform_10s"]) == ["z"]
    assert list(effect["parameters"]["sensitivity"]["values"]) == ["z"]
    assert {tuple(truth["noise"]) for _, truth in copies.values()} == {("z",)}


def test_half_of_the_injections_have_the_strength_from_which_most_should_be_named() -> None:
    strengths = [plan["strength"] for plan in plan_injections(400, seed=3)[::4]]
    assert set(strengths) == {3.0, 5.0, 8.0}
    assert 0.4 < strengths.count(5.0) / len(strengths) < 0.6


def test_injection_adds_the_effect_and_leaves_controls_unchanged():
    log = make_case(small(None))[0][["rate"]]
    copies = inject_effect(log, "vibration_rectification", 6.0, np.random.default_rng(2))
    record = log.rate.values
    np.testing.assert_array_equal(copies["untouched"][0].rate.values, record)
    np.testing.assert_array_equal(copies["flipped"][0].rate.values, -record)
    np.testing.assert_array_equal(copies["reversed"][0].rate.values, record[:, ::-1])
    injected, truth = copies["injected"]
    (effect,) = truth["effects"]
    added = injected.rate.values - record
    assert np.nanmax(np.abs(added)) == pytest.approx(effect["parameters"]["peak"]["value"], rel=0.1)
    for axis in AXES:
        assert (np.nanmax(np.abs(added[AXES.index(axis)])) > 0) == (axis in effect["axes"])
    for copy, copy_truth in copies.values():
        check_log(copy)
        assert set(copy.data_vars) == set(injected.data_vars)
        kind = "injected" if copy_truth["effects"] else "control"
        assert copy_truth["plan"]["kind"] == kind


def test_injection_into_a_quantized_log_keeps_step_and_mean():
    log = make_case(small(None, rate=10.0, seconds=1200))[0][["rate"]]
    counted = np.rint(log.rate.values / 0.5) * 0.5
    copies = inject_effect(
        log.assign(rate=(log.rate.dims, counted, log.rate.attrs)),
        "vibration_rectification",
        8.0,
        np.random.default_rng(2),
    )
    injected, truth = copies["injected"]
    is_finite = np.isfinite(counted)
    assert quantization_step(counted[0]) == pytest.approx(0.5)
    np.testing.assert_allclose(
        np.remainder(injected.rate.values[is_finite] / 0.5 + 0.25, 1.0), 0.25, atol=1e-6
    )
    sent = {axis: np.array(values) for axis, values in truth["effects"][0]["waveform_10s"].items()}
    axis, expected = max(sent.items(), key=lambda item: np.ptp(item[1]))
    row = list(injected.axis.values).index(axis)
    added = np.nanmean((injected.rate.values - counted)[row].reshape(-1, 100), axis=1)
    scatter = 0.5 / math.sqrt(12 * 100)
    assert np.nanmax(np.abs(added - expected)) < 8 * scatter


def test_injection_into_a_real_gyro_log(recordings):
    import pandas as pd

    from gyrostab.ingest.make_log import make_log

    table = pd.read_csv(recordings("rlg-static-30min/lasergyro.csv.gz"), nrows=60_000)
    gyros = [column for column in table.columns if column.lower().startswith(("gyro", "w", "g"))][
        :3
    ]
    log = make_log(table[gyros].to_numpy().T, rate=100.0, unit="deg/h")
    copies = inject_effect(log, "spectral_line", 5.0, np.random.default_rng(4))
    added = copies["injected"][0].rate.values - log.rate.values
    assert np.abs(added).max() > 0
    assert copies["injected"][1]["effects"][0]["name"] == "spectral_line"
