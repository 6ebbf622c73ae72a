"""Tables of a fleet: verdicts and effects of the diagnoses of its runs."""

from __future__ import annotations

import json
from pathlib import Path

import pandas as pd
import pytest

from gyrostab.jobs.archive import find_archive, find_runs
from gyrostab.jobs.fleet_table import list_effects, read_verdict
from gyrostab.report.fleet import combine_effects
from tests.support.diagnosed import content


def write_diagnosis(folder: Path, nats: float | None) -> None:
    """A diagnosis that names the noise of vibration, or nothing."""
    made = content() | {"mismatches": []}
    (effect,) = (one for one in made["effects"] if one["name"] == "vibration_noise")
    effect["held_out_gain"]["nats"] = nats
    folder.mkdir(parents=True)
    found = {"effects": [effect] if nats else [], "verdict": "explained" if nats else "no mismatch"}
    (folder / "diagnosis.json").write_text(json.dumps(made | found))


def test_effects_of_one_name_are_combined_over_the_runs_of_a_tool(tmp_path):
    names = ["tool/a", "tool/b", "tool/c", "tool/damaged"]
    for name, nats in zip(names, (4.0, 8.5, None, 1.0), strict=True):
        write_diagnosis(tmp_path / name, nats)
    damaged = tmp_path / names[-1] / "diagnosis.json"
    damaged.write_text(damaged.read_text().replace('"nats"', '"gnats"'))
    table = pd.DataFrame({"run": names, "tool": "tool", "start": pd.Timestamp("2026-05-01")})
    table["diagnosis"] = [str(tmp_path / name) for name in names]
    table["verdict"] = [read_verdict(folder) for folder in table["diagnosis"]]
    assert list(table["verdict"]) == ["explained", "explained", "no mismatch", "not readable"]
    effects = list_effects(table)
    assert list(effects["evidence [nats]"]) == [4.0, 8.5]
    (combined,) = combine_effects(effects, table)
    assert combined["seen"] == "2 of 3 diagnosed runs"
    assert combined["evidence"] == "12.5"
    assert combined["sizes"][0] == "tool/a, x: white 0.00045 (0.000405 to 0.000495) deg/sqrt(h)/g"


@pytest.mark.parametrize("text", ["{", "[" * 100_000, '{"recording": {"files": 5}}'])
def test_a_damaged_diagnosis_is_that_of_the_run_above_it(text, tmp_path):
    table = pd.DataFrame(
        {"file": [str(tmp_path / "a" / "log.nc")], "bytes": 0, "is_log": True, "note": ""}
    )
    (tmp_path / "a" / "found").mkdir(parents=True)
    (tmp_path / "a" / "log.nc").touch()
    (tmp_path / "a" / "found" / "diagnosis.json").write_text(text)
    (found,) = find_runs(find_archive([tmp_path]), table)
    assert read_verdict(str(found.diagnosis)) == "not readable"
