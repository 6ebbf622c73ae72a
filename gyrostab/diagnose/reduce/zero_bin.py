"""Width of the zero bin of a quantization grid, which shows a rate truncated towards zero.

Rounding to the nearest value, or down, makes all bins one step wide. Truncation towards zero takes
everything less than a step on either side of zero together: the zero bin is two steps wide, all
others one. A loop that sticks at zero widens that bin too, but its neighbours then lack samples.
"""

from __future__ import annotations

import numpy as np
import xarray as xr

from gyrostab.arrays import Bools, Floats, Ints

#: Bins whose widths are measured: the zero bin, and its two neighbours together.
BINS = ("zero", "next")
_TRUNCATED_WIDTHS_STEPS = np.array([2.0, 1.0])  # bin widths under truncation; derived
_WIDTH_MODEL_ERROR_SHARE = 0.05  # of a width, from non-normal noise; design choice
_MIN_EXCESS_STDERRS = 5.0  # by which the zero bin must be wider than one step; design choice
_MAX_MISFIT_STDERRS = 3.5  # by which a width may differ from truncation; design choice
_MAX_WIDTH_STDERR_STEPS = 0.25  # of the width over all axes; design choice
_MAX_STEP_SCATTERS = 0.7  # coarser bins of normal noise do not follow a parabola
_FIT_REACH_SCATTERS = 1.0  # range of the fit on either side of zero; design choice
_MIN_FIT_BINS, _MAX_FIT_BINS = 4, 200  # on either side; design choice
_OFF_GRID_SHARE = 0.01  # of the values, and of a step, that values may be off the grid
_MAX_ITERATIONS = 50
#: Levels in as much beyond an empty zone as it is wide; by chance 1 in 2^40 gaps leaves out 40.
_MIN_BEYOND = 40
_MIN_STICKING_RUNS = 5  # of equal samples at one value; design choice
_MIN_SCATTER_STEPS = 2.0  # scatter of values on a grid, of which the most common has 28 % of runs


def bin_widths(values: Floats, step: float) -> tuple[Floats, Floats]:
    """Measure the widths of the zero bin and of its neighbours, in steps, with standard errors.

    The logarithms of the counts of the other bins are a parabola in the rate, as they are in normal
    noise. It gives the number of values per step. Both results are in the order of `BINS`, and NaN
    where not measurable. The grid goes through 0; its step is 0 for none.

    Examples
    --------
    >>> noise = np.random.default_rng(1).standard_normal(60_000) / 0.2
    >>> for rounded in (np.rint(noise), np.floor(noise), np.trunc(noise)):
    ...     print(bin_widths(rounded * 0.2, 0.2)[0].round())
    [1. 1.]
    [1. 1.]
    [2. 1.]
    """
    nothing = np.full(2, np.nan)
    finite = values[np.isfinite(values)]
    if not step > 0.0 or finite.size < 2:
        return nothing, nothing
    place = np.rint(finite / step)
    scatter = float(finite.std())
    if (
        step > _MAX_STEP_SCATTERS * scatter
        or (np.abs(finite - place * step) > _OFF_GRID_SHARE * step).mean() > _OFF_GRID_SHARE
    ):
        return nothing, nothing
    reach = int(np.clip(_FIT_REACH_SCATTERS * scatter / step, _MIN_FIT_BINS, _MAX_FIT_BINS))
    count = np.bincount(
        (place[np.abs(place) <= reach] + reach).astype(np.int64), minlength=2 * reach + 1
    )
    number = np.arange(-reach, reach + 1)
    beyond = np.abs(number) > 1
    fit = _fit_log_counts((number + 0.5 * np.sign(number))[beyond], count[beyond], float(reach))
    if fit is None:
        return nothing, nothing
    size, covariance = fit
    counted = [
        (count[reach], np.array([-0.5, 0.5])),
        (count[reach - 1] + count[reach + 1], np.array([-1.5, 1.5])),
    ]
    width, error = np.empty(2), np.empty(2)
    for bin_index, (bin_count, at) in enumerate(counted):
        columns = _parabola_columns(at, float(reach))
        density = np.exp(columns @ size)
        slope = density @ columns / density.sum()
        usual = float(density.mean() if bin_index == 0 else density.sum())
        width[bin_index] = bin_count / usual
        error[bin_index] = np.hypot(
            np.sqrt(max(bin_count, 1)) / usual,
            width[bin_index] * np.sqrt(slope @ covariance @ slope),
        )
    return width, error


def empty_zone(values: Floats) -> tuple[float, float]:
    """Measure the half width of a zone around zero whose outer part is empty, and its error.

    A loop that sticks near zero, and is right outside of its zone, leaves such a gap: between the
    values at which it sticks, which may be noisy, and the least rate that it shows. The stretch of
    the same width beyond has the levels that a gap leaves out: by chance they are few, and on a
    quantization grid there is one.

    NaN without such a zone.

    Examples
    --------
    >>> rate = np.random.default_rng(1).normal(0.0, 1.0, 20_000)
    >>> sticking = np.where(np.abs(rate) < 0.3, 0.01 * rate, rate)
    >>> round(empty_zone(sticking)[0], 3), empty_zone(rate)
    (0.3, (nan, nan))
    """
    levels = np.unique(np.abs(values[np.isfinite(values)]))
    if levels.size < _MIN_BEYOND:
        return np.nan, np.nan
    inner, outer = levels[:-1], levels[1:]
    beyond = np.searchsorted(levels, 2.0 * outer - inner, "right") - np.arange(1, levels.size)
    gap = int(np.argmax(beyond >= _MIN_BEYOND))
    if beyond[gap] < _MIN_BEYOND:
        return np.nan, np.nan
    return float(outer[gap]), float((outer[gap] - inner[gap]) / beyond[gap])


