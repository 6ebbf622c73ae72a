"""Held-out evidence against marginal likelihoods by dense linear algebra."""

from __future__ import annotations

import time

import numpy as np
import pytest
import xarray as xr

from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.evidence.folds import FOLDS, fold_blocks, fold_subsets
from gyrostab.diagnose.evidence.held_out import mean_factors, noise_columns
from gyrostab.diagnose.evidence.products import WIDTHS, held_out_evidence
from gyrostab.diagnose.nulls.records import null_records
from gyrostab.diagnose.predict.linear_model import initial_state
from gyrostab.diagnose.predict.search import compute_evidence, evidence_by_effect
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.statistics.build_candidates import effect_candidates
from gyrostab.ingest.make_log import make_log
from gyrostab.kernels.regression.state_space import flicker_states
from gyrostab.units import HOUR
from tests.kernels.regression.test_state_space import relaxation_covariance, walk_covariance
from tests.support.evidence import mean_evidence, power_evidence, power_factors

STEP = 20.0


def frame(n: int) -> dict:
    edges = np.arange(n + 1) * STEP
    return {"begin": ("block", edges[:-1]), "end": ("block", edges[1:])}


def mean_case(
    n: int, *, records: int, missing: float = 0.2, seed: int = 1
) -> tuple[xr.Dataset, xr.Dataset]:
    """Block means of one axis and their baseline."""
    rng = np.random.default_rng(seed)
    variance = rng.uniform(0.5, 2.0, (1, n)) * 1e-3
    mean = np.sqrt(variance) * rng.standard_normal((records, 1, n)) + np.cumsum(
        3e-3 * rng.standard_normal((records, 1, n)), axis=-1
    )
    mean[..., rng.random(n) < missing] = np.nan
    data = xr.Dataset(
        {"mean": (("record", "axis", "block"), mean)}, coords={**frame(n), "axis": ["x"]}
    )
    K, B = (component.ravel() for component in np.meshgrid([0.0, 0.02, 0.1], [0.0, 0.01]))
    grid = ("axis", "grid")
    weights = rng.uniform(-3.0, 0.0, (2, 1, K.size))
    baseline = xr.Dataset(
        {
            "known_mean": (("axis", "block"), np.full((1, n), 0.2)),
            "mean_variance": (("axis", "block"), variance),
            "angle_variance": (("axis",), np.zeros(len(variance))),
            "grid_K": (grid, K[None]),
            "grid_B": (grid, B[None]),
            "grid_prior": (grid, weights[0]),
            "grid_calibrated": (grid, weights[1]),
        },
        coords={"axis": ["x"]},
    )
    return data, baseline


def power_case(
    n: int, bands: int, *, records: int, seed: int = 2, axes: str = "x"
) -> tuple[xr.Dataset, xr.Dataset]:
    rng = np.random.default_rng(seed)
    frequency = np.geomspace(0.05, 50.0, bands)
    columns = np.stack(
        [4e-4 * frequency**2, np.full(bands, 3600.0), 0.16 / frequency, 7e-6 / frequency**2],
        axis=-1,
    )
    square = np.array([0.3, 9e-6, 1.6e-5, 4e-4])
    spectrum = np.broadcast_to(columns @ square, (len(axes), n, bands))
    shape = np.broadcast_to(np.maximum(1.0, frequency * STEP / 3.0), spectrum.shape).copy()
    shape[:, rng.random(n) < 0.1] = np.nan
    power = (
        spectrum
        * rng.gamma(np.where(np.isfinite(shape), shape, 1.0), size=(records, *spectrum.shape))
        / shape
    )
    dims = ("axis", "block", "band")
    data = xr.Dataset(
        {"power": (("record", *dims), power), "shape": (dims, shape)},
        coords={**frame(n), "axis": list(axes), "frequency": ("band", frequency)},
    )
    tall = np.broadcast_to(columns, (len(axes), n, bands, 4))
    baseline = xr.Dataset(
        {
            "spectrum": (dims, spectrum),
            "columns": ((*dims, "noise"), tall),
            "shape_alone": (dims, shape),
            "common": (("axis", "block"), np.where(rng.random((len(axes), n)) < 0.5, 0.0, 0.03)),
            "square": (("axis", "noise"), np.broadcast_to(square, (len(axes), 4))),
            "square_stderr": (("axis", "noise"), np.broadcast_to(0.05 * square, (len(axes), 4))),
        },
        coords={"axis": list(axes), "noise": list("QNBK")},
    )
    return data, baseline


def density(y: np.ndarray, V: np.ndarray, constant: bool) -> float:
    """Return the log density of y, up to a number that depends only on its size."""
    if not y.size:
        return 0.0
    ones, inverse = np.ones(y.size), np.linalg.inv(V)
    value = y @ inverse @ y + np.linalg.slogdet(V)[1]
    if constant:
        value += np.log(ones @ inverse @ ones) - (y @ inverse @ ones) ** 2 / (ones @ inverse @ ones)
    return float(-0.5 * value)


