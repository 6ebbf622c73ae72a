"""The main job, composed of the stages: logs -> regular log -> dynamic Allan variance -> coefficients -> NetCDF."""

from __future__ import annotations

import math
import tempfile
import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import xarray as xr

from gyrostab.errors import OptionError, OutputError
from gyrostab.progress import Stage, no_stage

__all__ = ["check_output", "check_windows", "load_log", "run", "samples_of"]


def check_output(path: str | Path, *, suffixes: Sequence[str] = (), overwrite: bool = False, inputs: Iterable[str | Path] = ()) -> Path:
    """Make sure, before the long work starts, that a result can be written.

    Parameters
    ----------
    path : str or Path
        File (or Zarr folder) to be written.
    suffixes : sequence of str
        Endings that the stage can write, with the dot; empty for any.
    overwrite : bool
        Whether an existing output may be replaced.
    inputs : iterable of path
        Files that are read, which the output must not replace.

    Returns
    -------
    Path
        The path.

    Raises
    ------
    OptionError
        When the name has the wrong ending, or is an input.
    OutputError
        When the output exists and `overwrite` is not given, or its folder cannot be written to.

    Examples
    --------
    >>> check_output("product.txt", suffixes=[".nc"])
    Traceback (most recent call last):
    gyrostab.errors.OptionError: output 'product.txt' must end in .nc; give another name with -o
    """
    path = Path(path)
    if suffixes and path.suffix.lower() not in suffixes:
        raise OptionError(f"output {str(path)!r} must end in {' or '.join(suffixes)}; give another name with -o")
    if any(Path(item).resolve() == path.resolve() for item in inputs):
        raise OptionError(f"output {str(path)!r} is also an input and would be destroyed; give another name with -o")
    if path.is_dir() and path.suffix.lower() != ".zarr":
        raise OutputError(f"output {str(path)!r} is a directory; give another name with -o")
    if path.is_file() and path.suffix.lower() == ".zarr":
        raise OutputError(f"output {str(path)!r} is a file, and Zarr needs a directory; give another name with -o")
    if path.exists() and not overwrite:
        raise OutputError(f"output {str(path)!r} exists already; give --overwrite to replace it, or another name with -o")
    try:
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise OutputError(f"output {str(path)!r}: nothing can be written in {str(path.parent)!r} ({error.strerror})") from error
    return path


def load_log(paths: Sequence[str | Path], *, max_gap: str = "10D", **reading: Any) -> xr.Dataset:
    """Read logs in any format and put them on a uniform time axis.

    Parameters
    ----------
    paths : sequence of path
        Files, in any order; NetCDF and Zarr logs that gyrostab wrote are joined as they are, without loading them.
    max_gap : str
        Longest gap; a longer step of the stamps is taken for a step of the clock.
    **reading
        Options of `gyrostab.read.read_log`: ``rate``, ``start``, ``epoch``, ``map``, ``unit``, ``kind``, ``channel``,
        ``strict``, ``on_file``.

    Returns
    -------
    xarray.Dataset
        Log of `gyrostab.schema`.
    """
    from gyrostab.read import read_log
    from gyrostab.regularise import regularise
    from gyrostab.regularise.notes import describe_channels

    log = read_log(paths, max_gap=max_gap, **reading)
    if "sampling_rate_hz" not in log.attrs:
        log = regularise(log, rate=reading.get("rate"), max_gap=max_gap)
        said = "; ".join(f"{name}: {_said(value)}" for name, value in reading.items() if value and name != "on_file")
        if said:
            log.attrs["history"] += f" (read with {said})"
    elif reading.get("channel"):
        log = log.assign_attrs(notes=[*log.attrs.get("notes", []), *describe_channels(log)])
    for note in log.attrs.get("notes", []):
        warnings.warn(note, stacklevel=2)
    return log


