"""Options of a run, checked before it starts, and its logs, put on a uniform time axis."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import xarray as xr

from gyrostab.errors import OptionError
from gyrostab.jobs.job import format_option


def check_run_options(
    *,
    reading: Mapping[str, Any] | None = None,
    windows: Mapping[str, Any] | None = None,
    fitting: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Check the options of a run as far as they do not depend on the log; return them as dicts.

    Raises
    ------
    OptionError
        When one of them cannot be used.
    """
    from gyrostab.allan.fit_inputs import check_fit_options
    from gyrostab.ingest.uniform import check_cut

    options = {
        "reading": dict(reading or {}),
        "windows": dict(windows or {}),
        "fitting": dict(fitting or {}),
    }
    check_cut(**options["reading"])
    _check_windows(**options["windows"])
    check_fit_options(**options["fitting"])
    return options


def _check_windows(
    *,
    window: str | None = None,
    step: str | None = None,
    taus: Any = "40",
    tau_max: str | None = None,
    **other: Any,
) -> None:
    """Check options of `gyrostab.allan.davar.davar`, as text; others than these are ignored.

    Raises
    ------
    OptionError
        When one of them is not a duration, or the step or an averaging time is too long for the
        window.

    Examples
    --------
    >>> _check_windows(window="10", step="1min")
    Traceback (most recent call last):
    gyrostab.errors.OptionError: window 10 has no unit; write '10s' for seconds or '10samples' ...
    """
    from gyrostab.time.durations import TAUS, averaging_factors, duration_seconds, samples

    fine = 1e6  # Hz; the true rate is not known yet
    length = math.inf if window is None else samples(window, fine, "window")
    step_length = samples(step, fine, "step") if step else 1
    if window and step and ("sample" in window) == ("sample" in step) and step_length > length:
        raise OptionError(
            f"the step of {step} is longer than the window of {window}, "
            "so samples would be left out; give a shorter step (--step)"
        )
    # the duration of a number of samples depends on the rate
    half = math.inf if window and "sample" in window else length / fine / 2
    lengths = [(tau_max, duration_seconds(tau_max, "tau_max"))] if tau_max else []
    if isinstance(taus, int) or (isinstance(taus, str) and taus.strip().isdigit()):
        averaging_factors(taus, rate=fine, window=2)
    elif isinstance(taus, str) and taus.strip() not in ("octave", "all"):
        listed = taus.split(",")
        lengths += [(tau, duration_seconds(tau, "tau", example=TAUS)) for tau in listed]
    for tau, seconds in lengths:
        if seconds > half:
            raise OptionError(
                f"tau {tau.strip()} is longer than half of the window of {window}, "
                "so no second difference fits; "
                "give a longer window (--window) or a shorter tau"
            )


def load_log(
    paths: Sequence[str | Path],
    *,
    max_gap: str = "10D",
    time_from: Any = None,
    time_to: Any = None,
    exclude: Sequence[Any] = (),
    **reading: Any,
) -> xr.Dataset:
    """Read logs in any format and put them on a uniform time axis.

    Parameters
    ----------
    paths : sequence of path
        Files, in any order; NetCDF and Zarr logs that gyrostab wrote are concatenated without
        loading them.
    max_gap : str
        Longest gap; a larger step of the stamps is treated as a step of the clock.
    time_from, time_to : str, datetime or duration, optional
        First time to use, and the time up to which (exclusive): dates and times (ISO 8601, UTC), or
        durations after the start of the log.
    exclude : sequence of str or pairs
        Spans ``"START/END"`` whose samples are treated as missing; see
        `gyrostab.ingest.uniform.cut_log`.
    **reading
        Options of `gyrostab.ingest.read_log`: ``rate``, ``start``, ``epoch``, ``map``, ``unit``,
        ``missing_value``, ``kind``, ``channel``, ``strict``, ``limits``, ``on_file``, ``read``.

    Returns
    -------
    xarray.Dataset
        Log of `gyrostab.schema`.
    """
    from gyrostab.ingest import read_log
    from gyrostab.ingest.grid.notes import describe_channels
    from gyrostab.ingest.grid.regularise import regularise
    from gyrostab.ingest.uniform import cut_log

    log = read_log(paths, max_gap=max_gap, **reading)
    if "sampling_rate_hz" not in log.attrs:
        log = regularise(
            log, rate=reading.get("rate"), max_gap=max_gap, limits=reading.get("limits")
        )
        options = "; ".join(
            f"{name}: {format_option(value)}"
            for name, value in reading.items()
            if value and name not in ("on_file", "read")
        )
        if options:
            log.attrs["history"] += f" (read with {options})"
    elif reading.get("channel"):
        log = log.assign_attrs(notes=[*log.attrs.get("notes", []), *describe_channels(log)])
    log = cut_log(log, time_from=time_from, time_to=time_to, exclude=exclude)
    for note in log.attrs.get("notes", []):
        warnings.warn(note, stacklevel=2)
    return log


def count_axis_samples(log: xr.Dataset) -> int:
    """Count the samples of a log over all its axes."""
    return int(log.sizes["axis"] * log.sizes["time"])
