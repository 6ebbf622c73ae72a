"""Transfers from a reference channel, or from another axis, to an axis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import xarray as xr

from gyrostab.arrays import Array
from gyrostab.diagnose.evidence.held_out import LinearModel
from gyrostab.diagnose.predict.candidates import Candidate, Component, Prospect, Variant
from gyrostab.diagnose.predict.condition import free_covariance
from gyrostab.diagnose.predict.linear_model import (
    State,
    expected_cross,
    linear_model,
    pair_rows,
    real_and_imaginary,
    records_last,
    reference_channel_power,
    variant_designs,
)
from gyrostab.diagnose.predict.sizes import component_mixture
from gyrostab.diagnose.predict.windows import distinct_variants
from gyrostab.diagnose.reduce.schema import read_as_measured
from gyrostab.diagnose.statistics.base import Statistic
from gyrostab.physics.base import Effect
from gyrostab.physics.prediction import Windows
from gyrostab.physics.registry import effects


class Transfer(Statistic):
    """What an axis has in common with a channel on the log's time, or with another axis."""

    name = "transfer"
    view = "davar"
    explained_views = ("davar", "cross_axis", "spectrum", "mean", "distribution")
    containing_views = ("davar",)
    is_power_weighted = True
    is_transfer = True

    def candidates(
        self,
        kind: type[Effect],
        driver: tuple[str, ...],
        prospects: Sequence[Prospect],
        windows: Windows,
        blocks: xr.Dataset,
    ) -> list[Candidate]:
        """Return candidates of rates that follow another channel or axis at every frequency.

        Channels of no known effect, such as a seismometer, may see real motion without any other.
        """
        usable = {*_reference_channels(blocks), *windows.axes}
        by_channel: dict[str, list[Variant]] = {}
        for prospect in prospects:
            for (parameter, channel), transfer in prospect.prediction.transfer.items():
                if channel in usable:
                    by_channel.setdefault(channel, []).append(
                        Variant(prospect.values, (parameter,), np.asarray(transfer)[None])
                    )
        is_without_channel = kind.name == "real_motion" and not driver
        if is_without_channel or (by_channel and kind.stage == "motion"):
            for channel in [*by_channel, *_unknown_channels(blocks)]:
                by_channel[channel] = by_channel.get(channel, []) + _any_transfer(
                    windows.frequency.size
                )
        return [
            Candidate(kind.name, self, driver, distinct_variants(variants), reference=(channel,))
            for channel, variants in by_channel.items()
        ]

    def model(
        self, candidates: Sequence[Candidate], row: int, data: xr.Dataset, state: State
    ) -> LinearModel:
        cross, power = reference_channel_of(
            candidates[0].reference[0], row, data, state.blocks, state.baseline
        )
        root = np.sqrt(np.where(power > 0.0, power, np.nan))
        share = _moving_share(candidates[0].reference[0], power, state)
        weight = 2.0 * state.blocks["shape"].values[row] / state.expected_power[row]
        weight = np.where(
            np.isfinite(root) & np.isfinite(weight) & ~state.masked[row][:, None], weight, 0.0
        )
        weight = np.concatenate([weight, weight], axis=1)
        with np.errstate(invalid="ignore"):
            values = real_and_imaginary(cross / root[..., None], axis=1)
        designs = variant_designs(
            candidates, lambda density: real_and_imaginary(density * root * share)
        )
        given = state.given.get(("transfer", state.axes[row]), [])
        return linear_model(values, weight, designs, given)

    def condition(self, state: State, component: Component) -> State:
        axis = component.row[0]
        power = reference_channel_power(component.candidate.reference[0], state.blocks)
        power = np.where(np.isfinite(power), power, 0.0)
        root, design = np.sqrt(power)[:, None], component.variant.design
        columns = np.concatenate([design.real * root, design.imag * root], axis=-1)
        state = state.with_columns("transfer", axis, list(np.moveaxis(columns, 1, 0)))
        for band in range(power.shape[1]):
            column = np.zeros_like(power)
            column[:, band] = power[:, band] / max(power[:, band].max(initial=0.0), 1e-300)
            if np.ptp(column[:, band]) > 0.5:
                state = state.with_columns("power", axis, [column])
            state = free_covariance(state, axis, column)
        return state

    def noise_shares(
        self, component: Component, axis: str, state: State, expected_power: Array
    ) -> tuple[Array | float, list[Array], list[Array]]:
        """Return the power that follows the channel or the other axis."""
        state = replace(state, expected_power=expected_power)
        mean, _ = component_mixture(component, state).moments()
        transfer = np.tensordot(mean, component.variant.design, axes=1)
        power = reference_channel_power(component.candidate.reference[0], state.blocks)
        return np.abs(transfer) ** 2 * np.nan_to_num(power), [], []


