"""Process every recording of real_recordings.toml and write docs/real-recordings.md."""

import os
import shlex
import tempfile
import textwrap
import tomllib
from pathlib import Path

import numpy as np
import pandas as pd

import gyrostab
from gyrostab.units import parse_unit

ROOT = Path(__file__).resolve().parents[2]
PLAN = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))


def pick(value, log, product):
    """Select numbers by name, axis, averaging time, time and level of a channel."""
    if value["of"] == "gaps":
        return gyrostab.gap_table(log).loc[
            lambda gaps: gaps["cause"] == value["cause"], value["column"]
        ]
    if value["of"] == "published":
        table = (
            pd.read_csv(value["file"]).query(value["rows"]).sort_values(["channel", "haar_scale_s"])
        )
        return np.abs(
            product["avar"].values.ravel()
            / (2 * table["haar_wavelet_variance"] * parse_unit("deg/s").factor ** 2)
            - 1
        )
    numbers = {
        **log,
        **product,
        "adev": np.sqrt(product["avar"].sel(tau=value.get("tau", 1.0), method="nearest")),
        "misfit": product["fit_chi2"] / product["fit_dof"],
    }[value["of"]]
    numbers = numbers.sel(axis=value["axis"]) if "axis" in value else numbers
    if "time" not in numbers.dims:
        return numbers
    seconds = (numbers["time"] - log["time"][0]) / np.timedelta64(1, "s")
    numbers = numbers[(seconds >= value.get("from", 0)) & (seconds <= value.get("to", np.inf))]
    return (
        numbers[log[value["where"]] > value["above"] * log[value["where"]].max()]
        if "where" in value
        else numbers
    )


def examine(entry, file):
    """Compute the product, write and open it, and compute every number that the text uses."""
    log = gyrostab.regularise(gyrostab.read_log(entry["files"], **entry["read"]))
    product = gyrostab.fit_noise(gyrostab.davar(log, **entry["davar"]), **entry.get("fit", {}))
    product = gyrostab.open_product(gyrostab.to_netcdf(product, file)).load()
    results = {
        "hertz": log.attrs["sampling_rate_hz"],
        "minutes": np.ptp(log["time"].values) / np.timedelta64(1, "m"),
    }
    results["missing"] = float(log["rate"].isnull().mean())
    for name, value in entry["values"].items():
        numbers = (
            np.divide(*map(results.get, value["ratio"]))
            if "ratio" in value
            else np.asarray(pick(value, log, product))
        )
        scale = value.get("times", 1.0) / (
            parse_unit(value["unit"]).factor if "unit" in value else 1.0
        )
        results[name] = float(getattr(np, value.get("over", "nanmedian"))(numbers)) * scale
    return log, product, results


def refusal(entry):
    """Return what gyrostab answers without any option."""
    try:
        return f"{gyrostab.read_log(entry['files']).sizes['row']} rows"
    except gyrostab.errors.GyrostabError as error:
        return str(error)


def command(entry):
    """Write the same job as a shell command."""
    words = ["gyrostab", "run", *entry["files"], "-o", "product.nc"]
    fit = {
        option.replace("tau_min", "fit_from"): given
        for option, given in entry.get("fit", {}).items()
    }
    for option, given in {**entry["read"], **entry["davar"], **fit}.items():
        texts = (
            [f"{key}={text}" for key, text in given.items()]
            if isinstance(given, dict)
            else np.atleast_1d(given)
        )
        words += [word for text in texts for word in (f"--{option.replace('_', '-')}", str(text))]
    return shlex.join(words)


def break_command(text):
    """Break a command of an indented block before options; 96 columns hold all but long ones."""
    line, *options = text.replace(" --", "\n--").split("\n")
    lines = [line]
    for option in options:
        if len(lines[-1]) + len(option) < 94:
            lines[-1] += f" {option}"
        else:
            lines.append(f"    {option}")
    return " \\\n    ".join(lines)


def describe(name, entry, folder):
    """Process one recording: its table row, its section, and its rows of the temperature table."""
    log, product, results = examine(entry, Path(folder, f"{name}.nc"))
    notes = "".join(
        f"- {note}\n"
        for note in log.attrs["notes"]
        if not any(words in note for words in PLAN["page"]["usual"])
    )
    if "figure" in entry:
        gyrostab.plot_davar(product, axis=entry["figure"]).savefig(
            ROOT / "docs" / "figures" / f"{name}.png", dpi=110
        )
    about = {
        **entry,
        **entry["davar"],
        **results,
        "name": name,
        "axes": ", ".join(log["axis"].values),
        "gaps": log.sizes["gap"],
    }
    about |= {
        "text": entry["text"].format_map(results | {"refusal": refusal(entry)}),
        "command": break_command(command(entry)),
        "notes": notes,
    }
    windows = (
        [gyrostab.fit_noise(gyrostab.davar(log, **entry["follow"]))] if "follow" in entry else []
    )
    cells = [
        row
        for made in windows
        for row in gyrostab.correlation_rows(gyrostab.correlate(made, variables="window_mean"))[::2]
    ]
    followed = "".join(
        f"| {' | '.join([name, *map(row.get, PLAN['page']['follow'])])} |\n" for row in cells
    )
    return (
        PLAN["page"]["row"].format_map(about),
        PLAN["page"]["section"].format_map(about),
        followed,
    )


def wrap(page):
    """Break paragraphs and list items at 120 columns, but no tables, commands or quotes."""
    fixed = ("|", "    ", "#", ">", "!")
    return "\n".join(
        line
        if line.startswith(fixed)
        else textwrap.fill(
            line,
            width=120,
            subsequent_indent="  " if line.startswith("- ") else "",
            break_long_words=False,
            break_on_hyphens=False,
        )
        for line in page.split("\n")
    )


if __name__ == "__main__":
    os.chdir(os.environ.get("GYROSTAB_RECORDINGS", ROOT.parent / "shared" / "recordings"))
    with tempfile.TemporaryDirectory() as folder:
        parts = zip(
            *[describe(name, entry, folder) for name, entry in PLAN["recording"].items()],
            strict=True,
        )
    (ROOT / "docs" / "real-recordings.md").write_text(
        wrap(PLAN["page"]["head"].format(*map("".join, parts))), encoding="utf-8"
    )
