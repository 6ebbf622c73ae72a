"""Tables of a fleet: verdicts and effects of the diagnoses of its runs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from gyrostab.jobs.archive import find_archive, find_runs, read_diagnosis
from gyrostab.jobs.fleet_table import find_trends, list_effects
from gyrostab.report.fleet import combine_effects
from tests.support.diagnosed import content


def write_diagnosis(folder: Path, nats: float | None) -> None:
    """A diagnosis that names the noise of vibration, or nothing."""
    made = content() | {"mismatches": []}
    (effect,) = (effect for effect in made["effects"] if effect["name"] == "vibration_noise")
    effect["held_out_gain"]["nats"] = nats
    folder.mkdir(parents=True)
    findings = {
        "effects": [effect] if nats else [],
        "verdict": "explained" if nats else "no mismatch",
    }
    (folder / "diagnosis.json").write_text(json.dumps(made | findings))


def test_effects_of_one_name_are_combined_over_the_runs_of_a_tool(tmp_path):
    names = ["tool/a", "tool/b", "tool/c", "tool/damaged"]
    for name, nats in zip(names, (4.0, 8.5, None, 1.0), strict=True):
        write_diagnosis(tmp_path / name, nats)
    damaged = tmp_path / names[-1] / "diagnosis.json"
    damaged.write_text(damaged.read_text().replace('"nats"', '"gnats"'))
    table = pd.DataFrame({"run": names, "tool": "tool", "start": pd.Timestamp("2026-05-01")})
    table["diagnosis"] = [str(tmp_path / name) for name in names]
    assert read_diagnosis(damaged.parent) is None
    table["verdict"] = ["explained", "explained", "no mismatch", "not readable"]
    effects = list_effects(table)
    assert list(effects["evidence [nats]"]) == [4.0, 8.5]
    (combined,) = combine_effects(effects, table)
    assert combined["seen"] == "2 of 3 diagnosed runs"
    assert combined["evidence"] == "12.5"
    assert combined["sizes"][0] == "tool/a, x: white 0.00045 (0.000405 to 0.000495) deg/sqrt(h)/g"


_OURS = '{"schema": "gyrostab.diagnosis/1", '


@pytest.mark.parametrize(
    "text", [_OURS, _OURS + "[" * 100_000, _OURS + '"recording": {"files": 5}}']
)
def test_a_damaged_diagnosis_is_that_of_the_run_above_it(text, tmp_path):
    table = pd.DataFrame(
        {"file": [str(tmp_path / "a" / "log.nc")], "bytes": 0, "is_log": True, "note": ""}
    )
    (tmp_path / "a" / "found").mkdir(parents=True)
    (tmp_path / "a" / "log.nc").touch()
    (tmp_path / "a" / "found" / "diagnosis.json").write_text(text)
    (run,) = find_runs(find_archive([tmp_path]), table)
    assert run.diagnosis == tmp_path / "a" / "found"
    assert run.verdict == "not readable"


@pytest.mark.parametrize("text", ["{", '{"schema": "hospital/1"}'])
def test_a_diagnosis_of_another_program_hides_no_logs(tmp_path, text):
    (tmp_path / "diagnosis.json").write_text(text)
    (tmp_path / "log.csv").touch()
    archive = find_archive([tmp_path])
    assert not archive.diagnoses
    assert [path.name for path in archive.files] == ["diagnosis.json", "log.csv"]


# ------------------------------------------------------------------------------
# changes with age and temperature


def make_runs(draw: np.random.Generator, count: int = 12) -> pd.DataFrame:
    """Runs of one tool whose N rises by 0.1 a month, and whose B is noise."""
    days = np.sort(draw.uniform(0.0, 360.0, count))
    rows = {
        "run": [f"tool/{number}" for number in range(count)],
        "tool": "tool",
        "error": "",
        "start": pd.Timestamp("2026-01-01") + pd.to_timedelta(days, unit="D"),
        "N_x [deg/sqrt(h)]": 3.0 + days / 300.0 + 0.1 * draw.standard_normal(count),
        "N_x_upper [deg/sqrt(h)]": 1.0,
        "B_x [deg/h]": draw.standard_normal(count),
        "temperature [degC]": 20.0 + draw.standard_normal(count),
    }
    return pd.DataFrame(rows)


def size_rows(table: pd.DataFrame, values: np.ndarray) -> pd.DataFrame:
    known = {"effect": "bias", "parameter": "value", "axes": "x", "unit": "deg/h"}
    return table[["run", "tool", "start"]].assign(value=values, **known)


def test_a_coefficient_that_rises_with_age_is_a_trend():
    table = make_runs(np.random.default_rng(1))
    effects = size_rows(table, 2.0 * table["temperature [degC]"])
    trends = find_trends(table, effects).set_index(["quantity", "against"])
    assert len(trends) == 6
    rising = trends.loc[("N_x [deg/sqrt(h)]", "age [d]")]
    assert (rising["runs"], rising["tool"]) == (12, "tool")
    assert rising["low"] < 1.0 / 300.0 < rising["high"]
    size = trends.loc[("bias value x [deg/h]", "temperature [degC]")]
    assert (size["low"], size["slope"], size["high"]) == pytest.approx((2.0, 2.0, 2.0))
    assert set(trends.index[trends["p_value"] < 0.05]) == {rising.name, size.name}


@pytest.mark.slow
def test_trends_of_noise_are_rarely_found():
    """The probability that chance shows any trend of a fleet is at most 5 %."""
    draw = np.random.default_rng(2)
    rises = 0
    for _ in range(60):
        table = make_runs(draw, 8)
        table["N_x [deg/sqrt(h)]"] = draw.standard_cauchy(8)
        rises += bool((find_trends(table, size_rows(table, np.nan))["p_value"] < 0.05).any())
    assert rises <= 8  # of 60 with 5 % each, in all but 1 % of cases


def test_few_or_failed_runs_have_no_trends():
    table = make_runs(np.random.default_rng(3), 4)
    for part in (table, table.assign(error="failed", start=None)):
        assert not len(find_trends(part, size_rows(part, np.nan)))
