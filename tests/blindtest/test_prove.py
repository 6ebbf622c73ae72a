"""The benchmark commits truths before diagnoses, resumes, and scores the files on disk."""

from __future__ import annotations

import hashlib
import importlib
import json
import os
import shutil
from pathlib import Path
from typing import ClassVar

import dask
import numpy as np
import pandas as pd
import pytest
import xarray as xr

import gyrostab
from gyrostab.blindtest.generator.record import make_log
from gyrostab.blindtest.runner.benchmark import Proof
from gyrostab.blindtest.runner.folder import (
    FIRST_PUBLIC_SEED,
    begin_run,
    case_name,
    inspect_folder,
    read_sums,
)
from gyrostab.blindtest.runner.outcome import _thin_out, format_outcome, score_rows
from gyrostab.blindtest.runner.steps import diagnose_case, run_in_processes
from gyrostab.blindtest.scenarios.injection import RECORDINGS
from gyrostab.blindtest.scenarios.plan import plan_case
from gyrostab.blindtest.scoring.table import score_table
from gyrostab.errors import (
    FormatError,
    GyrostabError,
    OptionError,
    OutputError,
    ResumeError,
    WorkerError,
)
from tests.support.command_line import call

core = importlib.import_module("gyrostab.blindtest.runner.benchmark")
diagnosing = importlib.import_module("gyrostab.diagnose.core")

SMALL = {"rate": 10.0, "seconds": 600, "gaps": 0.0, "cuts": 0, "heavy": False, "degradation": None}
#: Effect and strength of each case, none for noise alone.
CASES: tuple[tuple[str, float] | None, ...] = (None, ("spectral_line", 8.0))


def small_plans(number: int, *, seed: int) -> list[dict]:
    plans = []
    for index, drawn in zip(range(number), CASES, strict=False):
        names, strengths = ([drawn[0]], [drawn[1]]) if drawn else ([], [])
        kind = "single" if drawn else "null"
        plans.append(
            plan_case(index, seed=seed)
            | SMALL
            | {"kind": kind, "names": names, "strengths": strengths, "in_fitted_noise": False}
        )
    return plans


class NothingFound:
    verdict = "no mismatch"
    model: ClassVar = {"noise": {"x": {"N": 0.003}}}

    def to_json(self) -> str:
        content = {"mismatches": [], "effects": [], "unexplained": [], "held_out": {}}
        return json.dumps({"verdict": self.verdict, **content})


@pytest.fixture
def small(monkeypatch):
    """Benchmarks of two small cases; the figures of `finished` are drawn, those of others empty."""
    monkeypatch.setattr(
        "gyrostab.blindtest.runner.outcome.save_png",
        lambda figure, target, **_: Path(target).write_bytes(b""),
    )
    monkeypatch.setattr("gyrostab.blindtest.scenarios.plan.plan_cases", small_plans)
    monkeypatch.setitem(core._DEFAULTS, "counterparts", 0)


def run_benchmark(folder: Path, **patches) -> tuple[Path, list[str], Proof]:
    """Run a benchmark of two small cases; return its folder, messages and result."""
    messages: list[str] = []

    def say(text: str) -> None:
        messages.append(f"{text} [{len(list((folder / 'diagnoses').glob('*.json')))} diagnosed]")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gyrostab.blindtest.scenarios.plan.plan_cases", small_plans)
        patch.setitem(core._DEFAULTS, "counterparts", 0)
        for name, function in patches.items():
            patch.setattr(diagnosing, name, function)
        proof = gyrostab.prove(folder, cases=2, seed=5, nulls=100, workers=0, say=say)
    return folder, messages, proof


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> tuple[Path, list[str], Proof]:
    """A benchmark whose diagnoses find nothing."""
    folder = tmp_path_factory.mktemp("finished") / "proof"
    return run_benchmark(folder, diagnose=lambda *log, **options: NothingFound())


def test_truths_are_committed_before_the_first_diagnosis(finished):
    folder, messages, proof = finished
    sums = (folder / "SHA256SUMS").read_bytes()
    assert proof.commitment == hashlib.sha256(sums).hexdigest()
    assert any(proof.commitment in text and "[0 diagnosed]" in text for text in messages)
    assert "--seed 5" in messages[0]
    for line in sums.decode().splitlines():
        value, path = line.split("  ")
        assert hashlib.sha256((folder / path).read_bytes()).hexdigest() == value
    assert len(sums.splitlines()) == 2
    written = [path.stat().st_mtime_ns for path in (folder / "diagnoses").glob("*.json")]
    assert (folder / "SHA256SUMS").stat().st_mtime_ns < min(written)