def sticking_value(values: Floats, step: float) -> tuple[float, float]:
    """Find the value other than 0 at which an axis sticks, and its samples per repeated sample.

    Held samples repeat a different value each time; a loop sticks at one value, and most runs of
    equal samples have it. On a quantization grid of many levels no value has most of the runs by
    chance. Ends of the range are left out. NaN without such a value.

    Examples
    --------
    >>> rate = np.random.default_rng(1).normal(0.0, 1.0, 20_000)
    >>> sticking = np.where(np.abs(rate - 0.5) < 0.3, 0.5, rate)
    >>> sticking_value(sticking, 0.0)[0], sticking_value(np.rint(10.0 * rate) / 10.0, 0.1)
    (0.5, (nan, 1.0))
    """
    present = values[np.isfinite(values)]
    if not present.size or not present.std() > _MIN_SCATTER_STEPS * step:
        return np.nan, 1.0
    same = np.concatenate([[False], values[1:] == values[:-1]]) & (values != 0.0)
    starts = np.flatnonzero(same[1:] & ~same[:-1])
    levels, runs = np.unique(values[starts + 1], return_counts=True)
    inside = (levels > present.min()) & (levels < present.max())
    if not inside.any():
        return np.nan, 1.0
    most = int(np.argmax(np.where(inside, runs, 0)))
    if runs[most] < max(_MIN_STICKING_RUNS, 0.5 * runs.sum()):
        return np.nan, 1.0
    return float(levels[most]), float((values == levels[most]).sum() / same.sum())


def sticking_axes(blocks: xr.Dataset) -> Bools:
    """Find the axes (axis,) that stick at a value other than 0; see `sticking_value`."""
    return np.asarray(np.isfinite(blocks["zone_centre"].values))


def _parabola_columns(at: Floats, reach: float) -> Floats:
    return np.stack([np.ones(at.size), at / reach, np.square(at / reach)], axis=1)


def _fit_log_counts(at: Floats, count: Ints, reach: float) -> tuple[Floats, Floats] | None:
    """Fit a parabola to the logarithms of Poisson counts; return it with its covariance."""
    columns = _parabola_columns(at, reach)
    if (count > 0).sum() <= columns.shape[1]:
        return None
    size = np.linalg.lstsq(
        columns * np.sqrt(count)[:, None],
        np.log(np.maximum(count, 0.5)) * np.sqrt(count),
        rcond=None,
    )[0]
    for _ in range(_MAX_ITERATIONS):
        expected = np.exp(np.clip(columns @ size, -30.0, 30.0))
        normal = (columns.T * expected) @ columns + 1e-9 * np.eye(columns.shape[1])
        move = np.linalg.solve(normal, columns.T @ (count - expected))
        size = size + move / max(1.0, float(np.abs(columns @ move).max()))
        if np.abs(move).max() < 1e-6:
            return size, np.linalg.inv(normal)
    return None


def truncated_axes(blocks: xr.Dataset) -> Bools:
    """Find the axes (axis,) whose rate is truncated towards zero on its quantization grid.

    The axes are judged together, because one logger writes all of them in the same way.
    """
    quantized = np.asarray(blocks["quantization_step"].values > 0.0)
    width, error, is_measured = _read_widths(blocks)
    like_truncation = is_measured & _is_like_truncation(width, error)
    narrower = is_measured & (
        width[:, 0] < (_TRUNCATED_WIDTHS_STEPS - _allowed_misfit(error))[:, 0]
    )
    if not like_truncation.any() or narrower.any():
        return np.zeros_like(quantized)
    weight = error[like_truncation, 0] ** -2.0
    mean_width = float(weight @ width[like_truncation, 0] / weight.sum())
    sure = (
        weight.sum() ** -0.5 < _MAX_WIDTH_STDERR_STEPS
        and (mean_width - 1.0) * np.sqrt(weight.sum()) > _MIN_EXCESS_STDERRS
    )
    return np.asarray(quantized & sure)


def possibly_truncated_axes(blocks: xr.Dataset) -> Bools:
    """Find the quantized axes whose bins do not rule out truncation; see `truncated_axes`."""
    width, error, is_measured = _read_widths(blocks)
    return np.asarray(
        (blocks["quantization_step"].values > 0.0)
        & (~is_measured | _is_like_truncation(width, error))
    )


def _read_widths(blocks: xr.Dataset) -> tuple[Floats, Floats, Bools]:
    """Return the widths, their errors, and which axes have them."""
    width, error = (blocks[name].values for name in ("bin_width", "bin_width_stderr"))
    return width, error, np.isfinite(width).all(axis=1) & np.isfinite(error).all(axis=1)


def _is_like_truncation(width: Floats, error: Floats) -> Bools:
    misfit = np.abs(width - _TRUNCATED_WIDTHS_STEPS)
    return np.asarray((misfit <= _allowed_misfit(error)).all(axis=1))


def _allowed_misfit(error: Floats) -> Floats:
    """Return by how much widths (axis, bin) may differ from those of truncation."""
    model_error = _WIDTH_MODEL_ERROR_SHARE * _TRUNCATED_WIDTHS_STEPS
    return np.asarray(_MAX_MISFIT_STDERRS * np.hypot(error, model_error))
