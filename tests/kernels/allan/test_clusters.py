"""Weighted cluster means against a matrix of their terms, and their scatter over many records."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gyrostab.allan.davar import davar
from gyrostab.ingest.make_log import make_log
from gyrostab.kernels.allan.clusters import cluster_strides
from gyrostab.kernels.allan.pairs import white_pair_sum
from gyrostab.schema import ESTIMATORS
from tests.reference import cluster_cell

WEIGHTED = ESTIMATORS.index("weighted_clusters")
N = 900


def regular(length: int, lost: int) -> np.ndarray:
    return np.arange(N) % length >= lost


def blocks(mean: float, share: float) -> np.ndarray:
    rng, present = np.random.default_rng(3), np.ones(N, dtype=bool)
    while present.mean() > 1 - share:
        start = int(rng.integers(0, N))
        present[start : start + int(rng.geometric(1 / mean))] = False
    return present


PATTERNS = {
    "every 7th": regular(7, 1),
    "every 8th": regular(8, 1),
    "20 of 64": regular(64, 20),
    "30 of 100": regular(100, 30),
    "random, 20 %": np.random.default_rng(1).random(N) > 0.2,
    "random, 40 %": np.random.default_rng(2).random(N) > 0.4,
    "blocks of 60": blocks(60, 0.3),
    "one block": ~((np.arange(N) >= 500) & (np.arange(N) < 700)),
    "the end": np.arange(N) < 740,
    "a third is left": (np.arange(N) >= 300) & (np.arange(N) < 600),
}


def surface(x: np.ndarray, ks: list[int], *, window: int = N, step: int | None = None, **options):
    log = make_log(
        x, rate=1.0, unit="deg/h", axis=[f"a{i}" for i in range(np.atleast_2d(x).shape[0])]
    )
    ks = [k for k in ks if 2 * k <= window]
    made = davar(
        log,
        window=f"{window}samples",
        step=f"{step or window}samples",
        taus=[float(k) for k in ks],
        min_strict=1.01,
        min_coverage=0.0,
        **options,
    )
    return made.load()


@given(st.integers(0, 2**32 - 1), st.data())
def test_cells_equal_the_sum_over_their_terms(seed, data):
    rng = np.random.default_rng(seed)
    x = rng.standard_normal(data.draw(st.integers(20, 700))) + data.draw(
        st.sampled_from([0.0, 1e4])
    )
    x[rng.random(x.size) < data.draw(st.sampled_from([0.0, 0.02, 0.2, 0.5]))] = np.nan
    start = int(rng.integers(0, x.size))
    x[start : start + data.draw(st.sampled_from([1, 30, 200]))] = np.nan
    window = data.draw(st.integers(4, x.size))
    step = max(data.draw(st.integers(1, window)), (x.size - window) // 8, 1)
    ks = sorted(data.draw(st.sets(st.integers(1, window // 2), min_size=1, max_size=4)))
    made = surface(x, ks, window=window, step=min(step, window)).isel(axis=0)
    for j in range(made.sizes["time"]):
        first = j * made.attrs["step_samples"]
        for i, k in enumerate(ks):
            stride = int(cluster_strides(window, np.array([k]))[0])
            cell = made.isel(time=j, tau=i)
            want = cluster_cell(x[first : first + window], k, stride=stride, first=first)
            if int(cell["estimator"]) != WEIGHTED:
                assert (
                    np.isfinite(x[first : first + window]).all() or not want["count"] or window < 8
                )
                continue
            assert int(cell["count"]) == want["count"]
            if not want["count"]:
                assert np.isnan(cell.avar)
                continue
            for name in (
                "avar",
                "white_response",
                "quantization_response",
                "ramp_response",
                "coverage",
            ):
                assert float(cell[name]) == pytest.approx(
                    want[name], rel=1e-6 if name == "avar" else 1e-10, abs=1e-12
                ), name
            assert float(cell.difference_trend) / 3600 == pytest.approx(
                want["slope"], rel=1e-6, abs=1e-9
            )


@pytest.mark.parametrize("share", [0.05, 0.2])
def test_clusters_do_not_depend_on_the_other_averaging_times(share):
    rng, window = np.random.default_rng(8), 6000
    x = rng.standard_normal(window + 900)
    x[rng.random(x.size) < share] = np.nan
    x[2000:2777] = np.nan
    few, many = (
        surface(x, [*ks, 800, 1500, 2000], window=window, step=300).isel(axis=0)
        for ks in ([], [1, 2, 3])
    )
    for name in (
        "avar",
        "count",
        "coverage",
        "white_response",
        "quantization_response",
        "ramp_response",
    ):
        assert np.array_equal(few[name], many[name].sel(tau=few.tau), equal_nan=True), name
    for k in (800, 1500, 2000):
        stride = int(cluster_strides(window, np.array([k]))[0])
        want = cluster_cell(x[300 : 300 + window], k, stride=stride, first=300)
        for name in ("avar", "white_response", "ramp_response", "coverage"):
            assert float(few[name].isel(time=1).sel(tau=k)) == pytest.approx(
                want[name], rel=1e-9
            ), name


def test_short_window_uses_every_pair_and_long_window_only_some():
    ks = np.array([1, 31, 32, 100, 372, 499])
    assert list(cluster_strides(1000, ks)) == [1, 1, 2, 2, 1, 1]
    assert list(cluster_strides(120_000, ks)) == [1, 1, 2, 4, 16, 16]


@pytest.mark.parametrize("pattern", PATTERNS)
def test_degrees_of_freedom_are_those_of_the_mask(pattern):
    """The kernel uses only some pairs of terms; the reference uses all of them."""
    x = np.where(PATTERNS[pattern], 1.0, np.nan) * np.random.default_rng(4).standard_normal(N)
    ks = [2, 5, 16, 50, 120, 250, 330, 400, 440]
    made = surface(x, ks).isel(axis=0, time=0)
    compared = 0
    for k in ks:
        want, cell = cluster_cell(x, k), made.sel(tau=float(k))
        assert bool(np.isnan(cell.avar)) == (want["count"] == 0)
        assert float(cell.gap_factor) > 0.0 or want["count"] == 0
        if want["count"]:
            terms = N - 2 * k + 1
            full = terms**2 / white_pair_sum(terms, k)
            assert float(cell.gap_factor) * full == pytest.approx(want["edf"], rel=0.12)
            compared += 1
    assert compared >= 5


@pytest.mark.parametrize(
    "pattern", ["every 7th", "random, 40 %", "blocks of 60", "one block", "the end"]
)
def test_scatter_of_many_records_agrees_with_the_degrees_of_freedom(pattern):
    """A cell with nu degrees of freedom has the variance ``2 mean^2 / nu``."""
    records, ks = 1500, [1, 2, 3, 5, 8, 12, 20, 30, 50, 80, 120, 180, 250, 330, 400, 440]
    x = np.where(PATTERNS[pattern], np.random.default_rng(5).standard_normal((records, N)), np.nan)
    made = surface(x.ravel(), ks).isel(axis=0, tau=slice(3, None))
    scattered = 2 * made.avar.mean("time") ** 2 / made.avar.var("time")
    claimed = made.edf.median("time")
    has_edf = claimed.notnull().values
    assert has_edf.sum() >= 10
    error = np.sqrt((2 + 12 / scattered) / records)
    assert (abs(np.log(claimed / scattered)) < 3.5 * error + 0.1).values[has_edf].all()


def test_cell_near_zero_by_chance_has_few_degrees_of_freedom():
    """Windows of 10 s at 100 Hz without their end leave few positions at long averaging times."""
    x = np.random.default_rng(6).standard_normal((300, 1000))
    x[:, 890:] = np.nan
    made = (
        surface(x.ravel(), list(range(1, 500, 6)), window=1000)
        .isel(axis=0)
        .sel(tau=slice(420.0, 490.0))
    )
    assert (made["count"] == 1001 - 2 * made.tau).all()
    assert ((made.avar * made.tau / made.white_response) < 1e-5).mean() < 0.01
    single = [cluster_cell(x[0], int(k))["edf"] for k in made.tau]
    assert (made.edf < 2 * np.array(single)).mean() > 0.95
    assert (made.edf < made["count"]).all()
