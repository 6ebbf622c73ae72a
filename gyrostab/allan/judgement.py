"""Sentences of judgement on a product, and what windows of some length can observe."""

from __future__ import annotations

import math
from collections import defaultdict
from itertools import zip_longest

import numpy as np
import xarray as xr

from gyrostab.arrays import Bools
from gyrostab.noise import LAWS
from gyrostab.schema import OBSERVED, check_product, is_rate_of_change, texts
from gyrostab.time.durations import format_duration
from gyrostab.units import HOUR
from gyrostab.wording import format_rounded, join_words

#: Lengths of windows to suggest [s].
SUGGESTED_WINDOWS_S = (60, 300, 1200, *(int(hours * HOUR) for hours in (1, 4, 24)))
#: Coefficient that half of the windows observe, for N = 1 deg/sqrt(h) and windows of one hour; it
#: falls with the window to the powers 1/2, 1 and 3/2. Measured with 42 simulated windows for each
#: of twelve sizes, for windows of 10 min at 10 Hz and of 2 h at 2 Hz, which agree within 10 %.
_HALF_OBSERVE = {"B": (8.3, 0.5), "K": (49.0, 1.0), "R": (26.0, 1.5)}
#: Standard errors of a window beyond which a coefficient has changed: two-sided P = 0.0027 for a
#: normal error.
_CLEAR_SIGMA = 3.0
#: Windows needed in either state of a channel.
_MIN_WINDOWS = 3
#: Share of windows from which a term counts as observed in a state, and up to which as absent.
_MOST, _FEW = 0.5, 0.1
#: Share of windows that may observe a term that is absent (docs/statistics.md).
_FALSE_ALARMS = 0.03
#: A channel whose range is a smaller share of its largest magnitude is taken as constant.
_MIN_RANGE_SHARE = 0.3


def smallest_observable(window: float, white: float) -> dict[str, float]:
    """Return the B, K and R that half of the windows would observe, with white noise only.

    Other noise raises these values.

    Parameters
    ----------
    window : float
        Length of the windows [s].
    white : float
        Angle random walk N [deg/sqrt(h)].

    Returns
    -------
    dict
        B [deg/h], K [deg/h^1.5] and R [deg/h^2].

    Examples
    --------
    >>> {term: round(size, 3) for term, size in smallest_observable(3600.0, 0.01).items()}
    {'B': 0.083, 'K': 0.49, 'R': 0.26}
    """
    return {
        term: factor * white / (window / HOUR) ** power
        for term, (factor, power) in _HALF_OBSERVE.items()
    }


