"""The options of a dynamic Allan variance in samples, and its division into units of work."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np
import xarray as xr

from gyrostab.arrays import Floats, Ints
from gyrostab.errors import OptionError
from gyrostab.kernels.allan.surface import WorkUnit
from gyrostab.kernels.allan.variances import VARIANCES
from gyrostab.schema import signal_name
from gyrostab.time.durations import averaging_factors, samples

Data = TypeVar("Data", xr.Dataset, xr.DataArray)
#: Largest number of cells (windows times averaging times) of a unit of work, and of a part of a
#: surface over all axes.
MOST_CELLS = 2**20
#: Default windows [s]; the longest that fits four times into the record is used.
WINDOWS_S = (600, 300, 120, 60, 30, 20, 10, 5, 2, 1)
#: Shortest window [samples].
MIN_WINDOW_SAMPLES = 4


class SurfacePlan(NamedTuple):
    """Options of `davar`, in samples."""

    signal: xr.DataArray
    unit: WorkUnit
    rate: float
    attrs: dict[str, Any]
    #: Averaging factors of `unit` that were asked for; the noise is identified from all of them.
    reported: slice | Ints

    @property
    def taus(self) -> Floats:
        """Averaging times of the surface [s]."""
        return np.asarray(self.unit.ks[self.reported] / self.rate)


def make_plan(
    log: xr.Dataset, *, window: Any = None, step: Any = None, taus: Any = 40, tau_max: Any = None,
    axis: str | Sequence[str] | None = None, min_strict: float = 0.3, min_coverage: float = 0.1,
    variance: str = "avar",
) -> SurfacePlan:  # fmt: skip
    """Check the options of `davar` against a log of `gyrostab.ingest.convert.as_log`."""
    if not isinstance(variance, str) or variance not in VARIANCES:
        raise OptionError(f"variance={variance!r}: give one of {', '.join(VARIANCES)}")
    # with min_strict above 1, all cells are of cluster means
    for option, share, most in (
        ("min_strict", min_strict, np.inf),
        ("min_coverage", min_coverage, 1.0),
    ):
        if not (isinstance(share, int | float | np.number) and 0.0 <= share <= most):
            raise OptionError(f"{option}={share!r}: give a share from 0 to 1")
    name = signal_name(log)
    signal = log[name] if axis is None else select_axes(log[name], axis)
    rate = float(log.attrs["sampling_rate_hz"])
    intervals = signal.sizes["time"] - (1 if name == "angle" else 0)
    length, hop = _window_and_step(
        choose_window(log) if window is None else window, step, rate, intervals
    )
    order = VARIANCES[variance].order
    asked = averaging_factors(taus, rate=rate, window=length, tau_max=tau_max, order=order)
    ks, interval = _fill_octaves(asked), 1.0 / rate
    unit = WorkUnit(length, hop, ks, name == "angle", interval, min_strict, min_coverage, variance)
    attrs = {
        "window_s": length / rate, "step_s": hop / rate,
        "window_samples": length, "step_samples": hop,
        "overlap": "full", "min_strict": min_strict, "min_coverage": min_coverage,
        "variance": variance,
    }  # fmt: skip
    # a slice copies nothing
    reported = slice(None) if np.array_equal(ks, asked) else np.searchsorted(ks, asked)
    return SurfacePlan(signal, unit, rate, attrs, reported)


def _fill_octaves(ks: Ints) -> Ints:
    """Add averaging factors until neighbours, from 1 on, are at most an octave apart.

    The degrees of freedom depend on the kind of noise, which a few long averaging times do not
    show.
    """
    added = [[1]]
    for below, above in zip([1, *ks[:-1].tolist()], ks.tolist(), strict=True):
        octaves = math.ceil(math.log2(above / below))
        added.append([round(below * 2.0**i) for i in range(1, octaves)])
    return np.union1d(ks, np.concatenate(added).astype(np.int64))


def choose_window(log: xr.Dataset) -> str:
    """Choose a window for a record: ten minutes, or at most a quarter of a shorter record.

    Parameters
    ----------
    log : xarray.Dataset
        Regular log.

    Returns
    -------
    str
        A duration of `WINDOWS_S`, or a number of samples if the record is shorter than four
        seconds.

    Examples
    --------
    >>> from gyrostab.ingest.make_log import make_log
    >>> choose_window(make_log(np.zeros(8600), rate=100.0, unit="deg/h"))
    '20s'
    """
    size, rate = log.sizes["time"], float(log.attrs["sampling_rate_hz"])
    _check_size(size)
    seconds = next((window for window in WINDOWS_S if 4 * window * rate <= size), None)
    if seconds is None:
        return f"{max(MIN_WINDOW_SAMPLES, size // 4)}samples"
    return f"{seconds}s" if seconds < 60 else f"{seconds // 60}min"


def select_axes(log: Data, axis: str | Sequence[str]) -> Data:
    """Return a log, or its signal, with these axes only."""
    labels = [axis] if isinstance(axis, str) or not np.iterable(axis) else axis
    axes = list(dict.fromkeys(str(np.asarray(label)) for label in labels))
    available = [str(name) for name in log["axis"].values]
    unknown = [name for name in axes if name not in available]
    if not axes:
        raise OptionError(f"axis={axis!r} names no axis; the log has {', '.join(available)}")
    if unknown:
        quoted = ", ".join(map(repr, unknown))
        raise OptionError(f"axis {quoted} is not in the log; it has {', '.join(available)}")
    return log.sel(axis=axes)


def _check_size(available: int) -> None:
    """Refuse a record that is shorter than the shortest window."""
    if available < MIN_WINDOW_SAMPLES:
        raise OptionError(
            f"the record has {available} sample{'s' * (available > 1)}, and a window needs at "
            f"least {MIN_WINDOW_SAMPLES}; no window (--window) helps: give a longer log"
        )


def _window_and_step(window: Any, step: Any, rate: float, available: int) -> tuple[int, int]:
    length = samples(window, rate, "window")
    _check_size(available)
    if length > available:
        raise OptionError(
            f"the window of {length / rate:g} s ({length} samples) is longer than the record of "
            f"{available / rate:g} s; give a shorter window (--window)"
        )
    if length < MIN_WINDOW_SAMPLES:
        raise OptionError(
            f"the window of {length} samples is too short; it needs at least {MIN_WINDOW_SAMPLES} "
            f"({MIN_WINDOW_SAMPLES / rate:g} s at {rate:g} Hz)"
        )
    hop = max(1, length // 10) if step is None else samples(step, rate, "step")
    if hop > length:
        raise OptionError(
            f"the step of {hop / rate:g} s is longer than the window of {length / rate:g} s, so "
            "samples would be left out; give a shorter step (--step)"
        )
    return length, hop


def units_of_work(n_samples: int, unit: WorkUnit) -> list[slice]:
    """Divide the windows into units of work, independently of any chunking."""
    points = unit.window + (1 if unit.angle else 0)
    n_windows = (n_samples - points) // unit.step + 1
    # The samples that the last windows share with the next unit are processed twice; long units
    # keep that share small.
    length = max(4 * unit.window, min(16 * unit.window, 2**21), 2**18)
    per_unit = max(8, min((length - unit.window) // unit.step, MOST_CELLS // unit.ks.size))
    return [
        slice(first, min(first + per_unit, n_windows)) for first in range(0, n_windows, per_unit)
    ]


def last_sample(windows: slice, unit: WorkUnit) -> int:
    """Find one past the last sample of some windows."""
    return int((windows.stop - 1) * unit.step + unit.window + (1 if unit.angle else 0))