def _said(value: Any) -> str:
    """An option in one line."""
    if isinstance(value, Mapping):
        return ", ".join(f"{left}={right}" for left, right in value.items())
    return ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)


def check_windows(*, window: str, step: str | None = None, taus: str = "40", tau_max: str | None = None, **other: Any) -> None:
    """Make sure, before the long work starts, that the lengths of time can be read at all.

    Parameters
    ----------
    window, step, taus, tau_max : str
        Options of `gyrostab.davar.davar`, as text; others are passed over.

    Raises
    ------
    OptionError
        When one of them is no length of time, or the step or an averaging time is too long for the window.

    Examples
    --------
    >>> check_windows(window="10", step="1min")
    Traceback (most recent call last):
    gyrostab.errors.OptionError: window '10' has no unit; write for instance 10s, 10min or 10samples
    """
    from gyrostab.windows import averaging_factors, duration_seconds, samples

    fine = 1e6  # Hz; the true rate is not known yet
    length, hop = samples(window, fine, "window"), samples(step, fine, "step") if step else 1
    if step and ("sample" in window) == ("sample" in step) and hop > length:
        raise OptionError(f"the step of {step} is longer than the window of {window}, so samples would be left out; give a shorter --step")
    half = None if "sample" in window else length / fine / 2  # how long a number of samples is depends on the rate
    given = [tau_max] if tau_max else []
    if taus.strip().isdigit():
        averaging_factors(taus, rate=fine, window=2)
    elif taus.strip() not in ("octave", "all"):
        given += taus.split(",")
    for tau in given:
        if duration_seconds(tau, "tau") > (half or math.inf):
            raise OptionError(
                f"tau {tau.strip()} is longer than half of the window of {window}, so no second difference fits; "
                "give a longer --window or a shorter tau"
            )


def samples_of(log: xr.Dataset) -> int:
    """Count the samples of a log over all its axes."""
    return int(log.sizes["axis"] * log.sizes["time"])


def run(
    paths: Sequence[str | Path],
    output: str | Path,
    *,
    reading: Mapping[str, Any] | None = None,
    windows: Mapping[str, Any] | None = None,
    fitting: Mapping[str, Any] | None = None,
    overwrite: bool = False,
    stage: Stage = no_stage,
) -> Path:
    """Make the product of some logs and write it as NetCDF, without holding the log in memory.

    Parameters
    ----------
    paths : sequence of path
        Logs.
    output : path
        NetCDF file to be written.
    reading, windows, fitting : mapping
        Options of `gyrostab.read.read_log`, `gyrostab.davar.davar` and `gyrostab.fit.fit_noise`.
    overwrite : bool
        Whether an existing output may be replaced.
    stage : callable
        Told the name of each stage as it begins, and its number of samples.

    Returns
    -------
    Path
        The file written.
    """
    from gyrostab.davar import davar
    from gyrostab.export import to_netcdf
    from gyrostab.fit import fit_noise

    target = check_output(output, suffixes=[".nc"], overwrite=overwrite, inputs=paths)
    check_windows(**(windows or {}))
    stage("reading", 0)
    log = load_log(paths, **(reading or {}))
    stage("computing", samples_of(log))
    surface = davar(log, **(windows or {}))
    to_netcdf(fit_noise(surface, **(fitting or {})), target, overwrite=overwrite)
    stage("checking", 0)
    _note_constant(target)
    return target


def _note_constant(path: Path) -> None:
    """Warn of windows in which an axis never moved: the Allan variance is zero at the shortest and the longest tau."""
    from gyrostab.export import open_product

    with open_product(path) as product:
        still = (product["avar"].isel(tau=[0, -1]) == 0.0).all("tau").compute()
    for axis in still["axis"].values:
        share = float(still.sel(axis=axis).mean())
        if share > 0.0:
            warnings.warn(
                f"gyro axis {axis} is constant in {share:.0%} of the windows: is the sensor stuck, or its column a filler?", stacklevel=2
            )
