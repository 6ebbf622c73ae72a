"""Score of the dynamic Allan variance of the block statistics against that of the simulation."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import xarray as xr

from gyrostab.diagnose.evidence.held_out import LinearModel, noise_columns, with_independent_cells
from gyrostab.diagnose.evidence.spectral_lines import expected_lines
from gyrostab.diagnose.predict.candidates import Candidate, Component, Prospect, Variant
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
from gyrostab.diagnose.reduce.schema import axis_values
from gyrostab.diagnose.statistics.allan_surface import allan_surface
from gyrostab.diagnose.statistics.base import Competitor, Region, Statistic, choose_columns
from gyrostab.diagnose.statistics.power_forms import free_powers, parts_of_record, separate_filters
from gyrostab.diagnose.statistics.scores import (
    Array,
    cube_root_score,
    statistic_dataset,
)
from gyrostab.diagnose.statistics.wording import is_higher, subject, taus_text
from gyrostab.noise import sampled_psd

#: Columns of the score that show another level of the noise.
LEVEL_COLUMNS = ("avar", "level")


class Power(Statistic):
    """Band powers and their dynamic Allan variance."""

    name = "power"
    view = "davar"
    explains = ("davar", "spectrum", "distribution")
    contained_in = ("davar", "distribution")
    nuisance_alternative = "~N(t)"
    error_shows_in = ("power",)
    null_variable = "power"
    is_power_weighted = True
    is_in_baseline = True
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

    def design(self, case: Prospect) -> Iterator[Variant]:
        """Yield added densities; for a filter what it adds or removes at its full size.

        Constant coherent densities are left to the cross-spectra.
        """
        frequency = case.blocks["frequency"].values
        rate = float(case.blocks.attrs["sampling_rate_hz"])
        level: dict[str, Array] = {}
        for (symbol, name), share in case.prediction.level.items():
            square = (
                case.coefficient.sel(term=symbol).values ** 2
                if symbol in case.coefficient["term"].values
                else np.zeros(case.coefficient.sizes["axis"])
            )
            component = (
                np.atleast_2d(share)[..., None]
                * square[:, None, None]
                * sampled_psd(symbol, frequency, rate)
            )
            level[name] = level.get(name, 0.0) + component
        spectrum = {}
        if case.prediction.line is None:
            spectrum = {
                name: with_axis(density)
                for name, density in case.prediction.spectrum.items()
                if (_changes_over_time(density) or not case.prediction.coherent)
                and not is_correlated_bias(name, case.prediction, case.blocks)
            }
        for columns, squared in ((level, False), (spectrum, True)):
            densities = {
                name: density
                for name, density in columns.items()
                if np.abs(density).max(initial=0.0) > 0 and not _is_white_and_constant(density)
            }
            yield from choose_columns(case.values, densities, squared=squared)
        response = case.prediction.response
        if response:  # on noise as it was logged, whose N contains the aliases
            change = _filter_change(response["N"], case.coefficient, frequency, rate)
            yield Variant(case.values, (), change[None])

    def model(
        self, candidates: Sequence[Candidate], row: int, data: xr.Dataset, state: State
    ) -> LinearModel:
        axis = state.axes[row]
        expected = axis_values(state.baseline, "spectrum", axis)
        values = records_last(data["power"].values, 3)[row] - expected[..., None]
        weight = axis_values(state.baseline, "shape_alone", axis) / state.weight[row] ** 2
        weight = np.where(state.masked[row][:, None], 0.0, weight)
        level, precision, low = noise_columns(state.baseline, axis=axis)
        unspread, width = unspread_share(state.blocks)[row], band_widths(state.blocks)
        model = linear_model(
            values,
            weight,
            variant_designs(
                candidates,
                lambda density: mix_with_mean(select_row(density, row), unspread, width),
            ),
            state.power_columns(axis),
            known=[level[..., number] * expected for number in range(level.shape[2])],
            precision=np.diagonal(precision),
            is_bounded=[
                variant.squared for candidate in candidates for variant in candidate.variants
            ],
            low=[*low, *state.least_powers(axis)],
        )
        common = axis_values(state.baseline, "common", axis)
        return with_independent_cells(model, common, state.weight[row])

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
        if self.is_filter(component.variant) and axis in state.baseline.attrs.get(
            "recalibrated", ()
        ):
            return state  # the noise of the baseline is filtered already
        return state.with_columns(
            "added_power" if component.variant.squared else "power",
            axis,
            [power_column(density, row, state) for density in component.variant.design],
        )

    def describe(self, region: Region, when: str) -> str:
        is_single = len(region["axes"]) == 1
        return (
            f"{subject(region)} {'is' if is_single else 'are'} "
            f"{'noisier' if is_higher(region) else 'quieter'} than the simulation {when}: "
            f"at {taus_text(region)} {'its' if is_single else 'their'} Allan variance is "
            f"{region['ratio']:.3g} times the expected value"
        )


def _filter_change(
    response: Array, coefficient: xr.DataArray, frequency: Array, rate: float
) -> Array:
    """Return the change of the baseline spectrum by a response."""
    total = np.zeros((coefficient.sizes["axis"], 1, frequency.size))
    size, terms = coefficient.values, list(coefficient["term"].values)
    for symbol in (symbol for symbol in "QNBK" if symbol in terms):
        total += size[:, terms.index(symbol), None, None] ** 2 * sampled_psd(
            symbol, frequency, rate
        )
    return total * (response - 1.0)


def with_axis(density: Array) -> Array:
    """Return a density with the axis first."""
    return np.asarray(density if np.ndim(density) == 3 else np.asarray(density)[None])


def _changes_over_time(density: Array) -> bool:
    rows = with_axis(density)
    return bool(np.abs(rows - rows[:, :1]).max(initial=0.0) > 1e-6 * np.abs(rows).max(initial=0.0))


def _is_white_and_constant(density: Array) -> bool:
    """Return whether a density is white and constant: a change of N, which is free."""
    return bool(np.ptp(with_axis(density)) <= 1e-6 * np.abs(density).max(initial=0.0))
