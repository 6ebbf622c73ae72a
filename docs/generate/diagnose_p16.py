"""Diagnose the simulated vibration experiment of P16; write table and figure of the page."""

import re
import sys
import tomllib
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np

import gyrostab
from gyrostab.plot.style import save_png
from gyrostab.report.diagnosis_charts import draw_change
from gyrostab.report.static import draw_static
from tests.support.published import fit_deviations


def published(log, plan):
    """Fit the five terms as the paper does; return their medians over still and shaken windows."""
    product = fit_deviations(gyrostab.davar(log, **plan["davar"]))
    seconds = (product["time"] - log["time"][0]) / np.timedelta64(1, "s")
    parts = {
        name: product.isel(time=((seconds > low) & (seconds < high)).values)
        for name, (low, high) in plan["parts"].items()
    }
    return {
        name: {term: part[term].median("time").to_series() for term in plan["terms"]}
        for name, part in parts.items()
    }


def experiment(plan, folder):
    """Simulate the recording, and diagnose it against each of the simulations of the plan."""
    tables = tomllib.loads((folder / plan["model"]).read_text(encoding="utf-8"))
    for name, changed in plan.get("change", {}).items():
        tables[name] = tables[name] | changed if isinstance(changed, dict) else changed
    log = gyrostab.simulate(tables, seed=plan["seed"]).compute()
    five = {"noise": tables["noise"]}
    against = {name: five if run.get("five_terms") else None for name, run in plan["run"].items()}
    return log, {
        name: gyrostab.diagnose(log, simulation=model, nulls=plan["nulls"])
        for name, model in against.items()
    }


def sizes(effect):
    """Write what an effect measures, with its 95 % interval."""
    entries = effect["parameters"].items()
    return "; ".join(
        f"{name} {entry['value']:.3g} ({entry['low']:.3g} to {entry['high']:.3g}) {entry['unit']}"
        for name, entry in entries
    )


def found(runs):
    """Table of the effects that every run names."""
    rows = [["against", "verdict", "named", "axes", "size, 95 %", "evidence, nats", "alternatives"]]
    for name, run in runs.items():
        for effect in run.effects or [{}]:
            gain = effect["held_out_gain"] if effect else {"nats": 0.0, "threshold": 0.0}
            cells = [
                effect.get("name", "nothing"),
                ", ".join(effect.get("axes", [])),
                sizes(effect) if effect else "",
            ]
            others = ", ".join(effect.get("alternatives", [])) or "none"
            rows.append(
                [
                    name,
                    run.verdict,
                    *cells,
                    f"{gain['nats']:.3g}, threshold {gain['threshold']:.2g}",
                    others,
                ]
            )
    return lines(rows)


def proof(runs):
    """Table of what the effects are worth on time held out."""
    rows = [
        [
            "against",
            "misfit before",
            "after",
            "inside 95 % before",
            "after",
            "forecast of the last 30 % [nats]",
        ]
    ]
    for name, run in runs.items():
        held = run.content["held_out"]
        shares = [
            held[f"{measure}_{when}"]
            for measure in ("misfit", "coverage95")
            for when in ("before", "after")
        ]
        gain = held["forecast_gain"]  # None where no effect acts before and after 70 %
        forecast = "none" if gain is None else f"{gain:.3g}"
        rows.append([name, *(f"{share:.3g}" for share in shares), forecast])
    return lines(rows)


def lines(rows):
    """Write a table."""
    return "\n".join(
        f"| {' | '.join(row)} |" for row in [rows[0], ["---"] * len(rows[0]), *rows[1:]]
    )


if __name__ == "__main__":
    plan_file = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_suffix(".toml")
    plan, folder = tomllib.loads(plan_file.read_text(encoding="utf-8")), plan_file.parent
    log, runs = experiment(plan, folder)
    medians = [
        [part, *(f"{fit[term]['x']:.3g}" for term in plan["terms"])]
        for part, fit in published(log, plan).items()
    ]
    made = {
        "found": found(runs),
        "proof": proof(runs),
        "fit": lines([["axis x", *plan["terms"]], *medians]),
    }
    page = folder / plan["page"]
    for name, text in made.items():
        pattern, put = (
            rf"(<!-- {name}: begin -->\n).*?(<!-- {name}: end -->)",
            rf"\g<1>{text}\n\g<2>",
        )
        page.write_text(
            re.sub(pattern, put, page.read_text(encoding="utf-8"), flags=re.S), encoding="utf-8"
        )
    drawn = runs[plan["drawn"]]
    picture = draw_static(draw_change(drawn.surfaces, drawn.content))
    save_png(picture, folder / plan["figure"], **plan["figures"])
    print(*runs.values(), sep="\n\n")
