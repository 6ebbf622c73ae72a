"""The whole analysis of the shipped log: warm-up, rest, vibration, and rest again."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr

from gyrostab.allan.summary import TermSummary, summarise_terms
from gyrostab.errors import OutputError
from gyrostab.jobs.load import count_axis_samples, load_log
from gyrostab.progress import Stage, no_stage

WINDOW, STEP = "4h", "30min"
#: Parts of the record, which ``data/models/demo.toml`` describes: begin and end [h].
PARTS = {"warm-up": (0, 6), "rest": (6, 12), "vibration": (12, 18), "rest again": (18, 24)}
FILES = (
    "product.nc",
    "log.nc",
    "report.html",
    "signal.png",
    "davar.png",
    "davar_3d.png",
    "coefficients.png",
)
_DPI = 200


def sample_log(name: str = "mwd_sample.csv.gz") -> Path:
    """Find a shipped log: inside an installed package, or in ``data/`` of a source tree.

    Parameters
    ----------
    name : {"mwd_sample.csv.gz", "mwd_day.csv.gz"}
        A quarter of an hour on a shaker at 100 Hz, or the day of the demo at 2 Hz.

    Examples
    --------
    >>> sample_log().name
    'mwd_sample.csv.gz'
    """
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "data", package.parent / "data"):
        path = folder / name
        if path.exists():
            return path
    raise OutputError(f"the file {name} is missing from {package / 'data'}; install gyrostab again")


def summarise(product: xr.Dataset) -> pd.DataFrame:
    """Tabulate the coefficients of each part, over the windows inside it.

    The table has one row per axis and term: axis, term, unit, and one column of text per part. The
    text is the median if most windows observe the term, else ``< x`` with the median upper limit.
    """
    begin, end = (
        (product["time_bounds"].values[:, side] - product["time_bounds"].values.min())
        / np.timedelta64(1, "h")
        for side in (0, 1)
    )
    rows: dict[tuple[str, str], dict[str, str]] = {}
    for name, (first, last) in PARTS.items():
        inside = np.flatnonzero((begin >= first) & (end <= last))
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


def format_summary(product: xr.Dataset) -> str:
    """Format the table of `summarise` as text, with sentences of judgement below."""
    from gyrostab.allan.judgement import judge_product

    table = summarise(product).to_string(index=False, justify="right")
    return (
        f"Noise coefficients, medians over the windows of {WINDOW} wholly in each part "
        f"(< x: upper limit, 95 %)\n\n{table}\n\n" + "\n".join(judge_product(product))
    )


def run_demo(
    folder: str | Path, *, overwrite: bool = False, stage: Stage = no_stage
) -> tuple[xr.Dataset, list[Path]]:
    """Run the whole analysis on the shipped log; return the product, and the files written.

    Raises
    ------
    OutputError
        When the folder cannot be written to, or holds one of the files and `overwrite` is not
        given.
    """
    from gyrostab.allan.davar import davar
    from gyrostab.allan.fit import fit_noise
    from gyrostab.io.datasets import to_netcdf
    from gyrostab.plot import plot_coefficients, plot_davar, plot_davar_3d, plot_signal
    from gyrostab.plot.style import save_png
    from gyrostab.report import write_report
    from gyrostab.store.output import check_folder, new_folder, protect_inputs

    folder, path = Path(folder), sample_log("mwd_day.csv.gz")
    with protect_inputs([path]):
        check_folder(folder, FILES, overwrite=overwrite)
        with new_folder(folder, overwrite=overwrite) as temporary:
            stage("reading")
            log = load_log([path])
            to_netcdf(log, temporary / "log.nc")
            stage("drawing the log")  # while another process compiles the fit, on the first run
            save_png(plot_signal(log), temporary / "signal.png", dpi=_DPI)
            stage("computing", count_axis_samples(log))
            surface = davar(log, window=WINDOW, step=STEP).compute()
            stage("fitting")
            product = fit_noise(surface).compute()
            to_netcdf(product, temporary / "product.nc")
            stage("drawing")
            axis = str(product["axis"].values[0])
            for name, figure in (
                ("davar.png", plot_davar(product)),
                ("davar_3d.png", plot_davar_3d(product, axis=axis)),
                ("coefficients.png", plot_coefficients(product)),
            ):
                save_png(figure, temporary / name, dpi=_DPI)
            write_report(product, temporary / "report.html", log=log)
    return product, [folder / name for name in FILES]
