"""Factors of common noise: from products of pairs, behind a low-pass, and with a single pair."""

from __future__ import annotations

import math

import numpy as np
import pytest
import xarray as xr

from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.predict.candidates import Component
from gyrostab.diagnose.predict.linear_model import cross_column, initial_state, pair_rows
from gyrostab.diagnose.statistics.build_candidates import effect_candidates
from gyrostab.diagnose.statistics.shared_factors import estimate_shared_factors
from tests.support.named import COEFFICIENT, record

AXES = ("x", "y", "z")
RECORDS = 8


@pytest.fixture(scope="module")
def noise_only():
    blocks = record([])
    candidates, _ = effect_candidates(blocks, COEFFICIENT)
    return (
        blocks,
        calibrate_noise(blocks),
        next(candidate for candidate in candidates if candidate.effect == "shared_source"),
    )


def estimate_sizes(noise_only, factors, number, *, bandwidth=math.inf, axes=AXES):
    """Estimate factors from cross-spectra drawn for common noise, white or behind one pole."""
    blocks, baseline, candidate = noise_only
    rng = np.random.default_rng([11, number])
    f = blocks["frequency"].values
    density = 3600.0 / (1.0 + (f / bandwidth) ** 2)
    spectrum = baseline["spectrum"].transpose("axis", "block", "band").values
    shape = blocks["cross_shape"].transpose("pair", "block", "band").values
    cross = np.empty(shape.shape, np.complex128)
    for row, pair in enumerate(pair_rows(blocks)):
        i, j = (AXES.index(axis) for axis in pair)
        scatter = np.sqrt(spectrum[i] * spectrum[j] / (2.0 * shape[row]))
        noise = scatter * (
            rng.standard_normal(shape[row].shape) + 1j * rng.standard_normal(shape[row].shape)
        )
        cross[row] = (
            factors[i] * factors[j] * cross_column(density[None, None], row, blocks) + noise
        )
    state = initial_state(
        blocks.assign(cross=xr.DataArray(cross, dims=("pair", "block", "band"))), baseline
    )
    variant = candidate.variants[-1]
    components = [
        Component(candidate, variant, row, 10.0)
        for row in pair_rows(blocks)
        if set(row) <= set(axes)
    ]
    return estimate_shared_factors(components, axes, state)


@pytest.mark.slow
@pytest.mark.parametrize("bandwidth", [math.inf, 1.2])
def test_intervals_hold_the_true_factors(noise_only, bandwidth):
    truth = (0.0014, 0.0011, -0.0016)
    held = []
    for number in range(RECORDS):
        estimates = estimate_sizes(noise_only, truth, number, bandwidth=bandwidth)
        sign = np.sign(
            sum(
                estimates[f"N.{axis}"][0] * factor for axis, factor in zip(AXES, truth, strict=True)
            )
        )
        held += [
            sorted((sign * low, sign * high))
            for _, _, low, high in (estimates[f"N.{axis}"] for axis in AXES)
        ]
    inside = [
        low <= factor <= high for (low, high), factor in zip(held, truth * RECORDS, strict=True)
    ]
    assert np.mean(inside) >= 0.8


def test_bandwidth_is_given_only_if_it_shows(noise_only):
    slow = estimate_sizes(noise_only, (0.002, 0.002, 0.002), 1, bandwidth=0.8)["bandwidth"]
    assert slow[2] < 0.8 < slow[3]
    assert slow[3] / slow[2] < 2.0
    assert math.isinf(estimate_sizes(noise_only, (0.002, 0.002, 0.002), 1)["bandwidth"][0])


def test_one_pair_determines_only_the_product(noise_only):
    """The factors range between the most that the axis has and what the other axis leaves."""
    truth = (0.0024, 0.0009, 0.0)
    estimates = estimate_sizes(noise_only, truth, 3, axes=("x", "y"))
    (x, _, x_low, x_high), (y, _, y_low, y_high) = estimates["N.x"], estimates["N.y"]
    assert x * y == pytest.approx(truth[0] * truth[1], rel=0.15)
    assert x_low < truth[0] < x_high < 0.0032
    assert y_low < truth[1] < y_high
    assert x_low * y_high == pytest.approx(truth[0] * truth[1], rel=0.25)


def test_common_noise_does_not_exceed_the_noise(noise_only):
    estimates = estimate_sizes(noise_only, (0.0004, 0.0004, 0.0004), 5)
    assert all(abs(estimates[f"N.{axis}"][3]) < 0.0033 for axis in AXES)


def test_other_pairs_do_not_matter(noise_only):
    without_z, with_z = (
        estimate_sizes(noise_only, (0.002, 0.0015, 0.0), 7, axes=("x", "y")),
        estimate_sizes(noise_only, (0.002, 0.0015, 0.003), 7, axes=("x", "y")),
    )
    assert without_z == with_z
