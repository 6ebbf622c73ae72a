"""Score of the dynamic Allan variance of the block statistics against that of the simulation."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.arrays import Floats, Ints
from gyrostab.diagnose.evidence.held_out import LinearModel, noise_columns, with_independent_cells
from gyrostab.diagnose.evidence.spectral_lines import JUDGED_PARTS, expected_lines
from gyrostab.diagnose.predict.candidates import (
    Candidate,
    Component,
    Prospect,
    Variant,
    numbered_columns,
)
from gyrostab.diagnose.predict.condition import condition_on
from gyrostab.diagnose.predict.filter_response import undo_filter
from gyrostab.diagnose.predict.linear_model import (
    State,
    band_widths,
    is_correlated_bias,
    linear_model,
    mix_with_mean,
    power_column,
    records_last,
    select_row,
    unspread_share,
    variant_designs,
)
from gyrostab.diagnose.predict.sizes import component_mixture, component_size, disagreement_nats
from gyrostab.diagnose.predict.windows import hat_functions
from gyrostab.diagnose.reduce.schema import axis_values
from gyrostab.diagnose.statistics.allan_surface import allan_surface
from gyrostab.diagnose.statistics.base import Competitor, Statistic, choose_columns
from gyrostab.diagnose.statistics.mismatch_wording import capitalise_axes, is_higher, taus_text
from gyrostab.diagnose.statistics.scores import cube_root_score, statistic_dataset
from gyrostab.noise import sampled_psd
from gyrostab.physics.registry import effects

#: Columns of the score that show another level of the noise.
LEVEL_COLUMNS = ("avar", "level")
_MAX_INTERVALS = 240  # intervals of a burst that are tried; limits time


class Power(Statistic):
    """Band powers and their dynamic Allan variance."""

    name = "power"
    view = "davar"
    explained_views = ("davar", "spectrum", "distribution")
    containing_views = ("davar", "distribution")
    modelled_views = explained_views
    unsupported_as = "~N(t)"
    null_variable = "power"
    is_power_weighted = True
    is_power = True
    has_course = True
    is_ratio = True

    def competitors(
        self, components: Sequence[Component], state: State, error: float
    ) -> Iterator[Competitor]:
        return separate_filters(components, state)

    def axis_competitors(self, component: Component, state: State) -> Iterator[Competitor]:
        return parts_of_record(component, state)

    def nuisance_alternatives(self, blocks: xr.Dataset) -> list[Candidate]:
        """Return noise of any course, in an interval, and of any spectrum."""
        return [
            Candidate(name, self, (), variants) for name, variants in free_powers(blocks).items()
        ]

    def score(self, blocks: xr.Dataset, baseline: xr.Dataset) -> xr.Dataset:
        """Score the Allan variance in windows of three lengths and of the whole record.

        Within blocks it is computed from the band powers, at octaves of the sampling interval up to
        a quarter of a block; the column ``level`` weights all bands equally, as the likelihood
        does. From a block on it is computed from the block means.
        """
        surface = allan_surface(blocks, baseline)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = surface["observed"] / surface["expected"]
        return statistic_dataset(
            blocks,
            windows=surface["windows"],
            columns=surface["columns"],
            z=cube_root_score(ratio, surface["shape"]),
            ratio=ratio,
        )

    def design(self, prospect: Prospect) -> Iterator[Variant]:
        """Yield added densities; for a filter what it adds or removes at its full size.

        Constant coherent densities are left to the cross-spectra.
        """
        frequency = prospect.blocks.variables["frequency"].values
        rate = float(prospect.blocks.attrs["sampling_rate_hz"])
        level: dict[str, Floats] = {}
        for (symbol, name), share in prospect.prediction.level.items():
            square = prospect.coefficient.sel(term=symbol).values ** 2
            component = (
                np.atleast_2d(share)[..., None]
                * square[:, None, None]
                * sampled_psd(symbol, frequency, rate)
            )
            level[name] = level.get(name, 0.0) + component
        spectrum = {}
        if prospect.prediction.line is None:
            spectrum = {
                name: put_axis_first(density)
                for name, density in prospect.prediction.spectrum.items()
                if (_changes_over_time(density) or not prospect.prediction.coherent)
                and not is_correlated_bias(name, prospect.prediction, prospect.blocks)
            }
        for columns, squared in ((level, False), (spectrum, True)):
            densities = {
                name: density
                for name, density in columns.items()
                if np.abs(density).max(initial=0.0) > 0 and not _is_white_and_constant(density)
            }
            yield from choose_columns(prospect.values, densities, squared=squared)
        response = prospect.prediction.response
        if response:  # on noise as it was logged, whose N contains the aliases
            change = _filter_change(response["N"], prospect.coefficient, frequency, rate)
            yield Variant(prospect.values, (), change[None])

    def model(
        self, candidates: Sequence[Candidate], row: int, data: xr.Dataset, state: State
    ) -> LinearModel:
        axis = state.axes[row]
        expected = axis_values(state.baseline, "spectrum", axis)
        values = records_last(data["power"].values, 3)[row] - expected[..., None]
        weight = axis_values(state.baseline, "shape_alone", axis) / state.expected_power[row] ** 2
        weight = np.where(state.masked[row][:, None], 0.0, weight)
        level, precision, low = noise_columns(state.baseline, axis=axis)
        unspread, width = unspread_share(state.blocks)[row], band_widths(state.blocks)
        model = linear_model(
            values,
            weight,
            variant_designs(
                candidates, lambda density: mix_with_mean(select_row(density, row), unspread, width)
            ),
            state.power_columns(axis),
            noise_columns=[level[..., number] * expected for number in range(level.shape[2])],
            precision=np.diagonal(precision),
            is_bounded=[
                variant.squared for candidate in candidates for variant in candidate.variants
            ],
            low=[*low, *state.least_powers(axis)],
        )
        common = axis_values(state.baseline, "common", axis)
        return with_independent_cells(model, common, state.expected_power[row])

    def is_filter(self, variant: Variant) -> bool:
        """Return whether a variant has no size: what a filter does at its full size."""
        return not variant.columns

    def condition(self, state: State, component: Component) -> State:
        axis = component.row[0]
        row = state.axes.index(axis)
        if self.is_filter(component.variant):
            expected = expected_lines(state.baseline, state.blocks["line_frequency"].values)[row]
            blocks, stopped = undo_filter(
                state.blocks, axis, component.candidate.effect, component.variant.values, expected
            )
            state = replace(state, blocks=blocks).with_columns("line", "all", [stopped])
            if state.is_recalibrated(axis):
                return state  # the noise of the baseline is filtered already
        return state.with_columns(
            "added_power" if component.variant.squared else "power",
            axis,
            [power_column(density, row, state) for density in component.variant.design],
        )

    def describe(self, region: Mapping[str, Any], when: str) -> str:
        is_single = len(region["axes"]) == 1
        return (
            f"{capitalise_axes(region['axes'])} {'is' if is_single else 'are'} "
            f"{'noisier' if is_higher(region) else 'quieter'} than the simulation {when}: "
            f"at {taus_text(region)} {'its' if is_single else 'their'} Allan variance is "
            f"{region['ratio']:.3g} times the expected value"
        )


def _filter_change(
    response: Floats, coefficient: xr.DataArray, frequency: Floats, rate: float
) -> Floats:
    """Return the change of the baseline spectrum by a response."""
    total = np.zeros((coefficient.sizes["axis"], 1, frequency.size))
    for symbol in "QNBK":
        square = coefficient.sel(term=symbol).values[:, None, None] ** 2
        total += square * sampled_psd(symbol, frequency, rate)
    return total * (response - 1.0)


def put_axis_first(density: Floats) -> Floats:
    """Return a density with the axis first."""
    return np.asarray(density if np.ndim(density) == 3 else np.asarray(density)[None])


def _changes_over_time(density: Floats) -> bool:
    rows = put_axis_first(density)
    return bool(np.abs(rows - rows[:, :1]).max(initial=0.0) > 1e-6 * np.abs(rows).max(initial=0.0))


def _is_white_and_constant(density: Floats) -> bool:
    """Return whether a density is white and constant: a change of N, which is free."""
    rows = put_axis_first(density)
    return bool((np.ptp(rows, axis=(1, 2)) <= 1e-6 * np.abs(rows).max(axis=(1, 2))).all())


def parts_of_record(component: Component, state: State) -> Iterator[Competitor]:
    """Yield other sizes in the eighths of a record of an effect that acts all the time.

    Noise that is present only while the tool rotates has a broad spectrum too, but is neither a
    filter nor a wandering bias.
    """
    if not effects()[component.candidate.effect].is_steady:
        return
    state = replace(state, expected_power=condition_on(state, [component]).expected_power)
    size, error = np.array(
        [
            _fit_part(component, state, inside)
            for inside in np.array_split(np.arange(state.blocks.sizes["block"]), JUDGED_PARTS)
        ]
    ).T
    weight = np.where(np.isfinite(size) & np.isfinite(error) & (error > 0.0), error, np.inf) ** -2.0
    size = np.where(weight > 0.0, size, 0.0)
    nats = disagreement_nats(size, weight)
    allowed = state.settings.disagreement_nats + state.settings.spectrum_error_share * max(
        component.evidence_nats, 0.0
    )
    yield Competitor("an effect in a part of the record", nats, allowed)


def _fit_part(component: Component, state: State, inside: Ints) -> tuple[float, float]:
    """Fit the first column to some blocks only; return its size and error."""
    outside = np.ones(state.masked.shape[1], np.bool_)
    outside[inside] = False
    row = state.axes.index(component.row[0])
    power = state.blocks["power"].isel(axis=row).values
    if not (np.isfinite(power).any(axis=1) & ~state.masked[row] & ~outside).any():
        return 0.0, np.inf
    mean, covariance = component_mixture(
        component, replace(state, masked=state.masked | outside)
    ).moments()
    return float(mean[0]), float(np.sqrt(covariance[0, 0]))


def separate_filters(components: Sequence[Component], state: State) -> Iterator[Competitor]:
    """Yield a filter for each axis.

    All axes pass the same logger, which takes the same share of the noise of each. The share of the
    strongest component is fitted on every axis, and once for all of them.
    """
    shown = [component for component in components if component.is_filter]
    if not shown:
        return
    first = max(shown, key=lambda component: component.evidence_nats)
    share, error = np.array(
        [component_size(replace(first, row=(axis,)), state) for axis in state.axes]
    ).T
    evidence = sum(max(component.evidence_nats, 0.0) for component in shown)
    nats = disagreement_nats(share, error**-2.0)
    allowed = state.settings.reject_nats + state.settings.spectrum_error_share * evidence
    yield Competitor("a filter on each axis", nats, allowed)


def burst_intervals(block_count: int) -> Ints:
    """List intervals of blocks, (interval, 2) as first and stop: 1, 2, 4, ... up to half of all.

    Each starts half its length after the one before. If there are too many of a length, only the
    first and the last are kept, because a trend in time differs from a short event only there.

    Examples
    --------
    >>> burst_intervals(4).tolist()
    [[0, 1], [1, 2], [2, 3], [3, 4], [0, 2], [1, 3], [2, 4]]
    >>> burst_intervals(1000)[:4].tolist(), len(burst_intervals(1000)) <= 240
    ([[0, 1], [999, 1000], [0, 2], [998, 1000]], True)
    """
    lengths = [2**power for power in range(max(1, block_count // 2).bit_length())]
    first = [np.arange(0, block_count - length + 1, max(1, length // 2)) for length in lengths]
    while sum(starts.size for starts in first) > _MAX_INTERVALS:
        # The shortest intervals are the most numerous.
        longest = next(number for number, starts in enumerate(first) if starts.size > 2)
        first[longest] = np.array([0, block_count - lengths[longest]])
    return np.concatenate(
        [
            np.stack([starts, starts + length], axis=1)
            for starts, length in zip(first, lengths, strict=True)
        ]
    )


def free_powers(blocks: xr.Dataset) -> dict[str, tuple[Variant, ...]]:
    """Return the powers of nuisance alternatives, by name: any course, bursts and any spectrum."""
    white = sampled_psd("N", blocks["frequency"].values, float(blocks.attrs["sampling_rate_hz"]))
    begin, end = blocks["begin"].values, blocks["end"].values
    hats = hat_functions(begin, end)
    bands, block = blocks.sizes["band"], np.arange(begin.size)
    shapes = np.eye(bands)[:, None, None, :]
    return {
        "~N(t)": (Variant({}, numbered_columns(len(hats)), hats[:, None, :, None] * white),),
        "~burst": tuple(
            Variant(
                {"begin": float(begin[first]), "end": float(end[stop - 1])},
                ("0",),
                ((block >= first) & (block < stop))[None, None, :, None] * white,
            )
            for first, stop in burst_intervals(begin.size).tolist()
        ),
        "~S(f)": (
            *(
                Variant({"band": float(number)}, ("0",), shape[None])
                for number, shape in enumerate(shapes)
            ),
            Variant({}, numbered_columns(bands), shapes),
        ),
    }