def dense_mean(data, baseline, design, given, subset, weights) -> float:
    """Return the log evidence of one record, with the factors' variance in the covariance."""
    n = data.sizes["block"]
    y = (data["mean"] - baseline["known_mean"]).values[0, 0]
    present = np.isfinite(y)
    D = baseline["mean_variance"].values[0]
    edges = np.arange(n + 1) * STEP
    share, times, white = flicker_states(STEP, n * STEP)
    walk, flicker = (
        walk_covariance(edges),
        np.eye(n) * white
        + sum(v * relaxation_covariance(edges, t) for v, t in zip(share, times, strict=True)),
    )

    def left(x, others):
        """Return the square of x in white noise, given other columns with a wide prior."""
        W = np.diag(1.0 / D[present])
        u = np.ones((present.sum(), 1))
        W = W - W @ u @ u.T @ W / (u.T @ W @ u)
        if others.shape[1]:
            Z = others[present]
            size = np.sqrt(np.diag(Z.T @ W @ Z))
            W = W - W @ Z @ np.linalg.solve(
                Z.T @ W @ Z + np.diag((size / WIDTHS[-1]) ** 2), Z.T @ W
            )
        return np.einsum("ij,ik,kj->j", x[present], W, x[present])

    wide = WIDTHS[-1] ** 2 / left(given, np.empty((n, 0))) if given.shape[1] else np.empty(0)
    limit = 1.0 / left(design, given) if design.shape[1] else np.empty(0)
    use = present & subset
    total = []
    for K, B, weight in zip(
        baseline.grid_K.values[0], baseline.grid_B.values[0], weights, strict=True
    ):
        V = np.diag(D) + K**2 / HOUR * walk + B**2 * flicker + (given * wide) @ given.T
        for width in WIDTHS if design.shape[1] else (0.0,):
            full = V + (design * limit * width**2) @ design.T
            total.append(
                weight
                + density(y[use], full[np.ix_(use, use)], True)
                - np.log(len(WIDTHS) if design.shape[1] else 1)
            )
    return float(np.logaddexp.reduce(total) - np.logaddexp.reduce(weights))


@pytest.mark.parametrize("tier", ["free", "calibrated"])
@pytest.mark.parametrize("given_columns", [0, 2])
def test_factors_of_means_are_those_of_dense_marginal_likelihoods(tier, given_columns):
    n = 30
    data, baseline = mean_case(n, records=1)
    rng = np.random.default_rng(5)
    given = np.cumsum(rng.standard_normal((n, given_columns)), axis=0)
    designs = [np.arange(n, dtype=float), np.sin(np.arange(n) / 3.0), rng.standard_normal((n, 3))]
    factors = mean_factors(
        data, baseline, designs, axis="x", tier=tier, given=given if given_columns else None
    )
    weights = baseline["grid_prior" if tier == "free" else "grid_calibrated"].values[0]
    subsets = fold_subsets(fold_blocks(data))
    assert factors.shape == (len(subsets), 4, 1)
    for number in (0, 5, 12):
        base = dense_mean(data, baseline, np.empty((n, 0)), given, subsets[number], weights)
        for place, design in enumerate(designs, start=1):
            with_it = dense_mean(
                data, baseline, design.reshape(n, -1), given, subsets[number], weights
            )
            assert factors[number, place, 0] == pytest.approx(with_it - base, abs=1e-6)
    difference = factors[3, 0, 0] - factors[0, 0, 0]
    none = [
        dense_mean(data, baseline, np.empty((n, 0)), given, subsets[i], weights) for i in (0, 3)
    ]
    assert difference == pytest.approx(none[1] - none[0], abs=1e-6)