def reference_channel_of(
    name: str, row: int, data: xr.Dataset, blocks: xr.Dataset, baseline: xr.Dataset
) -> tuple[Array, Array]:
    """Return the cross-power of an axis with a channel or other axis, and the power of that.

    Shapes (block, band, record) and (block, band). Expected cross-spectra are subtracted.
    """
    axes = [str(axis) for axis in blocks.variables["axis"].values]
    power = reference_channel_power(name, blocks)
    if name not in axes:
        cross = records_last(data["reference_cross"].values, 4)
        return cross[row, _reference_channels(blocks).index(name)], power
    cross = records_last(read_as_measured(data, "cross").values, 3)
    cross = cross - expected_cross(baseline, blocks)[..., None]
    if name == axes[row]:
        return np.full(cross.shape[1:], np.nan + 0j), power
    pairs = pair_rows(blocks)
    number = next(place for place, pair in enumerate(pairs) if set(pair) == {name, axes[row]})
    of_pair = np.conj(cross[number]) if pairs[number][0] == name else cross[number]
    has_power = np.isfinite(blocks.variables["power"].values[row])[..., None]
    return np.where(has_power, of_pair, np.nan), power


def _moving_share(name: str, power: Array, state: State) -> Array:
    """Return the share of another axis's power (block, band) that is motion; 1 for a channel.

    Only intermittent motion leaks: at rest the axes may have noise and lines in common, which are
    not a leak. Therefore the power of an axis in the quieter blocks of a band, and its expected
    noise, do not count as motion. The noise of a channel is unknown.
    """
    if name not in state.axes:
        return np.ones_like(power)
    row = state.axes.index(name)
    noise = state.baseline["spectrum"].values[row]
    with_data = np.where(np.isfinite(power).any(axis=0), power, 0.0)
    noise = np.fmax(noise, np.nanquantile(with_data, state.settings.quiescent_share, axis=0))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(power > state.settings.clear_sigma**2 * noise, 1.0 - noise / power, 0.0)


def _reference_channels(blocks: xr.Dataset) -> list[str]:
    return (
        list(map(str, blocks.variables["reference"].values)) if "reference" in blocks.dims else []
    )


def _unknown_channels(blocks: xr.Dataset) -> list[str]:
    """Return the channels on the log's time that may show motion, but drive no known effect."""
    bases = {name for kind in effects().values() for name in kind.channels}
    known = (*(base.rstrip("0123456789").rstrip("_") + "_" for base in bases),)
    return [
        name
        for name in sorted(_reference_channels(blocks))
        if not (name in bases or name == "pressure" or name.startswith(known))
    ]


def _any_transfer(bands: int) -> list[Variant]:
    """Return any factor in each band, and in all bands: a mounting may resonate."""
    single_bands = np.eye(bands, dtype=np.complex128)
    variants = [Variant({}, ("any",) * 2, np.stack([row, 1j * row])) for row in single_bands]
    return [
        *variants,
        Variant({}, ("any",) * (2 * bands), np.concatenate([single_bands, 1j * single_bands])),
    ]
