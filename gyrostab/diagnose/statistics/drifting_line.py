"""Score of drifting lines, too short at each frequency to be significant, along their paths."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from scipy.special import log_ndtr

from gyrostab.arrays import Floats, Ints
from gyrostab.diagnose.evidence.spectral_lines import expected_lines
from gyrostab.diagnose.statistics.base import Statistic
from gyrostab.diagnose.statistics.mismatch_wording import axes_text
from gyrostab.diagnose.statistics.scores import (
    SINE_TAU_CYCLES,
    BlockWindows,
    cube_root_score,
    exponential_score,
    part_windows,
    statistic_dataset,
)
from gyrostab.kernels.spectra.line_levels import local_level
from gyrostab.kernels.spectra.line_paths import largest_path_sums

_SPECTRUM_SECTIONS = 8  # in which paths begin and end; design choice
_MIN_PARTS = 6  # of the record, that a path must cover; design choice
_MIN_MOVED_LINES = 4  # of a drifting line; design choice
#: Bends of a path, as a share of its length, from accelerating to slowing down. Derived: a path
#: between two of them is within 4 % of its length, and a part of the record has 6 %.
_BENDS = (-0.7, -0.35, 0.0, 0.35, 0.7)
#: Largest contribution of a line of one part, and of a part: a drifting line is in all parts.
_MAX_CELL_SIGMA, _MAX_PART_SIGMA = 4.0, 3.0
_MAX_LINES = 250  # more are averaged in groups; limits time
_INDEPENDENT_SHARE = 0.2  # of the paths that are tried; estimate
_MAX_EXPECTED_PATHS = 20.0  # that noise has; beyond, a score is as low as any


class DriftingLine(Statistic):
    """Lines that drift through the spectrum."""

    name = "drifting_line"
    view = "spectrum"
    uses_line_spectra = True

    def score(self, blocks: xr.Dataset, baseline: xr.Dataset) -> xr.Dataset | None:
        r"""Score lines along paths, at another frequency in each part of the record.

        A line of power :math:`E` relative to the density of the noise in every block, moving over L
        lines while B blocks pass, is in each line of each of P parts for only B / L blocks. There
        it raises the mean of B / P blocks by E P / L, which scatters by :math:`\sqrt{P / B}`; the L
        cells of its path together exceed noise by :math:`E \sqrt{P B / L}` standard deviations.
        Paths begin anywhere, cover 4 lines or more in either direction, and accelerate or slow down
        by up to a half of their mean speed. The largest sum from one eighth of the spectrum to
        another is the score of that column, and ``ratio``. Several axes have a row of all together.
        None with spectra of fewer than 6 parts of the record.

        Every line is relative to the lines around it in its part and to its own mean over the
        parts, and its contribution is limited: neither a steady line nor a noisier part of the
        record is a drifting line.
        """
        power, weight = blocks["line_power"].values, blocks["line_weight"].values
        present = np.isfinite(power).reshape(-1, *power.shape[-3:]).all(axis=(0, 3)) & (weight > 0)
        parts = np.flatnonzero(present.all(axis=0))
        lines = power.shape[-1]
        if parts.size < _MIN_PARTS or lines < 2 * _SPECTRUM_SECTIONS:
            return None
        cells = _score_cells(
            power[..., parts, :],
            weight[:, parts, None],
            _expected_spectrum(blocks, baseline)[:, parts],
        )
        axes = [str(axis) for axis in blocks["axis"].values]
        if len(axes) > 1:
            cells = np.concatenate(
                [cells, cells.sum(axis=-3, keepdims=True) / np.sqrt(len(axes))], axis=-3
            )
            axes = [*axes, " ".join(axes)]
        # Axes with common noise add up to more.
        cells = cells / np.maximum(cells.std(axis=(-2, -1), keepdims=True), 1.0)
        edges = np.stack([parts, parts + 1]) - parts[0]
        paths = _list_paths(cells.shape[-1], edges / edges.max())
        path_count = paths.count_by_column(cells.shape[-1])
        largest = _largest_path_sums(cells, paths)
        with np.errstate(divide="ignore", invalid="ignore"):
            # Expected number of paths of noise with this score.
            expected_count = np.exp(np.log(_INDEPENDENT_SHARE * path_count) + log_ndtr(-largest))
            p_value = -np.expm1(-np.minimum(expected_count, _MAX_EXPECTED_PATHS))
            z = np.where(path_count > 0, exponential_score(-np.log(p_value)), np.nan)
        first, stop = part_windows(blocks, blocks.sizes["part"])
        return statistic_dataset(
            blocks,
            rows=axes,
            windows=BlockWindows(first[parts[:1]], stop[parts[-1:]]),
            columns=_path_columns(blocks["line_frequency"].values),
            z=z[..., None, :],
            ratio=np.where(path_count > 0, largest, np.nan)[..., None, :],
            one_sided=True,
        )

    def describe(self, region: Mapping[str, Any], when: str) -> str:
        first, last = region["quantity"].split()[1:]
        course = (
            f"near {first} Hz" if first == last else f"from about {first} Hz to about {last} Hz"
        )
        return f"The spectrum of {axes_text(region['axes'])} has a drifting line {when}, {course}"


def _expected_spectrum(blocks: xr.Dataset, baseline: xr.Dataset) -> Floats:
    """Return the spectrum of the baseline at the lines by axis, part, line."""
    parts, block_count = blocks.sizes["part"], blocks.sizes["block"]
    part_of_block = np.arange(block_count) * parts // block_count
    lines = blocks["line_frequency"].values
    return np.stack(
        [
            expected_lines(baseline.isel(block=part_of_block == part), lines)
            for part in range(parts)
        ],
        axis=1,
    )


def _score_cells(power: Floats, weight: Floats, expected: Floats) -> Floats:
    """Score every line of every part relative to its surroundings and its mean over the parts.

    Many lines are averaged in groups.
    """
    flat = power / expected
    flat = flat / local_level(flat)
    flat = flat / ((flat * weight).sum(axis=-2, keepdims=True) / weight.sum(axis=-2, keepdims=True))
    cells = np.clip(cube_root_score(flat, weight), -_MAX_CELL_SIGMA, _MAX_CELL_SIGMA)
    group = -(-cells.shape[-1] // _MAX_LINES)
    lines = cells.shape[-1] // group
    return np.asarray(
        cells[..., : lines * group].reshape(*cells.shape[:-1], lines, group).sum(axis=-1)
        / np.sqrt(group)
    )


class _Paths(NamedTuple):
    """Paths of all shapes, by shape; `gyrostab.kernels.spectra.line_paths` has the meanings."""

    low: Ints  # (shape, part)
    high: Ints
    first: Ints  # (shape,)
    stop: Ints
    step: Ints
    move: Ints

    def count_by_column(self, lines: int) -> Floats:
        """Return the number of paths between each two sections, (column,)."""
        out = np.zeros(_SPECTRUM_SECTIONS**2)
        for first, stop, step, move in zip(*self[2:], strict=True):
            start = np.arange(first, stop, step)
            begin, end = (place * _SPECTRUM_SECTIONS // lines for place in (start, start + move))
            np.add.at(out, begin * _SPECTRUM_SECTIONS + end, 1.0)
        return out


def _list_paths(lines: int, edges: Floats) -> _Paths:
    """List the paths through `lines` lines; `edges` (2, part) are begin and end of each part."""
    moves, size = [], _MIN_MOVED_LINES
    while size < lines:
        moves += [size, -size]
        size += max(1, size // _SPECTRUM_SECTIONS)
    move = np.repeat(moves, len(_BENDS))
    bend = np.tile(_BENDS, len(moves))
    along = edges + bend[:, None, None] * edges * (1.0 - edges)
    shift = np.rint(move[:, None, None] * along).astype(np.int64)
    return _Paths(
        shift.min(axis=1),
        shift.max(axis=1) + 1,
        np.maximum(0, -move),
        lines - np.maximum(0, move),
        np.maximum(1, np.abs(move) // (2 * edges.shape[1])),
        move,
    )


def _largest_path_sums(cells: Floats, paths: _Paths) -> Floats:
    """Find the largest sum along paths between sections by (record), row, column.

    `cells` are (record), row, part, line [standard deviations].
    """
    series = np.ascontiguousarray(cells.reshape(-1, *cells.shape[-2:]))
    largest = largest_path_sums(series, *paths, _SPECTRUM_SECTIONS, _MAX_PART_SIGMA)
    return np.asarray(
        largest.reshape(*cells.shape[:-2], _SPECTRUM_SECTIONS**2) / np.sqrt(cells.shape[-2])
    )


def _path_columns(frequency: Floats) -> dict[str, Any]:
    """Return columns from the middle of one section to another, and averaging times between."""
    edges = np.linspace(frequency[0], frequency[-1], _SPECTRUM_SECTIONS + 1)
    middle = (edges[1:] + edges[:-1]) / 2.0
    begin_section, end_section = np.divmod(np.arange(_SPECTRUM_SECTIONS**2), _SPECTRUM_SECTIONS)
    return {
        "quantity": [
            f"drifting {middle[a]:.3g} {middle[b]:.3g}"
            for a, b in zip(begin_section, end_section, strict=True)
        ],
        "tau_min_s": SINE_TAU_CYCLES / edges[np.maximum(begin_section, end_section) + 1],
        "tau_max_s": SINE_TAU_CYCLES / edges[np.minimum(begin_section, end_section)],
    }
