"""Score of the coherency between axes, which the Allan variance of one axis does not show."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.arrays import Complexes, Floats, Ints
from gyrostab.diagnose.evidence.held_out import LinearModel
from gyrostab.diagnose.predict.candidates import (
    Candidate,
    Component,
    Prospect,
    Variant,
    numbered_columns,
)
from gyrostab.diagnose.predict.linear_model import (
    State,
    band_widths,
    cross_column,
    expected_cross,
    linear_model,
    mix_with_mean,
    pair_rows,
    power_column,
    real_and_imaginary,
    records_last,
    select_row,
    unspread_share,
    variant_designs,
)
from gyrostab.diagnose.reduce.schema import pair_indices
from gyrostab.diagnose.statistics.base import SizeFit, Sizes, Statistic
from gyrostab.diagnose.statistics.mismatch_wording import capitalise_axes, taus_text
from gyrostab.diagnose.statistics.power import put_axis_first
from gyrostab.diagnose.statistics.scores import (
    BlockWindows,
    cube_root_score,
    statistic_dataset,
    sum_over_windows,
    window_set,
)
from gyrostab.diagnose.statistics.shared_factors import estimate_shared_factors

#: Lengths of the windows [blocks]; the record as a whole is one more.
LENGTHS = (5, 15, 45)
#: Least share of the variance of a cross-spectrum in quadrature to shared noise. Design choice.
_MIN_QUADRATURE_SHARE = 0.05
_MAX_WHITE_RANGE = 0.04  # of a density, over the bands, for white noise; design choice
_MIN_FREQUENCIES = 8.0  # complex frequencies, for a meaningful coherency; design choice


class CrossSpectrum(Statistic):
    """Cross-spectra of pairs of axes, which the Allan variance of one axis does not show."""

    name = "cross_spectrum"
    view = "cross_axis"
    explained_views = ("cross_axis", "davar")
    containing_views = ("davar", "cross_axis")
    modelled_views = explained_views
    unsupported_as = "~cov"
    null_variable = "cross"
    is_power_weighted = True
    is_pairwise = True
    has_course = True
    takes_noise = False  # only the effect itself gives the power of each axis

    def nuisance_alternatives(self, blocks: xr.Dataset) -> list[Candidate]:
        """Return noise that two axes share, of any phase and spectrum."""
        if not blocks.sizes["pair"]:
            return []
        return [Candidate("~cov", self, (), _covariance_variants(blocks.sizes["band"]))]

    def score(self, blocks: xr.Dataset, baseline: xr.Dataset) -> xr.Dataset | None:
        """Score the coherency of every pair of axes, in phase and in quadrature.

        ``ratio`` and ``estimate`` are the coherency, in bands and in total. Three axes or more have
        a row of all pairs together, over all bands in phase.
        """
        if not blocks.sizes["pair"]:
            return None
        axes = [str(axis) for axis in blocks["axis"].values]
        left, right = pair_indices(blocks)
        windows = window_set(blocks.sizes["block"], LENGTHS)
        coherency, count = _pair_coherency(blocks, baseline, left, right, windows)
        r = real_and_imaginary(coherency)
        z = correlation_score(r, np.concatenate([2.0 * count] * 2, axis=-1))
        rows = [f"{axes[a]} {axes[b]}" for a, b in zip(left, right, strict=True)]
        bands = blocks.sizes["band"]
        if len(rows) > 1:
            empty = np.full((*z.shape[:-3], 1, *z.shape[-2:]), np.nan)
            z, r = (np.concatenate([part, empty], axis=-3) for part in (z, r))
            broad = z[..., :-1, :, bands]
            mean_square = (broad**2).mean(axis=-2)
            z[..., -1, :, bands] = cube_root_score(
                mean_square, np.full(mean_square.shape, len(rows) / 2.0)
            )
            r[..., -1, :, bands] = np.sqrt((r[..., :-1, :, bands] ** 2).mean(axis=-2))
            rows = [*rows, " ".join(axes)]
        low, high = blocks["band_low"].values, blocks["band_high"].values
        low = np.maximum(low, 0.5 / float(blocks.attrs["block_s"]))
        f_min, f_max = np.append(low, low[0]), np.append(high, high[-1])
        return statistic_dataset(
            blocks,
            rows=rows,
            windows=windows,
            columns={
                "quantity": np.repeat(
                    ["in phase", "all in phase", "in quadrature", "all in quadrature"],
                    [bands, 1, bands, 1],
                ),
                "tau_min_s": np.tile(0.5 / f_max, 2),
                "tau_max_s": np.tile(0.5 / f_min, 2),
                "frequency": np.tile(np.append(blocks["frequency"].values, np.nan), 2),
            },
            z=z,
            ratio=np.abs(r),
            estimate=r,
        )

    def design(self, prospect: Prospect) -> Iterator[Variant]:
        """Yield cross-densities per product of the factors of both axes."""
        prediction = prospect.prediction
        if not prediction.coherent or prediction.line is not None:
            return
        for name, density in prediction.spectrum.items():
            yield Variant(prospect.values, (name,), put_axis_first(density)[None], squared=True)

    def rows(self, candidate: Candidate, state: State) -> list[tuple[str, ...]]:
        return pair_rows(state.blocks)

    def model(
        self, candidates: Sequence[Candidate], row: int, data: xr.Dataset, state: State
    ) -> LinearModel:
        pair = pair_rows(state.blocks)[row]
        i, j = (state.axes.index(axis) for axis in pair)
        shared = expected_cross(state.baseline, state.blocks)[row]
        values = records_last(data["cross"].values, 3)[row] - shared[..., None]
        shape = state.blocks["cross_shape"].values[row]
        # The scatter is larger in phase with shared noise, and smaller in quadrature.
        noise_product = state.expected_power[i] * state.expected_power[j]
        shared_product = (shared**2).real
        in_quadrature = np.maximum(
            noise_product - shared_product, _MIN_QUADRATURE_SHARE * noise_product
        )
        variance = np.concatenate([noise_product + shared_product, in_quadrature], axis=1)
        weight = np.tile(2.0 * shape, 2) / variance
        weight = np.where((state.masked[i] | state.masked[j])[:, None], 0.0, weight)
        unspread, width = unspread_share(state.blocks, "pair")[row], band_widths(state.blocks)
        designs = variant_designs(
            candidates,
            lambda density: real_and_imaginary(
                mix_with_mean(select_row(density, row) + 0j, unspread, width)
            ),
        )
        given = state.given.get(("cross", ",".join(pair)), [])
        return linear_model(real_and_imaginary(values, axis=1), weight, designs, given)

    def condition(self, state: State, component: Component) -> State:
        row = pair_rows(state.blocks).index(component.row)
        columns = []
        for density in component.variant.design:
            chosen = cross_column(density, row, state.blocks)
            columns.append(real_and_imaginary(chosen))
        state = state.with_columns("cross", ",".join(component.row), columns)
        if not component.variant.squared:
            return state
        calibrated = state.baseline.attrs.get("source", "calibrated") == "calibrated"
        # White noise was calibrated with it.
        added = [
            density.real
            for density in component.variant.design
            if not (calibrated and _is_white(density))
        ]
        for axis in component.row if added else ():
            powers = [power_column(density, state.axes.index(axis), state) for density in added]
            known = state.power_columns(axis)
            new = [power for power in powers if not any(np.array_equal(power, k) for k in known)]
            state = state.with_columns("added_power", axis, new)
        return state

    def has_power_of_effect(self, component: Component, state: State) -> bool:
        """Return True: the powers of the axes have no column."""
        return True

    def estimate(self, fit: SizeFit) -> Sizes:
        """Estimate the factor of every axis from the products of two."""
        return estimate_shared_factors(fit.components, fit.axes, fit.state)

    def describe(self, region: Mapping[str, Any], when: str) -> str:
        estimate = region.get("estimate", np.nan)
        size = f" (coherency {estimate:.2g})" if np.isfinite(estimate) else ""
        return (
            f"{capitalise_axes(region['axes'])} vary together{size} {when}, at "
            f"{taus_text(region)}, which independent gyros do not"
        )


@np.errstate(divide="ignore", invalid="ignore")
def _pair_coherency(
    blocks: xr.Dataset, baseline: xr.Dataset, left: Ints, right: Ints, windows: BlockWindows
) -> tuple[Complexes, Floats]:
    """Compute the coherency and the number of complex frequencies by (record), pair, window, band.

    The last band is that of all bands together. If both axes are noisy in only a few blocks, these
    dominate: the number is that of equal blocks with the same scatter.
    """
    cross = blocks["cross"].values
    if "cross" in baseline:
        cross = cross - baseline["cross"].values
    power, shape = blocks["power"].values, blocks["shape"].values
    spectrum = baseline["spectrum"].values
    flat = power / spectrum
    cross = cross / np.sqrt(spectrum[left] * spectrum[right])
    weight = np.minimum(shape[..., left, :, :], shape[..., right, :, :])
    left_power, right_power = flat[..., left, :, :], flat[..., right, :, :]
    present = np.isfinite(cross) & np.isfinite(left_power) & np.isfinite(right_power) & (weight > 0)
    weight = np.where(present, weight, 0.0)

    def summed(values: Complexes) -> Complexes:
        sums = sum_over_windows(np.where(present, values, 0.0) * weight, windows)
        return np.concatenate([sums, sums.sum(axis=-1, keepdims=True)], axis=-1)

    product = summed(left_power).real * summed(right_power).real
    sums = summed(cross) / np.sqrt(product)
    count = np.fmin(
        summed(np.ones_like(left_power)).real, product / summed(left_power * right_power).real
    )
    return np.where(count >= _MIN_FREQUENCIES, sums, complex(np.nan, np.nan)), count


def correlation_score(r: Floats, samples: Floats) -> Floats:
    """Return the normal score of a correlation of independent samples of known mean (Wallace 1959).

    Examples
    --------
    >>> correlation_score(np.array([0.0, 0.1]), np.array([400.0, 400.0])).round(2)
    array([0., 2.])
    """
    freedom = np.maximum(samples - 1.0, 1.0)
    size = np.sqrt(-freedom * np.log1p(-np.minimum(r**2, 1.0 - 1e-12)))
    return np.asarray(np.sign(r) * size * (8.0 * freedom + 1.0) / (8.0 * freedom + 3.0))


def _is_white(density: Complexes) -> bool:
    """Return whether a density is the same in all bands, up to `_MAX_WHITE_RANGE`."""
    size = np.abs(density)
    return bool(np.ptp(size, axis=-1).max() <= _MAX_WHITE_RANGE * size.max(initial=0.0))


def draw_coherency(shape: Floats, size: tuple[int, ...], rng: np.random.Generator) -> Complexes:
    """Draw the sample coherency of independent signals, from `shape` complex frequencies."""
    freedom = np.maximum(np.where(np.isfinite(shape), shape, 1.0) - 1.0, 0.0)
    with np.errstate(divide="ignore", over="ignore"):
        # Beta(1, n - 1)
        squared = np.where(freedom > 0.0, 1.0 - rng.random(size) ** (1.0 / freedom), 1.0)
    return np.asarray(np.sqrt(squared) * np.exp(2j * np.pi * rng.random(size)))


def _covariance_variants(bands: int) -> tuple[Variant, ...]:
    """Return covariances in each band, or in four groups of bands, with any phase."""
    single_bands = np.eye(bands)
    groups = [part.sum(axis=0) for part in np.array_split(single_bands, min(4, bands))]
    return (*(_any_phase([band]) for band in single_bands), _any_phase(groups))


def _any_phase(rows: list[Floats]) -> Variant:
    """Return cross-densities of any phase in these bands."""
    columns = np.array([factor * row for row in rows for factor in (1.0 + 0j, 1j)])
    return Variant({}, numbered_columns(len(columns)), columns[:, None, None, :])
