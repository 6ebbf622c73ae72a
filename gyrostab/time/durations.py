"""Conversion of windows, steps and averaging times to numbers of samples."""

from __future__ import annotations

import re
import warnings
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from gyrostab.arrays import Ints
from gyrostab.errors import OptionError
from gyrostab.wording import list_some

#: Examples of averaging times, for messages.
TAUS = "40 (how many), octave, all or 0.1s,1s,10s for taus (--taus)"
#: Relative error of a duration that was printed with six digits, as the messages print it.
PRINTED_DIGITS = 1e-5
#: Largest share by which an averaging time of a list is rounded without a warning: from three
#: samples on, none is rounded by more.
_MAX_ROUNDING_SHARE = 0.2
#: Part of the window that the longest averaging time takes, by the order of the differences.
_PARTS = {2: "half", 3: "a third"}
_SAMPLE_COUNT = re.compile(r"^\s*(\d{1,18})\s*samples?\s*$", re.ASCII)
_COUNT = re.compile(r"^\d{1,18}$", re.ASCII)
_NUMBER = re.compile(r"^\s*[-+]?(\d+(\.\d*)?|\.\d+)(e[-+]?\d+)?\s*$", re.IGNORECASE)
#: Numbers that pandas joins: "1,5min" would be 15 minutes.
_JOINED = re.compile(r"\d\s*,\s*\d|\d\s+\d|\.\d*\.")


def duration_seconds(
    value: Any, option: str, *, example: str = "10min, 30s or 2h", zero: bool = False
) -> float:
    """Convert a duration to seconds: a number [s], a timedelta, or a string such as ``"10min"``.

    Lengths that may also be counted in samples (window, step and block) are read by `samples`,
    which takes no bare number.

    Raises
    ------
    OptionError
        When it cannot be read or is not above zero; with `zero`, when it is below zero.

    Examples
    --------
    >>> duration_seconds("10min", "window")
    600.0
    """
    value = _take_number(value)
    try:
        if isinstance(value, str):
            if _is_bare_number(value) and not (zero and float(value) == 0.0):
                raise OptionError(f"{option} {value!r} has no unit; write for instance {example}")
            if _JOINED.search(value):
                raise ValueError("numbers without a unit between them")
            text = re.sub(r"(?<=[\d ])m$", "min", value.strip().replace("μ", "µ"))
            text = re.sub(r"(?<=[\d ])d(?![a-z])", "D", text)  # as pandas names a day
            seconds = _timedelta_seconds(text)
        elif _is_bare_number(value):
            seconds = float(value)
        else:
            seconds = _timedelta_seconds(value)
    except OptionError:
        raise
    except (ValueError, TypeError, OverflowError) as error:
        raise OptionError(
            f"{option} {value!r} is not a duration; write for instance {example}"
        ) from error
    if not (np.isfinite(seconds) and (seconds > 0 or (zero and seconds == 0))):
        least = "zero or longer" if zero else "longer than zero"
        raise OptionError(f"{option} {value!r} must be {least}")
    return float(seconds)


def _take_number(value: Any) -> Any:
    """Return the number of an array without dimensions, such as ``surface.tau[3]``."""
    is_array = isinstance(value, xr.DataArray | np.ndarray) and value.ndim == 0
    return np.asarray(value)[()] if is_array else value


def _timedelta_seconds(value: Any) -> float:
    length = pd.Timedelta(value)
    if pd.isna(length):
        raise ValueError("no length")
    return float(length.value / 1e9)


def format_duration(seconds: float, space: str = "") -> str:
    """Format a length of time in its largest unit, as options take it.

    Examples
    --------
    >>> format_duration(90.0), format_duration(0.25), format_duration(7200, " ")
    ('1.5min', '0.25s', '2 h')
    """
    size, name = largest_unit(seconds)
    rounded = float(f"{seconds / size:.{3 if size == 1 else 4}g}")
    return f"{np.format_float_positional(rounded, trim='-')}{space}{name}"


def format_measured_duration(seconds: float) -> str:
    """Format a length of time that was measured: milliseconds, seconds up to two hours, or hours.

    `format_duration` is for lengths that a user chose.

    Examples
    --------
    >>> format_measured_duration(1068.0), format_measured_duration(0.0045)
    ('1068.0 s', '4.5 ms')
    >>> format_measured_duration(200 * 3600)
    '200.0 h'
    """
    if abs(seconds) < 1.0:
        return f"{seconds * 1e3:.3g} ms"
    return f"{seconds:.1f} s" if abs(seconds) < 7200 else f"{seconds / 3600:.1f} h"


def largest_unit(seconds: float) -> tuple[float, str]:
    """Find the largest unit that is at most as long as a length of time, in seconds, and its name.

    Examples
    --------
    >>> largest_unit(7200.0), largest_unit(0.1)
    ((3600.0, 'h'), (1.0, 's'))
    """
    units = ((86400.0, "d"), (3600.0, "h"), (60.0, "min"))
    return next((unit for unit in units if seconds >= unit[0]), (1.0, "s"))