def test_figures_are_drawn(finished):
    folder, *_ = finished
    for name in ("completeness", "reliability", "calibration", "ranks", "roc"):
        assert (folder / f"{name}.png").read_bytes()[:4] == b"\x89PNG"


def test_recording_reveals_nothing_of_the_truth(finished):
    folder, *_ = finished
    recordings = sorted((folder / "recordings").iterdir())
    assert sorted(path.stem for path in recordings) == sorted(
        case_name(5, index) for index in range(2)
    )
    for path in recordings:
        with xr.open_dataset(path) as log:
            content = json.dumps(
                [
                    str(log.attrs),
                    *(str(log[name].attrs) for name in log.variables),
                    *map(str, log.variables),
                ]
            )
        for word in (
            "spectral",
            "ageing",
            "null",
            "single",
            "seed",
            "strength",
            "concealed",
            "plan",
        ):
            assert word not in content.lower()


@pytest.mark.slow
def test_every_case_is_scored(tmp_path):
    folder, _, proof = run_benchmark(tmp_path / "proof")
    scores = pd.read_csv(folder / "scores.csv", keep_default_na=False, na_values=[""])
    assert list(scores["kind"]) == ["null", "single"]
    assert list(scores["effect"].fillna("")) == ["", "spectral_line"]
    line = scores.iloc[1]
    assert bool(line["detected"])
    diagnosis = json.loads((folder / "diagnoses" / f"{line['name']}.json").read_text())
    assert line["verdict"] == diagnosis["verdict"]
    assert [identification["name"] for identification in json.loads(line["identifications"])] == [
        effect["name"] for effect in diagnosis["effects"]
    ]
    check = json.loads(line["model_check"])
    assert check["runs"]
    assert check["nats"] > 0.0
    assert proof.table.set_index("quantity").filter(like="without refit", axis=0)["n"].item() == 1
    assert {"Allan plot", "correlation with channels", "stepwise regression", "random number"} == (
        set(json.loads(line["baseline_detectors"]))
    )
    assert proof.failed == {}
    text = (folder / "table.md").read_text()
    assert proof.commitment in text
    assert "not for publication" in text
    detected = proof.table.set_index("quantity").loc["detected, strength 1.5 or more"]
    assert detected["n"] == 1
    assert detected["value"] == pytest.approx(scores["detected"][1:].mean())
    for name in ("completeness", "reliability", "calibration", "ranks", "roc"):
        assert (folder / f"{name}.png").read_bytes()[:4] == b"\x89PNG"


def test_resumed_finished_run_repeats_the_scores(finished, small):
    folder, _, before = finished
    times = {path: path.stat().st_mtime_ns for path in folder.glob("*/*")}
    scores = (folder / "scores.csv").read_bytes()
    resumed = gyrostab.prove(folder, workers=0, resume=True)
    assert {path: path.stat().st_mtime_ns for path in folder.glob("*/*")} == times
    assert (folder / "scores.csv").read_bytes() == scores
    assert resumed.seed == 5
    assert resumed.commitment == before.commitment


def test_run_that_another_version_drew_is_completed(finished, small, monkeypatch):
    folder, *_ = finished
    scores = (folder / "scores.csv").read_bytes()
    planned = core._plan_all

    def plan_others(job):
        first, *others = planned(job).items()
        return dict([*others, ("f" * 12, first[1])])

    with monkeypatch.context() as patch:
        patch.setattr(core, "_plan_all", plan_others)
        gyrostab.prove(folder, workers=0, resume=True)
    again = (folder / "scores.csv").read_bytes()
    assert sorted(again.splitlines()) == sorted(scores.splitlines())
    gyrostab.prove(folder, workers=0, resume=True)


def test_deleted_truth_is_named(finished, small):
    folder, *_ = finished
    path = folder / "truth" / f"{case_name(5, 1)}.json"
    text = path.read_text()
    path.unlink()
    try:
        with pytest.raises(FormatError, match="deleted after it was committed"):
            gyrostab.prove(folder, workers=0, resume=True)
    finally:
        path.write_text(text)


def test_changed_truth_is_refused(finished, small):
    folder, *_ = finished
    name = case_name(5, 1)
    path = folder / "truth" / f"{name}.json"
    text = path.read_text()
    try:
        path.write_text(text.replace('"strength": 8.0', '"strength": 4.0'))
        with pytest.raises(FormatError, match="changed after it was committed"):
            gyrostab.prove(folder, workers=0, resume=True)
    finally:
        path.write_text(text)


