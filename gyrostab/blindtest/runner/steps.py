"""Steps of one case: draw and commit, diagnose, compare; each writes a complete file or none."""

from __future__ import annotations

import json
import traceback
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gyrostab.blindtest.runner.folder import write_json
from gyrostab.errors import GyrostabError
from gyrostab.store.output import write_text

if TYPE_CHECKING:
    import xarray as xr


def draw_case(directory: Path, name: str, plan: dict[str, Any], real: Path | None = None) -> str:
    """Write recording and truth of a plan unless they exist; return the SHA-256 of the truth.

    `real` is the folder of the real recordings.
    """
    from gyrostab.blindtest.scenarios.case import make_case
    from gyrostab.blindtest.scenarios.commitment import commit_case, fingerprint
    from gyrostab.blindtest.scenarios.real import make_injection_case

    truth = directory / "truth" / f"{name}.json"
    if truth.exists():  # written after the recording
        return fingerprint(truth.read_text(encoding="utf-8"))
    log, content = (
        make_injection_case(plan, real)
        if real is not None and "recording" in plan
        else make_case(plan)
    )
    return commit_case(log, content, directory, name=name)


def diagnose_case(recording: Path, target: Path, failed: Path, nulls: int) -> bool:
    """Diagnose a recording; return whether that succeeded, else write the reason to `failed`.

    The diagnosis is written with the check of its model, if that has an effect.
    """
    from gyrostab import diagnose
    from gyrostab.jobs import load_log

    try:
        log = load_log([recording])
        diagnosis = diagnose(log, nulls=nulls, seed=int(recording.stem[:7], 16))
        checked = _check_model(log, diagnosis) if diagnosis.model.get("effect") else None
        write_json(target, json.loads(diagnosis.to_json()) | {"model_check": checked})
    except Exception as error:  # a case that breaks the diagnosis is reported as a result
        lines = traceback.format_exc() if not isinstance(error, GyrostabError) else ""
        write_text(failed, f"{type(error).__name__}: {error}\n{lines}")
        return False
    failed.unlink(missing_ok=True)
    return True


def _check_model(log: xr.Dataset, diagnosis: Any) -> dict[str, Any]:
    """Compare a recording with its model and with the noise that was calibrated first."""
    from gyrostab.blindtest.scoring.resimulation import check_model

    try:
        calibrated = {
            axis: {term: entry["value"] for term, entry in terms.items()}
            for axis, terms in diagnosis.content["baseline"]["noise"].items()
        }
        return check_model(log.compute(), diagnosis.model, calibrated)
    except Exception as error:  # the diagnosis is good, but not its model
        return {"runs": False, "reason": f"{type(error).__name__}: {error}"}


def compare_case(recording: Path, truth: dict[str, Any], target: Path) -> dict[str, float]:
    """Apply the detectors to compare with; above 0, a score is a detection."""
    import numpy as np

    from gyrostab.blindtest.scoring.baseline_detectors import (
        LEVEL,
        RANDOM,
        allan_detector,
        channel_detector,
    )
    from gyrostab.blindtest.scoring.stepwise import stepwise_detector
    from gyrostab.jobs import load_log

    if target.exists():
        stored: dict[str, float] = json.loads(target.read_text(encoding="utf-8"))
        if RANDOM in stored:  # earlier versions did not keep scores
            return stored
    log = load_log([recording]).compute()
    rng = np.random.default_rng(int(recording.stem[:7], 16))
    scores = {
        "Allan plot": allan_detector(np.asarray(log["rate"].values), truth, rng=rng),
        "correlation with channels": channel_detector(log),
        "stepwise regression": stepwise_detector(log),
        RANDOM: LEVEL - rng.random(),
    }
    write_json(target, scores)
    return scores
