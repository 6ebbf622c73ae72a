"""Coupling with a channel: detection, false alarms, coverage of the intervals, and messages."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path

import cf_units
import numpy as np
import pytest
import xarray as xr
from threadpoolctl import threadpool_info, threadpool_limits

import gyrostab
from gyrostab.cli import main
from gyrostab.correlate.dataset import join
from gyrostab.correlate.drivers import Driver
from gyrostab.correlate.fit import fit_driver, make_blocks
from gyrostab.correlate.judge import VERDICTS, format_correlation
from gyrostab.errors import MissingUnitError, OptionError, SchemaError, TimeError, UnitError
from gyrostab.kernels.regression.coupling import (
    calibrated,
    decompose,
    fit_lags,
    project_out,
    slope_interval,
    uncalibrated,
)
from gyrostab.plot.figures import product_figures
from tests.support import coupled, synthetic
from tests.support.cf_checker import assert_follows_cf

ROOT = Path(__file__).resolve().parents[2]


def verdict(correlation: xr.Dataset, **where: str) -> str:
    return VERDICTS[int(correlation["coupling_verdict"].sel(**where))]


def test_slope_and_lag_are_found_and_other_axes_show_no_coupling():
    correlation = gyrostab.correlate(
        coupled.product(slope=0.3, lag=4, noises="white"), max_lag="5min"
    )
    place = {"axis": "x", "variable": "window_mean", "driver": "temperature"}
    assert verdict(correlation, **place) == "coupled"
    assert abs(float(correlation["coupling_lag"].sel(place)) - 120) <= 60
    assert (
        float(correlation["window_mean_per_temperature_low"][0])
        < 0.3
        < float(correlation["window_mean_per_temperature_high"][0])
    )
    assert (
        correlation["coupling_verdict"].sel(axis=["y", "z"]) == VERDICTS.index("none_seen")
    ).all()
    assert "follows temperature" in str(correlation["statement"].sel(place).values)


def test_small_matrices_are_solved_by_one_thread(monkeypatch):
    counts = []

    def fit(*arguments):
        counts.extend(pool["num_threads"] for pool in threadpool_info() if "blas" in pool.values())
        return fit_driver(*arguments)

    monkeypatch.setattr(sys.modules["gyrostab.correlate.core"], "fit_driver", fit)
    with threadpool_limits(2, user_api="blas"):
        gyrostab.correlate(coupled.product(slope=0.3, noises="white"), max_lag=0)
    assert counts
    assert set(counts) == {1}


def test_statement_and_table_give_the_units_of_the_coefficients():
    product = coupled.product(slope=0.3, noises="white")
    product["N"] = product["window_mean"].assign_attrs(
        units="degree hour-1", unit_label="deg/sqrt(h)"
    )
    correlation = gyrostab.correlate(product, variables=["N", "window_mean"], max_lag=0)
    units = {"N": "deg/sqrt(h)/K", "window_mean": "deg/h/K"}
    for name, unit in units.items():
        place = {"axis": "x", "variable": name, "driver": "temperature"}
        statement = str(correlation["statement"].sel(place).values)
        assert f") {unit}, given the other drivers" in statement
    rows = gyrostab.correlation_rows(correlation)
    assert {row["variable"]: row["unit"] for row in rows if row["driver"] == "temperature"} == units
    assert correlation["N_per_temperature_rate"].attrs["unit_label"] == "deg/sqrt(h) h/K"


def test_coupling_with_the_rate_of_change_is_found():
    correlation = gyrostab.correlate(
        coupled.product(pace=0.05, noises="white"), variables="window_mean", max_lag=0
    )
    assert (
        verdict(correlation, axis="x", variable="window_mean", driver="temperature_rate")
        == "coupled"
    )
    low, high = (
        float(correlation[f"window_mean_per_temperature_rate_{end}"][0]) for end in ("low", "high")
    )
    assert low < 0.05 < high


def test_an_effect_of_temperature_is_not_taken_for_one_of_its_rate_and_the_reverse():
    options = {"variables": "window_mean"}
    kind = {"noises": "white", "heat": "chamber", "axes": "x", "terms": False, "windows": 240}
    drivers = ["temperature", "temperature_rate"]
    for effect, follows in (({"slope": 0.1}, drivers), ({"pace": 0.004}, drivers[::-1])):
        correlation = gyrostab.correlate(coupled.product(**kind, **effect), **options)
        place = {"axis": "x", "variable": "window_mean"}
        assert (correlation["p_value_adjusted"].sel(place) < 0.05).all()  # each alone
        verdicts = [verdict(correlation, **place, driver=driver) for driver in follows]
        assert verdicts == ["coupled", "not_told_apart"]
        size = float(correlation[f"window_mean_per_{follows[0]}_partial"][0])
        error = float(correlation[f"window_mean_per_{follows[0]}_partial_stderr"][0])
        assert abs(size - next(iter(effect.values()))) < 4 * error < size
    named = gyrostab.correlate(coupled.product(**kind, **effect), channel=drivers, **options)
    for name in ("p_value_partial", "coupling_verdict"):
        np.testing.assert_array_equal(named[name], correlation[name])


@pytest.mark.parametrize(
    ("effect", "follows"), [({"slope": 0.3}, "temperature"), ({"pace": 0.05}, "temperature_rate")]
)
def test_of_two_sines_the_one_with_the_shorter_lag_is_the_cause(effect, follows):
    product = coupled.product(seed=4, noises="white", heat="sine", axes="x", terms=False, **effect)
    correlation = gyrostab.correlate(product, variables="window_mean")
    place = {"axis": "x", "variable": "window_mean"}
    assert (correlation["p_value_partial"].sel(place) > 0.05).all()  # given the other one
    for driver in correlation["driver"].values.tolist():
        expected = "coupled" if driver == follows else "not_told_apart"
        assert verdict(correlation, **place, driver=driver) == expected


def test_rising_and_falling_slopes_are_fitted_separately():
    correlation = gyrostab.correlate(
        coupled.product(slope=0.3, noises="white", windows=240), variables="window_mean", max_lag=0
    )
    for way in ("rising", "falling"):
        slope, error = (
            float(correlation[f"window_mean_per_temperature_{way}{end}"][0])
            for end in ("", "_stderr")
        )
        assert abs(slope - 0.3) < 4 * error < 0.2


def shaken_product(**options):
    """Make a product with a vibration that moves mostly with temperature."""
    product = coupled.product(noises="white", terms=False, **options)
    warm = product["temperature"].values
    standardised = (warm - warm.mean()) / warm.std()
    shaking = standardised + 0.15 * np.sin(np.linspace(0, 40, warm.size))
    product["vibration"] = ("time", 2 + 0.5 * shaking, {"units": "9.80665 m s-2"})
    return product


def test_partial_effects_separate_two_drivers_that_move_together():
    product = shaken_product(slope=0.3)
    single = gyrostab.correlate(product, channel="vibration", variables="window_mean", max_lag=0)
    assert float(single["p_value"].sel(axis="x", driver="vibration").item()) < 0.01
    correlation = gyrostab.correlate(
        product, channel=["temperature", "vibration"], variables="window_mean", max_lag=0
    )
    assert list(correlation["driver"].values) == ["temperature", "vibration"]
    warmed = {"axis": "x", "variable": "window_mean", "driver": "temperature"}
    shaken = warmed | {"driver": "vibration"}
    assert verdict(correlation, **warmed) == "coupled"
    assert verdict(correlation, **shaken) == "not_told_apart"
    low, high = (
        correlation[f"window_mean_per_temperature_partial_{end}"][0] for end in ("low", "high")
    )
    assert low < 0.3 < high
    low, high = (
        correlation[f"window_mean_per_vibration_partial_{end}"][0] for end in ("low", "high")
    )
    assert low < 0.0 < high
    assert correlation["p_value_partial"].sel(shaken) > 0.05
    assert "another channel or rate of change explains it equally well" in str(
        correlation["statement"].sel(shaken).values
    )
    assert "given the other drivers" in format_correlation(correlation)


def test_a_driver_without_some_values_takes_no_windows_from_the_others():
    product = shaken_product(slope=0.3)
    options = {
        "variables": "window_mean",
        "max_lag": "5min",
        "channel": ["temperature", "vibration"],
    }
    complete = gyrostab.correlate(product, **options)
    first_part = product.isel(time=slice(2 * product.sizes["time"] // 3))
    part = product.assign(
        vibration=product["vibration"].where(product["time"].isin(first_part.time))
    )
    correlation = gyrostab.correlate(part, **options)
    warm = {"driver": "temperature"}
    for name in ("windows_used", "coupling_lag", "p_value", "correlation"):
        np.testing.assert_array_equal(correlation[name].sel(warm), complete[name].sel(warm))
    name = "window_mean_per_temperature_stderr"
    np.testing.assert_array_equal(correlation[name], complete[name])
    used = correlation["windows_used"].sel(axis="x", driver="vibration")
    assert 0 < used.item() <= first_part.sizes["time"]
    known = {**options, "max_lag": 0}
    of_part, of_first = (gyrostab.correlate(data, **known) for data in (part, first_part))
    for name in ("window_mean_per_temperature_partial", "window_mean_per_vibration_partial_low"):
        np.testing.assert_array_equal(of_part[name], of_first[name])


def test_a_driver_without_any_value_is_named_and_left_out():
    product = shaken_product(slope=0.3)
    options = {"variables": "window_mean", "max_lag": 0}
    names = ["temperature", "vibration"]
    expected = gyrostab.correlate(product, channel=names, **options)
    product["pressure"] = product["vibration"].copy(data=np.full(product.sizes["time"], np.nan))
    product["pressure"].attrs["units"] = "Pa"
    with pytest.warns(UserWarning, match="pressure has no value in any window, so it is left out"):
        correlation = gyrostab.correlate(product, channel=[*names, "pressure"], **options)
    for name in ("window_mean_per_temperature_partial", "window_mean_per_vibration_low"):
        np.testing.assert_array_equal(correlation[name], expected[name])
    assert set(correlation["coupling_verdict"].sel(driver="pressure").values.ravel()) == {0}
    assert "pressure has no value" in str(correlation["statement"].sel(driver="pressure").values)


def test_a_single_channel_without_any_value_is_named_with_the_usable_ones():
    product = shaken_product(slope=0.3)
    product["pressure"] = (product["vibration"] * np.nan).assign_attrs(units="Pa")
    product["temperature"][:] = np.nan
    with pytest.warns(UserWarning, match="no value") as caught:
        gyrostab.correlate(product, variables="window_mean", max_lag=0)
    assert [str(warning.message) for warning in caught] == [
        "temperature has no value in any window of the product; it has vibration; give another, or "
        "a file with --channel"
    ]
    with pytest.raises(OptionError, match="no channel 'power'; it has vibration; give another"):
        gyrostab.correlate(product.drop_vars(["temperature", "temperature_rate"]), channel="power")


def test_rate_of_change_is_a_driver_only_if_it_is_named_with_others():
    product = shaken_product().drop_vars("temperature_rate")
    correlation = gyrostab.correlate(
        product, channel=["vibration", "temperature_rate"], variables="window_mean", max_lag=0
    )
    assert list(correlation["driver"].values) == ["vibration", "temperature_rate"]
    with pytest.raises(OptionError, match="name each once"):
        gyrostab.correlate(product, channel=["vibration", "vibration"])
    with pytest.raises(OptionError, match="at least one channel"):
        gyrostab.correlate(product, channel=[])


def probe_of(product: xr.Dataset, *, degrees: float) -> xr.DataArray:
    """Make a channel like that of a file, with its own times, near the temperature."""
    values = degrees + product["temperature"].values
    times = {"time_probe": product["time"].values}
    return xr.DataArray(values, times, ["time_probe"], "temperature", {"units": "degC"})


def test_a_second_file_replaces_the_series_of_the_first():
    product = shaken_product(slope=0.3)
    options = {"variables": "window_mean", "max_lag": 0}
    for degrees in (30.0, 100.0):
        result = gyrostab.correlate(product, channel=probe_of(product, degrees=degrees), **options)
        product = join(product, result)
        series = product["temperature_of_file"].values
        np.testing.assert_allclose(series, degrees + product["temperature"].values, atol=1.0)


def test_rate_of_change_of_a_file_is_named_beside_it(tmp_path, capsys):
    product = shaken_product(slope=0.3)
    probe = probe_of(product, degrees=0.0).rename("probe")
    correlation = gyrostab.correlate(
        product, channel=[probe, "probe_rate"], variables="window_mean", max_lag=0
    )
    assert list(correlation["driver"].values) == ["probe", "probe_rate"]
    gyrostab.to_netcdf(product.drop_vars("temperature_rate"), tmp_path / "product.nc")
    stamps = product["time"].dt.strftime("%Y-%m-%dT%H:%M:%SZ").values
    rows = [f"{at},{value}" for at, value in zip(stamps, probe.values, strict=True)]
    (tmp_path / "probe.csv").write_text("\n".join(["time,probe [degC]", *rows]))
    options = ["--with", "probe,probe_rate", "--channel", str(tmp_path / "probe.csv")]
    assert main(["correlate", str(tmp_path / "product.nc"), *options]) == 0
    assert "rate of change of probe" in capsys.readouterr().out


def test_windows_that_lost_all_samples_count_where_the_loss_is_correlated():
    """Vibration of 120 s in 240 s, in which all samples are lost."""
    shaken = np.arange(36_000) // 1200 % 2 == 1
    rates = np.where(shaken, np.nan, np.random.default_rng(3).standard_normal(36_000))
    log = gyrostab.make_log(
        rates, rate=10.0, unit="deg/h", channels={"vibration": (2.0 * shaken, "g")}
    )
    product = gyrostab.fit_noise(gyrostab.davar(log, window="40s", step="40s"))
    correlation = gyrostab.correlate(
        product, channel="vibration", variables="window_coverage", max_lag=0
    )
    slope = float(correlation["window_coverage_per_vibration"].isel(axis=0))
    assert int(correlation["windows_used"].max()) == product.sizes["time"]
    assert slope == pytest.approx(-0.5, abs=0.02)


def test_several_drivers_on_the_command_line(tmp_path, capsys):
    path = gyrostab.to_netcdf(shaken_product(slope=0.3), tmp_path / "product.nc")
    command = ["correlate", str(path), "--max-lag", "0s"]
    assert main([*command, "--with", "temperature,vibration"]) == 0
    together = capsys.readouterr().out
    assert "given the others" in together
    assert main([*command, "--with", "temperature", "--with", "vibration"]) == 0
    assert capsys.readouterr().out == together


def test_losses_that_follow_a_channel_are_found():
    product = coupled.product(noises="white", terms=False, axes="x", gap=False)
    shaking = np.clip(product["temperature"].values - 40, 0, None) / 10
    product["vibration"] = ("time", shaking, {"units": "9.80665 m s-2"})
    lost = 0.1 * shaking + 0.02 * np.random.default_rng(1).random(120)
    product["window_coverage"][:] = 1 - lost
    correlation = gyrostab.correlate(
        product, channel="vibration", variables="window_coverage", max_lag=0
    )
    assert (
        verdict(correlation, axis="x", variable="window_coverage", driver="vibration") == "coupled"
    )
    slope = float(correlation["window_coverage_per_vibration"].item())
    assert slope == pytest.approx(-0.1, rel=0.1)
    assert correlation["window_coverage_per_vibration"].attrs["unit_label"] == "1/g"


def test_combinations_that_cannot_be_judged_take_one_line():
    few = gyrostab.correlate(coupled.product(windows=16))
    table = format_correlation(few)
    assert len(gyrostab.correlation_rows(few)) == 18
    assert len(table.splitlines()) == 1
    assert table.startswith("18 of 18 combinations (window_mean, N, B) cannot be judged")
    assert "too few independent windows" in table


def test_fit_under_white_noise_is_ordinary_least_squares():
    rng = np.random.default_rng(3)
    y, x = rng.normal(size=(40, 1)), rng.normal(size=(40, 1))
    fit = fit_lags(project_out(decompose([np.eye(40)], np.zeros(1)), np.ones((40, 1))), y, x)
    design = np.concatenate([np.ones((40, 1)), x], axis=1)
    solved, rest, *_ = np.linalg.lstsq(design, y, rcond=None)
    assert fit.slope[0, 0, 0] == pytest.approx(solved[1, 0])
    error = np.sqrt(rest[0] / 38 * np.linalg.inv(design.T @ design)[1, 1])
    assert fit.stderr[0, 0, 0] == pytest.approx(error)
    assert slope_interval(fit, 0, 0, 0.05)[3] == pytest.approx(
        solved[1, 0] + 2.024394 * error, rel=1e-5
    )


def test_calibration_of_p_values_is_inverted_exactly():
    chance = np.random.default_rng(6).uniform(size=2000) ** 2  # P(p <= x) = sqrt(x)
    for p in (1e-6, 1e-3, 0.05, 0.3, 0.9):
        assert calibrated(p, chance) == pytest.approx(np.sqrt(p), rel=1.0 if p < 1e-4 else 0.3)
        assert uncalibrated(calibrated(p, chance), chance) == pytest.approx(p, rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("noises", "heat", "gap"),
    [
        ("white", "sine", True),
        ("flicker", "sine", False),
        ("walk", "ramps", True),
    ],
)
def test_intervals_have_their_coverage_and_agree_with_the_p_values(noises, heat, gap):
    hold = []
    for seed in range(8):
        product = coupled.product(
            seed=40_000 + seed,
            noises=noises,
            heat=heat,
            slope=0.5,
            windows=80,
            terms=False,
            gap=gap,
        )
        correlation = gyrostab.correlate(product, max_lag=0)
        low = correlation["window_mean_per_temperature_low"].values
        high = correlation["window_mean_per_temperature_high"].values
        hold += list((low < [0.5, 0, 0]) & (high > [0.5, 0, 0]))
        p = correlation["p_value"].sel(variable="window_mean", driver="temperature").values
        np.testing.assert_array_equal((low > 0) | (high < 0), p < 0.05)
        assert (
            (correlation["p_value_adjusted"] >= correlation["p_value"])
            .where(correlation["p_value"].notnull(), True)
            .all()
        )
    assert np.mean(hold) > 0.80  # 0.95 less three standard errors of 24 shares


@pytest.mark.slow
@pytest.mark.parametrize(("noises", "heat"), [("flicker", "sine"), ("slow", "walk")])
def test_false_alarms_are_rare(noises, heat):
    false_alarms = 0
    for seed in range(8):
        product = coupled.product(
            seed=50_000 + seed, noises=noises, heat=heat, windows=80, terms=False
        )
        false_alarms += bool(
            (
                gyrostab.correlate(product, max_lag="8min")["coupling_verdict"]
                == VERDICTS.index("coupled")
            ).any()
        )
    assert false_alarms <= 2  # of 8 at a rate of 5 %; more happen once in 170


def test_adjusted_p_value_accounts_for_the_search_over_lags():
    """With a driver without memory, 12 lags count as many tests."""
    product = coupled.product(noises="white", terms=False, axes="x")
    rng = np.random.default_rng(7)
    product["temperature"] = product["temperature"].copy(
        data=30 + rng.normal(size=120).cumsum() * 0.2 + rng.normal(size=120)
    )
    correlation = gyrostab.correlate(product).sel(
        axis="x", variable="window_mean", driver="temperature"
    )
    without_lags = gyrostab.correlate(product, max_lag=0).sel(axis="x", variable="window_mean")
    assert float(correlation["p_value_adjusted"]) > 4 * float(correlation["p_value"])
    smaller = without_lags["p_value"].min()
    assert float(without_lags["p_value_adjusted"].min()) == pytest.approx(
        min(1.0, 2 * float(smaller))
    )  # two drivers, Holm


def test_search_over_lags_of_a_channel_without_memory_counts_every_lag():
    """If driver and noise are white, 48 lags are 48 independent tests."""
    rng = np.random.default_rng(7)
    vibration, mean = rng.normal(size=207), rng.normal(size=(1, 160))
    values = np.stack([vibration[47 - lag : 207 - lag] for lag in range(48)])
    blocks = make_blocks(np.ones(160, bool), np.arange(160.0), 1.0, 1.0, np.ones(160))
    (entry,) = fit_driver(
        blocks, mean, Driver("vibration", "vibration", "g", values), [], np.arange(48.0), 0.95
    )
    expected = 1.0 - (1.0 - entry["p_value"]) ** 48
    assert 0.2 < expected < 0.9
    assert entry["p_search"] == pytest.approx(expected, rel=0.3)


def test_a_thinned_product_keeps_its_windows():
    def find_used(time):
        return time[
            make_blocks(np.ones(time.size, bool), time, 40.0, 1.0, np.ones(time.size)).windows
        ]

    every_second = np.arange(800.0)
    np.testing.assert_array_equal(find_used(every_second), every_second[::5])  # 8 in a length
    for k in (2, 7, 40):
        thinned = every_second[::k]
        np.testing.assert_array_equal(
            find_used(thinned),
            [thinned[thinned // 5 == span][0] for span in np.unique(thinned // 5)],
        )


@pytest.mark.parametrize("share", [1.0, 0.05])
def test_scattered_windows_make_no_more_blocks_than_a_whole_record(share):
    time = np.arange(4000) * 60.0
    known = np.random.default_rng(0).random(4000) < share
    blocks = make_blocks(known, time, 600.0, 60.0, np.ones(4000))
    assert 100 < blocks.offsets.shape[0] <= 160


def test_autocorrelation_lowers_the_effective_samples():
    many = gyrostab.correlate(coupled.product(noises="white", terms=False), max_lag=0)[
        "effective_samples"
    ].sel(driver="temperature")
    few = gyrostab.correlate(coupled.product(noises="walk", terms=False), max_lag=0)[
        "effective_samples"
    ].sel(driver="temperature")
    # 108 windows that overlap by half, in blocks of a window
    assert 20 < float(many.median()) <= 60
    assert float(few.median()) < 20


def test_statement_gives_the_reason_why_a_record_cannot_tell():
    flat = gyrostab.correlate(coupled.product(heat="flat"), variables="window_mean")
    assert (flat["coupling_verdict"] == VERDICTS.index("cannot_tell")).all()
    assert "temperature is constant" in str(flat["statement"].values[0, 0, 0])
    few = gyrostab.correlate(coupled.product(windows=16), variables="window_mean")
    assert "too few independent windows" in str(few["statement"].values[0, 0, 0])
    absent = coupled.product(axes="x")
    absent["window_mean"][:] = 5.0
    still = gyrostab.correlate(absent, variables="window_mean")
    assert str(still["statement"].values[0, 0, 0]).endswith("window mean of axis x is constant.")
    absent["temperature"][:] = np.nan
    with pytest.warns(UserWarning, match="temperature has no value in any window of the product"):
        unknown = gyrostab.correlate(absent, variables="window_mean", channel="temperature")
    assert "temperature has no value in any window" in str(unknown["statement"].values[0, 0, 0])
    rise = gyrostab.correlate(
        coupled.product(heat="rise", slope=1.0, noises="white"), variables="window_mean", max_lag=0
    )
    assert verdict(rise, axis="x", variable="window_mean", driver="temperature") == "not_told_apart"
    assert "changes mainly in one direction" in str(rise["statement"].values[0, 0, 0])
    steps = coupled.product(axes="x")
    levels = np.repeat([20.0, 25.0, 20.0, 60.0], 30)[: steps.sizes["time"]]
    steps = steps.assign(temperature=steps["temperature"].copy(data=levels))
    steps = steps.drop_vars("temperature_rate", errors="ignore")
    moments = gyrostab.correlate(steps)["statement"].values[0, 0, 1]
    assert "temperature changes mainly at one moment" in str(moments)


def test_two_clusters_across_a_gap_give_no_slope():
    product = coupled.product(windows=160, noises="white", gap=False)
    late = np.arange(160) >= 80
    rng = np.random.default_rng(5)
    product["temperature"] = product["temperature"].copy(
        data=26 + 6.0 * late + rng.normal(0, 0.05, 160)
    )
    product["window_mean"] = product["window_mean"] + 30.0 * late
    product["window_mean"][:, 50:110] = np.nan
    correlation = gyrostab.correlate(product, variables="window_mean", max_lag=0)
    assert set(correlation["coupling_verdict"].sel(driver="temperature").values.ravel()) == {
        VERDICTS.index("cannot_tell")
    }
    assert "separated by a gap" in str(correlation["statement"].values[0, 0, 0])


def test_channel_of_a_file_is_averaged_and_never_extrapolated(tmp_path):
    product = coupled.product(slope=0.3, noises="white", gap=False)
    stamps = product["time_bounds"].values[0, 0] + (np.arange(2400) * 1_000_000_000).astype(
        "timedelta64[ns]"
    )
    seconds = np.arange(2400.0)
    probe = xr.DataArray(
        20 + 5 * np.sin(seconds / 300),
        dims="t",
        coords={"t": stamps},
        name="probe",
        attrs={"units": "degree_Celsius"},
    )
    correlation = gyrostab.correlate(product, channel=probe, variables="window_mean", max_lag=0)
    np.testing.assert_allclose(correlation["probe"][3], probe[90:150].mean())
    assert np.isnan(correlation["probe"].values[80:]).all()
    with pytest.raises(TimeError, match=r"do not overlap; .* \(--unit time=UTC-06:00\)"):
        gyrostab.correlate(product, channel=probe.assign_coords(t=stamps - np.timedelta64(9, "D")))


def probe_channel(values, product, every):
    stamps = product["time_bounds"].values[0, 0] + (
        np.arange(values.size) * int(every * 1e9)
    ).astype("timedelta64[ns]")
    return xr.DataArray(
        values, dims="t", coords={"t": stamps}, name="probe", attrs={"units": "degree_Celsius"}
    )


@pytest.mark.parametrize(
    ("units", "factor", "offset", "inner"),
    [
        ("degF", 1.8, 32.0, "K"),
        ("K", 1.0, 273.15, "K"),
        ("rpm", 1 / 6, 0.0, "degree s-1"),
        ("m/s", 1.0, 0.0, "m s-1"),
        ("m s^-1", 1.0, 0.0, "m s-1"),
        ("m.s-1", 1.0, 0.0, "m s-1"),
        ("metre per second", 1.0, 0.0, "m s-1"),
        ("g/cm3", 1.0, 0.0, "g cm-3"),  # the gram, not gravity
    ],
)
def test_sensitivities_are_in_the_unit_of_the_channel(units, factor, offset, inner):
    product = coupled.product(slope=0.3, noises="white", gap=False, terms=False)
    course = 20 + 5 * np.sin(np.arange(363.0) / 30)
    probe = probe_channel(course, product, 10.0)
    options = {"variables": "window_mean", "max_lag": 0}
    expected = gyrostab.correlate(product, channel=probe, **options)
    given = (probe * factor + offset).assign_attrs(units=units)
    found = gyrostab.correlate(product, channel=given, **options)
    for name, over in (("probe", inner), ("probe_rate", f"{inner} hour-1")):
        slope = found[f"window_mean_per_{name}"]
        np.testing.assert_allclose(slope, expected[f"window_mean_per_{name}"])
        meant = cf_units.Unit("degree hour-1") / cf_units.Unit(over)
        assert cf_units.Unit(slope.units).convert(1.0, meant) == pytest.approx(1.0)
    np.testing.assert_allclose(found["probe"], expected["probe"])


@pytest.mark.parametrize("units", ["degree hour-1", "rpm", "degF"])
def test_a_channel_of_the_product_is_stored_in_the_unit_of_its_sensitivity(units):
    product = coupled.product(slope=0.3, noises="white", gap=False, terms=False, axes="x")
    product["other"] = (100 * product["temperature"] + 7).assign_attrs(units=units)
    options = {"variables": "window_mean", "max_lag": 0}
    expected = gyrostab.correlate(product, **options)
    found = gyrostab.correlate(product, channel="other", **options)
    drive = found["window_mean_per_other"] * np.ptp(found["other"].values)
    np.testing.assert_allclose(
        drive,
        expected["window_mean_per_temperature"] * np.ptp(product["temperature"].values),
        rtol=1e-6,
    )
    if units == "degree hour-1":
        assert found["window_mean_per_other"].units == "1"
        assert found["other"].identical(product["other"])
    joined = join(product, found)
    assert joined["other"].identical(found["other"])


@pytest.mark.parametrize(
    ("attrs", "error"), [({}, MissingUnitError), ({"units": "0.5 m"}, UnitError)]
)
def test_channels_without_a_usable_unit_are_refused(attrs, error):
    product = coupled.product(noises="white", gap=False, terms=False)
    probe = probe_channel(np.arange(363.0), product, 10.0)
    probe.attrs = attrs
    product["flow"] = product["temperature"].drop_attrs().assign_attrs(attrs)
    for channel in (probe, "flow"):
        with pytest.raises(error, match=r"attrs\['units'\] = 'degC'|product of powers"):
            gyrostab.correlate(product, channel=channel)


def test_short_gaps_of_a_channel_are_interpolated_and_long_ones_are_not():
    product = coupled.product(noises="white", gap=False, terms=False)
    seconds = np.arange(3630.0)
    course = 20 + 5 * np.sin(seconds / 300)
    holed = course.copy()
    holed[600:655] = np.nan  # less than a window of 60 s
    holed[2000:2300] = np.nan  # five windows, a twelfth of the record
    aligned = gyrostab.correlate(
        product, channel=probe_channel(holed, product, 1.0), variables="window_mean", max_lag=0
    )["probe"].values
    whole = np.array([course[30 * i : 30 * i + 60].mean() for i in range(120)])
    inside = np.flatnonzero((np.arange(120) * 30 >= 1990) & (np.arange(120) * 30 + 60 <= 2310))
    assert inside.size > 5
    assert np.isnan(aligned[inside]).all()
    np.testing.assert_allclose(aligned[15:30], whole[15:30], atol=0.6)
    assert np.isnan(aligned).sum() < inside.size + 5


def test_a_slow_channel_is_interpolated_between_its_values_only():
    product = coupled.product(noises="white", gap=False, terms=False)
    at = np.arange(0.0, 3300.0, 150.0)
    aligned = gyrostab.correlate(
        product,
        channel=probe_channel(20 + at / 100, product, 150.0),
        variables="window_mean",
        max_lag=0,
    )["probe"].values
    middle = np.arange(120) * 30 + 30.0
    known = middle <= at[-1]
    np.testing.assert_allclose(aligned[known], 20 + middle[known] / 100, rtol=1e-12)
    assert np.isnan(aligned[~known]).all()


def test_a_rate_of_change_without_values_takes_no_windows_from_its_channel():
    product = coupled.product(slope=0.3, noises="white", terms=False)
    options = {"variables": "window_mean", "max_lag": "5min"}
    complete = gyrostab.correlate(product, **options)
    rate = product["temperature_rate"]
    few = rate.where(np.arange(rate.size) % 5 == 0).where(np.arange(rate.size) < 60)
    for unknown in (rate * np.nan, few):
        part = product.assign(temperature_rate=unknown.assign_attrs(rate.attrs))
        correlation = gyrostab.correlate(part, **options)
        warm = {"driver": "temperature"}
        for name in ("windows_used", "p_value", "coupling_verdict"):
            np.testing.assert_array_equal(correlation[name].sel(warm), complete[name].sel(warm))


def test_the_rate_of_a_channel_with_one_value_per_window_is_that_of_its_means():
    product = coupled.product(pace=0.05, noises="white", terms=False)
    unknown = product["temperature_rate"] * np.nan
    options = {"variables": "window_mean", "max_lag": 0}
    correlation = gyrostab.correlate(
        product.assign(temperature_rate=unknown.assign_attrs(units="K hour-1")), **options
    )
    place = {"axis": "x", "variable": "window_mean", "driver": "temperature_rate"}
    assert verdict(correlation, **place) == "coupled"
    low, high = (
        float(correlation[f"window_mean_per_temperature_rate_{end}"][0]) for end in ("low", "high")
    )
    assert low < 0.05 < high


def test_command_refuses_options_that_it_does_not_use(stored, capsys):
    assert main(["correlate", str(stored), "--rate", "100"]) == 2
    assert "--rate" in capsys.readouterr().err
    assert main(["correlate", str(stored), "--map", "T=temperature"]) == 2
    assert "name that file too" in capsys.readouterr().err


def test_errors_say_what_to_do():
    product = coupled.product()
    with pytest.raises(OptionError, match="no channel 'vibration'; it has temperature"):
        gyrostab.correlate(product, channel="vibration")
    series = product["temperature"].to_series()
    with pytest.raises(OptionError, match=r"type Series is neither .*DataArray; .*\.to_xarray\(\)"):
        gyrostab.correlate(product, channel=series)
    empty = (product["temperature"] * np.nan).assign_attrs(units="degC")
    with pytest.raises(SchemaError, match="channel 'temperature' holds no value; give one with"):
        gyrostab.correlate(product, channel=empty)
    repeated = product.assign(temperature=product["temperature"] + xr.zeros_like(product["N"]))
    with pytest.raises(
        OptionError, match=r"'temperature' of the product has dimensions \('time', "
    ):
        gyrostab.correlate(repeated)
    alone = product.drop_vars(["temperature", "temperature_rate"])
    with pytest.raises(OptionError, match="the product has no channels; give a file"):
        gyrostab.correlate(alone)
    with pytest.raises(OptionError, match="longer than the record"):
        gyrostab.correlate(product, max_lag="3D")
    with pytest.raises(OptionError, match="variable 'avar'"):
        gyrostab.correlate(product, variables="avar")
    with pytest.raises(OptionError, match="variable 3"):
        gyrostab.correlate(product, variables=3)
    with pytest.raises(OptionError, match="variables N, N are not all different; name each once"):
        gyrostab.correlate(product, variables=["N", "N"])
    named = product.rename(temperature="p_value")
    with pytest.raises(OptionError, match=r"'p_value' has the name of a result .*rename\(p_value="):
        gyrostab.correlate(named, channel="p_value")
    with pytest.raises(OptionError, match="at least one variable"):
        gyrostab.correlate(product, variables=[])
    for level in ("0.9", None, 95):
        with pytest.raises(OptionError, match=f"level {level!r}: .* between 0.5 and 1"):
            gyrostab.correlate(product, level=level)


@pytest.fixture(scope="module")
def stored(tmp_path_factory) -> Path:
    return gyrostab.to_netcdf(
        coupled.product(slope=0.3, noises="white"),
        tmp_path_factory.mktemp("coupled") / "product.nc",
    )


def test_command_writes_legal_units_and_a_figure(stored, tmp_path, capsys):
    target = tmp_path / "out.nc"
    assert (
        main(
            [
                "correlate",
                str(stored),
                "--with",
                "temperature",
                "--max-lag",
                "5min",
                "-o",
                str(target),
            ]
        )
        == 0
    )
    printed = capsys.readouterr().out
    assert "Window mean of axis x follows temperature" in printed
    assert target.with_suffix(".png").stat().st_size > 10_000
    with gyrostab.open_product(target) as correlation:
        units = correlation["window_mean_per_temperature"].attrs["units"]
        assert cf_units.Unit(units) == cf_units.Unit("degree hour-1") / cf_units.Unit("K")
    assert_follows_cf(target)


@pytest.mark.full
def test_pipeline_joins_another_teams_file(stored, tmp_path):
    plan = tomllib.loads(
        (ROOT / "pipelines" / "temperature_chain.toml").read_text(encoding="utf-8")
    )
    product = gyrostab.open_product(stored)
    (tmp_path / plan["product"]).write_bytes(stored.read_bytes())
    lines = [
        f"{t},{v:.4f}"
        for t, v in zip(product["time"].values, product["temperature"].values, strict=True)
    ]
    (tmp_path / plan["channel"]["file"]).write_text(
        "\n".join(["time,T_probe", *lines]), encoding="utf-8"
    )
    (tmp_path / "plan.toml").write_bytes(
        (ROOT / "pipelines" / "temperature_chain.toml").read_bytes()
    )
    done = subprocess.run(
        [sys.executable, ROOT / "pipelines" / "temperature_chain.py", tmp_path / "plan.toml"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "Window mean of axis x follows temperature of file" in done.stdout
    assert {"coupling.nc", "coupling.png"} <= {path.name for path in tmp_path.iterdir()}


WARM_UP = {"map": {"wx": "gyro_x", "wy": "gyro_y", "wz": "gyro_z", "Tx": "temperature"}}
WARM_UP["unit"] = {"gyro": "deg/s", "time": "s", "temperature": "degC"}
MPU = {"map": {"gx_dps": "gyro_x", "gy_dps": "gyro_y", "gz_dps": "gyro_z", "temp_C": "temperature"}}
MPU["unit"] = {"gyro": "deg/s", "temperature": "degC"}
ROCKET = {"temperature_celsius": "temperature [degC]"}
ROCKET |= {f"raw_angular_rate_{axis}_deg_per_s": f"gyro_{axis} [deg/s]" for axis in "xyz"}


@pytest.mark.parametrize(
    ("name", "read", "window", "step", "following", "quiet"),
    [
        ("fog-hybrid-warmup/run1_static.txt", WARM_UP, "2.5s", "0.5s", "y", "z"),
        ("mpu6050-static-temperature/mpu6050_10min.csv.gz", MPU, "20s", "5s", "x", "z"),
        ("rocket-flight-temperature/jackpot_launch_1.csv", {"map": ROCKET}, "5s", "1s", "", "xyz"),
    ],
)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_real_recordings(recordings, name, read, window, step, following, quiet):
    log = gyrostab.regularise(gyrostab.read_log(recordings(name), **read))
    product = gyrostab.fit_noise(gyrostab.davar(log, window=window, step=step, taus=8))
    whole = gyrostab.correlate(product, variables="window_mean")
    verdicts = whole["coupling_verdict"].sel(variable="window_mean")
    for axis in following:
        assert VERDICTS[int(verdicts.sel(axis=axis, driver="temperature"))] in (
            "coupled",
            "not_told_apart",
        )
        statement = str(
            whole["statement"].sel(variable="window_mean", axis=axis, driver="temperature").values
        )
        assert "temperature changes mainly in one direction" in statement
        assert (
            " changes with " in statement
            or float(whole["p_value"].sel(variable="window_mean", axis=axis, driver="temperature"))
            < 0.05
        )
    for axis in quiet:
        assert set(verdicts.sel(axis=axis).values) <= {
            VERDICTS.index("cannot_tell"),
            VERDICTS.index("none_seen"),
        }


def test_term_observed_in_scattered_windows_only_gives_no_verdict():
    """Where each window is a separate segment, no slope can be estimated."""
    product = synthetic.product()
    correlation = gyrostab.correlate(product)
    assert np.isfinite(correlation["p_value"].sel(variable="window_mean")).any()
    is_observed = product["observable"].sel(axis="x", term="Q").values == 2
    assert 12 < is_observed.sum() < 20
    assert not (
        is_observed[1:] & is_observed[:-1]
    ).any()  # enough windows, but no two next to each other
    assert (
        VERDICTS[int(correlation["coupling_verdict"].sel(axis="x", variable="Q").values[0])]
        == "cannot_tell"
    )


def test_an_axis_is_judged_by_its_own_coverage():
    product = coupled.product(axes="xy", gap=False, terms=False)
    product["window_coverage"].loc["y"] = np.resize(np.repeat([1.0, 0.08], 10), 120)
    both, alone = (gyrostab.correlate(part) for part in (product, product.sel(axis=["y"])))
    own = both.sel(axis=["y"])
    for name in ("p_value", "window_mean_per_temperature", "window_mean_per_temperature_stderr"):
        np.testing.assert_array_equal(own[name].values, alone[name].values)


def test_a_second_correlation_replaces_the_first():
    product = shaken_product()
    first = join(product, gyrostab.correlate(product))
    second = gyrostab.correlate(first, channel="vibration", variables="window_mean")
    joined = join(first, second)
    assert list(joined["driver"].values) == ["vibration", "vibration_rate"]
    assert not [name for name in joined if "_per_temperature" in str(name)]
    assert all(joined[name].variable.equals(second[name].variable) for name in second)
    figure = product_figures(joined)["temperature"]()
    assert figure.axes[-2].get_xlabel().startswith("temperature")


@pytest.mark.parametrize("name", ["spin", "rotation_rate", "temperature_rate"])
def test_only_the_rate_of_change_of_a_channel_needs_no_plateau(name):
    product = coupled.product(terms=False)
    ramp = np.abs(np.arange(120) % 40 - 20.0)
    product[name] = ("time", ramp, {"units": "degree s-1"})
    limits = gyrostab.correlate(product, channel=name)["coupling_limits"].sel(driver=name)
    bit = dict(zip(limits.flag_meanings.split(), limits.flag_masks, strict=True))["no_plateau"]
    assert bool((limits & bit).any()) == (name != "temperature_rate")


@pytest.mark.parametrize("none", [0, "0", "0min", np.timedelta64(0, "s")])
def test_no_lag_can_be_written_in_any_way(none):
    assert float(gyrostab.correlate(coupled.product(), max_lag=none).attrs["longest_lag_s"]) == 0.0


@pytest.mark.parametrize("use", [gyrostab.correlation_rows, gyrostab.plot_correlation])
def test_a_product_without_a_correlation_is_refused(use):
    with pytest.raises(SchemaError, match=r"call gyrostab\.correlate"):
        use(coupled.product())