def samples(value: Any, rate: float, option: str) -> int:
    """Convert a duration, or a text such as ``"2000samples"``, to a number of samples.

    Parameters
    ----------
    value : str or timedelta
        The length. A bare number is refused: it could be seconds or samples.
    rate : float
        Sampling rate [Hz].

    Raises
    ------
    OptionError
        When it is a bare number, cannot be read, or is shorter than one sample.

    Examples
    --------
    >>> samples("10s", 400.0, "window"), samples("2000samples", 400.0, "window")
    (4000, 2000)
    """
    value = _take_number(value)
    if _is_bare_number(value):
        text = str(value).strip()
        raise OptionError(
            f"{option} {text} has no unit; "
            f"write '{text}s' for seconds or '{text}samples' for samples"
        )
    match = _SAMPLE_COUNT.match(value) if isinstance(value, str) else None
    if match:
        count = int(match.group(1))
        if count < 1:
            raise OptionError(f"{option} of {count} samples: give at least 1")
        return count
    seconds = duration_seconds(value, option, example="10min, 30s or 2000samples")
    count = round(seconds * rate)
    if count < 1:
        raise OptionError(
            f"{option} {value!r} is shorter than one sample at {rate:g} Hz; "
            f"give {1 / rate:g} s or more"
        )
    return count


def _is_bare_number(value: Any) -> bool:
    """Whether a length is a number without a unit, or the text of one.

    Examples
    --------
    >>> _is_bare_number(60), _is_bare_number("60"), _is_bare_number("60s")
    (True, True, False)
    """
    if isinstance(value, str):
        return bool(_NUMBER.match(value))
    return isinstance(value, int | float | np.number) and not isinstance(
        value, bool | np.timedelta64
    )


def _show_length(value: Any) -> str:
    """Show a length in a message: a number is in seconds, anything else as it was written."""
    return f"{value:g} s" if _is_bare_number(value) and not isinstance(value, str) else repr(value)


def averaging_factors(
    taus: Any, *, rate: float, window: int, tau_max: Any = None, order: int = 2
) -> Ints:
    """Find the averaging factors k of the requested averaging times ``k / rate``, in rising order.

    Parameters
    ----------
    taus : int, {"octave", "all"} or sequence
        A number of them evenly spaced in log, ``octave``, ``all``, or a list of durations [s].
    rate : float
        Sampling rate [Hz].
    window : int
        Window [samples].
    tau_max : float or str, optional
        Longest averaging time, even of a list; by default a third of the terms of the window is
        left, and a list is used as it is.
    order : int
        Order of the differences: a term spans ``order * k`` samples.

    Raises
    ------
    OptionError
        When a term is longer than the window, or there is no averaging time.

    Examples
    --------
    >>> averaging_factors("octave", rate=100.0, window=1000)
    array([  1,   2,   4,   8,  16,  32,  64, 128, 256])
    >>> averaging_factors(["0.1s", "1s"], rate=100.0, window=1000)
    array([ 10, 100])
    """
    longest = window // order
    limit = 2 * window // (3 * order)
    if tau_max is not None:
        asked = duration_seconds(tau_max, "tau_max") * rate
        nearest = round(asked)
        limit = nearest if nearest <= asked * (1 + PRINTED_DIGITS) else int(asked)
        if limit > longest or limit < 1:
            raise OptionError(
                f"tau_max of {limit / rate:g} s does not fit the window of {window / rate:g} s; "
                f"give {1 / rate:g} s to {longest / rate:g} s ({_PARTS[order]} of the window)"
            )
    limit = max(1, limit)
    if isinstance(taus, str):
        text = taus.strip()
        if text == "octave":
            return np.asarray(2 ** np.arange(int(np.log2(limit)) + 1), dtype=np.int64)
        if text == "all":
            return np.arange(1, limit + 1, dtype=np.int64)
        is_count = _COUNT.match(text)
        taus = int(text) if is_count else [part for part in text.split(",") if part.strip()]
    is_number = isinstance(taus, int | np.integer) and not isinstance(taus, bool)
    if (is_number and taus < 1) or not (is_number or np.iterable(taus)):
        raise OptionError(
            f"taus={taus}: give a number of averaging times above 0, 'octave', 'all' "
            "or a list such as 0.1s,1s"
        )
    if is_number:
        if taus >= 2 * limit * np.log(limit) + 2:  # spaced by less than half a sample everywhere
            return np.arange(1, limit + 1, dtype=np.int64)
        return np.unique(np.round(np.geomspace(1, limit, int(taus))).astype(np.int64))
    factors = _listed_factors(taus, rate, longest, order)
    if tau_max is not None:  # to the nearest factor, as those of the list
        factors = factors[factors <= round(duration_seconds(tau_max, "tau_max") * rate)]
    if len(factors) == 0:
        given = "given" if tau_max is None else f"given up to tau_max of {limit / rate:g} s"
        raise OptionError(f"no averaging time is {given}; write for instance {TAUS}")
    return factors


def _listed_factors(taus: Any, rate: float, longest: int, order: int) -> Ints:
    """Return the averaging factors of a list of durations, of which `longest` is the largest."""
    ks, moved = [], []
    for tau in map(_take_number, taus):
        samples = duration_seconds(tau, "tau", example=TAUS) * rate
        k = round(samples)
        if k < 1:
            raise OptionError(
                f"tau {_show_length(tau)} is shorter than one sample at {rate:g} Hz; "
                f"give {1 / rate:g} s or more"
            )
        if k > longest:
            raise OptionError(
                f"tau {_show_length(tau)} is longer than {_PARTS[order]} of the window "
                f"({longest / rate:g} s), so no {'second' if order == 2 else 'third'} difference "
                "fits; give a longer window (--window) or shorter taus (--taus)"
            )
        ks.append(k)
        if abs(k - samples) > _MAX_ROUNDING_SHARE * samples:
            moved.append(f"{_show_length(tau)} to {k / rate:g} s")
    if moved:
        warnings.warn(
            f"averaging times (--taus) are rounded to whole samples at {rate:g} Hz: "
            + list_some(moved),
            stacklevel=5,
        )
    return np.unique(np.asarray(ks, dtype=np.int64))