@pytest.mark.parametrize("is_known", [False, True])
def test_factors_of_powers_are_those_of_dense_marginal_likelihoods(is_known):
    n, bands = 14, 4
    data, baseline = power_case(n, bands, records=2)
    if is_known:  # a model without quantization and flicker
        baseline = baseline.assign(
            square=baseline["square"] * [0.0, 1.0, 0.0, 1.0],
            square_stderr=0.0 * baseline["square_stderr"],
        )
    rng = np.random.default_rng(8)
    designs = [
        np.repeat(np.arange(n)[:, None] / n, bands, axis=1),
        rng.standard_normal((n, bands, 2)),
    ]
    factors = power_factors(data, baseline, designs, axis="x")
    level, precision, _ = noise_columns(baseline, axis="x")
    weight = data["shape"].values[0].ravel()
    cells = np.isfinite(weight)
    Z = level.reshape(-1, precision.shape[0])
    shared = np.kron(np.diag(baseline["common"].values[0]), np.ones((bands, bands)))
    W = np.linalg.inv(np.diag(1.0 / weight[cells]) + shared[np.ix_(cells, cells)])
    middle = W - W @ Z[cells] @ np.linalg.solve(
        Z[cells].T @ W @ Z[cells] + precision, Z[cells].T @ W
    )
    for record in range(2):
        y = (data["power"] / baseline["spectrum"] - 1.0).values[record, 0].ravel()
        for number, subset in list(enumerate(fold_subsets(fold_blocks(data))))[record::4]:
            use = cells & np.repeat(subset, bands)
            V = (
                np.diag(1.0 / weight[use])
                + shared[np.ix_(use, use)]
                + Z[use] @ np.linalg.solve(precision, Z[use].T)
            )
            base = density(y[use], V, False)
            for place, design in enumerate(designs, start=1):
                X = design.reshape(n * bands, -1)
                limit = 1.0 / np.einsum("ij,ik,kj->j", X[cells], middle, X[cells])
                densities = [
                    density(y[use], V + (X[use] * limit * width**2) @ X[use].T, False)
                    for width in WIDTHS
                ]
                expected = np.logaddexp.reduce(densities) - np.log(len(WIDTHS)) - base
                assert factors[number, place, record] == pytest.approx(expected, abs=1e-6)


def test_evidence_is_the_loss_without_the_folds_at_the_best_length_or_the_whole_factor():
    rng = np.random.default_rng(0)
    factors = rng.standard_normal((1 + 3 * FOLDS, 3, 5))
    gains = held_out_evidence(factors, [0, 0, 1])
    for record in range(5):
        mixed = np.log(np.exp(factors[:, :2, record]).mean(axis=1))
        components = [
            sum(mixed[0] - mixed[1 + 4 * length + fold] for fold in range(4)) for length in range(3)
        ]
        assert gains[0, record] == pytest.approx(max(*components, mixed[0]))
    parts = [(factors[0, 2, 0] - factors[1 + 4 * i : 5 + 4 * i, 2, 0]).sum() for i in range(3)]
    assert gains[1, 0] == pytest.approx(max(*parts, factors[0, 2, 0]))
    factors[1:] = factors[0] - 0.1  # hardly any interval is needed: the others predict it
    assert held_out_evidence(factors, [0, 0, 0])[0] == pytest.approx(
        np.maximum(np.log(np.exp(factors[0]).mean(axis=0)), 0.4)
    )


def test_only_a_present_effect_has_evidence():
    n = 180
    data, baseline = mean_case(n, records=40, missing=0.3)
    step = (np.arange(n) >= 90).astype(float)
    power, level = power_case(n, 10, records=40)
    trend = np.repeat((np.arange(n) / n)[:, None], 10, axis=1)
    candidates = {"step": [step], "sine": [np.sin(np.arange(n) / p) for p in (3.0, 9.0)]}
    loud = data.assign(mean=data["mean"] + xr.DataArray(0.2 * step, dims="block"))
    spoken = power.assign(
        power=power["power"] * (1.0 + 0.1 * xr.DataArray(trend, dims=("block", "band")))
    )
    quiet_means, loud_means = (
        mean_evidence(means, baseline, candidates, axis="x") for means in (data, loud)
    )
    quiet, risen = (
        power_evidence(powers, level, {"trend": [trend]}, axis="x") for powers in (power, spoken)
    )
    assert quiet_means.dims == ("candidate", "record")
    assert float(loud_means.sel(candidate="step").min()) > 8.0
    assert float(loud_means.sel(candidate="sine").max()) < 8.0
    assert float(risen.min()) > 8.0
    assert float(quiet_means.quantile(0.9)) < 3.0
    assert float(quiet.quantile(0.9)) < 3.0


def test_constant_or_empty_designs_have_no_evidence():
    n = 60
    data, baseline = mean_case(n, records=3)
    absent = np.zeros(n)
    absent[np.isnan(data["mean"].values[0, 0])] = 1.0
    gains = mean_evidence(
        data,
        baseline,
        {"constant": [np.ones(n)], "nothing": [np.zeros(n)], "in a gap": [absent]},
        axis="x",
    )
    assert np.abs(gains).max() < 1e-9
    power, level = power_case(n, 6, records=3)
    flat = power_evidence(
        power, level, {"level": [np.ones((n, 6)) * 3600.0 / level["spectrum"].values[0]]}, axis="x"
    )
    assert np.abs(flat).max() < 0.05