def test_existing_run_is_neither_lost_nor_mixed(finished):
    folder, *_ = finished
    with pytest.raises(OutputError, match="--resume"):
        gyrostab.prove(folder)
    with pytest.raises(ResumeError, match="seed 5, not 6"):
        gyrostab.prove(folder, seed=6, resume=True)
    with pytest.raises(ResumeError, match="cases 2, not 4"):
        gyrostab.prove(folder, cases=4, resume=True)
    assert (folder / "scores.csv").exists()


class Stopped(Exception):
    pass


def test_resumed_run_equals_an_uninterrupted_one(finished, small, tmp_path, monkeypatch):
    unbroken, _, _ = finished
    folder, calls = tmp_path / "proof", []

    def real(recording, target, failed, nulls):
        shutil.copy(unbroken / "diagnoses" / target.name, target)  # same recording, same diagnosis
        return True

    def stop_at_the_second(*job):
        if calls:
            raise Stopped
        calls.append(job[0])
        return real(*job)

    monkeypatch.setattr(core, "diagnose_case", stop_at_the_second)
    with pytest.raises(Stopped):
        gyrostab.prove(folder, cases=2, seed=5, nulls=100, workers=0)
    assert len(list((folder / "diagnoses").iterdir())) == 1
    assert not (folder / "scores.csv").exists()
    sums = (folder / "SHA256SUMS").read_bytes()
    leftover = folder / "diagnoses" / ".abc.json.gyrostab-12345678.part"
    leftover.write_text("half")

    later = []
    monkeypatch.setattr(core, "diagnose_case", lambda *job: later.append(job[0]) or real(*job))
    gyrostab.prove(folder, workers=0, resume=True)
    assert set(later).isdisjoint(calls)
    assert len(later) == 1
    assert not leftover.exists()
    assert (folder / "SHA256SUMS").read_bytes() == sums == (unbroken / "SHA256SUMS").read_bytes()
    for recording in (unbroken / "recordings").iterdir():
        with (
            xr.open_dataset(recording) as expected,
            xr.open_dataset(folder / "recordings" / recording.name) as other,
        ):
            xr.testing.assert_identical(expected, other)
    assert (folder / "scores.csv").read_bytes() == (unbroken / "scores.csv").read_bytes()


@pytest.mark.slow
def test_failed_diagnosis_is_reported_and_retried(small, tmp_path, monkeypatch):
    monkeypatch.setattr(diagnosing, "diagnose", lambda *log, **options: 1 / 0)
    proof = gyrostab.prove(tmp_path / "proof", cases=2, seed=9, nulls=100, workers=0)
    assert set(proof.failed) == {case_name(9, 0), case_name(9, 1)}
    text = (tmp_path / "proof" / "table.md").read_text()
    assert "ZeroDivisionError: division by zero" in text
    assert "its diagnosis failed" in text
    detected = proof.table.set_index("quantity").loc["detected, strength 1.5 or more"]
    assert (detected["n"], detected["value"]) == (1, 0.0)

    class Unknown(NothingFound):
        verdict = "unknown"

    monkeypatch.setattr(diagnosing, "diagnose", lambda *log, **options: Unknown())
    resumed = gyrostab.prove(tmp_path / "proof", workers=0, resume=True)
    assert resumed.failed == {}
    assert not list((tmp_path / "proof" / "failed").iterdir())
    assert resumed.table.set_index("quantity").loc["detected, strength 1.5 or more", "value"] == 1.0


