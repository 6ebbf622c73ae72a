"""The text of `gyrostab run`: terms, misfit, outliers, motion, and the time to fit from."""

import re

import numpy as np
import pytest

import gyrostab
from gyrostab.allan.plan import choose_window
from gyrostab.allan.summary import (
    describe_record,
    find_fit_from,
    format_product,
    summarise_fit,
    summarise_terms,
)
from gyrostab.cli import main
from gyrostab.kernels.allan.biased_samples import count_outliers
from tests.support import synthetic

RATE = 100.0
NOISE_DEG_H = 6.0  # white, standard deviation of a sample at 100 Hz: N = 0.01 deg/sqrt(h)


def make_product(values, window="60s", **options):
    log = gyrostab.make_log(values, rate=RATE, unit="deg/h")
    return gyrostab.fit_noise(gyrostab.davar(log, window=window, step=window), **options)


def white(samples, seed):
    return NOISE_DEG_H * np.random.default_rng(seed).standard_normal(samples)


def filtered(samples, seed):
    """White noise after a boxcar of ten samples; the terms fail below 0.1 s."""
    return np.convolve(white(samples + 9, seed), np.ones(10) / 10, mode="valid")


def test_a_term_counts_as_observed_where_most_windows_observe_it():
    product = synthetic.product(axes="x", windows=20)
    number = list(product.term.values).index("K")
    product["observable"][:, :, number] = 1
    product["observable"][:, :2, number] = 2
    product["K"][:] = np.where(product["observable"].sel(term="K") == 2, 7.0, np.nan)
    product["K_upper"][:] = np.where(product["observable"].sel(term="K") == 1, 30.0, np.nan)
    terms = {term.symbol: term for term in summarise_terms(product)}
    assert (terms["K"].status, terms["K"].value) == ("upper_limit_only", 30.0)
    assert (terms["K"].median, terms["K"].observed_share) == (7.0, 0.1)
    assert terms["N"].status == "observed"
    assert terms["N"].value == pytest.approx(float(product.N.median()))


def test_white_noise_is_described_and_a_filter_is_not():
    product = make_product(white(120_000, 1))
    (fit,) = summarise_fit(product)
    assert not fit.fails
    assert 0.6 < fit.chi2_per_dof < 1.4
    assert find_fit_from(product) is None
    product = make_product(filtered(120_000, 2), tau_min="all")
    (fit,) = summarise_fit(product)
    assert fit.fails
    assert fit.chi2_per_dof > 5
    assert all(term.status == "upper_limit_only" for term in summarise_terms(product))


def test_fit_from_the_proposed_averaging_time_describes_the_record():
    product = make_product(filtered(240_000, 3), window="2min", tau_min="all")
    start = find_fit_from(product)
    assert 0.05 < start < 1.0
    text = format_product(product)
    assert f"fit again with tau_min (--fit-from) {start:.3g}s" in text
    refitted = gyrostab.fit_noise(product, tau_min=start)
    assert not summarise_fit(refitted)[0].fails
    # 1.005: the boxcar leaves the noise at averaging times of ten filter lengths and more as it was
    white = {term.symbol: term for term in summarise_terms(refitted)}["N"]
    assert (white.status, white.value) == ("observed", pytest.approx(0.01, rel=0.1))


@pytest.mark.parametrize(("terms", "advised"), [("NB", True), ("QNBKR", False)])
def test_terms_that_were_left_out_are_named_as_a_reason_of_misfit(terms, advised):
    line = white(12_000, 8) + 20.0 * np.sin(0.3 * np.arange(12_000))  # which no term describes
    lines = describe_record(make_product(line, window="1min", terms=terms, tau_min="all"))
    misfit = next(line for line in lines if line.startswith("The terms do not describe x"))
    assert misfit.endswith(", or fit all terms (--terms QNBKR).") == advised


def test_a_single_window_has_standard_errors_in_place_of_a_range():
    product = make_product(white(12_000, 7), window="2min")
    lines = format_product(product).splitlines()
    assert "of a single window" in lines[0]
    assert lines[2].split()[2:5] == ["value", "standard", "error"]
    row = next(line.split() for line in lines if line.split()[1:2] == ["N"])
    assert float(row[3]) == pytest.approx(float(product["N_stderr"][0, 0]), rel=0.01)


