"""Simulated noise against the laws of the table, the spectrum, and itself in other chunks."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gyrostab.errors import OptionError
from gyrostab.kernels.random.stochastic import RATIO, brownian_means, flicker_times
from gyrostab.noise import LAWS, URAD_PER_S
from gyrostab.simulate.noise import FLICKER_LOW, begin_noise, draw, make_noise, shape
from tests.support.effect_bench import markov_avar, sinusoid_avar

RATE = 50.0
LENGTH, RECORDS = 500, 5000
TAUS = np.unique(np.geomspace(1, LENGTH // 10, 12).astype(int))
SIZES = {"Q": 0.5, "N": 0.01, "B": 0.1, "K": 0.3, "R": 1.0}
MARKOV = (0.2, 0.15)  # deg/h, s
SINE = (0.3, 2.3, 0.4)  # deg/h, Hz, rad


def allan(records: np.ndarray, *numbers: int, rate: float = RATE) -> np.ndarray:
    """Ensemble mean of the overlapping Allan variance of `records` (record, time).

    At each of these numbers of samples.
    """
    angle = np.cumsum(np.pad(records, ((0, 0), (1, 0))), axis=1) / rate
    variances = []
    for k in numbers:
        second = angle[:, 2 * k :] - angle[:, k:-k]
        second -= angle[:, k:-k]
        second += angle[:, : -2 * k]
        variances.append(np.vdot(second, second) / second.size / (2 * (k / rate) ** 2))
    return np.array(variances)


def laws(term: str, tau: np.ndarray) -> np.ndarray:
    if term == "gauss_markov":
        return markov_avar(tau, *MARKOV)
    if term == "sinusoid":
        return sinusoid_avar(tau, *SINE[:2])
    return LAWS[term].avar(tau, SIZES[term])


def records(term: str) -> np.ndarray:
    size = {"gauss_markov": MARKOV, "sinusoid": SINE}.get(term) or SIZES[term]
    return make_noise(rate=RATE, size=LENGTH * RECORDS, seed=3, **{term: size}).reshape(
        RECORDS, LENGTH
    )


@pytest.fixture(scope="module")
def ensembles() -> dict[str, np.ndarray]:
    return {}


@pytest.mark.parametrize("term", [*"QNBKR", "gauss_markov", "sinusoid"])
def test_ensemble_allan_variance_matches_the_law_at_every_tau(term, ensembles):
    """From one sample to a tenth of the record, within 2 % (the ensemble scatters by 0.7 %)."""
    ensembles[term] = made = records(term)
    variance = allan(made, *TAUS)
    expected = laws(term, TAUS / RATE)
    np.testing.assert_allclose(
        variance, expected, rtol=0.02, atol=2e-4 * expected.max() if term == "sinusoid" else 0.0
    )


@pytest.mark.parametrize("term", [*"QNBK", "gauss_markov"])
def test_ensemble_spectrum_integrates_to_the_law(term, ensembles):
    """P16 Eq. 7: sigma^2 = int S(f) 2 sin^4(pi f tau) / (k sin(pi f dt))^2 df over all f.

    For samples, whose angle is a sum, (k sin(pi f dt))^2 stands for (pi f tau)^2; aliases are in S
    already.
    """
    made = ensembles.get(term)
    made = (records(term) if made is None else made).reshape(-1, 4000)
    window = np.hanning(4001)[:-1]
    flat = made - made.mean(axis=1, keepdims=True)
    power = np.abs(np.fft.rfft(flat * window, axis=1)) ** 2
    density = power.mean(axis=0) / (window**2).sum() / RATE  # two-sided
    f = np.fft.rfftfreq(4000, 1 / RATE)[1:]
    for k in (1, 2, 5, 10, 20):
        transfer = 2 * np.sin(np.pi * f * k / RATE) ** 4 / (k * np.sin(np.pi * f / RATE)) ** 2
        weight = np.where(f == RATE / 2, 1.0, 2.0)
        variance = float((weight * density[1:] * transfer).sum() * RATE / 4000)
        assert variance == pytest.approx(float(laws(term, np.array(k / RATE))), rel=0.02), k


@pytest.mark.parametrize("rate", [0.1, 10.0, 400.0, 2000.0])
def test_flicker_is_flat_from_one_sample_to_twenty_hours(rate):
    """Compute the exact Allan variance of the sum of processes, the fast ones as white noise."""
    times = flicker_times(rate, low=FLICKER_LOW)
    tau = np.geomspace(1 / rate, 72000.0, 300)
    share = np.log(RATIO) / np.pi
    variance = sum(share * markov_avar(tau, 1.0, time) for time in times)
    faster = times[-1] / RATIO ** np.arange(1, 40)
    variance = variance + share * 2 * faster.sum() / tau
    np.testing.assert_allclose(variance, LAWS["B"].avar(tau), rtol=0.004)
    assert times[-1] <= 1 / rate / 12


def test_flicker_keeps_to_its_band():
    band = make_noise(rate=100.0, size=2**17, B=1.0, seed=2, flicker_band=(0.1, 5.0))
    power = np.abs(np.fft.rfft(band)) ** 2 / band.size / 100.0
    f = np.fft.rfftfreq(band.size, 0.01)
    law = 1 / (2 * np.pi * np.maximum(f, 1e-9))

    def share(low, high):
        part = (f > low) & (f < high)
        return power[part].mean() / law[part].mean()

    assert share(0.4, 1.5) == pytest.approx(1.0, abs=0.1)
    assert share(0.003, 0.01) < 0.15
    assert share(30.0, 50.0) < 0.35  # falls off with one more power of f


def test_random_walk_is_averaged_not_sampled():
    """Point samples have (K^2 tau / 3) (1 + 1 / (2 k^2)); means have K^2 tau / 3."""
    rng = np.random.default_rng(1)
    steps = rng.standard_normal((RECORDS, 60))
    sampled = np.cumsum(steps, axis=1)
    averaged = np.stack([brownian_means(row, rng.standard_normal(60), 0.0)[0] for row in steps])
    for k in (1, 2, 5):
        assert allan(sampled, k, rate=1.0) == pytest.approx(k / 3 * (1 + 1 / (2 * k**2)), rel=0.02)
        assert allan(averaged, k, rate=1.0) == pytest.approx(k / 3, rel=0.02)


def test_quantization_is_a_bounded_error_of_the_angle():
    rate = make_noise(rate=RATE, size=20_000, Q=0.5, seed=1)
    angle = np.cumsum(rate) / RATE / URAD_PER_S
    assert np.ptp(angle) <= 0.5 * np.sqrt(12)  # one least significant bit
    assert angle.std() == pytest.approx(0.5, rel=0.03)
    assert np.abs(np.corrcoef(angle[1:], angle[:-1])[0, 1]) < 0.02


# --------------------------------------------------------------------------------
# streams

ALL = {**SIZES, "gauss_markov": MARKOV, "sinusoid": SINE}


@settings(max_examples=10)
@given(chunk=st.integers(3, 700), seed=st.integers(0, 2**40))
def test_chunks_do_not_change_a_bit(chunk, seed):
    whole = make_noise(rate=RATE, size=600, seed=seed, **ALL)
    cut = make_noise(rate=RATE, size=600, seed=seed, chunk=chunk, **ALL)
    np.testing.assert_array_equal(cut, whole)


def test_a_longer_record_begins_like_a_shorter_one():
    np.testing.assert_array_equal(
        make_noise(rate=RATE, size=2000, **ALL)[:700], make_noise(rate=RATE, size=700, **ALL)
    )


def test_each_term_is_the_same_with_and_without_the_others():
    parts = sum(
        make_noise(rate=RATE, size=3000, seed=7, **{name: size}) for name, size in ALL.items()
    )
    np.testing.assert_allclose(
        make_noise(rate=RATE, size=3000, seed=7, **ALL), parts, rtol=0, atol=1e-9
    )


@pytest.mark.parametrize(
    "size",
    [{"Q": 0.5}, {"N": 0.01}, {"B": 0.5}, {"K": 3.0}, {"gauss_markov": (1.0, 0.5)}],
    ids=lambda size: next(iter(size)),
)
def test_axes_and_seeds_are_independent(size):
    made = np.array(
        [
            make_noise(seed=seed, axis=axis, rate=RATE, size=40_000, **size)
            for seed in (1, 2)
            for axis in "xyz"
        ]
    )
    # differences, for what wanders is never far from correlated
    correlation = np.corrcoef(np.diff(made)) - np.eye(6)
    assert np.abs(correlation).max() < 6.0 / np.sqrt(40_000)


def test_level_may_change_from_sample_to_sample():
    state = begin_noise(1, "x", rate=RATE, terms="QNBK")
    units, _ = draw(state, 0, 6000)
    high = np.where(np.arange(6000) < 3000, 1.0, 9.0)
    for term in "QNBK":
        level = {other: 0.0 for other in "QNBK"} | {term: high}
        plain, _ = shape(units, {other: 0.0 for other in "QNBK"} | {term: 1.0}, RATE, {})
        raised, _ = shape(units, level, RATE, {})
        np.testing.assert_allclose(
            raised[:2999], plain[:2999], rtol=0, atol=1e-9 * np.abs(plain).max()
        )
        if term == "K":  # increments, not the position, are three times as large
            np.testing.assert_allclose(
                raised[3001:] - raised[3000], 3 * (plain[3001:] - plain[3000]), rtol=1e-9
            )
        else:
            np.testing.assert_allclose(raised[3001:], 3 * plain[3001:], rtol=1e-9)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"N": -1.0}, "N=-1.0: give a number from 0 up"),
        ({"rate": 0.0}, "rate=0.0: give a number above 0"),
        ({"K": np.nan}, "K=nan"),
        ({"N": "0.01"}, "N='0.01': give a number from 0 up"),
        ({"rate": None}, "rate=None: give a number above 0"),
        (
            {"B": 1.0, "flicker_band": (1.0,)},
            r"flicker_band=\(1.0,\): give the lowest and the high",
        ),
        ({"size": 1000.0}, "size=1000.0: give a whole number of samples"),
        ({"gauss_markov": (1.0, 0.0)}, "gauss_markov=.*correlation time in s, above 0"),
        ({"gauss_markov": (1.0, -5.0)}, "gauss_markov=.*correlation time in s, above 0"),
        ({"gauss_markov": (1.0,)}, "gauss_markov=.*correlation time in s, above 0"),
        ({"sinusoid": (1.0, 2.0)}, "sinusoid=.*phase in rad"),
        ({"B": 1.0, "flicker_band": (1e-60, 1.0)}, "1e-60 to 1 Hz begins below 1e-30 Hz; give the"),
        ({"B": 1.0, "flicker_band": (2.0, 1.0)}, "band of flicker noise 2 to 1 Hz is empty"),
    ],
)
def test_wrong_numbers_are_named(wrong, words):
    with pytest.raises(OptionError, match=words):
        make_noise(**{"rate": RATE, "size": 10, **wrong})
