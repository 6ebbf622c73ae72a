"""Gyro terms of an ISCWSA tool error model from the coefficients of a product.

===========  ===========================================================  ===========
kind         magnitude                                                    unit
===========  ===========================================================  ===========
noise        N / sqrt(T)                                                  deg/h
random walk  N                                                            deg/sqrt(h)
drift        sqrt(N^2 / C + B^2 F(S, C) + K^2 (S + C) / 3)                deg/h
g-dependent  factors of g_sensitivity, as a diagnosis found them          deg/h/g
===========  ===========================================================  ===========

T is the time of a station, C the time over which the bias was determined before the section, and S
the duration of the section, in hours. ``F = (S + C) ((S + C) ln(S + C) - S ln S - C ln C) / (pi S
C)``. The drift is the standard deviation of the mean bias of the section minus its mean during C,
without the white noise of the section, which is the random walk.

The mapping is gyrostab's own (docs/how-to/survey-error-model.md derives it) and is to be confirmed
by a survey engineer. Names, propagation modes and weighting functions are those of the reference
and of the tool codes of OWSG.

References
----------
Torkildsen et al. 2008, "Prediction of wellbore position accuracy when surveyed with gyroscopic
tools", SPE Drilling & Completion 23, doi:10.2118/90408-PA, tables 3, 4 and 6 to 8.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
import xarray as xr

from gyrostab.allan.summary import TermSummary, find_constant_axes, summarise_fit, summarise_terms
from gyrostab.errors import OptionError, SchemaError
from gyrostab.io.survey_model import KINDS, TABLES, Groups, Status, SurveyModel, SurveyTerm, Tool
from gyrostab.noise import LAWS
from gyrostab.schema import texts, with_axis
from gyrostab.time.durations import duration_seconds
from gyrostab.units import HOUR

if TYPE_CHECKING:
    from gyrostab.diagnose.result.diagnosis import Diagnosis

Statistic = Literal["median", "p95"]
#: From best to worst: a term has the worst status of its coefficients.
_STATUSES = ("observed", "upper_limit_only", "not_observable")
_CONFIRM = (
    "This mapping from N, B and K to survey error terms is gyrostab's own and is to be confirmed "
    "by a survey engineer."
)


class _Magnitude(NamedTuple):
    """A magnitude with its range."""

    value: float
    low: float
    high: float
    status: Status


def drift_rate(n: float, b: float, k: float, *, section: float, calibration: float) -> float:
    """Standard deviation [deg/h] of the change of the bias from its calibration to the section.

    The white noise of the section itself is left out.

    Parameters
    ----------
    n, b, k : float
        Coefficients N [deg/sqrt(h)], B [deg/h] and K [deg/h^1.5].
    section, calibration : float
        Duration of the section, and of the time before it over which the bias was averaged [s].

    Examples
    --------
    >>> drift_rate(0.0, 0.0, 1.0, section=5400.0, calibration=5400.0)  # K^2 (1.5 h + 1.5 h) / 3
    1.0
    """
    total = section + calibration
    spread = sum(
        sign * t * math.log(t) for sign, t in [(1, total), (-1, section), (-1, calibration)]
    )
    flicker = total * spread / (math.pi * section * calibration)
    white, walk = LAWS["N"].avar(calibration, n), LAWS["K"].avar(total, k)
    return math.sqrt(float(white) + b**2 * flicker + float(walk))


def survey_terms(
    product: xr.Dataset,
    *,
    station_time: Any = "2min",
    section_time: Any = "1h",
    calibration_time: Any = None,
    statistic: Statistic = "median",
    diagnosis: Mapping[str, Any] | Diagnosis | None = None,
) -> SurveyModel:
    """Compute the gyro terms of an ISCWSA tool error model from the noise of a product.

    The axis ``z`` is along the tool, ``x`` and ``y`` are across it.

    Parameters
    ----------
    product : xarray.Dataset
        What `gyrostab.fit_noise` returns or `gyrostab.open_product` opens. Its axes, some of ``x``,
        ``y`` and ``z``, decide which terms apply.
    station_time : duration
        Time of the measurement at a station.
    section_time : duration
        Duration of the survey section after the calibration of the bias.
    calibration_time : duration, optional
        Time over which the bias was averaged before the section; `station_time` unless given.
    statistic : {"median", "p95"}
        Median or 95 % quantile over the windows that observe a coefficient; for upper limits
        always the median.
    diagnosis : mapping or Diagnosis, optional
        Contents of ``diagnosis.json``, or what `gyrostab.diagnose` or `gyrostab.open_diagnosis`
        returns; the g-dependent terms are taken from it.

    Returns
    -------
    SurveyModel

    Raises
    ------
    SchemaError
        When `product` is not a product, has other axes, or shows neither N nor B nor K.
    OptionError
        When a time or the statistic cannot be read.

    Examples
    --------
    >>> from gyrostab import davar, fit_noise, make_log
    >>> noise = 6.0 * np.random.default_rng(1).standard_normal(60_000)  # N = 0.01 deg/sqrt(h)
    >>> product = fit_noise(davar(make_log(noise, rate=100.0, unit="deg/h"), window="1min"))
    >>> term = survey_terms(product, station_time="4min").terms[0]
    >>> term.code, f"{term.value:.2f} {term.unit}"  # 0.01 / sqrt(1/15)
    ('GXY-RN', '0.04 deg/h')
    """
    if statistic not in ("median", "p95"):
        raise OptionError(f"statistic (--statistic) {statistic!r} is neither median nor p95")
    times = {
        "station": duration_seconds(station_time, "station_time (--station-time)"),
        "section": duration_seconds(section_time, "section_time (--section-time)"),
        "calibration": duration_seconds(
            station_time if calibration_time is None else calibration_time,
            "calibration_time (--calibration-time)",
        ),
    }
    content = getattr(diagnosis, "content", diagnosis)
    if not (content is None or isinstance(content, Mapping)):
        raise OptionError(
            f"diagnosis is a {type(diagnosis).__name__}: give gyrostab.open_diagnosis(folder)"
        )
    product = with_axis(product)
    summaries = summarise_terms(product)
    tool = _find_tool([summary.axis for summary in summaries])
    magnitudes = _compute_magnitudes(summaries, statistic, times)
    magnitudes["g"] = _read_sensitivities(content or {})
    terms = [
        _make_term(code, kind, groups, magnitudes[kind])
        for code, kind, groups, _ in TABLES[tool]
        if any(name in magnitudes[kind] for group in groups for name in group)
    ]
    if all(math.isnan(term.value) for term in terms if term.unit != "deg/h/g"):
        silent = [axis for axis, walk in magnitudes["walk"].items() if math.isnan(walk.value)]
        constant = [axis for axis in find_constant_axes(product) if axis in silent]
        if constant:
            raise SchemaError(
                f"axis {', '.join(constant)} is constant: its sensor is dead, or its column the "
                "wrong one; make the product again without it (--axis, or log.sel(axis=[...]))"
            )
        raise SchemaError(
            f"no window of the product observes or limits N of axis {', '.join(silent)}; make the "
            "product again with a longer window (--window), or without that axis (--axis, or "
            "log.sel(axis=[...]))"
        )
    return SurveyModel(
        tool,
        tuple(terms),
        _find_ranges(product),
        _describe_origin(product, times, statistic),
        (
            _CONFIRM,
            *_note_ramps(product, summaries, times),
            *_make_notes(product, terms, times["section"], content),
        ),
    )


def _make_term(
    code: str, kind: str, groups: Groups, magnitudes: Mapping[str, _Magnitude]
) -> SurveyTerm:
    """Take the root mean square in each group, the largest of the groups, and the worst status."""
    known_groups = [[name for name in group if name in magnitudes] for group in groups]
    names = [name for group in known_groups for name in group]
    means = [
        np.sqrt(np.mean(np.square([magnitudes[name][:3] for name in group]), axis=0))
        for group in known_groups
        if group
    ]
    mode, propagation, unit, derivation = KINDS[kind]
    value, low, high = map(float, np.max(means, axis=0))
    status = _find_worst(magnitudes[name] for name in names)
    derivation = f"{derivation}; {', '.join(names)}"
    return SurveyTerm(code, value, low, high, status, unit, mode, propagation, derivation)


def _find_tool(axes: Sequence[str]) -> Tool:
    """Find which gyros a tool has, from the axes of its product."""
    if strange := sorted(set(axes) - set("xyz")):
        raise SchemaError(
            f"the product has axes named {', '.join(strange)}; survey terms need the axes x and y "
            "across the tool and z along it: name them with map (--map) when reading the log, or "
            "with product.assign_coords(axis=[...])"
        )
    if "z" not in axes:
        return "xy"
    return "z" if set(axes) == {"z"} else "xyz"


def _compute_magnitudes(
    summaries: Iterable[TermSummary], statistic: Statistic, times: Mapping[str, float]
) -> dict[str, dict[str, _Magnitude]]:
    """Compute kind -> axis -> magnitude from the coefficients."""
    coefficients: dict[str, dict[str, _Magnitude]] = {}
    for summary in summaries:
        chosen = _Magnitude(summary.value, 0.0, summary.value, summary.status)
        if summary.status == "observed":
            value = summary.median if statistic == "median" else summary.high
            chosen = _Magnitude(value, summary.low, summary.high, "observed")
        coefficients.setdefault(summary.axis, {})[summary.symbol] = chosen

    def combine(formula: Callable[..., float], symbols: str) -> dict[str, _Magnitude]:
        magnitudes = {}
        for axis, by_symbol in coefficients.items():
            used = [by_symbol[symbol] for symbol in symbols]
            rows = zip(*(magnitude[:3] for magnitude in used), strict=True)
            value, low, high = (formula(*row) for row in rows)
            magnitudes[axis] = _Magnitude(value, low, high, _find_worst(used))
        return magnitudes

    def noise(n: float) -> float:
        return math.sqrt(LAWS["N"].avar(times["station"], n))

    def drift(n: float, b: float, k: float) -> float:
        return drift_rate(n, b, k, section=times["section"], calibration=times["calibration"])

    bias = combine(drift, "NBK")
    return {
        "noise": combine(noise, "N"), "walk": combine(float, "N"), "bias": bias, "drift": bias,
    }  # fmt: skip


def _find_worst(magnitudes: Iterable[_Magnitude]) -> Status:
    return max((magnitude.status for magnitude in magnitudes), key=_STATUSES.index)


def _read_sensitivities(diagnosis: Mapping[str, Any]) -> dict[str, _Magnitude]:
    """Read gyro axis and axis of acceleration -> bias per g, or its upper limit for every pair."""
    limit = diagnosis.get("not_found", {}).get("g_sensitivity", {}).get("upper_limit")
    if limit is not None:
        return {
            gyro + acceleration: _Magnitude(limit, 0.0, limit, "upper_limit_only")
            for gyro in diagnosis["recording"]["axes"]
            for acceleration in "xyz"
        }
    sensitivities: dict[str, _Magnitude] = {}
    for effect in diagnosis.get("effects", []):
        if effect["name"] == "g_sensitivity":
            for name, size in effect["parameters"].items():
                value, *ends = (
                    size["value"] if size[key] is None else size[key]
                    for key in ("value", "low", "high")
                )
                if value is not None:
                    low, high = sorted(map(abs, ends))
                    low = 0.0 if ends[0] * ends[1] < 0.0 else low
                    magnitude = _Magnitude(abs(value), low, high, "observed")
                    along, _, axis = name.partition(".")  # "x", or "x.y" for the gyro y alone
                    sensitivities |= {gyro + along: magnitude for gyro in axis or effect["axes"]}
    return sensitivities


def _describe_origin(
    product: xr.Dataset, times: Mapping[str, float], statistic: Statistic
) -> tuple[str, ...]:
    from gyrostab import __version__

    names = [Path(name).name for name in texts(product, "source_files")]
    bounds = product["time_bounds"].values if "time_bounds" in product else product["time"].values
    start, end = (np.datetime_as_string(t, unit="s") for t in (bounds.min(), bounds.max()))
    quantile = {"median": "the median", "p95": "the 95 % quantile"}[statistic]
    return (
        f"Made by gyrostab {__version__} from {', '.join(names) or 'a log'}, {start} to {end}.",
        f"Each coefficient is {quantile} over the windows that observe it, or the median of its "
        "95 % upper limits (<) where more windows only limit it.",
        f"Station time {times['station']:g} s, calibration of the bias {times['calibration']:g} s, "
        f"section after it {times['section']:g} s.",
    )


def _find_ranges(product: xr.Dataset) -> dict[str, tuple[float, float, str]]:
    """Find the range of every channel over the windows."""
    return {
        str(name): (float(channel.min()), float(channel.max()), channel.attrs.get("units", "1"))
        for name, channel in product.data_vars.items()
        if channel.dims == ("time",) and channel.dtype.kind == "f" and channel.notnull().any()
    }


def _note_ramps(
    product: xr.Dataset, summaries: Iterable[TermSummary], times: Mapping[str, float]
) -> list[str]:
    """Say by how much observed rate ramps change the bias, as no term includes them."""
    if product.attrs.get("variance") == "hadamard":
        return [
            "A rate ramp R is in no term, and the Hadamard variance does not show it: make the "
            "product again with --variance avar to see whether there is one."
        ]
    hours = (times["section"] + times["calibration"]) / 2.0 / HOUR
    return [
        f"R of axis {summary.axis} ({summary.value:.3g} {summary.unit}) is in no term: such a ramp "
        f"changes the bias by {summary.value * hours:.3g} deg/h from the calibration to the "
        "section. Log after the warm-up, or add it to bias and drift."
        for summary in summaries
        if (summary.symbol, summary.status) == ("R", "observed")
    ]


def _make_notes(
    product: xr.Dataset,
    terms: Iterable[SurveyTerm],
    section: float,
    diagnosis: Mapping[str, Any] | None,
) -> list[str]:
    notes = []
    longest = float(product["tau"].max())
    if section > longest:
        notes.append(
            f"The drift of a section of {section:g} s is extrapolated: the longest averaging time "
            f"of the product is {longest:g} s."
        )
    if missing := [term.code for term in terms if math.isnan(term.value)]:
        notes.append(
            f"Not observable and not exported: {', '.join(missing)}; a longer window (--window) "
            "may show B and K."
        )
    if failing := [fit.axis for fit in summarise_fit(product) if fit.fails]:
        notes.append(f"The noise terms do not describe all windows of {', '.join(failing)}.")
    if diagnosis is None:
        notes.append("Without a diagnosis there are no g-dependent terms.")
        return notes
    limits = diagnosis["not_found"].get("g_sensitivity")
    if limits and limits["upper_limit"] is None:
        notes.append(f"The diagnosis has no g-dependent terms: {limits['reason']}.")
    effects = diagnosis["effects"]
    if other_effects := sorted({effect["name"] for effect in effects} - {"g_sensitivity"}):
        notes.append(f"No term covers what else the diagnosis found: {', '.join(other_effects)}.")
    rivals = {name for e in effects if e["name"] == "g_sensitivity" for name in e["alternatives"]}
    if rivals:
        notes.append(
            f"The g-dependent terms may also be due to {', '.join(sorted(rivals))}: the record "
            "cannot tell them apart."
        )
    return notes
