"""Other forms of effects on the powers, and changes of any form, which compete with them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.predict.candidates import Component, Variant, numbered_columns
from gyrostab.diagnose.predict.condition import condition_on
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.predict.sizes import component_mixture, component_size, disagreement_nats
from gyrostab.diagnose.predict.windows import hat_functions
from gyrostab.diagnose.reduce.accumulate import RECORD_PARTS
from gyrostab.diagnose.statistics.base import Competitor
from gyrostab.noise import sampled_psd
from gyrostab.physics.registry import effects

_MAX_INTERVALS = 240  # intervals of a burst that are tried; limits time


def parts_of_record(component: Component, state: State) -> Iterator[Competitor]:
    """Yield other sizes in the eighths of a record of an effect that acts all the time.

    Noise that is present only while the tool rotates has a broad spectrum too, but is neither a
    filter nor a wandering bias.
    """
    if not effects()[component.candidate.effect].is_steady:
        return
    state = replace(state, weight=condition_on(state, [component]).weight)
    size, error = np.array(
        [
            _fit_part(component, state, inside)
            for inside in np.array_split(np.arange(state.blocks.sizes["block"]), RECORD_PARTS)
        ]
    ).T
    weight = np.where(np.isfinite(size) & np.isfinite(error) & (error > 0.0), error, np.inf) ** -2.0
    size = np.where(weight > 0.0, size, 0.0)
    nats = disagreement_nats(size, weight)
    allowed = state.settings.disagreement_nats + state.settings.spectrum_error_share * max(
        component.evidence_nats, 0.0
    )
    yield Competitor("an effect in a part of the record", nats, allowed)


def _fit_part(component: Component, state: State, inside: NDArray[np.int64]) -> tuple[float, float]:
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


def burst_intervals(block_count: int) -> NDArray[np.int64]:
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
