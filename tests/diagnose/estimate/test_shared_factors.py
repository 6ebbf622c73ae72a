"""Sizes of noise that axes share: what products tell, what a low-pass hides, and what one pair cannot say."""

from __future__ import annotations

import math

import numpy as np
import pytest
import xarray as xr

from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.estimate.shared_factors import estimate_shared_factors
from gyrostab.diagnose.predict.candidates import effect_candidates
from gyrostab.diagnose.predict.condition import Component
from gyrostab.diagnose.predict.linear_model import cross_column, initial_state, pair_rows
from tests.support.named import COEFFICIENT, record

AXES = ("x", "y", "z")
RECORDS = 8


@pytest.fixture(scope="module")
def quiet():
    blocks = record([])
    candidates, _ = effect_candidates(blocks, COEFFICIENT)
    return (
        blocks,
        calibrate_noise(blocks),
        next(one for one in candidates if one.effect == "shared_source"),
    )


def sizes(quiet, factors, number, *, bandwidth=math.inf, axes=AXES):
    """Sizes from cross-spectra that are drawn about those of common noise with these factors, white or behind one pole."""
    blocks, baseline, candidate = quiet
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


@pytest.mark.parametrize("bandwidth", [math.inf, 1.2])
def test_intervals_hold_the_factors(quiet, bandwidth):
    truth = (0.0014, 0.0011, -0.0016)
    held = []
    for number in range(RECORDS):
        found = sizes(quiet, truth, number, bandwidth=bandwidth)
        sign = np.sign(
            sum(found[f"N.{axis}"][0] * one for axis, one in zip(AXES, truth, strict=True))
        )
        held += [
            sorted((sign * low, sign * high))
            for _, _, low, high in (found[f"N.{axis}"] for axis in AXES)
        ]
    inside = [low <= one <= high for (low, high), one in zip(held, truth * RECORDS, strict=True)]
    assert np.mean(inside) >= 0.8


def test_a_low_pass_is_told_where_it_shows_and_is_none_where_it_does_not(quiet):
    slow = sizes(quiet, (0.002, 0.002, 0.002), 1, bandwidth=0.8)["bandwidth"]
    assert slow[2] < 0.8 < slow[3]
    assert slow[3] / slow[2] < 2.0
    assert math.isinf(sizes(quiet, (0.002, 0.002, 0.002), 1)["bandwidth"][0])


def test_one_pair_tells_the_product_alone(quiet):
    """The factors may be any between the most that the axis has and what the most of the other one leaves."""
    truth = (0.0024, 0.0009, 0.0)
    found = sizes(quiet, truth, 3, axes=("x", "y"))
    (x, _, x_low, x_high), (y, _, y_low, y_high) = found["N.x"], found["N.y"]
    assert x * y == pytest.approx(truth[0] * truth[1], rel=0.15)
    assert x_low < truth[0] < x_high < 0.0032
    assert y_low < truth[1] < y_high
    assert x_low * y_high == pytest.approx(truth[0] * truth[1], rel=0.25)


def test_no_axis_shares_more_than_it_has(quiet):
    found = sizes(quiet, (0.0004, 0.0004, 0.0004), 5)
    assert all(abs(found[f"N.{axis}"][3]) < 0.0033 for axis in AXES)


def test_other_pairs_of_axes_change_nothing(quiet):
    one, other = (
        sizes(quiet, (0.002, 0.0015, 0.0), 7, axes=("x", "y")),
        sizes(quiet, (0.002, 0.0015, 0.003), 7, axes=("x", "y")),
    )
    assert one == other
