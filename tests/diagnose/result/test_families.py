"""Families of spectral lines: harmonics, side bands, and one finding for each family."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gyrostab.diagnose.result.families import MAX_CHANCE, UNRELATED, find_families
from gyrostab.report import write_diagnosis_report
from tests.support.diagnosed import content, diagnosis

SPECTRUM = {"resolution": 0.05, "bandwidth": 50.0}


@pytest.mark.parametrize("missing", [0, 2])
def test_harmonics_are_one_family_also_without_the_fundamental(missing: int):
    rng = np.random.default_rng(missing)
    comb = 4.1696 * np.arange(1 + missing, 12) + 0.02 * rng.uniform(-1.0, 1.0, 11 - missing)
    others = [7.013, 23.31, 39.77]
    families = find_families([*comb, *others], **SPECTRUM)
    assert set(families[: comb.size]) <= {"harmonics of 4.169 Hz", "harmonics of 4.17 Hz"}
    assert len(set(families)) == 2
    assert families[comb.size :] == [None] * 3


def test_precise_lines_are_harmonics_of_a_spacing_that_the_lowest_do_not_show():
    """Steady lines are known to 1e-3 of the distance of lines, in which the fundamental is lost."""
    rng = np.random.default_rng(3)
    orders = np.array([7, 9, 15, 25, 31, 33, 41, 49, 55, 63, 71, 95, 113])
    error = np.where(orders < 10, 0.025, 3e-4)
    comb = 0.18690 * orders + error * rng.uniform(-1.0, 1.0, orders.size)
    others = [7.347, 11.539, 13.752, 15.392, 16.766]
    families = find_families(
        [*comb, *others], resolution=[*(2.0 * error), *[6e-4] * 5], bandwidth=50.0
    )
    assert set(families[2:13]) == {"harmonics of 0.1869 Hz"}
    assert set(families[13:]) == {UNRELATED}


def test_unrelated_precise_lines_are_rarely_a_family():
    rng = np.random.default_rng(4)
    wrong = 0
    for _ in range(100):
        resolution = rng.choice([6e-4, 0.05], 8)
        families = find_families(rng.uniform(0.1, 50.0, 8), resolution=resolution, bandwidth=50.0)
        wrong += set(families) != {UNRELATED}
    assert wrong <= 100 * MAX_CHANCE


def test_side_bands_belong_to_their_line():
    families = find_families([20.01, 18.76, 21.26, 33.9], **SPECTRUM)
    assert families == ["side bands of 20.01 Hz, 1.25 Hz apart"] * 3 + [None]


def test_unrelated_lines_are_rarely_a_family():
    """The bound counts each spacing as independent, so that the true share is lower."""
    rng = np.random.default_rng(1)
    wrong = sum(
        set(find_families(rng.uniform(0.1, 50.0, 5), **SPECTRUM)) != {UNRELATED} for _ in range(200)
    )
    assert wrong <= 200 * MAX_CHANCE


def test_many_lines_without_a_family_are_one_finding():
    comb = [10.0, 20.0, 30.0, 40.0]
    unrelated = [7.013, 13.77, 23.31, 36.9]
    few, many = (
        find_families([*comb, *lines_without_family], **SPECTRUM)
        for lines_without_family in (unrelated[:3], unrelated)
    )
    assert few[4:] == [None] * 3
    assert set(many) == {"harmonics of 10 Hz", "lines without a common spacing"}


def test_a_family_is_one_finding_in_text_and_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("gyrostab.report.diagnosis_charts.static_png", lambda _: "")
    lines = [
        {
            **content()["effects"][0],
            "name": "spectral_line",
            "driver": None,
            "family": "harmonics of 10 Hz",
            "parameters": {
                "frequency": {"value": f, "stderr": 0.1, "low": f, "high": f, "unit": "Hz"}
            },
        }
        for f in (20.0, 10.0, 40.0)
    ]
    comb_diagnosis = replace(
        diagnosis(), content=diagnosis().content | {"effects": lines, "mismatches": []}
    )
    sentence = "It is the strongest of the harmonics of 10 Hz; the others are at 10 and 40 Hz."
    page = write_diagnosis_report(comb_diagnosis, tmp_path / "page.html").read_text(
        encoding="utf-8"
    )
    assert str(comb_diagnosis).count("- spectral_line:") == 1
    assert page.count('<div class="card">') == 1
    assert sentence in str(comb_diagnosis)
    assert sentence in page
    assert "(harmonics of 10 Hz, 3 lines)" in str(comb_diagnosis)