@pytest.mark.full
def test_injections_are_committed_and_scored_separately(small, tmp_path, monkeypatch, recordings):
    real = recordings("mems-static-53min/ch104.csv.gz").parents[1]
    monkeypatch.setattr(core, "_CASES_PER_INJECTION", 1)
    monkeypatch.setattr(diagnosing, "diagnose", lambda *log, **options: NothingFound())
    messages: list[str] = []
    proof = gyrostab.prove(
        tmp_path / "proof", cases=2, seed=8, nulls=100, workers=0, real=real, say=messages.append
    )
    assert "2 injections into real recordings" in messages[0]
    sums, _ = read_sums(tmp_path / "proof")
    assert len(sums) == 2 + 2 * 4
    for path in (tmp_path / "proof" / "recordings").iterdir():
        with xr.open_dataset(path) as log:
            words = json.dumps([path.name, str(log.attrs), *map(str, log.variables)]).lower()
        assert not [
            word
            for word in (
                "inject",
                "copy",
                "flipped",
                "reversed",
                "untouched",
                "mems",
                "laser",
                "fog",
            )
            if word in words
        ]
    scores = pd.read_csv(tmp_path / "proof" / "scores.csv", keep_default_na=False, na_values=[""])
    assert sorted(scores["kind"].value_counts().to_dict().items()) == [
        ("control", 6),
        ("injected", 2),
        ("null", 1),
        ("single", 1),
    ]
    assert set(scores["copy"].dropna()) == {"injected", "untouched", "flipped", "reversed"}
    counted = proof.table.set_index("quantity")
    assert (
        counted.loc["false alarms: effect named on a null record", "n"] == 1
    )  # a copy of a real recording is not a null record
    page = (tmp_path / "proof" / "table.md").read_text()
    assert "| reversing the sign adds a name | 0 |" in page


class NamedAlways(NothingFound):
    verdict = "explained"

    def to_json(self) -> str:
        gain = {"nats": 12.0, "stderr": 1.0, "threshold": 8.0}
        effect = {"name": "spectral_line", "alternatives": [], "held_out_gain": gain}
        return json.dumps(json.loads(super().to_json()) | {"effects": [effect]})


@pytest.mark.slow
def test_counterparts_count_as_noise_and_in_no_other_figure(small, tmp_path, monkeypatch):
    monkeypatch.setattr(diagnosing, "diagnose", lambda *log, **options: NamedAlways())
    proof = gyrostab.prove(
        tmp_path / "proof", cases=2, seed=8, nulls=100, counterparts=1, workers=0
    )
    scores = pd.read_csv(tmp_path / "proof" / "scores.csv", keep_default_na=False, na_values=[""])
    assert scores["kind"].tolist() == ["null", "single", "counterpart"]
    assert scores["score"].tolist() == [4.0] * 3
    noise = scores[scores["kind"] == "counterpart"].iloc[0]
    assert noise["name"] == case_name(8, 1, "counterpart")
    assert json.loads(noise["wrong_names"]) == ["spectral_line"]
    counted = proof.table.set_index("quantity")["n"]
    assert counted["false alarms: effect named on a null record"] == 1
    assert counted["false alarms of the Allan plot"] == 1
    page = (tmp_path / "proof" / "table.md").read_text()
    assert "| false alarms: effect named on a counterpart | 1 |" in page
    assert "| detected with its effects, and without them too | 1 |" in page
    assert "| catalogue | diagnosis | 1 | 2 |" in page
    assert "--counterparts 1" in page
    with pytest.raises(ResumeError, match="counterparts 1, not 4"):
        gyrostab.prove(tmp_path / "proof", counterparts=4, resume=True)


@pytest.mark.full
def test_run_of_an_earlier_version_is_scored_again(finished, small, tmp_path):
    before, _, _ = finished
    folder = shutil.copytree(before, tmp_path / "proof")
    job = json.loads((folder / "benchmark.json").read_text())
    del job["counterparts"]
    (folder / "benchmark.json").write_text(json.dumps(job))
    for path in (folder / "comparisons").iterdir():
        path.write_text(json.dumps({"Allan plot": False, "correlation with channels": True}))
    gyrostab.prove(folder, workers=0, resume=True)
    assert (folder / "scores.csv").read_bytes() == (before / "scores.csv").read_bytes()


def test_run_without_real_recordings_says_so(small, tmp_path, monkeypatch):
    monkeypatch.setattr(diagnosing, "diagnose", lambda *log, **options: NothingFound())
    messages: list[str] = []
    gyrostab.prove(tmp_path / "proof", cases=1, seed=8, nulls=100, workers=0, say=messages.append)
    assert "no injections into real recordings: too few cases" in messages[0]
    assert (
        "the folder of the real recordings was not given"
        in (tmp_path / "proof" / "table.md").read_text()
    )


def test_missing_real_recordings_are_reported(small, tmp_path, monkeypatch):
    monkeypatch.setattr(core, "_CASES_PER_INJECTION", 1)
    nowhere = tmp_path / "nowhere"
    with pytest.raises(FormatError, match=r"nowhere: has no fog-blueseis-ramp/fog_ramp\.csv\.gz"):
        gyrostab.prove(tmp_path / "proof", cases=1, seed=8, nulls=100, workers=0, real=nowhere)
    assert not list(tmp_path.iterdir())
    for entry in RECORDINGS.values():
        (nowhere / entry.file).parent.mkdir(parents=True)
        (nowhere / entry.file).write_text("")
    messages: list[str] = []
    with pytest.raises(GyrostabError):
        gyrostab.prove(
            tmp_path / "proof",
            cases=1,
            seed=8,
            nulls=100,
            workers=0,
            real=nowhere,
            say=messages.append,
        )
    assert "--real DIR\nand 1 injections" in messages[0]
    with pytest.raises(ResumeError, match="give their folder again"):
        gyrostab.prove(tmp_path / "proof", workers=0, resume=True)


