"""Export gyro noise for Kalibr and ROS: continuous-time densities in SI units, in a YAML file.

===========================  ================  =========  ====================================
key                          unit              from       factor
===========================  ================  =========  ====================================
gyroscope_noise_density      rad/s/sqrt(Hz)    N          pi / 180 / 60, N in deg/sqrt(h)
gyroscope_random_walk        rad/s^2/sqrt(Hz)  K          pi / 180 / 3600^1.5, K in deg/h^1.5
gyroscope_bias_instability   rad/s             B          pi / 180 / 3600, B in deg/h
accelerometer_noise_density  m/s^2/sqrt(Hz)    N          9.80665 * 60, N in g sqrt(h)
accelerometer_random_walk    m/s^3/sqrt(Hz)    K          9.80665 / 60, K in g/sqrt(h)
update_rate                  Hz                           sampling rate of the log
===========================  ================  =========  ====================================

The accelerometers are channels of the log. Allan variance and fit are homogeneous in the signal, so
that the same functions serve accelerations in g.

Kalibr itself does not use bias instability and ignores its key. The floor of the Allan deviation
lies at 0.664 of it.

References
----------
Kalibr wiki, "IMU Noise Model": the white noise is read off the Allan deviation at 1 s, the random
walk at 3 s.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr

from gyrostab.allan.davar import davar
from gyrostab.allan.fit import fit_noise
from gyrostab.allan.summary import (
    FitSummary,
    TermSummary,
    find_constant_axes,
    summarise_fit,
    summarise_terms,
)
from gyrostab.errors import OptionError, SchemaError
from gyrostab.ingest.convert import as_log
from gyrostab.ingest.make_log import make_log
from gyrostab.ingest.uniform import cut_log
from gyrostab.noise import LAWS
from gyrostab.schema import check_product, describe_times, texts, with_axis
from gyrostab.store.output import new_output
from gyrostab.units import HOUR

_GRAVITY = 9.80665  # m/s^2
#: Samples of an accelerometer that are read at a time.
_SAMPLES_READ = 2**22
#: Key -> symbol of the term, factor from the unit of the field, unit of Kalibr.
KEYS = {
    "gyroscope_noise_density": ("N", math.pi / 180.0 / 60.0, "rad/s/sqrt(Hz)"),
    "gyroscope_random_walk": ("K", math.pi / 180.0 / HOUR**1.5, "rad/s^2/sqrt(Hz)"),
    "gyroscope_bias_instability": ("B", math.pi / 180.0 / HOUR, "rad/s"),
}
#: The same for accelerations in g.
ACCELEROMETER_KEYS = {
    "accelerometer_noise_density": ("N", _GRAVITY * math.sqrt(HOUR), "m/s^2/sqrt(Hz)"),
    "accelerometer_random_walk": ("K", _GRAVITY / math.sqrt(HOUR), "m/s^3/sqrt(Hz)"),
}
_ACCELEROMETER_NAMES = {
    "accelerometer_noise_density": "velocity random walk",
    "accelerometer_random_walk": "acceleration random walk",
}


def convert_terms(
    product: xr.Dataset, keys: Mapping[str, tuple[str, float, str]]
) -> dict[str, dict[str, TermSummary]]:
    """Find axis -> key of `keys` -> term of a product, with median and limit in units of Kalibr."""
    by_symbol = {symbol: (key, factor) for key, (symbol, factor, _) in keys.items()}
    terms_by_axis: dict[str, dict[str, TermSummary]] = {}
    for term in summarise_terms(product):
        if term.symbol in by_symbol:
            key, factor = by_symbol[term.symbol]
            converted = replace(term, median=term.median * factor, limit=term.limit * factor)
            terms_by_axis.setdefault(term.axis, {})[key] = converted
    return {axis: {key: terms[key] for key in keys} for axis, terms in terms_by_axis.items()}


def _fit_accelerometers(log: xr.Dataset, product: xr.Dataset) -> xr.Dataset:
    """Fit the noise of the accelerometers of a log in the windows of a product, in g for deg/h."""
    log = as_log(log)
    rate = float(log.attrs["sampling_rate_hz"])
    sample = np.timedelta64(round(1e9 / rate), "ns")
    bounds = product["time_bounds"].values
    # half a sample, because times are rounded to nanoseconds
    ends = {"time_from": bounds.min() - sample // 2, "time_to": bounds.max() - sample // 2}
    try:
        log = cut_log(log, **ends)
    except OptionError as error:
        raise SchemaError(
            f"the log does not cover the windows of the product: {describe_times(log, product)}"
        ) from error
    names = [
        name
        for name in ("accel_x", "accel_y", "accel_z")
        if name in log and log[name].dims == ("time",)
    ]
    if not names:
        raise SchemaError(
            "the log has no channel accel_x, accel_y or accel_z with the sampling rate of the gyro"
        )
    axes = pd.Index([name[-1] for name in names], name="axis")
    signals = [log[name].chunk(time=_SAMPLES_READ) for name in names]
    accelerations = make_log(
        xr.concat(signals, axes, combine_attrs="drop").data,
        rate=rate,
        start=str(log["time"].isel(time=0).values),
        unit="deg/h",
        axis=list(axes),
    )
    window, step = (f"{product.attrs[name]}s" for name in ("window_s", "step_s"))
    fitted = fit_noise(davar(accelerations, window=window, step=step))
    has_samples = (product["window_coverage"] > 0.0).any("axis").values
    times = product["time"].values[has_samples]
    place = fitted.get_index("time").get_indexer(times, method="nearest", tolerance=sample)
    return fitted.isel(time=place[place >= 0])


def to_kalibr(
    product: xr.Dataset,
    path: str | os.PathLike[str],
    *,
    log: xr.Dataset | None = None,
    overwrite: bool = False,
) -> Path:
    """Write N, K and B as a YAML file for Kalibr.

    The worst axis is at the top, where Kalibr reads, and each axis is below.

    Parameters
    ----------
    product : xarray.Dataset
        What `gyrostab.fit_noise` returns or `gyrostab.open_product` opens, with the attribute
        ``sampling_rate_hz``.
    path : path-like
        The file to write.
    log : xarray.Dataset, optional
        Log of the product with the channels ``accel_x``, ``accel_y`` or ``accel_z`` at the sampling
        rate of the gyro, for the noise of the accelerometers in the windows of the product.
    overwrite : bool
        Replace an existing file.

    Returns
    -------
    pathlib.Path
        The file.

    Raises
    ------
    SchemaError
        When `product` is not a product, or has no sampling rate, or `log` has no accelerometer or
        does not cover the product, or `product` has no attribute ``window_s`` or ``step_s`` for it.
    OutputError
        When the file exists, or cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> from gyrostab import davar, fit_noise, make_log
    >>> log = make_log(np.random.default_rng(1).standard_normal(6000), rate=100.0, unit="deg/h")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = to_kalibr(fit_noise(davar(log, window="20s")), folder + "/imu.yaml")
    ...     print(path.read_text().splitlines()[5])
    update_rate: 100.0  # Hz
    """
    product = with_axis(product)
    check_product(product)
    rate = product.attrs.get("sampling_rate_hz")
    if rate is None:
        raise SchemaError(
            "the product has no attribute 'sampling_rate_hz', which is Kalibr's update_rate; "
            "give it one in Hz"
        )
    for name in ("window_s", "step_s") if log is not None else ():
        if name not in product.attrs:
            raise SchemaError(
                f"the product has no attribute {name!r}, by which windows of the accelerometers "
                f"are made; set it in seconds with .assign_attrs({name}=...)"
            )
    names = [Path(name).name for name in texts(product, "source_files")]
    fitted = {"gyroscope": (product, KEYS)}
    if log is not None:
        fitted["accelerometer"] = (_fit_accelerometers(log, product), ACCELEROMETER_KEYS)
    lines = [
        "# Noise of a gyro for Kalibr: medians over the windows of a dynamic Allan variance, "
        "made by gyrostab",
        f"# from {', '.join(names) or 'a log'}. At the top the worst axis, below each of them.",
        "# null: a longer window (--window) may show the term, if the sensor works.",
        "# Kalibr also asks for rostopic."
        if log is not None
        else "# Kalibr also asks for rostopic, accelerometer_noise_density and "
        "accelerometer_random_walk: give the log too, as log (--log), if it has accelerations.",
        *(_describe_fit(fit) for fit in summarise_fit(product)),
        *(
            f"# {sensor} axis {axis} is constant: its sensor is dead, or its column the wrong one"
            for sensor, (part, _) in fitted.items()
            for axis in find_constant_axes(part)
        ),
        f"update_rate: {float(rate)!r}  # Hz",
    ]
    noise = {sensor: convert_terms(*part) for sensor, part in fitted.items()}
    for sensor, (_, keys) in fitted.items():
        for key in keys:
            worst = _find_worst([values[key] for values in noise[sensor].values()])
            lines += _format_entry(key, worst, indent="")
    lines.append("axes:")
    for axis in dict.fromkeys(axis for values_by_axis in noise.values() for axis in values_by_axis):
        lines.append(f"  {json.dumps(axis)}:")
        for values_by_axis in noise.values():
            for key, value in values_by_axis.get(axis, {}).items():
                lines += _format_entry(key, value, indent="    ")
    with new_output(path, overwrite=overwrite) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return Path(path)


def _describe_fit(fit: FitSummary) -> str:
    """Describe in a comment how well the noise terms fit an axis."""
    if not fit.windows:
        return f"# axis {fit.axis}: no window has a misfit to judge the fit by"
    text = f"# axis {fit.axis}: median chi2/dof {fit.chi2_per_dof:.3g} over {fit.windows} windows"
    if fit.filter_time_constant > 0:
        text += (
            f", fitted from {fit.tau_min:.3g} s on because a filter shapes the noise below; values "
            "are those without the filter"
        )
    if fit.fails:
        text += (
            f"; the noise terms do NOT describe {100 * fit.failing_share:.0f} % of them: "
            "fit again from a longer averaging time, tau_min (--fit-from)"
        )
    return text


def _find_worst(values: list[TermSummary]) -> TermSummary:
    """Find the largest value or limit of any axis; an axis without one is left out."""
    known_values = [value for value in values if not math.isnan(value.value)]
    return max(known_values, key=lambda value: value.value) if known_values else values[0]


def _format_entry(key: str, term: TermSummary, *, indent: str) -> list[str]:
    symbol, _, unit = (KEYS | ACCELEROMETER_KEYS)[key]
    name = _ACCELEROMETER_NAMES.get(key, LAWS[symbol].name)
    comment = {
        "observed": f"{unit}; {symbol}, {name}, "
        f"observed in {100 * term.observed_share:.0f} % of the windows",
        "upper_limit_only": f"{unit}; 95 % UPPER LIMIT of {symbol} ({name}), "
        f"in {100 * term.limited_share:.0f} % of the windows",
        "not_observable": f"{unit}; {symbol}, {name}, not observable in any window",
    }[term.status]
    number = "null" if math.isnan(term.value) else f"{term.value:.6e}"
    return [f"{indent}{key}: {number}  # {comment}", f"{indent}{key}_meaning: {term.status}"]