def test_single_outliers_are_counted_and_noisy_spans_are_not():
    rng = np.random.default_rng(4)
    values = rng.standard_normal(40_000)
    starts = np.arange(0, 40_000, 10_000)
    assert count_outliers(values, starts, 10_000).tolist() == [0, 0, 0, 0]
    values[12_000:12_600] *= 50.0  # noisier for six seconds
    assert count_outliers(values, starts, 10_000).tolist() == [0, 0, 0, 0]
    values[[5, 9_000, 25_000, 25_004]] += [40.0, -40.0, 60.0, 60.0]
    assert count_outliers(values, starts, 10_000).tolist() == [2, 0, 2, 0]
    assert count_outliers(np.round(100 * values).astype(np.int32), starts, 10_000).tolist() == [
        2,
        0,
        2,
        0,
    ]
    values[24_000:24_990] = np.nan
    assert count_outliers(values, starts, 10_000).tolist() == [2, 0, 2, 0]


@pytest.mark.parametrize("place", [0, 19_999, 7_999, 8_001])
def test_outliers_at_an_end_and_next_to_a_lost_sample_are_counted(place):
    values = np.random.default_rng(6).standard_normal(20_000)
    values[8_000] = np.nan
    angles = np.cumsum(100.0 + np.nan_to_num(values)) + 0.0 * values
    assert count_outliers(angles, np.array([0]), 20_000).tolist() == [0]
    values[place] += 40.0
    assert count_outliers(values, np.array([0]), 20_000).tolist() == [1]


def test_slope_and_step_are_not_outliers():
    values = np.random.default_rng(5).standard_normal(20_000) + 100.0 * np.arange(20_000)
    values[10_000:] += 1e4
    assert count_outliers(values, np.array([0]), 20_000).tolist() == [0]


def test_values_on_a_coarse_grid_are_not_outliers():
    values = np.round(np.random.default_rng(6).standard_normal(50_000) * 0.3)
    assert count_outliers(values, np.array([0]), 50_000).tolist() == [0]


def test_outliers_and_motion_are_named_with_the_axis():
    values = np.stack([white(60_000, 7), white(60_000, 8)])
    values[0, [100, 30_000]] += 500.0
    values[1, 20_000:30_000] += 200.0  # turns at 200 deg/h for 100 s
    text = "\n".join(describe_record(make_product(values)))
    assert re.search(r"Outliers.*: x in 2 windows \(at most 1 in one\); N includes them", text)
    assert re.search(r"more than twice the Earth rate: y in [23] windows", text)


def test_outliers_get_no_advice_on_the_averaging_times():
    values = white(120_000, 7)
    values[np.random.default_rng(3).choice(120_000, 40, replace=False)] += 500.0
    text = "\n".join(describe_record(make_product(values, window="2min")))
    assert "these windows hold outliers, which no tau_min (--fit-from) removes" in text
    assert "fit again" not in text


def test_a_shorter_record_gets_a_shorter_window():
    def window(samples, rate=RATE):
        return choose_window(gyrostab.make_log(np.zeros(samples), rate=rate, unit="deg/h"))

    assert window(240_000) == "10min"
    assert window(239_999) == "5min"
    assert window(1_000) == "2s"
    assert window(90) == "22samples"


def test_run_prints_the_table_the_next_command_and_the_file(tmp_path, capsys):
    rows = "".join(f"{n / RATE:.2f},{value:.4f}\n" for n, value in enumerate(white(6_000, 9)))
    path = tmp_path / "bench run.csv"
    path.write_text("time [s],gyro_z [deg/h]\n" + rows)
    target = tmp_path / "product of it.nc"
    assert main(["run", str(path), "-o", str(target), "--quiet-progress"]) == 0
    shown = capsys.readouterr()
    assert "the window is 10s" in shown.err
    lines = shown.out.splitlines()
    assert lines[-1] == str(target)
    assert re.search(r"^ +z +N +0\.0(09\d*|1\d*) ", shown.out, re.MULTILINE)
    assert "Misfit, median chi2/dof" in shown.out
    command = next(line for line in shown.err.splitlines() if line.startswith("next: "))
    import shlex

    words = shlex.split(command.removeprefix("next: "))
    assert words[0] == "gyrostab"
    assert main(words[1:]) == 0
