"""The search for sines of constant phase, against simulated noise and closed forms."""

import numpy as np
import pytest
from scipy.special import gammaln

from gyrostab.diagnose.evidence.spectral_lines import line_evidence
from gyrostab.diagnose.predict.candidates import Candidate, Component, Variant
from gyrostab.diagnose.reduce import steady_sines
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.reduce.steady_sines import SineSearch, sine_factors
from gyrostab.diagnose.statistics import find_statistic
from gyrostab.diagnose.statistics.spectral_line import estimate_line
from gyrostab.ingest.make_log import make_log
from tests.support.named import name_effects, nulls

RATE, LENGTH, BLOCKS = 10.0, 200, 90
SIZE = LENGTH * BLOCKS
LINES = RATE / LENGTH * np.arange(1, LENGTH // 2)


def search(values, *, batch=LENGTH):
    sine_search = SineSearch(len(values), values.shape[1] // LENGTH, LENGTH, RATE)
    for begin in range(0, values.shape[1], batch):
        sine_search.add(values[:, begin : begin + batch])
    return sine_search.strongest(LINES)


def wave(frequency, amplitude, size=SIZE, phase=0.7):
    return amplitude * np.sin(2.0 * np.pi * frequency * np.arange(size) / RATE + phase)


@pytest.mark.parametrize("count", [1, 8])
def test_bayes_factor_of_noise_has_mean_one(count):
    ratio = np.geomspace(1e-8, 1e9, 400_001)
    log_density = (
        (count - 1) * np.log(ratio) - count * ratio + count * np.log(count) - gammaln(count)
    )
    mean = np.trapezoid(np.exp(log_density + sine_factors(ratio, count)), ratio)
    assert mean == pytest.approx(1.0, abs=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("case", ["white", "lost", "walk", "quantized", "burst"])
def test_noise_has_no_sine(case):
    rng = np.random.default_rng([1, len(case)])
    largest = []
    for _ in range(15):
        noise = rng.standard_normal((3, SIZE))
        if case == "lost":
            noise[:, rng.random(SIZE) < 0.4] = np.nan
            noise[:, 5000:7000] = np.nan
        elif case == "walk":
            noise = 0.1 * noise + np.cumsum(0.03 * rng.standard_normal((3, SIZE)), axis=1)
        elif case == "quantized":
            noise = np.round(noise)
        elif case == "burst":
            noise[:, 5000:8000] *= 30.0
        largest.append(search(noise)["sine_nats"].max(axis=1).max())
    # A Bayes factor of e^2 is reached in at most e^-2 of the records; 8 nats name an effect.
    assert np.mean(np.array(largest) > 2.0) <= 0.07
    assert max(largest) < 5.0


def test_constant_axis_has_no_sine():
    noise = np.random.default_rng(4).standard_normal((3, SIZE))
    expected = search(noise[:2])["sine_nats"]
    noise[2] = 5.0
    sines = search(noise)["sine_nats"]
    assert np.isneginf(sines[2]).all()
    np.testing.assert_allclose(sines[:2], expected, atol=1e-6)


@pytest.mark.parametrize("frequency", [0.0721, 0.1043, 0.70713, 1.3, 4.61])
def test_finds_a_sine_that_blocks_do_not_show(frequency):
    rng = np.random.default_rng(2)
    amplitude = np.sqrt(4.0 * 60.0 / SIZE)  # 60 nats in white noise of variance 1
    noise = rng.standard_normal((3, SIZE))
    noise[:2] += wave(frequency, amplitude)
    noise[:, rng.random(SIZE) < 0.1] = np.nan
    blocks = reduce_log(make_log(noise, rate=RATE, unit="deg/h"))
    place = int(np.argmin(np.abs(blocks["line_frequency"].values - frequency)))
    by_blocks = line_evidence(blocks["line_power"].values[None], blocks["line_weight"].values)[0]
    assert by_blocks[:, place].max() < 10.0
    line = blocks.isel(line=place)
    assert (line["sine_nats"][:2].values > 12.0).all()
    assert line["sine_nats"][2] < 0.0
    assert abs(line["sine_frequency"] - frequency) < 0.3 * RATE / SIZE
    assert blocks["sine_nats"].drop_isel(line=[place - 1, place, place + 1]).max() < 2.0


def test_finds_a_line_whose_phase_wanders():
    rng = np.random.default_rng(3)
    drift = np.cumsum(rng.normal(0.0, np.sqrt(36.0 / SIZE), SIZE))  # 6 rad in the record
    amplitude = np.sqrt(4.0 * 120.0 / SIZE)
    phase = 2.0 * np.pi * 1.303 * np.arange(SIZE) / RATE + drift
    noise = rng.standard_normal((1, SIZE)) + amplitude * np.sin(phase)
    sines = search(noise)
    place = int(sines["sine_nats"][0].argmax())
    assert sines["sine_nats"][0, place] > 10.0
    assert abs(sines["sine_frequency"][place] - 1.303) < 2.0 * sines["sine_resolution"][place]
    assert sines["sine_resolution"][place] > 2.0 * RATE / SIZE  # seen in the parts of the record


@pytest.mark.slow
@pytest.mark.parametrize("lost", ["none", "scattered", "stretches"])
def test_amplitude_has_the_error_it_states(lost):
    rng = np.random.default_rng(4)
    amplitude, errors = np.sqrt(4.0 * 60.0 / SIZE), []
    for _ in range(60):
        frequency = rng.uniform(1.0, 4.0)
        noise = rng.standard_normal((1, SIZE)) + wave(
            frequency, amplitude, phase=rng.uniform(0.0, 6.0)
        )
        if lost == "scattered":
            noise[:, rng.random(SIZE) < 0.4] = np.nan
        elif lost == "stretches":
            noise[:, 2000:5000] = noise[:, 9000:9600] = np.nan
        sines = search(noise)
        place = int(sines["sine_nats"][0].argmax())
        square, stderr = sines["sine_square"][0, place], sines["sine_square_stderr"][0, place]
        errors.append((square - amplitude**2) / stderr)
    assert abs(np.mean(errors)) < 0.35
    assert 0.7 < np.std(errors) < 1.3


def test_depends_neither_on_batches_nor_much_on_segments(monkeypatch):
    rng = np.random.default_rng(5)
    noise = rng.standard_normal((2, SIZE)) + wave(2.2, 0.15)
    whole, by_parts = search(noise), search(noise, batch=1_700)
    for name, values in whole.items():
        np.testing.assert_array_equal(values, by_parts[name])
    monkeypatch.setattr(steady_sines, "_MAX_SAMPLES", SIZE // 3)
    cut = search(noise)
    place = int(whole["sine_nats"].sum(axis=0).argmax())
    assert cut["sine_resolution"][place] == pytest.approx(3.0 * whole["sine_resolution"][place])
    assert cut["sine_nats"][0, place] > 0.6 * whole["sine_nats"][0, place]


def test_short_records_and_silent_axes_have_no_search():
    assert np.isneginf(search(np.zeros((1, 24 * LENGTH // 20)))["sine_nats"]).all()
    noise = np.random.default_rng(6).standard_normal((2, SIZE))
    noise[1] = np.nan
    sines = search(noise)["sine_nats"]
    assert np.isneginf(sines[1]).all()
    assert np.isfinite(sines[0]).any()


@pytest.mark.slow
def test_weak_sine_is_named_with_frequency_and_amplitude():
    rng = np.random.default_rng(7)
    amplitude = np.sqrt(4.0 * 60.0 / SIZE)
    noise = rng.standard_normal((1, SIZE)) + wave(1.7321, amplitude)
    blocks = reduce_log(make_log(noise, rate=RATE, unit="deg/h"))
    identified = name_effects(blocks, *nulls(blocks, 20)).identified
    assert [identification.effect for identification in identified] == ["spectral_line"]
    place = identified[0].components[0].line_index
    (size, stderr), (frequency, error) = estimate_line(blocks, "x", place)
    assert abs(size - amplitude) < 3.0 * stderr < 0.5 * amplitude
    assert abs(frequency - 1.7321) < 2.0 * error < 0.002


@pytest.mark.parametrize("is_steady", [True, False])
def test_a_sine_counts_by_its_phase_if_that_is_constant(is_steady: bool) -> None:
    rng = np.random.default_rng(5)
    noise = rng.standard_normal((1, SIZE))
    turns = 0.0 if is_steady else np.cumsum(rng.standard_normal(SIZE)) / np.sqrt(SIZE / 100.0)
    phase = 2.0 * np.pi * 0.1543 * np.arange(SIZE) / RATE + turns
    noise += np.sqrt(4.0 * (60.0 if is_steady else 600.0) / SIZE) * np.sin(phase)
    blocks = reduce_log(make_log(noise, rate=RATE, unit="deg/h", axis=["x"]))
    place = round(0.1543 / float(blocks["line_frequency"][0])) - 1
    line = find_statistic("spectral_line")
    variant = Variant({}, ("amplitude",), np.empty(0), squared=True)
    component = Component(
        Candidate("spectral_line", line, (), (variant,)), variant, ("x",), 50.0, place
    )
    assert line.is_only_in_phase(component, blocks) is is_steady


def test_blocks_longer_than_a_segment_have_no_search():
    sines = SineSearch(1, 24, 3_600_000, 1000.0)
    sines.add(np.zeros((1, 100)))
    assert np.isneginf(sines.strongest(np.arange(1.0, 5.0))["sine_nats"]).all()
