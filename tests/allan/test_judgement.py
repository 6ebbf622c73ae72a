"""Sentences of judgement follow from the product; suggested windows observe what they claim."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest

from gyrostab import davar, fit_noise, make_log
from gyrostab.allan.judgement import judge_product, smallest_observable, suggest_windows
from gyrostab.noise import LAWS
from gyrostab.schema import NOT_OBSERVABLE, OBSERVED, UPPER_LIMIT_ONLY
from gyrostab.simulate import simulate
from tests.support import synthetic

WHITE = 0.01


@pytest.mark.parametrize("term", ["B", "K", "R"])
def test_half_of_the_windows_observe_the_smallest_observable_coefficient(term):
    """The size that half of 42 windows observe is within a factor of 1.5 of the claim."""
    window = 600.0
    size = smallest_observable(window, WHITE)[term]
    shares = []
    for factor in (1.0 / 1.5, 1.5):
        log = simulate(
            {"noise": {"N": WHITE, term: factor * size}}, duration=14 * window, rate=10.0, seed=3
        )
        product = fit_noise(davar(log.load(), window="600s", step="600s"))
        is_observed = product["observable"].sel(term=term) == OBSERVED
        shares.append(float(is_observed.mean()))
    assert shares[0] < 0.5 < shares[1]


def _make_product(states: dict[str, int], vibration: list[float] | None = None):
    """A product of three axes with steady coefficients, and a state of each term."""
    product = synthetic.product()
    product["observable"] = product["observable"].copy()
    for term in LAWS:
        product[term] = (product["window_mean"] * 0.0).fillna(0.0) + 1.0
        product[f"{term}_stderr"] = 0.05 * product[term]
        product["observable"].loc[{"term": term}] = states.get(term, OBSERVED)
    if vibration is not None:
        product["vibration"] = ("time", np.resize(vibration, product.sizes["time"]))
    return product.drop_vars(["temperature", "temperature_rate"], errors="ignore")


def test_a_steady_product_is_called_steady():
    steady, terms = judge_product(_make_product({}))
    assert steady.startswith(
        "N is steady within its errors: it varies by 0 % on x, 0 % on y, 0 % on z"
    )
    assert terms.startswith("All five terms are observed")


@pytest.mark.parametrize(
    ("changes", "is_wrong"),
    [
        (["2026-01-01T00:20", "2026-01-01T00:40"], False),  # after the windows
        (["2025-12-31T23:00", "2025-12-31T23:50"], False),  # before them
        (["2025-12-31T23:00", "2025-12-31T23:50", "2026-01-01T00:05", "2026-01-01T00:06"], True),
        (["2026-01-01T00:05"], True),  # without its end
    ],
)
def test_only_windows_at_another_rate_cannot_be_judged(changes, is_wrong):
    noise = np.random.default_rng(2).standard_normal(6000)
    log = make_log(noise, rate=10.0, unit="deg/h", start="2026-01-01")
    product = fit_noise(davar(log, window="60s")).assign_attrs(rate_changes=changes)
    assert ("at another rate than 10 Hz" in judge_product(product)[0]) == is_wrong


def test_a_change_names_its_channel_axis_and_size():
    product = _make_product({}, vibration=[0.0, 8.0])
    product["N"].loc[{"axis": "x"}] = np.resize([1.0, 5.0], product.sizes["time"])
    assert judge_product(product)[0] == (
        "N is larger by a factor of 5 on x while vibration is high."
    )


@pytest.mark.parametrize(
    ("high", "sentence"),
    [
        (1.3, "N is larger by a factor of 1.3 on x while vibration is high."),
        (1.24, "N is larger by a factor of 1.2 on x while vibration is high."),
        # 3 times the error of the difference of two windows, 5 % each, is 0.21 in the logarithm
        (1.23, "N is steady within its errors: it varies by 10 % on x, 0 % on y, 0 % on z"),
    ],
)
def test_a_change_is_one_beyond_the_errors_of_its_windows(high, sentence):
    product = _make_product({}, vibration=[0.0, 8.0])
    product["N"].loc[{"axis": "x"}] = np.resize([1.0, high], product.sizes["time"])
    product["N_stderr"] = 0.05 * product["N"]
    assert judge_product(product)[0].startswith(sentence)


@pytest.mark.parametrize("high", [1.3, 1.4])
def test_n_varies_beyond_three_errors_on_either_side(high):
    product = _make_product({})
    product["N"].loc[{"axis": "x"}] = np.resize([1.0, high], product.sizes["time"])
    varies = "N varies by a factor of 1.4 on x (highest around 2026-"
    assert judge_product(product)[0].startswith(varies) == (high > math.exp(6 * 0.05))


@pytest.mark.parametrize("seed", range(3))
def test_white_noise_does_not_change_with_its_channels(seed):
    noise = np.random.default_rng(seed).standard_normal((3, 72_000))
    log = make_log(noise, rate=10.0, unit="deg/h")
    places = np.arange(72_000)
    level, smooth = (places // 9000) % 2.0, np.sin(places / 30_000)
    channels = {"vibration": level, "temperature": 150.0 + 30.0 * smooth}
    units = {"vibration": "9.80665 m s-2", "temperature": "degree_Celsius"}
    log = log.assign({name: ("time", channels[name], {"units": units[name]}) for name in units})
    product = fit_noise(davar(log, window="10min"))
    assert judge_product(product)[0].startswith("N is steady within its errors")


def test_a_coefficient_of_zero_is_not_judged():
    product = _make_product({}, vibration=[0.0, 8.0])
    product["N"].loc[{"axis": "x"}] = 0.0
    text = judge_product(product)[0]
    assert text.startswith("N is steady within its errors: it varies by 0 % on y, 0 % on z")


def test_a_term_that_one_state_hides_is_named():
    product = _make_product({"B": UPPER_LIMIT_ONLY}, vibration=[0.0, 8.0])
    product["observable"].loc[{"term": "B", "time": product["time"][::2]}] = OBSERVED
    assert "B only while vibration is low" in judge_product(product)[1]


def test_unobserved_terms_come_with_a_longer_window_or_a_longer_record():
    product = _make_product({"B": UPPER_LIMIT_ONLY, "K": NOT_OBSERVABLE})
    text = judge_product(product)[1]
    assert text.startswith("B and K are not observed in windows of 6s: use a window (--window) of ")
    assert "only a longer record" in judge_product(product.isel(time=slice(0, 4)))[1]
    assert "sampling rate" in judge_product(_make_product({"Q": UPPER_LIMIT_ONLY}))[1]


def test_a_fit_that_ends_early_is_the_reason_that_is_given():
    product = _make_product({"B": UPPER_LIMIT_ONLY, "K": NOT_OBSERVABLE})
    product.attrs["fit_tau_max_s"] = float(product["tau"][2])
    assert judge_product(product)[1].endswith(
        f": the fit ends at an averaging time of {product['tau'].values[2]:.3g} s "
        "(tau_max, --fit-to); longer ones may show B and K."
    )


def test_terms_observed_as_often_as_by_chance_count_as_unobserved():
    product = _make_product({"B": UPPER_LIMIT_ONLY}).isel(time=np.zeros(60, dtype=int))
    product["time"] = np.datetime64("2026-03-14", "ns") + np.arange(60) * np.timedelta64(10, "m")
    product["observable"].loc[{"term": "B", "time": product["time"][7]}] = OBSERVED
    text = judge_product(product)[1]
    assert text.startswith("B is observed in windows of 6s no more often than by chance (in up to")
    product["observable"].loc[{"term": "B", "time": product["time"][7:9]}] = OBSERVED
    assert judge_product(product)[1].startswith("All five terms are observed")


def test_a_longer_record_is_not_advised_for_what_it_cannot_show():
    short = slice(0, 4)
    product = _make_product({"Q": NOT_OBSERVABLE, "K": UPPER_LIMIT_ONLY}).isel(time=short)
    assert judge_product(product)[1].endswith("; only a longer record could show K.")
    product = _make_product(dict.fromkeys("QNBKR", UPPER_LIMIT_ONLY)).isel(time=short)
    assert judge_product(product)[1] == "No term is observed in windows of 6s."


def test_windows_with_too_few_samples_have_a_sentence_on_min_coverage():
    noise = 6.0 * np.random.default_rng(3).standard_normal(33_000)  # N = 0.014 deg/sqrt(h)
    bursts = np.where(np.arange(noise.size) % 3000 < 240, noise, np.nan)
    log = make_log(bursts, rate=50.0, unit="deg/h")
    windows = {"window": "2min", "step": "1min"}
    text = judge_product(fit_noise(davar(log, **windows)))[1]
    assert text.startswith("No term is observed in windows of 2min: they hold at most 8 % of their")
    assert "less than 10 % is left are not used; give a min_coverage (--min-coverage)" in text
    product = fit_noise(davar(log, **windows, min_coverage=0.05))
    assert (product["observable"].sel(term="N") == OBSERVED).all()
    assert float(product["N"].median()) == pytest.approx(0.014142, rel=0.05)
    gap = fit_noise(davar(log.assign(rate=log["rate"] * np.nan), **windows))
    assert judge_product(gap)[1].endswith("in windows of 2min: they hold no sample.")


def test_suggested_windows_fit_the_record():
    lines = suggest_windows(86400.0, WHITE)
    assert "N is about 0.01 deg/sqrt(h)" in lines[0]
    assert [line.split()[1].rstrip(":") for line in lines[1:-1]] == [
        "1min",
        "5min",
        "20min",
        "1h",
        "4h",
    ]
    assert "--window 4h --step 24min" in lines[-1]
    assert suggest_windows(100.0, WHITE) == []
    assert suggest_windows(1e5, float("nan")) == []


def test_terms_that_were_not_fitted_are_not_missed():
    product = _make_product(dict.fromkeys("QBKR", UPPER_LIMIT_ONLY)).assign_attrs(fit_terms="N")
    assert judge_product(product)[1].startswith("All fitted terms are observed")
    product = _make_product({"B": UPPER_LIMIT_ONLY, "R": UPPER_LIMIT_ONLY})
    text = judge_product(product.assign_attrs(variance="hadamard"))[1]
    assert text.startswith("B is not observed")
    assert "which observes" not in text


def test_a_decrease_and_a_channel_called_a_rate_are_described_as_what_they_are():
    product = _make_product({}, vibration=[0.0, 8.0]).rename(vibration="flow_rate")
    product["N"].loc[{"axis": "x"}] = np.resize([5.0, 1.0], product.sizes["time"])
    assert judge_product(product)[0] == (
        "N is smaller by a factor of 5 on x while flow rate is high."
    )


@pytest.mark.parametrize("term", "BKR")
def test_page_on_windows_has_the_sizes_that_half_of_them_observe(term):
    page = Path(__file__).parents[2] / "docs/how-to/choose-the-window.md"
    (row,) = (
        line for line in page.read_text(encoding="utf-8").splitlines() if f" {term} [" in line
    )
    assert f"from {smallest_observable(3600.0, 1.0)[term]:g} N /" in row
    size, hours = map(float, re.search(rf"{term} = ([\d.]+) .*W = ([\d.]+) h", row).groups())
    assert smallest_observable(hours * 3600.0, 0.01)[term] == pytest.approx(size, rel=0.03)
