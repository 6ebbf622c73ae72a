"""The DAVAR against its definition, the published algorithms, allantools and invariances."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import allantools
import dask
import dask.array as da
import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st

from gyrostab.allan.davar import davar, davar_part, davar_parts
from gyrostab.allan.fit import fit_noise
from gyrostab.errors import OptionError
from gyrostab.ingest.make_log import make_log
from gyrostab.kernels.allan.blocks import held_points
from gyrostab.kernels.allan.surface import WorkUnit, surface_unit
from gyrostab.kernels.workspace import Workspace, Workspaces
from gyrostab.schema import ESTIMATORS
from tests.reference import direct_angle_surface, direct_surface
from tests.support.published import published_davar
from tests.support.stored import make_lazy

STRICT, WEIGHTED = ESTIMATORS.index("strict_runs"), ESTIMATORS.index("weighted_clusters")


def log_of(x, rate=100.0, unit="deg/h", **options):
    return make_log(x, rate=rate, unit=unit, **options)


@st.composite
def records(draw):
    """Draw records with offset, scale, random walk and gaps, with windows and averaging factors."""
    seed = draw(st.integers(0, 2**32 - 1))
    rng = np.random.default_rng(seed)
    n = draw(st.integers(40, 1500))
    x = rng.standard_normal(n) * draw(st.sampled_from([1e-3, 1.0, 1e4])) + draw(
        st.sampled_from([0.0, -15.0, 1e5])
    )
    x += draw(st.sampled_from([0.0, 0.1])) * np.cumsum(rng.standard_normal(n))
    for _ in range(draw(st.integers(0, 5))):
        start = int(rng.integers(0, n))
        x[start : start + int(rng.integers(1, draw(st.sampled_from([2, 10, 400]))))] = np.nan
    window = draw(st.integers(4, n))
    step = draw(st.integers(1, window))
    ks = sorted(draw(st.sets(st.integers(1, window // 2), min_size=1, max_size=6)))
    if draw(st.booleans()):  # these share their loads
        ks = list(range(ks[0], min(ks[0] + draw(st.integers(4, 21)), window // 2 + 1)))
    dtype = draw(st.sampled_from([np.float64, np.float32, np.int32]))
    if dtype is np.int32:  # integers have no missing samples
        x = np.clip(np.round(np.where(np.isfinite(x), x, 0)), -(2**30), 2**30)
    return x.astype(dtype), window, step, ks


class TestAgainstTheDefinition:
    @given(records(), st.none() | st.integers(1, 700))
    def test_block_sums_equal_the_direct_sum(self, record, chunk):
        x, window, step, ks = record
        if (x.size - window) // step > 200:
            x = x[: window + 200 * step]
        log = log_of(x) if chunk is None else log_of(x).chunk(time=chunk)
        with dask.config.set(scheduler="sync"):
            result = davar(
                log,
                window=f"{window}samples",
                step=f"{step}samples",
                taus=[k / 100 for k in ks],
                min_strict=0.0,
                min_coverage=0.0,
            ).load()
        x = x.astype(np.float64)
        avar, count = direct_surface(x, window, step, ks)
        np.testing.assert_array_equal(result["count"].values[0], count)
        # a cell whose few terms happen to be tiny is known to the rounding of the terms, not of
        # their square
        size = np.nanstd(x) if np.isfinite(x).sum() > 1 else 1.0
        floor = 1e-12 * (
            size**2 / np.array(ks) ** 2 + np.nanmax(np.abs(x), initial=0.0) ** 2 * 1e-10
        )
        got, want = result["avar"].values[0], avar
        np.testing.assert_array_equal(np.isnan(got), np.isnan(want))
        assert np.all(np.abs(got - want)[count > 0] <= (1e-12 * want + floor)[count > 0])

    @given(records())
    def test_angle_records_use_every_complete_triple(self, record):
        x, window, step, ks = record
        x = x.astype(np.float64)
        window = min(window, x.size - 1)
        step, ks = min(step, window), [k for k in ks if 2 * k <= window] or [1]
        if (x.size - 1 - window) // step > 200:
            x = x[: window + 1 + 200 * step]
        log = make_log(x / 3600, rate=100.0, unit="deg", kind="angle")
        result = davar(
            log,
            window=f"{window}samples",
            step=f"{step}samples",
            taus=[k / 100 for k in ks],
            min_coverage=0.0,
        )
        avar, count = direct_angle_surface(x, window, step, ks, 0.01)
        np.testing.assert_array_equal(result["count"].values[0], count)
        floor = 1e-11 * np.nanmax(np.abs(x), initial=1.0) ** 2 * 1e4
        np.testing.assert_allclose(result["avar"].values[0], avar, rtol=1e-9, atol=floor)

    @pytest.mark.parametrize(
        ("window", "step", "longest"), [(3000, 700, 1408), (150_000, 75_000, 20_480)]
    )
    def test_unit_longer_than_the_angle_buffer(self, window, step, longest):
        rng = np.random.default_rng(5)
        x = rng.standard_normal(350_000) + 7.0
        for start in rng.integers(0, x.size, 40):
            x[start : start + 90] = np.nan
        ks = np.array([1, 2, 3, 4, 5, 6, 7, 8, 9, 24, 160, longest])
        assert held_points(x.size + 1, step, ks) < x.size / 1.4
        cells, _ = surface_unit(x, WorkUnit(window, step, ks, False, 0.01, 0.0, 0.0))
        avar, count = direct_surface(x, window, step, list(ks))
        np.testing.assert_array_equal(cells[1], count)
        np.testing.assert_allclose(cells[0], avar, rtol=1e-10)


class TestAgainstPeers:
    @pytest.mark.parametrize("window", [1000, 1003])
    def test_agrees_with_allantools_in_every_window(self, window):
        rng = np.random.default_rng(3)
        x = rng.standard_normal(5000) + 0.05 * np.cumsum(rng.standard_normal(5000))
        result = davar(
            log_of(x), window=f"{window}samples", step="500samples", taus="all", tau_max=4.0
        )
        for j in (0, 3, result.sizes["time"] - 1):
            part = x[j * 500 : j * 500 + window]
            tau, deviation, _, n = allantools.oadev(
                part, rate=100.0, data_type="freq", taus=result.tau.values
            )
            np.testing.assert_allclose(result.tau, tau, rtol=1e-12)
            np.testing.assert_allclose(result.avar[0, j], deviation**2, rtol=1e-12)
            np.testing.assert_array_equal(result["count"][0, j], n)

    @pytest.mark.parametrize("method", ["direct", "recursive"])
    def test_published_algorithms_agree_without_gaps_and_shocks(self, method):
        x = np.random.default_rng(4).standard_normal((2, 6000))
        x[1, 2000:2300] = np.nan
        log = log_of(x)
        options = {"window": "1000samples", "step": "30samples", "taus": 20, "min_strict": 0.0}
        slow, fast = published_davar(log, method=method, **options), davar(log, **options)
        np.testing.assert_array_equal(slow["count"], fast["count"])
        np.testing.assert_allclose(slow.avar, fast.avar, rtol=1e-8)

    def test_convention_of_the_paper_counts_fewer_terms_and_windows(self):
        x = np.random.default_rng(5).standard_normal(6000)
        options = {"window": "1000samples", "step": "30samples", "taus": [0.1]}
        paper = published_davar(log_of(x), method="direct", paper=True, **options)
        ours = davar(log_of(x), **options)
        assert (paper.sizes["time"], ours.sizes["time"]) == (166, 167)
        assert (int(paper["count"][0, 0, 0]), int(ours["count"][0, 0, 0])) == (980, 981)
        recursive = published_davar(log_of(x), method="recursive", paper=True, **options)
        np.testing.assert_allclose(recursive.avar, paper.avar, rtol=1e-9)

    def test_zero_filling_causes_the_gap_bias_and_counting_removes_it(self):
        """P16 divides by the number of terms without gaps, which lowers the surface."""
        x = np.random.default_rng(6).standard_normal(40_000)
        x[20_000:20_400] = np.nan
        options = {"window": "2000samples", "step": "200samples", "taus": [0.01]}
        surfaces = (
            published_davar(log_of(x), method="direct", zero_fill=True, **options),
            davar(log_of(x), **options),
        )
        zero, bridge = (surface.isel(axis=0, tau=0) for surface in surfaces)
        inside = zero.coverage < 0.9
        assert inside.sum() >= 8
        np.testing.assert_allclose(zero.avar / bridge.avar, bridge.coverage, rtol=1e-9)
        assert float(zero.avar[inside].mean()) < 0.85
        assert abs(float(bridge.avar[inside].mean()) - 1.0) < 0.1


class TestInvariance:
    @pytest.mark.parametrize("chunk", [999, 4096, 20_000])
    def test_bits_do_not_depend_on_the_chunking(self, chunk):
        rng = np.random.default_rng(7)
        x = rng.standard_normal((2, 20_000))
        x[0, 5000:5003] = x[1, rng.random(20_000) < 0.1] = np.nan
        log = log_of(x, channels={"temperature": (np.linspace(20, 30, 20_000), "degC")})
        options = {"window": "3000samples", "step": "250samples", "taus": 15}
        whole = davar(log, **options)
        with dask.config.set(scheduler="sync"):
            lazy = davar(log.chunk(time=chunk), **options)
            for name in (
                "avar",
                "count",
                "coverage",
                "edf",
                "estimator",
                "window_mean",
                "temperature",
                "temperature_rate",
            ):
                assert isinstance(lazy[name].data, da.Array), name
                np.testing.assert_array_equal(lazy[name].values, whole[name].values, err_msg=name)

    @pytest.mark.parametrize("dtype", [np.float64, np.float32])
    def test_parts_that_share_memory_equal_the_surface(self, dtype):
        rows = np.random.default_rng(8).standard_normal((2, 400_000)).astype(dtype)
        rows[1, 5000:9000] = np.nan
        log = log_of(rows)
        log = log.assign(rate=(log.rate.dims, make_lazy(rows, 30_000), log.rate.attrs))
        options = {"window": "4000samples", "step": "1000samples", "taus": 20}
        whole, space = davar(log, **options).load(), Workspace()
        parts = [
            davar_part(log, part=part, space=space, **options)
            for part in davar_parts(log, samples=10_000, **options)
        ]
        assert len(parts) > 1
        xr.testing.assert_identical(xr.concat(parts, "time", data_vars="minimal").avar, whole.avar)
        units_together = davar_part(log, part=slice(0, whole.sizes["time"]), space=space, **options)
        xr.testing.assert_identical(units_together.avar, whole.avar)

    @pytest.mark.parametrize(
        ("part", "windows"),
        [
            (slice(None, 3), [0, 1, 2]),
            (slice(9, None), [9, 10, 11, 12]),
            (slice(-2, 100), [11, 12]),
            (slice(100, 101), []),
            (slice(0, 0), []),
            (slice(0, 4, 2), []),
        ],
    )
    def test_a_part_is_a_slice_of_the_windows(self, part, windows):
        log, options = log_of(np.arange(1600.0) % 7), {"window": "400samples", "step": "100samples"}
        if not windows:
            with pytest.raises(OptionError, match="give a slice of windows 0 to 12"):
                davar_part(log, part=part, **options)
            return
        expected = davar(log, **options).isel(time=windows)
        xr.testing.assert_identical(davar_part(log, part=part, **options), expected)

    def test_every_thread_has_a_separate_workspace(self):
        spaces = Workspaces()
        with ThreadPoolExecutor(1) as pool:
            others = [pool.submit(lambda: spaces.own).result() for _ in range(2)]
        assert others[0] is others[1]
        assert others[0] is not spaces.own

    def test_a_dask_log_is_not_computed(self):
        def forbidden(*_, **__):
            raise AssertionError("the log was computed")

        data = da.map_blocks(
            forbidden, chunks=((1,), (5000,) * 4), dtype=float, meta=np.empty((0, 0))
        )
        surface = davar(log_of(data), window="3000samples", step="1000samples")
        assert surface.avar.shape[1] == 18
        with pytest.raises(AssertionError, match="the log was computed"):
            surface.avar.compute(scheduler="sync")

    @pytest.mark.parametrize(
        "dtype",
        [
            np.float32,
            np.int16,
            pytest.param(np.int32, marks=pytest.mark.slow),  # each type is compiled
            pytest.param(np.int64, marks=pytest.mark.slow),
        ],
    )
    def test_narrow_types_are_summed_in_double(self, dtype):
        x = (np.random.default_rng(8).standard_normal(5000) * 50 + 2000).astype(dtype)
        narrow = davar(log_of(x), window="1000samples", step="100samples")
        wide = davar(log_of(x.astype(np.float64)), window="1000samples", step="100samples")
        np.testing.assert_allclose(narrow.avar, wide.avar, rtol=1e-12)

    def test_integers_with_a_large_mean_are_exact(self):
        x = np.random.default_rng(9).integers(-3, 4, 5000)
        small = davar(log_of(x), window="1000samples", step="100samples")
        large = davar(log_of(x + 2**40), window="1000samples", step="100samples")
        np.testing.assert_array_equal(large.avar, small.avar)

    def test_axes_are_independent(self):
        x = np.random.default_rng(10).standard_normal((3, 5000))
        x[1, 100:200] = np.nan
        together = davar(log_of(x), window="1000samples")
        single = davar(log_of(x), window="1000samples", axis="y")
        xr.testing.assert_identical(together.avar.sel(axis=["y"]), single.avar)
        named_twice = davar(log_of(x), window="1000samples", axis=["y", "y"])
        xr.testing.assert_identical(named_twice.avar, single.avar)

    def test_scaling_and_constant(self):
        x = np.random.default_rng(11).standard_normal(5000)
        base = davar(log_of(x), window="1000samples").avar
        np.testing.assert_allclose(
            davar(log_of(1e4 * x + 7e6), window="1000samples").avar, 1e8 * base, rtol=1e-7
        )


class TestAccuracy:
    def test_shock_of_a_million_sigma_does_not_affect_later_windows(self):
        rng = np.random.default_rng(19)
        x = rng.standard_normal(60_000)
        shock = 30_000
        x[shock : shock + 200] += 1e6 * rng.standard_normal(200)
        taus = np.unique(np.round(np.geomspace(1, 999, 20)).astype(int)) / 100
        result = davar(log_of(x), window="2000samples", step="300samples", taus=list(taus))
        starts = np.arange(result.sizes["time"]) * 300
        after = starts >= shock + 200
        want, _ = direct_surface(
            x[starts[after][0] :], 2000, 300, list(np.round(taus * 100).astype(int))
        )
        error = np.abs(result.avar.values[0][after][: want.shape[0]] / want - 1)
        assert error.max() <= 1e-9
        options = {"window": "2000samples", "step": "300samples", "taus": list(taus)}
        recursive = published_davar(log_of(x), method="recursive", **options)
        assert np.abs(recursive.avar.values[0][after][: want.shape[0]] / want - 1).max() > 1e-4

    @pytest.mark.parametrize("turn", [1800.0, 108_000.0])  # deg/s; the second is 300 rev/s
    def test_a_rotating_tool_keeps_its_noise(self, turn):
        noise = 3e-3 * 60 * np.sqrt(400.0) * np.random.default_rng(3).standard_normal(50_000)
        still = davar(log_of(noise, rate=400.0), window="20000samples", step="10000samples")
        rotating = davar(
            log_of(noise + turn * 3600, rate=400.0), window="20000samples", step="10000samples"
        )
        np.testing.assert_allclose(rotating.avar, still.avar, rtol=1e-6)


class TestGaps:
    def test_many_small_gaps_are_bridged_and_marked(self):
        rng = np.random.default_rng(12)
        x = rng.standard_normal(20_000)
        x[rng.random(20_000) < 0.2] = np.nan
        result = davar(
            log_of(x), window="20000samples", step="20000samples", taus=[0.01, 0.05, 1.0]
        ).isel(axis=0, time=0)
        assert list(result.estimator.values) == [STRICT, WEIGHTED, WEIGHTED]
        # white noise is seen too high, by exactly what the mask says
        assert float(result.white_response.sel(tau=1.0)) == pytest.approx(1.25, abs=0.02)

    def test_bridged_window_does_not_depend_on_its_neighbours(self):
        x = np.random.default_rng(6).standard_normal(30_000) + 3.0
        x[5000:5800] = x[20_000:20_700] = np.nan
        ks = np.array([1, 30, 200, 300])
        unit = WorkUnit(1000, 300, ks, False, 0.01, 0.3, 0.1)
        cells, _ = surface_unit(x, unit)
        bridged = np.flatnonzero((cells[4] == WEIGHTED).any(axis=1))
        assert bridged.size >= 8
        assert np.diff(bridged).max() > 20
        for j in bridged:
            single, _ = surface_unit(x[j * 300 : j * 300 + 1000], unit)
            np.testing.assert_allclose(np.stack(cells)[:, j], np.stack(single)[:, 0], rtol=1e-9)

    @pytest.mark.parametrize("block", [5, 60])
    def test_responses_predict_what_gaps_do_to_white_and_quantization_noise(self, block):
        rng = np.random.default_rng(13)
        n, trials = 3000, 150
        present = np.ones(n, dtype=bool)
        while present.mean() > 0.75:
            start = int(rng.integers(0, n))
            present[start : start + int(rng.geometric(1 / block))] = False
        white = np.where(present, rng.standard_normal((trials, n)), np.nan)
        quantization = np.where(
            present, np.diff(rng.standard_normal((trials, n + 1)), axis=1), np.nan
        )
        names = [str(i) for i in range(trials)]
        for x, law, response in (
            (white, lambda k: 1 / k, "white_response"),
            (quantization, lambda k: 3 / k**2, "quantization_response"),
        ):
            surface = davar(
                log_of(x, axis=names),
                window=f"{n}samples",
                step=f"{n}samples",
                taus=[0.01, 0.05, 0.2, 1.0, 3.0],
            ).isel(time=0)
            k = np.round(surface.tau * 100)
            ratio = surface.avar.mean("axis") / law(k)
            scatter = (surface.avar.std("axis") / law(k)) / np.sqrt(trials)
            assert np.all(np.abs(ratio - surface[response].isel(axis=0)) < 5 * scatter)

    def test_empty_window_is_nan(self):
        x = np.random.default_rng(14).standard_normal(6000)
        x[2000:4000] = np.nan
        result = davar(log_of(x), window="1000samples", step="500samples").isel(axis=0)
        empty = result.window_coverage == 0
        assert empty.sum() == 3
        assert result.avar[empty].isnull().all()
        assert result.window_mean[empty].isnull().all()
        assert (result["count"][empty] == 0).all()
        assert (result.estimator[empty] == ESTIMATORS.index("none")).all()

    def test_record_that_is_only_a_gap_has_empty_windows(self):
        result = davar(log_of(np.full(3000, np.nan)), window="100samples", step="10samples")
        assert result.sizes["time"] == 291
        assert result.avar.isnull().all()
        assert (result["count"] == 0).all()

    def test_cells_with_low_coverage_are_nan(self):
        x = np.full(1000, np.nan)
        x[:60] = np.random.default_rng(15).standard_normal(60)
        result = davar(log_of(x), window="1000samples", min_coverage=0.1)
        assert result.avar.isnull().all()


def test_published_wavelet_variances_are_reproduced(recordings):
    """The R package wv publishes the Haar wavelet variance, half the Allan variance."""
    import pandas as pd

    table = pd.read_csv(recordings("reference-wavelet-variance/reference_wavelet_variance.csv.gz"))
    frame = pd.read_parquet(recordings("adis16405-static-2h47/adis_16405_imu1.parquet"))
    table = table[table["sensor"].str.contains("ADIS") & table["channel"].str.contains("Gyro")]
    columns = [
        name
        for name in frame.columns
        if "gyro" in name.lower() or name.lower().startswith(("gx", "gy", "gz"))
    ][:3]
    compared = 0
    for column, (_, rows) in zip(columns, table.groupby("channel", sort=True), strict=True):
        rows = rows.sort_values("haar_scale_s")
        taus = list(rows["haar_scale_s"].to_numpy() / 2)
        x = frame[column].to_numpy().astype(np.float64)
        log = make_log(x, rate=100.0, unit="deg/s")
        surface = davar(
            log,
            window=f"{x.size}samples",
            step=f"{x.size}samples",
            taus=[tau for tau in taus if tau <= x.size / 200],
            tau_max=x.size / 200,
        )
        ours = surface.avar.values[0, 0] / 2 / 3600.0**2
        np.testing.assert_allclose(
            ours, rows["haar_wavelet_variance"].to_numpy()[: ours.size], rtol=1e-8
        )
        compared += ours.size
    assert compared > 40


@pytest.mark.parametrize("kind", ["rate", "angle"])
def test_trend_is_that_of_a_straight_line_through_the_present_samples(kind):
    rng = np.random.default_rng(71)
    x = 1000.0 + 3.0 * rng.standard_normal(5000) + 0.02 * np.arange(5000)
    x[rng.random(5000) < 0.3] = np.nan
    x[2000:3100] = np.nan
    values = x if kind == "rate" else np.concatenate([[0.0], np.nancumsum(x)]) / 100.0 / 3600
    if kind == "angle":
        values[2000:3100] = np.nan
        x = np.diff(values) * 100.0 * 3600
    unit = "deg/h" if kind == "rate" else "deg"
    log = make_log(values, rate=100.0, unit=unit, kind=kind)
    surface = davar(log, window="1000samples", step="300samples", taus=[0.01])
    hours = np.arange(1000) / 100.0 / 3600
    spread = np.sum((hours - hours.mean()) ** 2)
    for j in range(surface.sizes["time"]):
        part = x[300 * j : 300 * j + 1000]
        present = np.isfinite(part)
        if present.sum() < 2:
            assert np.isnan(surface.window_trend[0, j])
            continue
        slope = np.polyfit(hours[present], part[present], 1)[0]
        assert float(surface.window_trend[0, j]) == pytest.approx(slope, rel=1e-6, abs=1e-3)
        share = spread / np.sum((hours[present] - hours[present].mean()) ** 2)
        assert float(surface.trend_response[0, j]) == pytest.approx(share, rel=1e-9)


def test_long_averaging_times_alone_have_the_degrees_of_freedom_of_the_same_noise():
    log = log_of(np.random.default_rng(1).standard_normal(120_000))
    options = {"window": "1min", "step": "1min"}
    few, octaves = (
        davar(log, taus=["5.12s", "20.48s"], **options),
        davar(log, taus="octave", tau_max="20.48s", **options),
    )
    np.testing.assert_array_equal(few.tau, [5.12, 20.48])
    for name in ("avar", "edf", "count"):
        np.testing.assert_allclose(few[name], octaves[name].sel(tau=few.tau), rtol=1e-6)
    assert fit_noise(few).edf.equals(few.edf)  # two averaging times do not show five terms


@pytest.mark.parametrize("taus", ["all", [0.01, 5.0]])
def test_fields_that_all_windows_share_are_stored_once(taus):
    log = make_log(np.random.default_rng(3).standard_normal(3000), rate=100.0, unit="deg/h")
    surface = davar(log, window="10s", step="1s", taus=taus)
    for name in ("count", "coverage", "estimator", "white_response", "gap_factor"):
        assert surface[name].values.strides[:2] == (0, 0), name
    assert surface.avar.values.strides[1] > 0


def test_units_of_work_run_in_other_processes():
    log = make_log(np.random.default_rng(4).standard_normal((2, 3000)), rate=100.0, unit="deg/h")
    options = {"window": "10s", "step": "1s", "taus": 5}
    with dask.config.set(scheduler="processes", num_workers=1):
        surface = davar(log, **options)
    assert surface.identical(davar(log, **options))
