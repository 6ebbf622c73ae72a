"""Diagnose the recordings of diagnose_recordings.toml, all or those named; print a table."""

import os
import sys
import tomllib
from pathlib import Path

import numpy as np

import gyrostab

ROOT, PLAN = (
    Path(__file__).resolve().parents[1],
    tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8")),
)
TAUS = "0.005s,0.01s,0.02s,0.04s,0.08s,0.16s,0.32s,0.5s,1s,5s,10s"


def log_of(name, start=0.0, end=np.inf):
    """Read a recording, from `start` to `end` seconds."""
    entry = PLAN["recording"][name]
    log = gyrostab.regularise(gyrostab.read_log(entry["files"], **entry["read"]))
    rate = log.attrs["sampling_rate_hz"]
    return log.isel(time=slice(round(start * rate), round(min(end * rate, log.sizes["time"]))))


def row(name, diagnosis):
    """Return one row of the table: verdict, and each effect with its axes and evidence."""
    named = [
        f"{effect['name']} ({', '.join(effect['axes'])}): {effect['held_out_gain']['nats']:.0f}"
        for effect in diagnosis.effects
    ]
    coverage = [diagnosis.content["held_out"][f"coverage95_{when}"] for when in ("before", "after")]
    shares = " | ".join(f"{100 * share:.0f} %" for share in coverage)
    return f"| {name} | {diagnosis.verdict} | {'; '.join(named)} | {shares} |"


def halves(name, *, nulls=400):
    """Compare the Allan variance of the second half with simulations fitted to the first half."""
    whole = log_of(name)
    seconds = whole.sizes["time"] / whole.attrs["sampling_rate_hz"]
    first, second = log_of(name, end=seconds / 2), log_of(name, start=seconds / 2)
    diagnosis = gyrostab.diagnose(first, nulls=nulls)
    before = {
        axis: {term: entry["value"] for term, entry in terms.items()}
        for axis, terms in diagnosis.content["baseline"]["noise"].items()
    }
    resets = [effect for effect in diagnosis.model["effect"] if effect["name"] == "feedback_reset"]
    ratio = {}
    for case, given in (
        ("five terms", {"noise": before}),
        ("with resets", {"noise": diagnosis.model["noise"], "effect": resets}),
    ):
        made = gyrostab.simulate(given, like=second, seed=1)
        options = {
            "window": f"{second.sizes['time']}samples",
            "step": f"{second.sizes['time']}samples",
            "taus": TAUS,
        }
        variances = [
            gyrostab.davar(log, **options)["avar"].isel(axis=0, time=0) for log in (second, made)
        ]
        ratio[case] = variances[0].values / variances[1].values
    return variances[0]["tau"].values, ratio


if __name__ == "__main__":
    os.chdir(os.environ.get("GYROSTAB_RECORDINGS", ROOT.parent / "shared" / "recordings"))
    for name in sys.argv[1:] or PLAN["recording"]:
        print(row(name, gyrostab.diagnose(log_of(name))), flush=True)
    for tau, *cases in zip(
        *(lambda taus, ratio: (taus, *ratio.values()))(*halves("fog-blueseis-ramp")), strict=True
    ):
        print(f"| {tau:g} | {' | '.join(f'{value:.2f}' for value in cases)} |")