def test_units_of_a_design_do_not_matter():
    n = 80
    data, baseline = mean_case(n, records=4)
    design = np.random.default_rng(3).standard_normal((n, 2))
    plain, scaled = (
        mean_evidence(data, baseline, {"c": [design * unit]}, axis="x")
        for unit in (1.0, np.array([1e-9, 1e6]))
    )
    np.testing.assert_allclose(plain, scaled, atol=1e-7)


def test_motion_far_beyond_the_noise_is_explained_as_a_whole():
    """With a factor of 100 000 standard errors, the means are as likely as those at rest."""
    data, baseline = mean_case(80, records=1)
    motion = np.repeat(np.random.default_rng(4).standard_normal(20), 4)
    moved = data.assign(mean=data["mean"] + 1e3 * xr.DataArray(motion, dims="block"))
    at_rest = mean_factors(data, baseline, [], axis="x")[0, 0, 0]
    without, gain = mean_factors(moved, baseline, [motion], axis="x")[0, :, 0]
    given = mean_factors(moved, baseline, [], axis="x", given=motion[:, None])[0, 0, 0]
    assert without < at_rest - 1000.0
    assert without + gain == pytest.approx(at_rest, abs=20.0)
    assert given == pytest.approx(at_rest, abs=20.0)


def test_folds_are_interleaved_and_scale_with_the_record():
    blocks = xr.Dataset(coords={name: value for name, value in frame(180).items()})
    fold = fold_blocks(blocks)
    assert fold["length"].values.tolist() == [100.0, 360.0, 900.0]
    assert [int((fold == number).sum()) for number in range(4)] == [
        45 + 54 + 45,
        45 + 54 + 45,
        45 + 36 + 45,
        45 + 36 + 45,
    ]
    assert len(np.unique(fold_subsets(fold), axis=0)) == 13
    short = fold_blocks(xr.Dataset(coords=frame(24)))
    assert short["length"].values.tolist() == [20.0, 40.0, 120.0]


@pytest.mark.slow
def test_evidence_of_many_records_takes_seconds():
    n = 180
    data, baseline = mean_case(n, records=400)
    power, level = power_case(n, 16, records=400)
    rng = np.random.default_rng(2)
    means = {str(i): [np.cumsum(rng.standard_normal(n)) for _ in range(3)] for i in range(20)}
    powers = {str(i): [rng.standard_normal((n, 16)) for _ in range(3)] for i in range(20)}
    begin = time.process_time()
    mean_evidence(data, baseline, means, axis="x")
    power_evidence(power, level, powers, axis="x")
    assert time.process_time() - begin < 10.0


def test_a_falling_spectrum_is_not_negative_quantization_noise():
    """A mean of two neighbours removes ``4 a (1 - a) sin^2(pi f / fs)``, like a negative Q^2."""
    raw = np.random.default_rng(12).standard_normal((1, 20_001))
    blocks = reduce_log(make_log(0.9 * raw[:, 1:] + 0.1 * raw[:, :-1], rate=10.0, unit="deg/h"))
    baseline = calibrate_noise(blocks)
    design = [
        np.tile(np.sin(np.pi * blocks["frequency"].values / 10.0) ** 2, (blocks.sizes["block"], 1))
    ]
    gain = power_factors(blocks, baseline, design, axis="x")[0, 1, 0]
    beside_any = power_factors(blocks, baseline.drop_vars("posterior"), design, axis="x")[0, 1, 0]
    assert gain > 20.0
    assert gain > 1.3 * beside_any
    assert (
        np.diagonal(noise_columns(baseline, axis="x")[1])[0]
        > 2.0 / baseline["square_stderr"].sel(noise="Q").item() ** 2
    )


@pytest.mark.parametrize(("share", "least", "most"), [(0.0, -np.inf, 2.0), (0.06, 10.0, np.inf)])
def test_evidence_of_a_weak_filter_exceeds_that_of_noise(share, least, most):
    """Six per cent of every sample come late: the spectrum falls by a quarter towards its end."""
    raw = np.random.default_rng(12).standard_normal((2, 15_001))
    blocks = reduce_log(
        make_log((1.0 - share) * raw[:, 1:] + share * raw[:, :-1], rate=10.0, unit="deg/h")
    )
    baseline = calibrate_noise(blocks)
    filters = [
        candidate
        for candidate in effect_candidates(blocks, baseline["coefficient"])[0]
        if candidate.effect == "logger_filter"
    ]
    (noise,) = null_records(blocks, baseline, count=200, rng=np.random.default_rng(3), chunk=200)
    start = initial_state(blocks, baseline)
    (gains,) = evidence_by_effect(compute_evidence(filters, blocks, start)).values()
    (drawn,) = evidence_by_effect(
        compute_evidence(filters, noise, start, rng=np.random.default_rng(1))
    ).values()
    assert least < gains[0] < most
    assert np.quantile(drawn, 0.99) < 5.0
