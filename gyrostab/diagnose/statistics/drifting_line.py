"""Lines that move through the spectrum: at each frequency too short to stand out, but along their way."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import xarray as xr
from scipy.special import log_ndtr

from gyrostab.diagnose.evidence.spectral_lines import expected_lines, local_level
from gyrostab.diagnose.statistics.scores import (
    Array,
    Windows,
    cube_root_score,
    exponential_score,
    statistic_dataset,
    values_of,
)

__all__ = ["score"]

_STRETCHES = 8  # of the spectrum, in which a way begins and ends
_FEWEST = 6  # parts of the record that a way must lead through
_LEAST = 4  # lines that a line must move: less is no motion
_BENDS = (
    -0.7,
    0.0,
    0.7,
)  # of a way, as a share of its length: it hastens, keeps its speed, or slows
_CELL, _PART = (
    4.0,
    3.0,
)  # standard deviations that one line of one part, and one part, count for: a moving line is everywhere
_MOST = 250  # lines; more are averaged in groups
_INDEPENDENT = 0.2  # of the ways that are looked at
_USUAL = 20.0  # ways that do as much, beyond which a score is as low as any
_BUMP = 0.371  # averaging time times frequency where the Allan variance of a sine is largest


def score(blocks: xr.Dataset, baseline: xr.Dataset) -> xr.Dataset | None:
    r"""Score the lines of the spectrum along ways: each part of the record at another frequency.

    A line of power :math:`E` over the density of the noise in every block, moving over L lines
    while B blocks pass, is in each line of each of P parts for B / L blocks only. There it raises
    the mean of B / P blocks by E P / L, which scatters by
    :math:`\sqrt{P / B}`; the L cells of its way together stand out by :math:`E \sqrt{P B / L}` standard deviations. The ways begin
    anywhere, lead over 4 lines or more in either direction, and hasten or slow by up to a half of
    their mean speed; the largest of those that lead from one eighth of the spectrum to another
    gives the score of that column.

    Parameters
    ----------
    blocks, baseline : xarray.Dataset
        Recording or null records, and what the simulation expects.

    Returns
    -------
    xarray.Dataset or None
        None without lines, or with spectra of fewer than 6 parts of the record. ``ratio`` is the
        power along the way over that of the noise. Several axes have a row of all together.

    Notes
    -----
    Every line is seen relative to the lines around it in its part and to its own mean over the
    parts, and counts for little by itself: a line that stands still, or a part of the record that
    is louder, is no motion.
    """
    if "line_power" not in blocks:
        return None
    power, weight = (
        values_of(blocks, "line_power", "axis", "part", "line"),
        values_of(blocks, "line_weight", "axis", "part"),
    )
    there = np.isfinite(power).reshape(-1, *power.shape[-3:]).all(axis=(0, 3)) & (weight > 0)
    components = np.flatnonzero(there.all(axis=0))
    lines = power.shape[-1]
    if components.size < _FEWEST or lines < 2 * _STRETCHES:
        return None
    cells = _cells(
        power[..., components, :],
        weight[:, components, None],
        _expected(blocks, baseline)[:, components],
    )
    axes = [str(axis) for axis in blocks["axis"].values]
    if len(axes) > 1:
        cells, axes = (
            np.concatenate(
                [cells, cells.sum(axis=-3, keepdims=True) / np.sqrt(len(axes))], axis=-3
            ),
            [*axes, " ".join(axes)],
        )
    cells = cells / np.maximum(
        cells.std(axis=(-2, -1), keepdims=True), 1.0
    )  # axes with noise in common add up to more
    edges = np.stack([components, components + 1]) - components[0]
    largest, ways = _largest(cells, edges / edges.max())
    with np.errstate(divide="ignore", invalid="ignore"):
        more = np.exp(
            np.log(_INDEPENDENT * ways) + log_ndtr(-largest)
        )  # ways of noise that would do as much
        z = np.where(
            ways > 0, exponential_score(-np.log(-np.expm1(-np.minimum(more, _USUAL)))), np.nan
        )
    block_count = -(-np.arange(power.shape[-2] + 1) * blocks.sizes["block"] // power.shape[-2])
    return statistic_dataset(
        "spectrum",
        blocks,
        rows=axes,
        windows=Windows(block_count[components[:1]], block_count[components[-1:] + 1]),
        columns=_columns(blocks["line_frequency"].values),
        z=z[..., None, :],
        ratio=np.where(ways > 0, largest, np.nan)[..., None, :],
        one_sided=True,
    )


def _expected(blocks: xr.Dataset, baseline: xr.Dataset) -> Array:
    """Spectrum of the baseline at the lines by axis, part, line."""
    components, block_count = blocks.sizes["part"], blocks.sizes["block"]
    of = np.arange(block_count) * components // block_count
    lines = blocks["line_frequency"].values
    return np.stack(
        [
            expected_lines(baseline.isel(block=of == component), lines)
            for component in range(components)
        ],
        axis=1,
    )


def _cells(power: Array, weight: Array, expected: Array) -> Array:
    """Near-normal score of every line of every part beside the lines around it and beside its own mean; some lines together where many."""
    flat = power / expected
    flat = flat / local_level(flat)
    flat = flat / ((flat * weight).sum(axis=-2, keepdims=True) / weight.sum(axis=-2, keepdims=True))
    cells = np.clip(cube_root_score(flat, weight), -_CELL, _CELL)
    wide = -(-cells.shape[-1] // _MOST)
    lines = cells.shape[-1] // wide
    return np.asarray(
        cells[..., : lines * wide].reshape(*cells.shape[:-1], lines, wide).sum(axis=-1)
        / np.sqrt(wide)
    )


def _moves(lines: int) -> Iterator[tuple[int, float]]:
    """Lines by which a way leads on, and its bend."""
    move = _LEAST
    while move < lines:
        yield from ((sign * move, bend) for sign in (1, -1) for bend in _BENDS)
        move += max(1, move // _STRETCHES)


def _largest(cells: Array, edges: Array) -> tuple[Array, Array]:
    """Largest sum along a way from each stretch to each by (record), row, column [standard deviations], and the ways looked at.

    `cells` are (record), row, part, line, `edges` (2, part) the begin and end of each part, 0 to 1.
    """
    lines, components = cells.shape[-1], cells.shape[-2]
    total = np.concatenate([np.zeros((*cells.shape[:-1], 1)), np.cumsum(cells, axis=-1)], axis=-1)
    largest = np.full((*cells.shape[:-2], _STRETCHES**2), -np.inf)
    ways = np.zeros(_STRETCHES**2)
    for move, bend in _moves(lines):
        at = np.rint(move * (edges + bend * edges * (1.0 - edges))).astype(np.int64)
        low, high = at.min(axis=0), at.max(axis=0) + 1
        begin, end, step = (
            max(0, -move),
            lines - max(0, move),
            max(1, abs(move) // (2 * components)),
        )
        start = np.arange(begin, end, step)
        along = np.zeros((*cells.shape[:-2], start.size))
        for component in range(components):
            upper, lower = (
                slice(begin + edge, end + edge, step) for edge in (high[component], low[component])
            )
            inside = total[..., component, upper] - total[..., component, lower]
            along += np.minimum(inside / np.sqrt(high[component] - low[component]), _PART)
        column = start * _STRETCHES // lines * _STRETCHES + (start + move) * _STRETCHES // lines
        first = np.flatnonzero(np.diff(column, prepend=-1))
        best = np.maximum.reduceat(along / np.sqrt(components), first, axis=-1)
        largest[..., column[first]] = np.maximum(largest[..., column[first]], best)
        np.add.at(ways, column, 1.0)
    return largest, ways


def _columns(frequency: Array) -> dict[str, Any]:
    """From the middle of one stretch of the spectrum to that of another, and the averaging times between."""
    edges = np.linspace(frequency[0], frequency[-1], _STRETCHES + 1)
    middle = (edges[1:] + edges[:-1]) / 2.0
    one, other = (
        component.ravel()
        for component in np.meshgrid(np.arange(_STRETCHES), np.arange(_STRETCHES), indexing="ij")
    )
    return {
        "what": [f"glide {middle[a]:.3g} {middle[b]:.3g}" for a, b in zip(one, other, strict=True)],
        "tau_min_s": _BUMP / edges[np.maximum(one, other) + 1],
        "tau_max_s": _BUMP / edges[np.minimum(one, other)],
    }
