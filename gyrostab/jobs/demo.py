"""The whole analysis on the shipped simulated log: a gyro at rest, vibrating, and at rest again."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr

from gyrostab.allan.summary import TermSummary, summarise_terms
from gyrostab.errors import OutputError, SchemaError
from gyrostab.jobs.run import count_samples, load_log
from gyrostab.progress import Stage, no_stage

__all__ = ["find_parts", "format_summary", "run_demo", "sample_log", "summarise"]

WINDOW, STEP = "60s", "10s"
FILES = (
    "product.nc",
    "log.nc",
    "report.html",
    "signal.png",
    "davar.png",
    "davar_3d.png",
    "coefficients.png",
)


def sample_log() -> Path:
    """Find the shipped log: inside an installed package, or in ``data/`` of a source tree.

    Examples
    --------
    >>> sample_log().name
    'mwd_sample.csv.gz'
    """
    here = Path(__file__).resolve().parents[1]
    for folder in (here / "data", here.parent / "data"):
        path = folder / "mwd_sample.csv.gz"
        if path.exists():
            return path
    raise OutputError(
        f"the shipped log mwd_sample.csv.gz is missing from {here / 'data'}; install gyrostab again"
    )


def find_parts(vibration: xr.DataArray) -> dict[str, tuple[pd.Timestamp, pd.Timestamp]]:
    """Find the parts of an on/off vibration test from the vibration channel.

    Parameters
    ----------
    vibration : xarray.DataArray
        Rms acceleration [g] on its own time coordinate.

    Returns
    -------
    dict
        ``still``, ``vibrating`` and ``after``: first and last stamp [UTC] within the part.

    Raises
    ------
    SchemaError
        When the channel never rises, or rises before its first or after its last sample.

    Examples
    --------
    >>> time = pd.date_range("2026-03-14", periods=9, freq="1s")
    >>> parts = find_parts(xr.DataArray([0, 0, 0, 9, np.nan, 9, 0, 0, 0], {"t": time}, ["t"]))
    >>> [str(stamp.time()) for stamp in parts["vibrating"]]
    ['00:00:03', '00:00:05']
    """
    (dim,) = vibration.dims
    known = vibration[np.isfinite(vibration.values)]
    stamps, level = pd.DatetimeIndex(known[dim].values), known.values
    shaken = np.flatnonzero(level > 0.5 * level.max()) if level.size else np.array([], dtype=int)
    if shaken.size == 0 or shaken[0] == 0 or shaken[-1] == level.size - 1:
        raise SchemaError(
            "the channel 'vibration' does not rise and fall again within the log; "
            "no parts can be told apart"
        )
    first, last = int(shaken[0]), int(shaken[-1])
    return {
        "still": (stamps[0], stamps[first - 1]),
        "vibrating": (stamps[first], stamps[last]),
        "after": (stamps[last + 1], stamps[-1]),
    }


def summarise(
    product: xr.Dataset, parts: dict[str, tuple[pd.Timestamp, pd.Timestamp]]
) -> pd.DataFrame:
    """Tabulate the coefficients of each part, over the windows inside it.

    Parameters
    ----------
    product : xarray.Dataset
        Product of `gyrostab.fit_noise`, with the length of its windows in the attribute
        ``window_s``.
    parts : dict
        First and last stamp by name, from `find_parts`.

    Returns
    -------
    pandas.DataFrame
        One row per axis and term: axis, term, unit, and one column of text per part. The text is
        the median if most windows observe the term, else ``< x`` with the median upper limit.
    """
    half = pd.Timedelta(seconds=float(product.attrs["window_s"])) / 2
    centre = pd.DatetimeIndex(product["time"].values)
    rows: dict[tuple[str, str], dict[str, str]] = {}
    for name, (start, end) in parts.items():
        inside = np.flatnonzero((centre - half >= start) & (centre + half <= end))
        for term in summarise_terms(product.isel(time=inside)):
            row = rows.setdefault(
                (term.axis, term.symbol),
                {"axis": term.axis, "term": term.symbol, "unit": term.unit},
            )
            row[name] = _format_term(term)
    return pd.DataFrame(list(rows.values()))


def _format_term(term: TermSummary) -> str:
    if term.status == "not_observable":
        return "-"
    return f"{term.value:.3g}" if term.status == "observed" else f"< {term.value:.2g}"


def format_summary(summary: pd.DataFrame) -> str:
    """Format the table of `summarise` as text."""
    return (
        f"Noise coefficients, medians over the windows of {WINDOW} wholly in each part "
        "(< x: not observable, 95 % upper limit)\n\n"
        + summary.to_string(index=False, justify="right")
    )


def run_demo(
    folder: str | Path, *, overwrite: bool = False, stage: Stage = no_stage
) -> tuple[pd.DataFrame, list[Path]]:
    """Run the whole analysis on the shipped log.

    Parameters
    ----------
    folder : path
        Folder to write to; it is made if it does not exist.
    overwrite : bool
        Whether files of an earlier run may be replaced.
    stage : callable
        Called with the name of each stage and its number of samples.

    Returns
    -------
    pandas.DataFrame, list of Path
        The table of `summarise` and the files written.

    Raises
    ------
    OutputError
        When the folder cannot be written to, or holds one of the files and `overwrite` is not
        given.
    """
    from gyrostab.allan.davar import davar
    from gyrostab.allan.fit import fit_noise
    from gyrostab.io.datasets import to_netcdf
    from gyrostab.report import write_report
    from gyrostab.store.output import check_folder, new_folder, protect_inputs

    folder = Path(folder)
    with protect_inputs([sample_log()]):
        check_folder(folder, FILES, overwrite=overwrite)
        with new_folder(folder, overwrite=overwrite) as temporary:
            stage("reading", 0)
            log = load_log([sample_log()])
            parts = find_parts(log["vibration"])
            to_netcdf(log, temporary / "log.nc")
            stage("computing", count_samples(log))
            product = fit_noise(davar(log, window=WINDOW, step=STEP)).compute()
            to_netcdf(product, temporary / "product.nc")
            stage("drawing", 0)
            _write_outputs(log, product, temporary)
            write_report(product, temporary / "report.html", log=log)
    return summarise(product, parts), [folder / name for name in FILES]


def _write_outputs(log: xr.Dataset, product: xr.Dataset, folder: Path) -> None:
    from gyrostab.plot import plot_coefficients, plot_davar, plot_davar_3d, plot_signal
    from gyrostab.plot.style import save_png

    axis = str(product["axis"].values[0])
    figures = {
        "signal.png": plot_signal(log),
        "davar.png": plot_davar(product),
        "davar_3d.png": plot_davar_3d(product, axis=axis),
        "coefficients.png": plot_coefficients(product),
    }
    for name, figure in figures.items():
        save_png(figure, folder / name, dpi=120)
