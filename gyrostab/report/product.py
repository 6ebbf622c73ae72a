"""One self-contained HTML page of a product: summary, coefficients, figures, gaps and notes."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from gyrostab.allan.variance import variance_name
from gyrostab.diagnose.result.diagnosis import Diagnosis
from gyrostab.errors import SchemaError
from gyrostab.ingest.convert import as_log
from gyrostab.noise import LAWS
from gyrostab.plot.style import axis_names, encode_png, unit_symbol
from gyrostab.report.charts import page_text
from gyrostab.report.product_charts import product_charts, window_data
from gyrostab.schema import GAP_CAUSES, check_product, describe_times, texts, with_axis
from gyrostab.store.output import new_output
from gyrostab.time.durations import format_duration
from gyrostab.wording import format_rounded, format_share

if TYPE_CHECKING:
    from gyrostab.allan.summary import TermSummary

_MAX_GAPS_LISTED = 20


def write_report(
    product: xr.Dataset,
    path: str | os.PathLike[str],
    *,
    log: xr.Dataset | None = None,
    overwrite: bool = False,
    plotly: str = "",
) -> Path:
    """Write a report on a product as one self-contained HTML file.

    Parameters
    ----------
    product : xarray.Dataset
        What `gyrostab.fit_noise` returns or `gyrostab.open_product` opens.
    path : path-like
        File to write.
    log : xarray.Dataset, optional
        Log from which the product was computed; adds the signal and the gaps to the report.
    overwrite : bool
        Replace an existing file.
    plotly : str
        Address of plotly.js, relative to the page, for many pages that share it; such a page has no
        static figures. By default the page holds all that it needs.

    Returns
    -------
    pathlib.Path
        The file.

    Raises
    ------
    SchemaError
        If `product` is not a product, or `log` is not a log or one of another time.
    OutputError
        If the file exists or cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> from gyrostab import davar, fit_noise, make_log
    >>> log = make_log(np.random.default_rng(1).standard_normal(6000), rate=100.0, unit="deg/h")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = write_report(fit_noise(davar(log, window="20s")), folder + "/report.html")
    ...     path.name, "plotly" in path.read_text(encoding="utf-8")
    ('report.html', True)
    """
    if isinstance(product, Diagnosis):
        raise SchemaError(
            "this is a diagnosis, not a product; gyrostab.write_diagnosis writes its report"
        )
    product = with_axis(product)
    check_product(product)
    if log is not None:
        log = as_log(log)
        times, windows = log["time"][[0, -1]].values, product["time"][[0, -1]].values
        if windows[1] < times[0] or times[1] < windows[0]:
            raise SchemaError(f"the log holds no window: {describe_times(log, product)} (--log)")
    from gyrostab.allan.judgement import judge_product
    from gyrostab.allan.summary import describe_spread, summarise_terms

    terms = summarise_terms(product)
    axes = dict.fromkeys(term.axis for term in terms)
    table = [(axis, [term for term in terms if term.axis == axis]) for axis in axes]
    gaps = None if log is None or "gap_start" not in log.variables else _list_gaps(log)
    with new_output(path, overwrite=overwrite) as temporary:
        text = page_text(
            "product.html.jinja",
            title="Gyro stability report",
            summary=_summarise_record(product),
            variance=variance_name(product),
            judgement=judge_product(product),
            findings=_describe_findings(product, table),
            facts=_list_facts(product),
            table=table,
            is_single=product.sizes["time"] == 1,
            spread=partial(describe_spread, product),
            laws=LAWS,
            number=_number_text,
            share=format_share,
            unit=unit_symbol,
            charts={chart.name: chart for chart in product_charts(product, log)},
            window_data=window_data(product),
            figures=[] if plotly else _make_figures(product, log),
            plotly=plotly,
            gaps=gaps,
            gap_summary=_summarise_gaps(log, gaps) if log is not None and gaps else "",
            notes="\n".join(texts(product, "notes")).splitlines(),
            history="\n".join(texts(product, "history")).splitlines(),
        )
        temporary.write_text(text, encoding="utf-8")
    return Path(path)


def _stamp_text(time: Any) -> str:
    return str(np.datetime_as_string(np.datetime64(time, "ns"), unit="s")).replace("T", " ")


def _record_span(product: xr.Dataset) -> tuple[Any, Any]:
    """Find the first and last time that any window covers."""
    if "time_bounds" in product.variables:
        bounds = product["time_bounds"].values
        return bounds.min(), bounds.max()
    half = np.timedelta64(int(float(product.attrs.get("window_s", 0.0)) * 5e8), "ns")
    return product["time"].values[0] - half, product["time"].values[-1] + half


def _number_text(value: float) -> str:
    return "–" if not np.isfinite(value) else format_rounded(value, 3)


def _missing_shares(product: xr.Dataset) -> dict[str, float]:
    coverage = product["window_coverage"]
    return {name: 1.0 - float(coverage.sel(axis=name).mean()) for name in axis_names(product)}


def _file_names(product: xr.Dataset) -> list[str]:
    return [Path(name).name for name in texts(product, "source_files")]


def _summarise_record(product: xr.Dataset) -> str:
    start, end = _record_span(product)
    axes = axis_names(product)
    files = _file_names(product)
    origin = f" from {len(files)} file{'s' if len(files) != 1 else ''}" if files else ""
    rate = product.attrs.get("sampling_rate_hz")
    speed = f" at {float(rate):g} Hz" if rate is not None else ""
    axis_text = f"{len(axes)} gyro {'axes' if len(axes) != 1 else 'axis'} ({', '.join(axes)})"
    length = format_duration(float((end - start) / np.timedelta64(1, "s")), " ")
    windows = product.sizes["time"]
    return (
        f"{axis_text}{speed}{origin}, {length} from {_stamp_text(start)} to {_stamp_text(end)} "
        f"UTC, analysed in {windows} window{'s' * (windows != 1)}."
    )


def _describe_findings(
    product: xr.Dataset, table: list[tuple[str, list[TermSummary]]]
) -> list[str]:
    from gyrostab.allan.summary import describe_record

    lines = []
    for axis, terms in table:
        medians = [
            f"{term.symbol} = {_number_text(term.median)} {unit_symbol(term.unit)}"
            + f" (observed in {format_share(term.observed_share)} of the windows only)"
            * (term.observed_share < 0.5)
            for term in terms
            if np.isfinite(term.median)
        ]
        text = (
            f"Axis {axis}{', medians' * (product.sizes['time'] > 1)}: {', '.join(medians)}."
            if medians
            else f"Axis {axis}: no coefficient is observed in any window."
        )
        lines.append(text)
    missing = {axis: share for axis, share in _missing_shares(product).items() if share > 0.0}
    if missing:
        lines.append(
            "Missing samples, mean over the windows: "
            + ", ".join(f"axis {axis} {format_share(share)}" for axis, share in missing.items())
            + "."
        )
    else:
        lines.append("No sample is missing in any window.")
    return [*lines, *describe_record(product)]


def _list_facts(product: xr.Dataset) -> list[tuple[str, str]]:
    attrs = product.attrs
    start, end = _record_span(product)
    tau = product["tau"].values
    shortest, longest = (format_duration(float(tau[end]), " ") for end in (0, -1))
    missing = (f"{axis}: {format_share(share)}" for axis, share in _missing_shares(product).items())
    facts = [
        ("Files", ", ".join(_file_names(product)) or "not recorded"),
        ("Span (UTC)", f"{_stamp_text(start)} to {_stamp_text(end)}"),
        ("Axes", ", ".join(axis_names(product))),
        ("Missing samples", ", ".join(missing)),
        ("Averaging times", f"{tau.size}, from {shortest} to {longest}"),
        ("Windows", str(product.sizes["time"])),
    ]
    facts += [
        (label, format_duration(float(attrs[name]), " "))
        for name, label in (("window_s", "Window"), ("step_s", "Step"))
        if name in attrs
    ]
    if "sampling_rate_hz" in attrs:
        facts.append(("Sampling rate", f"{float(attrs['sampling_rate_hz']):g} Hz"))
    if "kind" in attrs:
        facts.append(("Kind of signal", str(attrs["kind"]).replace("_", " ")))
    labels = ("no estimate", "from complete differences", "from incomplete (weighted) clusters")
    estimator = product["estimator"].values
    shares = [
        f"{label}: {format_share(float(np.mean(estimator == number)))}"
        for number, label in enumerate(labels)
    ]
    return [*facts, ("Cells of the surface", ", ".join(shares))]


def _list_gaps(log: xr.Dataset) -> list[dict[str, Any]]:
    """List the longest gaps in order of time."""
    samples = np.asarray(log["gap_samples"].values)
    chosen = np.sort(np.argsort(-samples, kind="stable")[:_MAX_GAPS_LISTED])
    causes = str(log["gap_cause"].attrs.get("flag_meanings", " ".join(GAP_CAUSES))).split()
    rate = float(log.attrs["sampling_rate_hz"])
    return [
        {
            "start": _stamp_text(log["gap_start"].values[i]),
            "end": _stamp_text(log["gap_end"].values[i]),
            "length": format_duration(float(samples[i]) / rate, " "),
            "samples": f"{int(samples[i]):,}".replace(",", " "),
            "cause": causes[int(log["gap_cause"].values[i])].replace("_", " "),
        }
        for i in chosen
    ]


def _summarise_gaps(log: xr.Dataset, gaps: list[dict[str, Any]]) -> str:
    total = log.sizes["gap"]
    seconds = float(log["gap_samples"].sum()) / float(log.attrs["sampling_rate_hz"])
    missing = format_duration(seconds, " ")
    shown = f" The table lists the {len(gaps)} longest." if total > len(gaps) else ""
    return f"{total} gap{'s' if total != 1 else ''}, {missing} in total.{shown}"


def _make_figures(product: xr.Dataset, log: xr.Dataset | None) -> list[dict[str, str]]:
    from gyrostab.plot import plot_adev, plot_coefficients, plot_davar, plot_signal

    variance = variance_name(product)
    change = f"Change of the dynamic {variance} deviation"
    window = f"{variance} deviation of one window"
    figures = [] if log is None else [("signal", plot_signal(log), "Signal as recorded")]
    figures += [
        ("coefficients", plot_coefficients(product), "Noise coefficients over time"),
        ("davar", plot_davar(product), f"Dynamic {variance} deviation"),
        ("change", plot_davar(product, relative=True), change),
        *(
            ("adev", plot_adev(product, axis), f"{window}, axis {axis}")
            for axis in axis_names(product)
        ),
    ]
    return [{"png": encode_png(figure), "name": name, "alt": alt} for name, figure, alt in figures]
