"""Held-out evidence against closed forms, and the surfaces."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.estimate.joint_fit import fit_identifications
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.result import held_out_table
from gyrostab.diagnose.result.held_out_table import cut_held_out_stretches, log_likelihood
from gyrostab.diagnose.result.surfaces import CASES, make_surfaces
from gyrostab.noise import LAWS
from gyrostab.simulate import simulate
from tests.support.candidates import identify_by_hand
from tests.support.reduced_records import BLOCK_S, RATE, baseline, records

LEVEL = 3600.0 * 0.003**2
VARIANCE = LEVEL / BLOCK_S
ON = slice(60, 90)


def held_out(blocks, *models, **others):
    """Compare models, those that are fitted to held-out blocks and those that are given."""
    models = [model if callable(model) else lambda known, model=model: model for model in models]
    if "shown" in others:
        others["shown"] = lambda known, model=others["shown"]: model
    others = {"added_nats": 0.0, "shown": models[1], "forecast": models[1]} | others
    return held_out_table.held_out(blocks, *models, **others)


def _record(seed=1, **options):
    base = baseline(**options)
    return base, records(base, 1, np.random.default_rng(seed)).isel(record=0)


def _with_effects(base, *, epsilon=0.0, height=0.0):
    after = base.copy(deep=True)
    after["spectrum"][0, ON] *= 1.0 + epsilon
    after["known_mean"][1, ON] += height
    return after


def _add_effects(blocks, *, epsilon=0.0, height=0.0):
    blocks["power"][0, ON] *= 1.0 + epsilon
    blocks["mean"][1, ON] += height


def test_no_gain_and_good_fit_without_effects():
    base, blocks = _record()
    result = held_out(blocks, base, base)
    assert result["log_likelihood_gain"] == 0.0
    assert result["forecast_gain"] == 0.0
    assert result["misfit_before"] == result["misfit_after"]
    assert result["blocks"] == 36
    results = [held_out(blocks, base, base) for _, blocks in map(_record, (11, 12, 13))]
    assert np.mean([result["misfit_before"] for result in results]) == pytest.approx(1.0, abs=0.06)
    assert 0.94 < np.mean([result["coverage95_before"] for result in results]) < 0.96


def test_gain_of_raised_noise_follows_the_gamma_law():
    base, blocks = _record(2)
    epsilon = 0.2
    _add_effects(blocks, epsilon=epsilon)
    result = held_out(blocks, base, _with_effects(base, epsilon=epsilon))
    shape = blocks["shape"].values[0, ON].sum()
    expected = shape * (epsilon - np.log1p(epsilon))
    scatter = np.sqrt(shape) * epsilon  # of sum n (P / S) epsilon / (1 + epsilon)
    assert result["log_likelihood_gain"] == pytest.approx(expected, abs=4.0 * scatter)
    assert result["log_likelihood_gain"] > 0.7 * expected
    assert result["stderr"] == pytest.approx(scatter, rel=0.25)
    assert result["misfit_before"] > result["misfit_after"] + 0.3
    assert result["coverage95_before"] < 0.93 < result["coverage95_after"] < 0.97


def test_gain_of_a_mean_follows_the_normal_law():
    base, blocks = _record(3)
    height = 0.15
    _add_effects(blocks, height=height)
    result = held_out(blocks, base, _with_effects(base, height=height))
    expected = 0.5 * height**2 / VARIANCE * 30 * (1.0 - 30.0 / 180.0)
    assert result["log_likelihood_gain"] == pytest.approx(expected, rel=0.35)
    assert result["misfit_after"] == pytest.approx(1.0, abs=0.12)


@pytest.mark.slow
def test_error_of_a_gain_is_its_scatter_over_records():
    gains, errors = [], []
    for seed in range(16):
        base, blocks = _record(200 + seed)
        _add_effects(blocks, epsilon=0.15, height=0.1)
        result = held_out(blocks, base, _with_effects(base, epsilon=0.15, height=0.1))
        gains.append(result["log_likelihood_gain"])
        errors.append(result["stderr"])
    assert 0.6 < np.std(gains, ddof=1) / np.mean(errors) < 1.6


def test_likelihood_of_means_agrees_with_dense_algebra():
    base, blocks = _record(4)
    known = np.ones(180, dtype=bool)
    known[40:52] = False
    known[100:110] = False  # held out by another stretch of the same fold
    twice = base.assign(mean_variance=base["mean_variance"] * 2.0)
    held = (np.arange(180) >= 40) & (np.arange(180) < 52)
    difference = log_likelihood(blocks, twice, known, held) - log_likelihood(
        blocks, base, known, held
    )
    dense = 0.0
    for axis in range(3):
        y, rest = blocks["mean"].values[axis, 40:52], blocks["mean"].values[axis, known]
        for factor, sign in ((2.0, 1.0), (1.0, -1.0)):
            covariance = factor * VARIANCE * (np.eye(12) + 1.0 / rest.size)
            away = y - rest.mean()
            dense += (
                -0.5
                * sign
                * (away @ np.linalg.solve(covariance, away) + np.linalg.slogdet(covariance)[1])
            )
    assert difference == pytest.approx(dense, rel=1e-6)


def test_likelihood_of_cross_spectra_is_that_of_the_wishart_law():
    base = baseline(axes="xy")
    blocks = records(base, 1, np.random.default_rng(5)).isel(record=0)
    share = 0.3
    blocks["cross"] = blocks["cross"] + share * LEVEL
    after = base.copy()
    after["cross"] = (("pair", "block", "band"), np.full(blocks["cross"].shape, share * LEVEL + 0j))
    known = np.ones(180, dtype=bool)
    known[20:30] = False
    difference = log_likelihood(blocks, after, known, ~known) - log_likelihood(
        blocks, base, known, ~known
    )
    model = LEVEL * np.array([[1.0, share], [share, 1.0]])
    expected = 0.0
    for block in range(20, 30):
        for band in range(blocks.sizes["band"]):
            c = complex(blocks["cross"].values[0, block, band])
            powers = blocks["power"].values[:, block, band]
            w = np.array([[powers[0], c], [c.conjugate(), powers[1]]])
            n = blocks["shape"].values[0, block, band]
            for s, sign in ((model, 1.0), (LEVEL * np.eye(2), -1.0)):
                expected -= (
                    sign * n * (np.linalg.slogdet(s)[1] + np.trace(np.linalg.solve(s, w)).real)
                )
    assert difference == pytest.approx(expected, rel=1e-9)
    assert difference > 0.0


def test_models_are_not_fitted_to_held_out_blocks():
    base, blocks = _record(6)
    fitted_blocks: list[np.ndarray] = []

    def train(known):
        fitted_blocks.append(known.copy())
        return base

    held_out(blocks, base, train)
    folds, forecast = fitted_blocks[:4], fitted_blocks[4]
    assert (
        np.sum([~known for known in folds], axis=0).tolist() == [1] * 180
    )  # each block is held out once
    assert forecast[:126].all()
    assert not forecast[126:].any()


def test_noise_is_calibrated_without_held_out_blocks(monkeypatch):
    models = []
    monkeypatch.setattr(
        held_out_table,
        "held_out",
        lambda blocks, before, after, **others: models.append((before, after)),
    )
    model = {"log": {"axes": ["x"]}, "noise": {"N": 0.003, "B": 0.001}}
    blocks = reduce_log(simulate(model, duration="20min", rate=10.0, seed=1).compute())
    known = np.arange(blocks.sizes["block"]) % 4 > 0
    louder = blocks.copy(deep=True)
    louder["power"][:, ~known] *= 2.0
    louder["mean"][:, ~known] += 0.05
    spectra = []
    for either in (blocks, louder):
        base = calibrate_noise(either, quiet=(0.0, 1200.0))
        found = identify_by_hand(either, base, "ageing_bias", "mean", ("slope",))
        held_out_table.measure_held_out(either, base, found, fit_identifications(found, base))
        spectra.append([model(known)["spectrum"].values for model in models.pop()])
    for of_blocks, of_louder in zip(*spectra, strict=True):
        np.testing.assert_allclose(of_louder[:, known], of_blocks[:, known], rtol=1e-12)


@pytest.mark.slow
def test_effect_fitted_to_noise_loses():
    """An effect whose size is fitted to the rest of the record gains nothing on held-out data
    without it."""
    gains = []
    for seed in range(8):
        base, blocks = _record(100 + seed)
        template = np.sin(np.arange(180) / 9.0)

        def fit(known, base=base, blocks=blocks, template=template):
            x, y = template[known] - template[known].mean(), blocks["mean"].values[0, known]
            after = base.copy(deep=True)
            after["known_mean"][0] = (x @ y) / (x @ x) * template
            return after

        gains.append(held_out(blocks, base, fit)["log_likelihood_gain"])
    assert np.mean(gains) < 0.1
    assert max(gains) < 4.0


@pytest.mark.parametrize(("period", "best"), [(36, 18), (180, 45)])  # blocks
def test_slow_drift_gains_more_on_long_stretches(period, best):
    base, blocks = _record(9, walk=0.1)
    after = base.copy(deep=True)
    drift = 0.3 * np.sin(2.0 * np.pi * np.arange(180) / period)
    blocks["mean"][0] += drift
    after["known_mean"][0] += drift

    def on(length):
        fold = np.arange(180) // length % 4
        return sum(
            log_likelihood(blocks, after, fold != k, fold == k)
            - log_likelihood(blocks, base, fold != k, fold == k)
            for k in range(4)
        )

    evidence_nats = held_out(blocks, base, after)["log_likelihood_gain"]
    assert evidence_nats == pytest.approx(on(best))
    assert on(best) == max(on(5), on(18), on(45))
    assert evidence_nats > on(5) + 1.0


def test_forecast_gains_if_the_effect_continues():
    base, blocks = _record(7)
    after = base.copy(deep=True)
    wave = 0.1 * np.sin(2.0 * np.pi * np.arange(180) / 60.0)
    blocks["mean"][0] += wave
    after["known_mean"][0] += wave
    evidence_nats = held_out(blocks, base, after)["forecast_gain"]
    tail = wave[126:]
    assert evidence_nats == pytest.approx(0.5 * (tail**2).sum() / VARIANCE, rel=0.5)


def test_gain_of_other_statistics_is_added():
    base, blocks = _record()
    result = held_out(blocks, base, base, added_nats=3.5)
    assert (result["log_likelihood_gain"], result["stderr"]) == (3.5, pytest.approx(np.sqrt(7.0)))


def test_allan_variance_is_compared_with_the_shown_model():
    base, blocks = _record()
    _add_effects(blocks, epsilon=0.5)
    whole = _with_effects(base, epsilon=0.5)
    with_model, blind = (
        held_out(blocks, base, base, added_nats=3.5, shown=whole),
        held_out(blocks, base, base, added_nats=3.5),
    )
    assert with_model["log_likelihood_gain"] == blind["log_likelihood_gain"] == pytest.approx(3.5)
    assert abs(with_model["misfit_after"] - 1.0) < 0.3 * abs(blind["misfit_after"] - 1.0)


def test_stretches_cover_the_record():
    _, blocks = _record()
    cut = cut_held_out_stretches(blocks)
    assert cut.first[0] == 0
    assert cut.stop[-1] == 180
    np.testing.assert_array_equal(cut.stop[:-1], cut.first[1:])


def test_gaps_do_not_change_the_coverage():
    base = baseline(missing=0.3)
    blocks = records(base, 1, np.random.default_rng(8), missing=0.3).isel(record=0)
    for name in ("mean", "power", "kurtosis"):
        blocks[name][:, 30:50] = np.nan
    blocks["samples"] = blocks["samples"].where((np.arange(180) < 30) | (np.arange(180) >= 50), 0)
    result = held_out(blocks, base, base)
    assert 0.93 < result["coverage95_before"] < 0.97
    assert np.isfinite(list(result.values())).all()


def test_surfaces_have_all_three_cases():
    base, blocks = _record(9)
    _add_effects(blocks, epsilon=0.5, height=0.4)
    surfaces = make_surfaces(blocks, base, _with_effects(base, epsilon=0.5, height=0.4))
    assert surfaces["case"].values.tolist() == list(CASES)
    assert surfaces["avar"].dims == ("case", "axis", "window", "tau")
    quiet = surfaces.sel(case="before").isel(axis=2)
    np.testing.assert_allclose(
        quiet["avar"].isel(window=0), LAWS["N"].avar(quiet["tau"].values, 0.003), rtol=0.02
    )
    recorded, after, before = (surfaces.sel(case=case) for case in CASES[:1] + CASES[:0:-1])
    inside = (recorded["avar"] > after["avar_low"]) & (recorded["avar"] < after["avar_high"])
    assert 0.92 < float(inside.where(recorded["avar"].notnull()).mean()) < 0.98
    during = (surfaces["begin"] >= 60 * BLOCK_S) & (surfaces["end"] <= 90 * BLOCK_S)
    low = surfaces["tau"] <= 1.0 / RATE
    assert float(before["avar"].isel(axis=0).where(during & low).mean() * 1.5) == pytest.approx(
        float(recorded["avar"].isel(axis=0).where(during & low).mean()), rel=0.03
    )
    step = (
        after["mean"].isel(axis=1).where(during).mean()
        - after["mean"].isel(axis=1).where(surfaces["end"] <= 1200.0).mean()
    )
    assert float(step) == pytest.approx(0.4, abs=1e-6)
    away = (recorded["mean"] - after["mean"]) / after["mean_stderr"]
    assert float((away**2).mean()) < 2.0
    # at the edge of the step the Allan variance of the known mean is in the expected one
    edge = (
        (surfaces["begin"] < 60 * BLOCK_S)
        & (surfaces["end"] > 60 * BLOCK_S)
        & (surfaces["end"] < 90 * BLOCK_S)
    )
    long = surfaces["tau"] >= BLOCK_S
    assert float(after["avar"].isel(axis=1).where(edge & long).mean()) > 2.0 * float(
        before["avar"].isel(axis=1).where(edge & long).mean()
    )


def test_band_of_a_known_mean_holds_95_percent():
    """Mean and noise have a product in the Allan variance, however well the mean is known."""
    inside = []
    for seed in range(12):
        base, blocks = _record(seed)
        wave = 10.0 * np.sqrt(VARIANCE) * np.sin(2.0 * np.pi * np.arange(180) / 30.0)
        blocks["mean"] = blocks["mean"] + xr.DataArray(wave, dims="block")
        after = base.assign(known_mean=base["known_mean"] + xr.DataArray(wave, dims="block"))
        surfaces = make_surfaces(blocks, base, after)
        surfaces = surfaces.isel(tau=surfaces["tau"].values >= BLOCK_S)
        recorded = surfaces["avar"].sel(case="recording")
        low, high = (surfaces[f"avar_{end}"].sel(case="after") for end in ("low", "high"))
        inside.append(((recorded >= low) & (recorded <= high)).where(np.isfinite(recorded)))
    share = xr.concat(inside, "seed").mean(["seed", "axis", "window"])
    np.testing.assert_allclose(share, 0.95, atol=0.05)


def test_a_narrow_line_survives_the_thinning_of_the_spectrum():
    base = baseline(rate=1000.0)
    blocks = records(base, 1, np.random.default_rng(1), rate=1000.0).isel(record=0)
    blocks["line_power"][0, :, 7_777] = 50.0
    density = make_surfaces(blocks, base, base)["line_density"].isel(axis=0)
    assert blocks.sizes["line"] == 10_000
    assert density.sizes["line"] <= 4000
    assert float(density.max()) == pytest.approx(50.0)
    assert density["line_frequency"].values[int(density.argmax())] == pytest.approx(
        blocks["line_frequency"].values[7_777], rel=1e-3
    )


def test_surfaces_of_a_long_record_stay_small():
    base = baseline(block_count=1000)
    blocks = records(base, 1, np.random.default_rng(1), block_count=1000).isel(record=0)
    surfaces = make_surfaces(blocks, base, base)
    assert surfaces.sizes["window"] <= 260
    assert surfaces["time"].dtype.kind == "M"
    assert isinstance(surfaces, xr.Dataset)