def test_wrong_names_on_null_records_are_listed():
    truth = {
        "effects": [],
        "accepted": [],
        "plan": {"index": 0, "kind": "null"},
        "sampling_rate_hz": 10.0,
        "seconds": 600.0,
    }
    truth |= {"missing_share": 0.0}
    identification = {
        "verdict": "explained",
        "mismatches": [],
        "unexplained": [],
        "held_out": {},
        "effects": [{"name": "shupe", "alternatives": []}],
    }
    rows = score_rows({"abc": identification}, {"abc": truth}, {"abc": {}})
    job = {
        "injected": 2,
        "cases": 1,
        "seed": FIRST_PUBLIC_SEED + 1,
        "nulls": 100,
        "counterparts": 4,
        "code": ["a", "b"],
        "begun": "now",
        "machine": "any",
    }
    table = score_table(rows)
    text = format_outcome(rows, table, job=job, commitment="0" * 64, failed={})
    assert "abc (null, 10 Hz, 10 min, 0 % lost): no effect; named shupe" in text
    assert "--real DIR`" in text
    assert "not for publication" not in text
    assert "The code changed 1 times" in text
    assert "false alarms: effect named on a null record: 1 " in text


def test_a_wrong_name_is_listed_with_all_effects_of_its_record():
    effect = {"strength": 2.0, "size": 2.0, "form_differs": False, "expected_nats": 20.0}
    effect |= {"tau_min_s": 1.0, "tau_max_s": 9.0, "localised": False, "parameters": {}}
    truth = {
        "effects": [effect | {"name": name} for name in ("shupe", "spikes")],
        "accepted": [],
        "plan": {"index": 0, "kind": "pair"},
        "sampling_rate_hz": 10.0,
        "seconds": 600.0,
        "missing_share": 0.0,
    }
    answer = json.loads(NamedAlways().to_json())
    rows = score_rows({"abc": answer}, {"abc": truth}, {"abc": {}})
    job = dict.fromkeys(("injected", "cases", "seed", "nulls", "counterparts"), 1)
    job |= {"code": ["a"], "begun": "now", "machine": "any"}
    text = format_outcome(rows, score_table(rows), job=job, commitment="", failed={})
    assert text.replace("\n ", "").count("shupe at 2 and spikes at 2; named spectral_line") == 1


def test_risk_curve_keeps_both_ends():
    risk = pd.DataFrame({"least": [1.0 - place / 100 for place in range(32)]})
    kept = _thin_out(risk)["least"]
    assert (len(kept), kept.iloc[0], kept.iloc[-1]) == (10, 1.0, risk["least"].iloc[-1])
    assert len(_thin_out(risk[:3])) == 3
    assert _thin_out(risk[:0]).empty


def test_a_model_that_cannot_be_checked_is_no_failed_diagnosis(tmp_path, monkeypatch):
    class Found(NamedAlways):
        model: ClassVar = {"noise": {}, "effect": [{}]}
        content: ClassVar = {}

    recording = make_log(np.zeros((3, 100)), {}, start=0, rate=10.0)
    monkeypatch.setattr("gyrostab.jobs.load_log", lambda paths: recording)
    monkeypatch.setattr(diagnosing, "diagnose", lambda *log, **options: Found())
    target, failed = tmp_path / "good.json", tmp_path / "failed.txt"
    assert diagnose_case(tmp_path / "0123456789ab.nc", target, failed, 100)
    check = json.loads(target.read_text())["model_check"]
    assert check == {"runs": False, "reason": "KeyError: 'baseline'"}


# -----------------------------------------------------------------------------------------------
# options and folders