def suggest_windows(span: float, white: float) -> list[str]:
    """Describe what windows of each length can observe in a record, and suggest one.

    Parameters
    ----------
    span : float
        Length of the record [s].
    white : float
        Angle random walk N of the record [deg/sqrt(h)].

    Returns
    -------
    list of str
        A heading, one line per length, and the suggestion; empty for a record of less than four of
        the shortest windows.
    """
    lengths = [window for window in SUGGESTED_WINDOWS_S if 4 * window <= span]
    if not lengths or not white > 0:
        return []
    lines = [
        f"N is about {white:.2g} deg/sqrt(h). With that noise alone, half of the windows observe:"
    ]
    for window in lengths:
        sizes = smallest_observable(window, white).items()
        limits = ", ".join(
            f"{term} from {format_rounded(size)} {LAWS[term].label}" for term, size in sizes
        )
        count = int(span // window)
        lines.append(
            f"  --window {format_duration(window)}: {limits}; {count} windows without overlap"
        )
    short, long = (format_duration(window) for window in (lengths[0], lengths[-1]))
    step = format_duration(lengths[-1] / 10)
    text = f"Suggested for B, K and R: --window {long} --step {step}"
    return [*lines, text + f"; to follow changes of N: --window {short}" * (long != short)]


def judge_product(product: xr.Dataset) -> list[str]:
    """Judge a product in plain sentences: what changes the noise, and what cannot be observed.

    Returns
    -------
    list of str
        One sentence on a change of the sampling rate within the record, on the largest change with
        a channel, or on how steady N is; and one on the terms that are not observed, or only
        observed while a channel is high or low.

    Examples
    --------
    >>> from gyrostab import davar, fit_noise, make_log
    >>> noise = 6.0 * np.random.default_rng(1).standard_normal(60_000)
    >>> product = fit_noise(davar(make_log(noise, rate=100.0, unit="deg/h"), window="1min"))
    >>> len(judge_product(product))
    2
    """
    check_product(product)
    longest_tau = float(product["tau"][-1])
    product = product.drop_dims("tau").compute()
    changes, absences = _compare_channels(product)
    return [
        _judge_sampling(product) or _judge_changes(product, changes),
        _judge_terms(product, absences, longest_tau),
    ]


def _judge_sampling(product: xr.Dataset) -> str:
    """Say where the samples come at another rate than the log states, or return ""."""
    half_window = np.timedelta64(round(0.5e9 * product.attrs.get("window_s", 0.0)), "ns")
    times = product["time"].values
    changes = texts(product, "rate_changes")
    for begin, end in zip_longest(changes[::2], changes[1::2], fillvalue=str(times.max())):
        first, last = np.datetime64(begin), np.datetime64(end)
        if first < times.max() + half_window and last > times.min() - half_window:
            span = " to ".join(text[:19].replace("T", " ") for text in (begin, end))
            return (
                f"N cannot be judged: from {span} the samples come at another rate than "
                f"{product.attrs['sampling_rate_hz']:.6g} Hz, so their times and coefficients are "
                "wrong; split the log there and run the parts separately."
            )
    return ""


def _compare_channels(
    product: xr.Dataset,
) -> tuple[dict[tuple[str, str], dict[str, float]], dict[tuple[str, str], list[str]]]:
    """Compare the windows where a channel is high with those where it is low.

    Returns, by channel and term, the ratio of the medians of each axis on which they differ; and,
    by term and state of a channel, the axes on which only that state shows the term.
    """
    changes: dict[tuple[str, str], dict[str, float]] = defaultdict(dict)
    absences: dict[tuple[str, str], list[str]] = defaultdict(list)
    for channel, low, high in _find_states(product):
        for axis in map(str, product["axis"].values):
            for term in LAWS:
                ratio, only = _compare_states(product.sel(axis=axis), term, low, high)
                if ratio != 1.0:
                    changes[channel, term][axis] = ratio
                if only:
                    absences[term, f"while {_name_channel(product, channel)} is {only}"].append(
                        axis
                    )
    return changes, absences


def _judge_changes(product: xr.Dataset, changes: dict[tuple[str, str], dict[str, float]]) -> str:
    """Describe the largest change with a channel, or how steady N is."""
    if not changes:
        return _judge_steadiness(product)
    (channel, term), ratios = max(
        changes.items(), key=lambda item: max(abs(np.log(ratio)) for ratio in item[1].values())
    )
    falls = all(ratio < 1.0 for ratio in ratios.values())
    sizes = join_words(
        [
            f"{_format_factor(1.0 / ratio if falls else ratio)} on {axis}"
            for axis, ratio in ratios.items()
        ]
    )
    rises = all(ratio > 1.0 for ratio in ratios.values())
    change = "is smaller" if falls else "is larger" if rises else "changes"
    name = _name_channel(product, channel)
    return f"{term} {change} by a factor of {sizes} while {name} is high."


def _format_factor(ratio: float) -> str:
    """Format a factor, one close to 1 with as many digits as show the difference.

    Examples
    --------
    >>> _format_factor(5.13), _format_factor(1.31), _format_factor(0.957)
    ('5.1', '1.3', '0.96')
    """
    if not 0.5 < ratio < 2.0 or ratio == 1.0:
        return format_rounded(ratio)
    return f"{ratio:.{math.ceil(-math.log10(abs(ratio - 1.0)))}f}"


def _find_states(product: xr.Dataset) -> list[tuple[str, Bools, Bools]]:
    """List the channels that change, with the windows in the lowest and highest quarter."""
    states = []
    for name, channel in product.data_vars.items():
        if channel.dims != ("time",) or channel.dtype.kind != "f":
            continue
        values = np.asarray(channel.values)
        if is_rate_of_change(str(name), product):
            values = np.abs(values)
        finite = values[np.isfinite(values)]
        if not finite.size or np.ptp(finite) <= _MIN_RANGE_SHARE * np.abs(finite).max():
            continue
        low = values < finite.min() + 0.25 * np.ptp(finite)
        high = values > finite.max() - 0.25 * np.ptp(finite)
        if min(low.sum(), high.sum()) >= _MIN_WINDOWS:
            states.append((str(name), low, high))
    return states


def _compare_states(part: xr.Dataset, term: str, low: Bools, high: Bools) -> tuple[float, str]:
    """Compare a term between two states: ratio of the medians, and the only state that shows it."""
    values, observed = part[term].values, _find_observed(part, term)
    in_low, in_high = float(observed[low].mean()), float(observed[high].mean())
    if max(in_low, in_high) >= _MOST and min(in_low, in_high) <= _FEW:
        return 1.0, "high" if in_high > in_low else "low"
    if min(in_low, in_high) < _MOST:
        return 1.0, ""
    below, above = values[low & observed], values[high & observed]
    ratio = float(np.median(above) / np.median(below))
    rises = np.quantile(above, 0.05) > np.quantile(below, 0.95)
    falls = np.quantile(above, 0.95) < np.quantile(below, 0.05)
    error = math.hypot(*(_relative_error(part, term, state & observed) for state in (low, high)))
    differs = (rises or falls) and abs(math.log(ratio)) > _CLEAR_SIGMA * error
    return (ratio if differs else 1.0), ""


def _find_observed(part: xr.Dataset, term: str) -> Bools:
    """Find the windows of an axis that observe a term, with a size above zero."""
    is_observed = part["observable"].sel(term=term).values == OBSERVED
    return np.asarray(is_observed & (part[term].values > 0.0))


def _relative_error(part: xr.Dataset, term: str, windows: Bools) -> float:
    """Return the relative standard error of a coefficient in one of the windows, their median."""
    return float(np.median(part[f"{term}_stderr"].values[windows] / part[term].values[windows]))


def _name_channel(product: xr.Dataset, channel: str) -> str:
    if is_rate_of_change(channel, product):
        return f"the rate of change of {channel.removesuffix('_rate').replace('_', ' ')}"
    return channel.replace("_", " ")


def _judge_steadiness(product: xr.Dataset) -> str:
    """Say how far N varies on each axis."""
    spreads = []
    for axis in map(str, product["axis"].values):
        part = product.sel(axis=axis)
        observed = _find_observed(part, "N")
        if observed.sum() >= _MIN_WINDOWS:
            low, middle, high = np.quantile(part["N"].values[observed], [0.05, 0.5, 0.95])
            when = part["time"].values[observed][np.argmax(part["N"].values[observed])]
            is_clear = math.log(high / low) > 2.0 * _CLEAR_SIGMA * _relative_error(
                part, "N", observed
            )
            spreads.append((axis, (high - low) / (2.0 * middle), high / low, is_clear, when))
    if not spreads:
        return "N is observed in too few windows to judge how steady it is."
    changing = [
        f"{_format_factor(ratio)} on {axis} (highest around {str(when)[:19].replace('T', ' ')})"
        for axis, _, ratio, is_clear, when in spreads
        if is_clear
    ]
    if changing:
        return f"N varies by a factor of {', '.join(changing)}, from its 5 % to its 95 % quantile."
    return (
        "N is steady within its errors: it varies by "
        + ", ".join(f"{100 * share:.0f} % on {axis}" for axis, share, *_ in spreads)
        + " (half of the range from 5 % to 95 %)."
    )


def _judge_terms(
    product: xr.Dataset, absences: dict[tuple[str, str], list[str]], longest_tau: float
) -> str:
    """Say which terms no axis observes more often than by chance, and which windows would."""
    terms = _fitted_terms(product)
    observed_share = (product["observable"] == OBSERVED).mean("time").max("axis")
    hidden = [term for term in terms if observed_share.sel(term=term) <= _FALSE_ALARMS]
    window = float(product.attrs.get("window_s", np.nan))
    where = f"in windows of {format_duration(window)}" if np.isfinite(window) else "in any window"
    if not hidden:
        which = "five" if len(terms) == len(LAWS) else "fitted"
        return f"All {which} terms are observed {where}{_list_absences(product, absences)}."
    if len(hidden) == len(terms):  # the terms do not describe the record, which has a sentence
        return f"No term is observed {where}{_explain_coverage(product)}."
    chance = f"no more often than by chance (in up to {100 * _FALSE_ALARMS:.0f} % of them)"
    is_rare = bool(observed_share.sel(term=hidden).any())
    text = f"{join_words(hidden)} {'is' if len(hidden) == 1 else 'are'} " + (
        f"observed {where} {chance}" if is_rare else f"not observed {where}"
    )
    white = float(product["N"].where(product["observable"].sel(term="N") == OBSERVED).median())
    if hidden == ["Q"]:
        return f"{text}: N hides it; a higher sampling rate would show it."
    slow = join_words([term for term in hidden if term != "Q"])
    fit_end = float(product.attrs.get("fit_tau_max_s", longest_tau))
    if fit_end < longest_tau:
        return (
            f"{text}: the fit ends at an averaging time of {fit_end:.3g} s (tau_max, --fit-to); "
            f"longer ones may show {slow}."
        )
    bounds = product["time"].values[[0, -1]]
    span = float((bounds[1] - bounds[0]) / np.timedelta64(1, "s")) + np.nan_to_num(window)
    longer = [length for length in SUGGESTED_WINDOWS_S if window < length <= span / 4]
    if not longer:
        return f"{text}; only a longer record could show {slow}."
    limits = smallest_observable(longer[-1], white)
    is_allan = product.attrs.get("variance", "avar") == "avar"  # which the limits are for
    sizes = [
        f"{term} from {format_rounded(limits[term])} {LAWS[term].label}"
        for term in hidden
        if term in limits and np.isfinite(white) and is_allan
    ]
    text += f": use a window (--window) of {format_duration(longer[-1])}"
    return text + (f", which observes {join_words(sizes)}." if sizes else ".")


def _explain_coverage(product: xr.Dataset) -> str:
    """Say that the samples of all windows are too few for `min_coverage`, or return ""."""
    least = float(product.attrs.get("min_coverage", 0.0))
    coverage = product["window_coverage"].values
    if not (coverage.size and (coverage < least).all()):
        return ""
    if not coverage.any():
        return ": they hold no sample"
    most = float(coverage.max())
    return (
        f": they hold at most {format_rounded(100 * most)} % of their samples, and averaging times "
        f"of which less than {100 * least:g} % is left are not used; give a min_coverage "
        f"(--min-coverage) below {most:.2g}"
    )


def _fitted_terms(product: xr.Dataset) -> list[str]:
    """List the terms that the fit could find on any axis."""
    fitted = set(product.attrs.get("fit_terms", LAWS))
    if product.attrs.get("variance") == "hadamard":
        fitted -= {"R"}
    if "filter_time_constant" in product and bool((product["filter_time_constant"] > 0).all()):
        fitted -= {"Q"}
    return [term for term in LAWS if term in fitted]


def _list_absences(product: xr.Dataset, absences: dict[tuple[str, str], list[str]]) -> str:
    """List the terms that most axes show in one state of a channel only; a high state first."""
    parts: dict[str, str] = {}
    count = product.sizes["axis"]
    for (term, state), axes in sorted(absences.items(), key=lambda item: item[0][1][-4:] != "high"):
        if 2 * len(axes) > count:
            which = "" if len(axes) == count else f" on {join_words(axes)}"
            parts.setdefault(term, f"{term}{which} only {state}")
    return ": " + join_words(list(parts.values())) if parts else ""
