"""Tables of a fleet: the files of its archive, its runs, and the effects their diagnoses name."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from gyrostab.io.opening import open_dataset
from gyrostab.jobs.archive import DIAGNOSIS, Archive, LogRun, find_archive, is_fleet, read_diagnosis
from gyrostab.noise import LAWS
from gyrostab.schema import escape_text, texts
from gyrostab.store.output import new_output
from gyrostab.store.remote import full_name, read_bytes, upload_file
from gyrostab.units import DAY, INNER

FILES, RUNS = "files", "runs"  # contents of tables
#: Name of the metadata of a table of this package in a Parquet file.
_METADATA = b"gyrostab"
#: Content -> columns without which a table is not one of this package.
_COLUMNS = {
    FILES: ("file", "base", "bytes", "changed_ns", "options", "is_log", "format", "note"),
    RUNS: ("run", "error", "report"),
}
_EFFECT_COLUMNS = (
    "run", "tool", "start", "effect", "axes", "driver", "evidence [nats]", "parameter", "value",
    "low", "high", "unit",
)  # fmt: skip

_TERMS = tuple(f"{symbol}_" for symbol in LAWS)
TREND_COLUMNS = ("tool", "quantity", "against", "runs", "slope", "low", "high", "p_value")
#: Kendall's test of fewer runs cannot reject at 5 %: its smallest p-value is 2 / n!.
_MIN_TREND_RUNS = 5
#: Largest number of runs in a trend; more are thinned evenly, because every pair has a slope.
_MAX_TREND_RUNS = 1000


def write_table(table: pd.DataFrame, path: Path, *, content: str, overwrite: bool) -> None:
    """Write a table as a Parquet file whose metadata names its content."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    made = pa.Table.from_pandas(table, preserve_index=False)
    made = made.replace_schema_metadata({**(made.schema.metadata or {}), _METADATA: content})
    with upload_file(path) as place, new_output(place, overwrite=overwrite) as temporary:
        pq.write_table(made, temporary)


