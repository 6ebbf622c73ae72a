"""A small benchmark of every kind of case, and one of a random seed that is diagnosed as well.

The random seed is printed; `GYROSTAB_PROVE_SEED=... python -m pytest -m full
tests/blindtest/test_prove_fresh.py` repeats the run.
"""

from __future__ import annotations

import hashlib
import importlib
import json
import os
import secrets
from pathlib import Path

import pandas as pd
import pytest

import gyrostab
from gyrostab.blindtest.runner.benchmark import Proof
from gyrostab.blindtest.runner.folder import FIRST_PUBLIC_SEED
from gyrostab.blindtest.scenarios.plan import KINDS, plan_case
from gyrostab.blindtest.scoring.table import score_table
from gyrostab.diagnose.result.content import check_diagnosis
from tests.support.diagnosed import diagnosis

NUMBER = 5


def shorten(plan: dict) -> dict:
    """Plan a short record; a sub-threshold effect needs a longer one."""
    return plan | {"rate": 10.0, "seconds": 3000.0 if plan["kind"] == "sub_threshold" else 600.0}


def short_plans(number: int, *, seed: int) -> list[dict]:
    return [shorten(plan_case(index, seed=seed)) for index in range(number)]


def plans_of_each_kind(number: int, *, seed: int) -> list[dict]:
    """Plan the first case of each kind."""
    plans = [shorten(plan_case(index, seed=seed)) for index in range(sum(KINDS.values()))]
    first = {plan["kind"]: plan for plan in reversed(plans)}
    return [first[kind] for kind in KINDS][:number]


@pytest.mark.full
def test_each_kind_of_case_is_committed_and_scored(tmp_path, monkeypatch):
    """All cases get the same diagnosis, with two effects of vibration."""
    monkeypatch.setattr("gyrostab.blindtest.scenarios.plan.plan_cases", plans_of_each_kind)
    diagnosing = importlib.import_module("gyrostab.diagnose.core")
    monkeypatch.setattr(diagnosing, "diagnose", lambda *log, **options: diagnosis())
    proof = gyrostab.prove(tmp_path / "proof", cases=len(KINDS), seed=1, nulls=100, workers=0)
    rows = check_run(tmp_path / "proof", proof, cases=len(KINDS))
    assert set(rows["kind"]) == {*KINDS, "counterpart"}
    assert rows["kind"].value_counts()["pair"] == 2
    assert rows["kind"].value_counts()["triple"] == 3


@pytest.mark.full
@pytest.mark.timeout(1800)
def test_random_cases_are_committed_diagnosed_and_scored(tmp_path, monkeypatch, capsys):
    seed = int(
        os.environ.get("GYROSTAB_PROVE_SEED") or FIRST_PUBLIC_SEED + secrets.randbelow(10**9)
    )
    with capsys.disabled():
        print(f"\nfresh cases of seed {seed}: GYROSTAB_PROVE_SEED={seed} draws them again")
    monkeypatch.setattr("gyrostab.blindtest.scenarios.plan.plan_cases", short_plans)
    folder = tmp_path / "proof"
    proof = gyrostab.prove(folder, cases=NUMBER, seed=seed, nulls=100, workers=0)
    assert proof.seed == seed
    check_run(folder, proof, cases=NUMBER)


def check_run(folder: Path, proof: Proof, *, cases: int) -> pd.DataFrame:
    """Check the files of a run against each other; return the rows of its scores."""
    assert proof.failed == {}
    sums = (folder / "SHA256SUMS").read_text()
    assert hashlib.sha256(sums.encode()).hexdigest() == proof.commitment
    names = []
    for line in sums.splitlines():
        value, path = line.split("  ")
        assert hashlib.sha256((folder / path).read_bytes()).hexdigest() == value
        names.append(path.removeprefix("truth/").removesuffix(".json"))
    rows = pd.read_csv(folder / "scores.csv", keep_default_na=False, na_values=[""])
    assert set(rows["name"]) == set(names)
    assert len(names) == cases + (rows["kind"] == "counterpart").sum()
    assert not rows["failed"].any()
    for name in names:
        diagnosis = json.loads((folder / "diagnoses" / f"{name}.json").read_text())
        check_diagnosis(diagnosis)
        truth = json.loads((folder / "truth" / f"{name}.json").read_text())
        mine = rows[rows["name"] == name]
        assert len(mine) == max(1, len(truth["effects"]))
        assert sorted(mine["effect"].dropna()) == sorted(
            effect["name"] for effect in truth["effects"]
        )
        assert set(mine["verdict"]) == {diagnosis["verdict"]}
        assert {
            identification["name"] for identification in json.loads(mine.iloc[0]["identifications"])
        } == {effect["name"] for effect in diagnosis["effects"]}

    assert list(proof.table["quantity"][:10]) == list(
        score_table([])["quantity"][:10]
    )  # every figure has a line
    assert set(proof.table["state"]) <= {"", "met", "missed", "not shown"}
    counted = proof.table.set_index("quantity")
    assert (
        counted.loc["false alarms: effect named on a null record", "n"]
        == (rows["kind"] == "null").sum()
    )
    page = (folder / "table.md").read_text()
    assert str(proof.seed) in page
    assert proof.commitment in page
    for name in ("completeness", "reliability", "calibration", "ranks", "roc"):
        assert (folder / f"{name}.png").read_bytes()[:4] == b"\x89PNG"
    return rows