def test_invalid_options_leave_nothing_behind(tmp_path):
    for options, complaint in (
        ({"cases": 0}, "cases=0"),
        ({"seed": -1}, "seed=-1"),
        ({"nulls": 20}, "nulls=20"),
        ({"counterparts": -1}, "counterparts=-1"),
        ({"workers": -1}, "workers=-1"),
    ):
        with pytest.raises(OptionError, match=complaint):
            gyrostab.prove(tmp_path / "proof", **options)
    with pytest.raises(OutputError, match="there is no directory"):
        gyrostab.prove(tmp_path / "no" / "proof")
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="is a file"):
        gyrostab.prove(tmp_path / "file")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_folder_with_foreign_files_is_never_emptied(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    for options in ({}, {"overwrite": True}, {"resume": True}):
        with pytest.raises(OutputError, match=r"thesis\.tex"):
            gyrostab.prove(tmp_path, cases=1, **options)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def damage_marker(folder: Path) -> None:
    (folder / "benchmark.json").write_text("{")


def stop_while_drawing(folder: Path) -> None:
    (folder / "recordings" / f".{case_name(1, 9)}.nc.gyrostab-12345678.part").write_text("half")


def stop_while_replacing(folder: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gyrostab.blindtest.runner.folder._remove_path", stop_at_table)
        with pytest.raises(Stopped):
            replace_run(folder)


def replace_run(folder: Path) -> None:
    usual = {**core._DEFAULTS, "seed": 2}
    begin_run(folder, inspect_folder(folder, {}, usual, resume=False, overwrite=True))


def stop_at_table(path: Path) -> None:
    if path.name == "table.md":
        raise Stopped
    shutil.rmtree(path) if path.is_dir() else path.unlink()


@pytest.mark.parametrize("break_off", [damage_marker, stop_while_drawing, stop_while_replacing])
def test_broken_run_can_be_replaced(finished, tmp_path, break_off):
    folder = shutil.copytree(finished[0], tmp_path / "proof")
    break_off(folder)
    (folder / "thesis.tex").write_text("years of work")
    with pytest.raises(OutputError, match=r"thesis\.tex"):
        replace_run(folder)
    (folder / "thesis.tex").unlink()
    replace_run(folder)
    assert {path.name for path in folder.rglob("*") if path.is_file()} == {"lock", "benchmark.json"}


@pytest.mark.slow
def test_overwrite_replaces_the_run(small, tmp_path, monkeypatch):
    monkeypatch.setattr(diagnosing, "diagnose", lambda *log, **options: 1 / 0)
    first = gyrostab.prove(tmp_path / "proof", cases=1, seed=1, workers=0)
    second = gyrostab.prove(tmp_path / "proof", cases=1, workers=0, overwrite=True)
    assert second.seed >= FIRST_PUBLIC_SEED != first.seed
    assert list(read_sums(tmp_path / "proof")[0]) == [case_name(second.seed, 0)]
    assert [path.stem for path in (tmp_path / "proof" / "recordings").iterdir()] == [
        case_name(second.seed, 0)
    ]


def test_folder_is_locked_by_one_run(small, tmp_path):
    from gyrostab.jobs import lock_job

    (tmp_path / "proof").mkdir()
    with lock_job(tmp_path / "proof"), pytest.raises(ResumeError):
        gyrostab.prove(tmp_path / "proof", cases=1, seed=1)
    assert [path.name for path in (tmp_path / "proof").iterdir()] == ["lock"]


def test_command_warns_of_a_tuning_seed(tmp_path, capfd):
    (tmp_path / "other.txt").write_text("")
    assert call("prove", "--cases", 1, "--seed", 3, "-o", tmp_path) == 2
    messages = capfd.readouterr().err
    assert "seeds are for tuning" in messages
    assert "other.txt" in messages
    assert call("prove", "--cases", 1, "--seed", FIRST_PUBLIC_SEED, "-o", tmp_path) == 2
    assert "seeds are for tuning" not in capfd.readouterr().err


# ---------------------------------------------------------------------------------------------
# processes


@pytest.mark.slow
def test_processes_keep_order_and_use_one_thread():
    counts: list[int] = []
    before = os.environ.get("OMP_NUM_THREADS")
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    jobs = [*((name,) for name in names), *(("not set", str(number)) for number in range(5))]
    done = run_in_processes(os.getenv, jobs, workers=2, report=counts.append)
    assert done == ["1", "1", "1", *map(str, range(5))]
    assert counts == list(range(1, 9))
    assert os.environ.get("OMP_NUM_THREADS") == before
    assert run_in_processes(dask.config.get, [("num_workers",)], workers=1) == [1]


@pytest.mark.slow
def test_dead_process_raises_worker_error():
    with pytest.raises(WorkerError, match="--resume"):
        run_in_processes(os._exit, [(1,)], workers=1)
