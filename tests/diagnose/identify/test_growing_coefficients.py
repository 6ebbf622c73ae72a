"""Growing coefficients of a fit have named causes; changing levels make neither lines nor tails."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import xarray as xr

import gyrostab
from gyrostab.diagnose.identify.identifications import Identifications
from gyrostab.diagnose.identify.selections import Selection
from gyrostab.diagnose.predict.candidates import Candidate, Component, Variant
from gyrostab.diagnose.predict.condition import drop_changed_tails
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.result.tables import identified_mismatches
from gyrostab.diagnose.settings import DEFAULTS
from gyrostab.diagnose.statistics import find_statistic
from gyrostab.ingest.make_log import make_log
from tests.conftest import ROOT
from tests.support.diagnosed import diagnosis
from tests.support.scripts import load_script

SCRIPT = load_script("docs/generate/diagnose_p16.py")
PLAN = tomllib.loads((ROOT / "docs" / "generate" / "diagnose_p16.toml").read_text(encoding="utf-8"))
#: Four minutes of the axes across the vibration, on which the rectified bias is not hidden.
SMALL: dict[str, Any] = {
    "log": {"duration": "240 s", "axes": ["y", "z"]},
    "environment": [
        {
            "profile": "vibration",
            "points": [[0, 0.02], [85, 13.39], [165, 0.02]],
            "band": [700, 800],
        }
    ],
    "effect": [
        {
            "name": "aliased_vibration",
            "axes": ["y", "z"],
            "sensitivity": 0.37,
            "low": 700,
            "high": 800,
        },
        {"name": "vibration_rectification", "sensitivity": 3e-3},
    ],
}


@pytest.fixture(scope="module")
def small() -> tuple[xr.Dataset, gyrostab.Diagnosis]:
    plan = PLAN | {"change": SMALL, "nulls": 100, "run": {"five": {"five_terms": True}}}
    log, runs = SCRIPT.experiment(plan, ROOT / "docs" / "generate")
    return log, runs["five"]


def test_fit_of_the_paper_shows_growth_in_every_term() -> None:
    along = [
        {"name": "aliased_vibration", "axes": ["x"], "sensitivity": 3.73, "low": 700, "high": 800}
    ]
    tables = {"noise": {"Q": 0.06, "N": 0.006, "B": 0.03, "K": 0.05}, **SMALL, "effect": along}
    tables["log"] = {"rate": 400, "duration": "240 s", "axes": ["x"]}
    log = gyrostab.simulate(tables, seed=1).compute()
    fits = SCRIPT.published(log, PLAN | {"parts": {"still": [5, 80], "shaken": [90, 160]}})
    for term in PLAN["terms"]:
        assert (fits["shaken"][term] > 5.0 * fits["still"][term]).all()


@pytest.mark.slow
def test_growing_coefficients_are_traced_to_their_causes(small) -> None:
    _, diagnosis = small
    named = {
        name for effect in diagnosis.effects for name in (effect["name"], *effect["alternatives"])
    }
    assert {"aliased_vibration", "vibration_rectification"} <= named
    assert named <= {
        "aliased_vibration",
        "vibration_noise",
        "vibration_rectification",
        "g_sensitivity",
    }
    for effect in diagnosis.effects:
        if effect["name"] == "aliased_vibration":
            for axis in effect["axes"]:
                entry = effect["parameters"].get(
                    f"sensitivity.{axis}", effect["parameters"].get("sensitivity")
                )
                assert entry["low"] < 0.37 < entry["high"]
    held = diagnosis.content["held_out"]
    assert held["misfit_before"] > 10.0
    assert held["misfit_after"] == pytest.approx(1.0, abs=0.25)


@pytest.mark.slow
def test_every_effect_explains_a_mismatch(small) -> None:
    _, diagnosis = small
    assert diagnosis.verdict == "explained", str(diagnosis)
    explained = {name for region in diagnosis.mismatches for name in region["explained_by"]}
    assert explained == {effect["name"] for effect in diagnosis.effects}


def test_docs_contain_the_tables_of_the_script() -> None:
    text = (ROOT / "docs" / "diagnosis.md").read_text(encoding="utf-8")
    for name in ("fit", "found", "proof"):
        table = text.split(f"<!-- {name}: begin -->\n")[1].split(f"<!-- {name}: end -->")[0]
        assert table.count("\n") >= 4, "run docs/generate/diagnose_p16.py"
    head = SCRIPT.found({"five": diagnosis()}).splitlines()[0]
    assert head in text
    assert (ROOT / "docs" / "figures" / "diagnosis-p16.png").stat().st_size > 1000


# --------------------------------------------------------------------------------
# a name without a box


def identifications(
    statistic: str, *, line_index: int = -1, evidence_nats: float = 40.0
) -> Identifications:
    shape = np.zeros((1, 1, 40))
    shape[..., 10:20] = 1.0
    variant = Variant({}, ("sensitivity",), shape if statistic == "mean" else shape[..., None])
    component = Component(
        Candidate("shupe", find_statistic(statistic), ("temperature",), (variant,)),
        variant,
        ("y",),
        evidence_nats,
        line_index,
    )
    identification = Selection(
        "shupe",
        ("temperature",),
        ("y",),
        (component, replace(component, evidence_nats=1.0)),
        evidence_nats,
        7.0,
    )
    null = np.sort(np.random.default_rng(1).exponential(1.0, 400))
    state: Any = SimpleNamespace(settings=DEFAULTS)
    examination: Any = SimpleNamespace(null_best=null)
    return Identifications(examination, (identification,), (), state)


def blocks() -> xr.Dataset:
    begin = np.arange(40) * 20.0
    return xr.Dataset(
        {
            "begin": ("block", begin),
            "end": ("block", begin + 20.0),
            "line_frequency": ("line", np.arange(1, 100) * 0.05),
        },
        attrs={"start_ns": 0, "block_s": 20.0, "sampling_rate_hz": 10.0},
    )


@pytest.mark.parametrize(
    ("statistic", "view", "taus"),
    [
        ("mean", "mean", (20.0, 400.0)),
        ("power", "davar", (0.1, 20.0)),
        ("spectral_line", "spectrum", (0.371 / 0.5,) * 2),
    ],
)
def test_effect_without_a_mismatch_gets_one_where_it_acts(
    statistic: str, view: str, taus: tuple[float, float]
) -> None:
    (region,) = identified_mismatches(
        identifications(statistic, line_index=9 if statistic == "spectral_line" else -1),
        blocks(),
        [],
    )
    assert (region["view"], region["axes"], region["explained_by"]) == (view, ["y"], ["shupe"])
    assert (region["tau_min_s"], region["tau_max_s"]) == pytest.approx(taus)
    whole = statistic == "spectral_line"  # a steady line is there all the time
    start, end = ("00:00", "13:20") if whole else ("03:20", "06:40")
    assert region["start"] == f"1970-01-01T00:{start}.000Z"
    assert region["end"] == f"1970-01-01T00:{end}.000Z"
    assert 0.0 < region["p_value"] < 1e-9
    assert "Shupe" in region["statement"]


def test_effect_with_a_mismatch_gets_no_other() -> None:
    known = [{"explained_by": ["shupe"], "axes": ["x", "y"]}]
    assert identified_mismatches(identifications("mean"), blocks(), known) == []
    elsewhere = [known[0] | {"axes": ["x"]}]
    assert len(identified_mismatches(identifications("mean"), blocks(), elsewhere)) == 1


# --------------------------------------------------------------------------------
# levels that change


@pytest.fixture(scope="module")
def noisy_log() -> xr.Dataset:
    """White noise at 50 Hz on two axes, thirty times noisier for 70 s from within a block."""
    rng = np.random.default_rng(3)
    values = rng.standard_normal((2, 30_000))
    values[:, 10_200:13_700] *= 30.0
    return reduce_log(make_log(values, rate=50.0, unit="deg/h"))


def flatten_levels(blocks: xr.Dataset, level: np.ndarray) -> xr.Dataset:
    expected = np.broadcast_to(level[:, None] / 50.0, blocks["power"].shape)
    return xr.Dataset(
        {"spectrum": (("axis", "block", "band"), expected), "frequency": blocks["frequency"]}
    )


def test_one_noisy_block_makes_no_lines(noisy_log) -> None:
    scores = find_statistic("spectral_line").score(
        noisy_log, flatten_levels(noisy_log, np.ones(noisy_log.sizes["block"]))
    )
    assert scores is not None
    assert np.nanmax(scores["z"].values) < 4.8  # of 2 898, of which few are independent


def test_two_levels_in_a_block_make_no_tails(noisy_log) -> None:
    share = (
        np.clip(
            np.minimum(noisy_log["end"], 274.0) - np.maximum(noisy_log["begin"], 204.0), 0.0, None
        ).values
        / noisy_log.attrs["block_s"]
    )
    base = flatten_levels(noisy_log, 1.0 + share * 899.0)
    calm = drop_changed_tails(noisy_log, base["spectrum"].values)
    before, after = (
        find_statistic("sample_counts").score(reduced, base).isel(tau=-1)["ratio"].max()
        for reduced in (noisy_log, calm)
    )
    assert before > 4.0
    assert after < 1.4  # of 324 samples: five standard deviations


def test_common_noise_of_the_model_is_not_a_mismatch(noisy_log) -> None:
    common = np.random.default_rng(4).standard_normal((1, 30_000))
    own = np.random.default_rng(5).standard_normal((2, 30_000))
    shared = reduce_log(make_log(own + common, rate=50.0, unit="deg/h"))
    base = flatten_levels(shared, np.full(shared.sizes["block"], 2.0))
    model = base.assign(
        cross=(("pair", "block", "band"), np.full(shared["cross"].shape, 1.0 / 50.0, complex))
    )
    before, after = (
        np.nanmax(np.abs(find_statistic("cross_spectrum").score(shared, expected)["z"].values))
        for expected in (base, model)
    )
    assert before > 30.0
    assert after < 8.0


@pytest.mark.full
def test_anomalous_samples_count_in_the_held_out_evidence() -> None:
    model = {
        "log": {"axes": ["x"]},
        "noise": {"N": 0.003},
        "effect": [{"name": "spikes", "axes": ["x"], "per_hour": 300.0}],
    }
    diagnosis = gyrostab.diagnose(
        gyrostab.simulate(model, duration="10min", rate=20.0, seed=2).compute(), nulls=100
    )
    (effect,) = diagnosis.effects
    assert effect["name"] == "spikes"
    held = diagnosis.content["held_out"]
    assert held["log_likelihood_gain"] > 0.5 * effect["held_out_gain"]["nats"] > 20.0
