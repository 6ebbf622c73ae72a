"""Simulate the papers' experiments, all or those named; write docs/seeds.md and its figures."""

import re
import sys
import time
import tomllib
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np

import gyrostab
from gyrostab.plot.style import save_png
from tests.support.published import fit_deviations, published_davar

ROOT = Path(__file__).resolve().parents[2]
PLAN = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))


def simulate(name, run):
    """Make the log of a model, with the changes of this run, and cut out its stretch of time."""
    model = tomllib.loads(Path(ROOT, "data", "models", f"{name}.toml").read_text(encoding="utf-8"))
    effects = [
        part for part in model.get("effect", []) if part["name"] not in run.get("without", [])
    ]
    model["effect"] = [part | run.get("effects", {}).get(part["name"], {}) for part in effects]
    log = gyrostab.simulate(model, seed=PLAN["seed"])
    first, last = (
        round(run.get(edge, 0) * log.attrs["sampling_rate_hz"]) or None for edge in ("from", "to")
    )
    return log.isel(time=slice(first, last))


def analyse(log, run):
    """Go from the log to noise coefficients, and note the processor time of the surface."""
    log, began = log.compute(), time.process_time()
    davar = published_davar if "method" in run["davar"] else gyrostab.davar
    surface = davar(log, **run["davar"]).assign(windows=lambda made: made.sizes["time"])
    surface = surface.assign(seconds=time.process_time() - began).compute()
    if run.get("fit") == "deviations":
        return fit_deviations(surface)
    return gyrostab.fit_noise(surface, **{"observed_only": False, **run.get("fit", {})})


def number(entry, products):
    """Find one number of the table by run, variable, axis, averaging time and time."""
    product = products[entry["run"]].sel(tau=entry.get("tau", 1.0), method="nearest")
    product = product.sel(axis=entry["axis"]) if "axis" in entry else product.isel(axis=0)
    begin, end = (
        (product["time_bounds"] - product["time_bounds"].min()) / np.timedelta64(1, "s")
    ).values.T
    inside = (begin > entry.get("from", 0) - 1e-6) & (end < entry.get("to", np.inf) + 1e-6)
    inside &= np.any(
        [(begin < at) & (at < end) for at in entry.get("across", [begin + 1e-6])], axis=0
    )
    product, over = (
        product.assign(adev=product["avar"].clip(0) ** 0.5).isel(time=inside),
        getattr(np, entry.get("over", "nanmedian")),
    )
    if entry["of"] + "_upper" in product:
        is_observed = product["observable"].sel(term=entry["of"]) == 2
        if not is_observed.any() or (over is np.nanmedian and is_observed.mean() < 0.5):
            return f"< {float(np.nanmedian(product[entry['of'] + '_upper'])):.3g}"
        return f"{float(over(product[entry['of']].where(is_observed))):.4g}"
    return f"{float(over(product[entry['of']])):.4g}"


def lines(head, rows):
    """Write a table."""
    texts = (
        [f"{cell:.4g}" if isinstance(cell, float) else cell for cell in row]
        for row in [head, ["---"] * len(head), *rows]
    )
    return "\n".join(f"| {' | '.join(row)} |" for row in texts)


def experiment(name, figures):
    """Run one experiment, draw its figures, and return its table with the numbers of the paper."""
    entry = PLAN["experiment"][name]
    logs = {run: simulate(name, options) for run, options in entry["run"].items()}
    products = {run: analyse(logs[run], options) for run, options in entry["run"].items()}
    for file, options in entry.get("figure", {}).items():
        shown = (logs if options["draw"] == "plot_signal" else products)[options["run"]]
        drawn = getattr(gyrostab, options["draw"])(shown, **options.get("with", {}))
        save_png(drawn, figures / f"seeds-{file}.png", **PLAN["figures"])
    head, rows = (
        entry["columns"],
        [(label, row, iter(row.get("paper", []))) for label, row in entry["rows"].items()],
    )
    cells = [
        [
            label,
            *(next(printed, "") if "paper" in to else number(row | to, products) for to in head),
        ]
        for label, row, printed in rows
    ]
    return lines(["", *(column["title"] for column in head)], cells)


def fill(page, name, text):
    """Put a table between the marks of its name."""
    return re.sub(
        rf"(<!-- {name}: begin -->\n).*?(<!-- {name}: end -->)",
        lambda marks: f"{marks[1]}{text}\n{marks[2]}",
        page,
        flags=re.S,
    )


if __name__ == "__main__":
    page = ROOT / "docs" / "seeds.md"
    for chosen in sys.argv[1:] or PLAN["experiment"]:
        made = experiment(chosen, page.parent / "figures")
        page.write_text(fill(page.read_text(encoding="utf-8"), chosen, made), encoding="utf-8")
