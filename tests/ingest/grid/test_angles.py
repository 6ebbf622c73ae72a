"""Cumulative angles that wrap around, and counters that begin again."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from gyrostab.ingest.grid.gaps import gap_table
from gyrostab.ingest.grid.regularise import regularise
from gyrostab.ingest.reading import read_log

RATE = 100.0


def make_angle(degree_per_second: float, rows: int = 20_000) -> np.ndarray:
    """Return cumulative angles [degree] of a turning gyro with white noise."""
    noise = np.random.default_rng(3).normal(0, 2e-4, rows)
    return 100 + np.cumsum(degree_per_second / RATE + noise)


def read_angle(folder, written, unit="deg", kept=slice(None), digits=9):
    """Read a log of angles in a unit; return it, and its angles [degree]."""
    path = folder / "log.csv"
    cells = [f"{value:.{digits}f}" for value in written[kept]]
    times = np.arange(len(written))[kept] / RATE
    pd.DataFrame({"time [s]": times, f"angle_x [{unit}]": cells}).to_csv(path, index=False)
    log = regularise(read_log(path, kind="angle"))
    return log, log.angle.values[0]


@pytest.mark.parametrize("block", [2**8, 2**20])
@pytest.mark.parametrize("low", [0.0, -180.0])
@pytest.mark.parametrize(("turning", "unit"), [(30.0, "deg"), (-2000.0, "rad"), (0.0, "deg")])
def test_wrapped_angle_is_continued(tmp_path, monkeypatch, block, low, turning, unit):
    monkeypatch.setattr("gyrostab.ingest.grid.angles.BLOCK_ROWS", block)
    angle = make_angle(turning) - (100.0 if turning == 0 else 0.0)  # about zero
    wrapped = (angle - low) % 360 + low
    written = np.deg2rad(wrapped) if unit == "rad" else wrapped
    log, read = read_angle(tmp_path, written, unit)
    np.testing.assert_allclose(read - read[0], angle - angle[0], atol=1e-6)
    is_continued = np.abs(np.diff(wrapped)).max() > 180
    assert any("is continued" in note for note in log.attrs["notes"]) == is_continued


@pytest.mark.parametrize("block", [7, 2**20])
def test_wrapped_angle_with_lost_rows_is_continued(tmp_path, monkeypatch, block):
    monkeypatch.setattr("gyrostab.ingest.grid.angles.BLOCK_ROWS", block)
    angle = make_angle(30.0, 4000)
    kept = np.flatnonzero(np.random.default_rng(1).random(angle.size) > 0.3)
    kept = kept[(kept < 1000) | (kept > 1100)]
    _, read = read_angle(tmp_path, angle % 360, kept=kept)
    found = np.isfinite(read)
    np.testing.assert_allclose((read - read[0])[found], angle[kept] - angle[kept[0]], atol=1e-6)


@pytest.mark.parametrize("most_in_memory", [2_000_000, 1000])
@pytest.mark.parametrize("pause", [1.0, 7.0, -100.0])
def test_unknown_turns_in_a_pause_are_missing_rates(tmp_path, monkeypatch, pause, most_in_memory):
    monkeypatch.setattr("gyrostab.ingest.grid.regularise.MAX_PLAIN_NUMBERS", most_in_memory)
    rows, turning = np.arange(20_000), -300.0
    times = rows / RATE + 1000 + np.where(rows >= 12_000, pause, 0.0)
    cells = {"time [s]": times, "angle_x [deg]": (turning * times + 0.3) % 360}
    pd.DataFrame(cells).to_csv(tmp_path / "log.csv", index=False)
    log = regularise(read_log(tmp_path / "log.csv", kind="angle"))
    missing = 1 if pause < 0 else round(pause * RATE)
    expected = np.full(rows.size + missing, turning * 3600)
    expected[[0, *range(12_000, 12_001 + missing)]] = np.nan
    np.testing.assert_allclose(log.rate.values[0], expected, rtol=1e-6)
    assert log.attrs["kind"] == "rate"
    assert gap_table(log).samples.tolist() == [1, missing + 1]
    (note,) = [note for note in log.attrs["notes"] if "so the log holds rates" in note]
    assert note.startswith("log.csv: an angle wraps around")


@pytest.mark.parametrize(
    ("bits", "low"),
    [(12, 0), (14, 0), (15, 0), (16, 0), (16, -(2**15)), (24, 0), (32, -(2**31)), (32, 0)],
)
def test_counter_that_is_full_is_continued(tmp_path, bits, low):
    counts = np.rint(make_angle(15 / 3600) / 0.01 * 3600)
    counts += low + 2**bits - counts[5000] + 20
    log, read = read_angle(tmp_path, (counts - low) % 2**bits + low, "0.01 arcsec", digits=0)
    expected = (counts - counts[0]) * 0.01 / 3600
    np.testing.assert_allclose(read - read[0], expected, atol=1e-9)
    assert any("is continued" in note for note in log.attrs["notes"])


def test_counter_that_is_set_to_zero_is_continued(tmp_path):
    angle = make_angle(0.5)
    written = angle.copy()
    written[9000:] -= angle[8999]
    log, read = read_angle(tmp_path, written)
    np.testing.assert_allclose(read, angle, atol=1e-6)
    assert any("is continued: 1 place, first row 9000" in note for note in log.attrs["notes"])


def test_wrapped_angle_is_continued_over_files(tmp_path, monkeypatch):
    monkeypatch.setattr("gyrostab.ingest.grid.regularise.MAX_PLAIN_NUMBERS", 1000)
    angle = make_angle(30.0)
    for number, rows in enumerate(np.split(np.arange(angle.size), 4)):
        cells = {"time [s]": rows / RATE, "angle_x [deg]": angle[rows] % 360, "angle_y [deg]": 5.0}
        pd.DataFrame(cells).to_csv(tmp_path / f"{number}.csv", index=False)
    log = regularise(read_log(tmp_path / "*.csv", kind="angle"))
    read = log.angle.values
    np.testing.assert_allclose(read[0] - read[0, 0], angle - angle[0], atol=1e-6)
    assert np.ptp(read[1]) == 0.0


@pytest.mark.parametrize("zero", [0.0, 100.0])
def test_angles_that_do_not_begin_again_are_kept(tmp_path, zero):
    angle = make_angle(0.0) - zero
    angle[4000] += 300.0  # a wrong value
    angle[5000:] += np.clip(np.arange(15_000) * 0.3, 0, 90)  # motion
    angle[9000:] -= 5000.0  # not to zero
    log, read = read_angle(tmp_path, angle)
    np.testing.assert_allclose(read, angle, atol=1e-6)
    assert not any("is continued" in note for note in log.attrs["notes"])
    (note,) = [note for note in log.attrs["notes"] if "jumps" in note]
    assert note.endswith("1 place, first row 9000")


@pytest.mark.parametrize("block", [2**12, 2**20])
@pytest.mark.parametrize(
    ("period", "unit"),
    [(80.0, "arcsec"), (150.0, "arcsec"), (64.0, "0.001 arcsec")],  # 64000 counts are not 16 bits
)
def test_an_angle_that_wraps_at_an_unknown_angle_has_a_note(
    tmp_path, monkeypatch, period, unit, block
):
    monkeypatch.setattr("gyrostab.ingest.grid.angles.BLOCK_ROWS", block)
    seconds = (make_angle(120 / 3600) * 3600 + period / 2) % period
    is_counted = unit != "arcsec"
    written, digits = (seconds * 1000, 0) if is_counted else (seconds, 9)
    log, read = read_angle(tmp_path, written, unit, digits=digits)
    np.testing.assert_allclose(read * 3600, seconds, atol=1e-3)
    (note,) = [note for note in log.attrs["notes"] if "of axis x" in note]
    falls = np.flatnonzero(np.diff(seconds) < -period / 2) + 1
    assert "jumps; variances over these rows are wrong" in note
    assert f"first row {falls[0]}" in note


def test_noise_of_fine_counts_is_no_full_counter(tmp_path):
    counts = np.rint(np.random.default_rng(1).normal(0, 8000, 20_000))
    _, read = read_angle(tmp_path, counts, "0.01 arcsec", digits=0)
    np.testing.assert_allclose(read, counts * 0.01 / 3600, atol=1e-9)