def read_table(path: Path, *, content: str) -> pd.DataFrame | None:
    """Read a table that `write_table` wrote; None for any other file, and one without rows."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        table = pq.read_table(pa.BufferReader(read_bytes(path)))
    except (OSError, pa.ArrowException):
        return None
    is_own = (table.schema.metadata or {}).get(_METADATA) == content.encode()
    if not is_own or not len(table) or not set(_COLUMNS[content]) <= set(table.column_names):
        return None
    frame: pd.DataFrame = table.to_pandas()
    return frame


def open_archive(paths: Sequence[str | Path], target: Path) -> tuple[Archive, pd.DataFrame | None]:
    """List an archive, or take the files of a table; return the latest table of its files too."""
    known_table = read_table(target / "files.parquet", content=FILES)
    if len(paths) == 1 and Path(paths[0]).suffix.lower() == ".parquet":
        given_table = read_table(Path(paths[0]), content=FILES)
        if given_table is not None:
            is_diagnosis = given_table["format"] == DIAGNOSIS
            files, diagnoses = (
                [Path(name) for name in given_table.loc[part, "file"]]
                for part in (~is_diagnosis, is_diagnosis)
            )
            return Archive(Path(given_table["base"].iloc[0]), files, diagnoses), given_table
    return find_archive(paths), known_table


def is_zarr(target: Path) -> bool:
    """Whether the products of an output are groups of a Zarr store."""
    return target.suffix.lower() == ".zarr"


def product_path(target: Path, name: str) -> Path:
    """Return the path of the product of a run."""
    return target / (name if is_zarr(target) else f"{name}.nc")


def open_fleet(folder: Path) -> xr.Dataset | None:
    """Open the windows of all runs of a fleet, or of those in a folder of it, as one product.

    The surfaces are left out but for the longest averaging time of each run. The result is None if
    `folder` is neither a fleet nor a folder of runs in one.
    """
    folder = Path(full_name(folder))
    root = next((path for path in (folder, *folder.parents) if is_fleet(path)), None)
    rows = {} if root is None else read_fleet_rows(root)
    paths = [product_path(root, name) for name, row in rows.items() if root and not row["error"]]
    products = []
    for path in paths:
        if folder in path.parents:
            with open_dataset(path) as product:
                names = [name for name, item in product.variables.items() if "time" in item.dims]
                products.append(product[names].isel(tau=slice(-1, None)).load())
    if not products:
        return None
    combined = xr.concat(
        products, "time", data_vars="all", join="outer", combine_attrs="drop_conflicts"
    )
    runs = "run" if len(products) == 1 else "runs"
    return combined.assign_attrs(source_files=[f"{len(products)} {runs} of {folder.name}"])


def summarise_run(product: xr.Dataset) -> dict[str, Any]:
    """Summarise a product in one row of a table, whose names of columns end with the unit.

    It has span, rate, windows, share of missing samples, worst window, and by axis the median of
    each term where it is observed (NaN elsewhere), its median upper limit, and the misfit, and the
    median of each temperature.

    Examples
    --------
    >>> from gyrostab import davar, fit_noise, make_log
    >>> noise = 6.0 * np.random.default_rng(1).standard_normal(60_000)
    >>> noise[30_000:36_000] *= 3.0
    >>> log = make_log(noise, rate=100.0, unit="deg/h")
    >>> row = summarise_run(fit_noise(davar(log, window="1min", step="1min")))
    >>> round(row["N_x [deg/sqrt(h)]"], 3), str(row["worst_window"])[11:19]
    (0.01, '00:05:30')
    """
    from gyrostab.allan.summary import summarise_fit, summarise_terms

    bounds = product["time_bounds"].values
    row: dict[str, Any] = {
        "start": bounds.min(),
        "end": bounds.max(),
        "span [s]": float((bounds.max() - bounds.min()) / np.timedelta64(1, "s")),
        "rate [Hz]": float(product.attrs["sampling_rate_hz"]),
        "windows": product.sizes["time"],
        "missing_share": 1.0 - float(product["window_coverage"].mean()),
        "notes": "\n".join(texts(product, "notes")),
        **_find_worst_window(product),
    }
    for term in summarise_terms(product):
        is_limit = term.status == "upper_limit_only"
        name = f"{term.symbol}_{term.axis}"
        row[f"{name} [{term.unit}]"] = np.nan if is_limit else term.value
        row[f"{name}_upper [{term.unit}]"] = term.value if is_limit else np.nan
    for fit in summarise_fit(product):
        row[f"misfit_{fit.axis}"] = fit.chi2_per_dof
    for label, channel in product.data_vars.items():
        if channel.attrs.get("units") == INNER["temperature"]:
            row[f"{label} [degC]"] = float(channel.median())
    return row


def _find_worst_window(product: xr.Dataset) -> dict[str, Any]:
    """Find the window and axis whose Allan deviation is largest, relative to the median window.

    Ratios are averaged over the averaging times on a logarithmic scale, with the equivalent degrees
    of freedom as weights: the variance of the logarithm of an Allan variance is about 2 / edf.
    """
    avar = product["avar"].where(product["avar"] > 0.0)
    logs = avar.copy(data=np.log(avar.values))
    change = logs - logs.median("time")
    level = change.weighted(product["edf"].fillna(0.0)).mean("tau").transpose("axis", "time")
    if not np.isfinite(level.values).any():
        return {"worst_window": np.datetime64("NaT", "ns"), "worst_axis": "", "worst_ratio": np.nan}
    axis, window = np.unravel_index(np.nanargmax(level.values), level.shape)
    return {
        "worst_window": product["time"].values[window],
        "worst_axis": str(product["axis"].values[axis]),
        "worst_ratio": float(np.exp(level.values[axis, window] / 2.0)),
    }


def read_fleet_rows(target: Path) -> dict[str, dict[str, Any]]:
    """Read the rows of the runs of an earlier call, by name."""
    table = read_table(target / "index.parquet", content=RUNS)
    records: Any = [] if table is None else table.to_dict("records")
    return {row["run"]: row for row in records}


def make_table(rows: Mapping[str, Mapping[str, Any]], runs: Sequence[LogRun]) -> pd.DataFrame:
    """Make the table of runs, with their present tools and logs and the verdicts of diagnoses."""
    present = {
        item.name: {"tool": item.tool, "logs": json.dumps([full_name(path) for path in item.files])}
        for item in runs
    }
    diagnosed = {
        item.name: {"verdict": item.verdict, "diagnosis": escape_text(full_name(item.diagnosis))}
        for item in runs
        if item.diagnosis
    }
    without = {"verdict": "", "diagnosis": ""}
    first = ("run", "tool", "error", "files", "start", "end", "span [s]", "rate [Hz]", "windows")
    return pd.DataFrame(
        [
            {
                **dict.fromkeys(first),
                **rows[name],
                **present.get(name, {}),
                **diagnosed.get(name, without),
            }
            for name in sorted(rows)
        ],
        columns=None if rows else list(first),
    )


def list_effects(table: pd.DataFrame) -> pd.DataFrame:
    """List the effects that the diagnoses of runs name.

    `table` has the columns run, tool, start and diagnosis (a folder, or empty). The result has one
    row for each run, effect and parameter: axes, driver, evidence [nats], and value with 95 %
    interval in the unit of the row.
    """
    rows = []
    for run in table.to_dict("records"):
        content = read_diagnosis(Path(run["diagnosis"])) if run["diagnosis"] else None
        for effect in content["effects"] if content else ():
            effect_row = {
                **{name: run[name] for name in ("run", "tool", "start")},
                "effect": effect["name"],
                "axes": " ".join(effect["axes"]),
                "driver": effect["driver"],
                "evidence [nats]": effect["held_out_gain"]["nats"],
            }
            for parameter, size in (effect["parameters"] or {"": {}}).items():
                numbers = {name: size.get(name) for name in ("value", "low", "high", "unit")}
                rows.append({**effect_row, "parameter": parameter, **numbers})
    return pd.DataFrame(rows, columns=list(_EFFECT_COLUMNS))


def find_trends(table: pd.DataFrame, effects: pd.DataFrame) -> pd.DataFrame:
    """Find how coefficients and sizes of effects change with age and temperature, by tool.

    Each run is one point. Theil-Sen slopes and Kendall's rank tests need no
    error of a point and resist outliers.

    Returns
    -------
    pandas.DataFrame
        One row for each tool, quantity and driver (age in days, temperatures) with at least five
        runs: slope with 95 % interval [unit of the quantity per unit of the driver], and p-value
        times the number of rows (Bonferroni).

    References
    ----------
    Sen 1968, doi:10.1080/01621459.1968.10480934.
    """
    from scipy.stats import kendalltau, theilslopes

    done = table[table["error"] == ""]
    columns = list(map(str, done.columns))
    terms = [name for name in columns if name[:2] in _TERMS and "_upper [" not in name]
    sizes = effects.assign(
        quantity=effects["effect"] + " " + effects["parameter"] + " " + effects["axes"]
        + " [" + effects["unit"] + "]"
    ).drop_duplicates(["run", "quantity"], keep=False)  # fmt: skip
    parts = [done.melt("run", terms, "quantity"), sizes[["run", "quantity", "value"]]]
    points = pd.concat([part.astype({"value": float}).dropna() for part in parts])
    start = pd.to_datetime(done["start"])
    drivers = {"age [d]": (start - start.min()).dt.total_seconds() / DAY}
    drivers |= {name: done[name] for name in columns if name.endswith(" [degC]")}
    points = points.merge(done[["run", "tool"]].assign(**drivers), on="run")
    rows = []
    for (tool, quantity), part in points.groupby(["tool", "quantity"]):
        for driver in drivers:
            pairs = part[[driver, "value"]].dropna().to_numpy(float)
            x, y = pairs[:: -(-len(pairs) // _MAX_TREND_RUNS) or 1].T
            if len(np.unique(x)) >= _MIN_TREND_RUNS:
                slope, _, low, high = theilslopes(y, x)
                p_value = kendalltau(x, y).pvalue
                rows.append((tool, quantity, driver, x.size, slope, low, high, p_value))
    trends = pd.DataFrame(rows, columns=list(TREND_COLUMNS))
    return trends.assign(p_value=(trends["p_value"] * len(trends)).clip(upper=1.0))
