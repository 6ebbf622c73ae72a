"""Real recordings, from log to product, compared with what their sources state."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import xarray as xr

import gyrostab
from gyrostab.cli import main
from gyrostab.units import parse_unit
from tests.support.scripts import load_script

ROOT = Path(__file__).resolve().parents[2]


SCRIPT = load_script("docs/generate/real_recordings.py")
ENTRIES: dict[str, Any] = SCRIPT.PLAN["recording"]
Outcome = tuple[xr.Dataset, xr.Dataset, dict[str, float]]


@pytest.fixture
def find_entry(
    recordings: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> Callable[[str], dict[str, Any]]:
    """Return a function that enters the directory of the recordings; skip without the files."""

    def go(name: str) -> dict[str, Any]:
        entry: dict[str, Any] = ENTRIES[name]
        for file in [*entry["files"], *entry["read"].get("channel", ())]:
            monkeypatch.chdir(recordings(file).parents[len(Path(file).parts) - 1])
        return entry

    return go


@pytest.fixture(scope="module")
def outcomes() -> dict[str, Outcome]:
    return {}


@pytest.fixture
def examine(
    find_entry: Callable[[str], dict[str, Any]],
    outcomes: dict[str, Outcome],
    tmp_path_factory: pytest.TempPathFactory,
) -> Callable[[str], Outcome]:
    """Process each recording once: log, product read back from disk, numbers of the page."""

    def run(name: str) -> Outcome:
        entry = find_entry(name)
        if name not in outcomes:
            outcomes[name] = SCRIPT.examine(
                entry, tmp_path_factory.mktemp("products") / f"{name}.nc"
            )
        return outcomes[name]

    return run


def test_the_page_has_the_command_of_each_recording() -> None:
    page = (ROOT / "docs" / "real-recordings.md").read_text(encoding="utf-8")
    lines = page.replace(" \\\n        ", " ").splitlines()
    commands = [line.removeprefix("    ") for line in lines if line.startswith("    gyrostab run")]
    assert commands == [SCRIPT.command(entry) for entry in ENTRIES.values()]
    assert page.count(" \\\n") > len(commands)


def deviation(product: xr.Dataset, axis: str, tau: float, unit: str) -> np.ndarray:
    nearest = product["avar"].sel(axis=axis).sel(tau=tau, method="nearest")
    assert float(nearest.tau) == pytest.approx(tau, rel=0.02)
    return np.sqrt(nearest.values) / parse_unit(unit).factor


def overlapped(x: np.ndarray, m: int) -> float:
    """The overlapping Allan deviation by its definition."""
    angle = np.concatenate([[0.0], np.cumsum(x)])
    second = angle[2 * m :] - 2 * angle[m:-m] + angle[: -2 * m]
    return float(np.sqrt(np.mean(second**2) / 2) / m)


@pytest.mark.parametrize("name", ENTRIES)
def test_every_recording_gives_a_product(examine, name):
    log, product, numbers = examine(name)
    assert set("QNBKR") <= set(product.data_vars)
    assert product["axis"].values.tolist() == log["axis"].values.tolist()
    assert np.isfinite(product["avar"].where(product["window_coverage"] == 1, 1.0)).all()
    assert ((product["count"] > 0) | product["avar"].isnull()).all()
    bounds = product["time_bounds"].values
    assert bounds[0, 0] == log["time"].values[0]
    assert bounds[-1, 1] <= log["time"].values[-1] + np.timedelta64(
        round(1e9 / numbers["hertz"]) + 1, "ns"
    )
    assert "{" not in ENTRIES[name]["text"].format_map(numbers | {"refusal": ""})


def test_published_haar_wavelet_variance_at_every_scale(find_entry, recordings, tmp_path):
    """By the command of the page: `gyrostab run` with the whole log as one window."""
    table = pd.read_csv(recordings("reference-wavelet-variance/reference_wavelet_variance.csv.gz"))
    words = shlex.split(SCRIPT.command(find_entry("reference-wavelet-variance")))
    words[words.index("product.nc")] = str(tmp_path / "product.nc")
    assert main([*words[1:], "--quiet-progress"]) == 0
    product = gyrostab.open_product(tmp_path / "product.nc")
    for axis in "xyz":
        rows = table[
            table["sensor"].str.startswith("ADIS") & (table["channel"] == f"Gyro. {axis.upper()}")
        ]
        assert len(rows) == product.sizes["tau"] == 18
        np.testing.assert_allclose(product["tau"], rows["haar_scale_s"] / 2)
        ours = product["avar"].sel(axis=axis).values[0] / 2 / 3600**2
        np.testing.assert_allclose(ours, rows["haar_wavelet_variance"], rtol=1e-6)


def test_the_page_compares_all_scales(examine):
    numbers = examine("reference-wavelet-variance")[2]
    assert numbers["scales"] == 54
    assert 0 < numbers["worst"] < 1e-6


def test_adis16405_is_stationary(examine):
    numbers = examine("adis16405-static-2h47")[2]
    slope = (numbers["n_035"] + numbers["n_075"]) / 2  # the slope is -1/2 between them
    assert numbers["n_x"] == pytest.approx(slope, rel=0.02)
    assert 0.7 < numbers["chi_x"] < 1.4
    assert numbers["chi_z"] > 100
    assert numbers["n_low"] > 0.93 * numbers["n_x"]
    assert numbers["n_high"] < 1.07 * numbers["n_x"]


def test_ring_laser_gyros_sway_intermittently(examine):
    log, product, numbers = examine("rlg-static-30min")
    pieces = deviation(product, "y", 1.0, "deg/h")[
        ::6
    ]  # a window every 30 s, so every sixth one is the next 3 min
    np.testing.assert_allclose(pieces, [121, 92, 74, 6, 5, 82, 7, 13, 20, 47], atol=0.6)
    rate = log["rate"].sel(axis="y").values
    np.testing.assert_allclose(
        pieces, [overlapped(rate[18_000 * i : 18_000 * (i + 1)], 100) for i in range(10)], rtol=1e-9
    )
    assert numbers["low"] < 5.5
    assert 115 < numbers["high"] < 125
    np.testing.assert_allclose(
        [numbers[f"mean_{axis}"] for axis in "xyz"], [-12.27, 0.44, 8.36], atol=0.02
    )


def test_blueseis_ramp_resets_and_white_noise(examine, recordings):
    log, _, numbers = examine("fog-blueseis-ramp")
    counts = pd.read_csv(recordings("fog-blueseis-ramp/fog_ramp.csv.gz"))
    top = counts["ramp_counts"] > 0.95 * 32767
    assert numbers["top"] == pytest.approx(counts["rate_counts"][top].mean(), rel=1e-9)
    assert numbers["top"] - numbers["all"] == pytest.approx(1716, abs=5)  # 1 count is 1 nrad/s
    assert numbers["at_5ms"] == pytest.approx(669, rel=0.01)
    assert numbers["at_1"] == pytest.approx(19, rel=0.05)
    assert numbers["at_10"] == pytest.approx(4.9, rel=0.05)
    assert numbers["excess"] > 2
    assert log["ramp"].attrs["units"] == "1"
    assert numbers["mean"] == pytest.approx(
        15.041067 * np.sin(np.deg2rad(47.9)), rel=2e-3
    )  # vertical Earth rate


def test_blueseis_angle_random_walk_from_one_second_on(examine):
    product, numbers = examine("fog-blueseis-from-1s")[1:]
    white = (
        np.rad2deg(19e-9) * 60
    )  # 19 nrad/s/sqrt(Hz) in deg/sqrt(h): 6.5e-5, or 0.0039 deg/h/sqrt(Hz)
    assert numbers["n"] == pytest.approx(white, rel=0.1)
    assert numbers["n_hz"] == pytest.approx(0.004, rel=0.1)
    assert (product["observable"].sel(term="N") == 2).all()
    whole, found_below = examine("fog-blueseis-ramp")[
        1:
    ]  # the resets of the ramp bend the curve below 1 s
    assert found_below["misfit"] > 100
    assert not (whole["observable"] == 2).any()
    assert (whole["N_upper"] > white).all()


def test_ch104_is_not_the_textbook_curve_below_10_s(examine):
    product, numbers = examine("mems-static-53min")[1:]
    assert numbers["at_1"] == pytest.approx(0.0077, rel=0.01)
    assert numbers["at_100"] == pytest.approx(6.9e-4, rel=0.1)
    assert numbers["n_1"] == pytest.approx(0.0077 * 60, rel=0.01)
    assert numbers["n_x"] < 0.75 * numbers["n_1"]  # noise between 1 and 10 s that is not white
    assert (product["observable"].sel(term="N") == 2).mean() > 0.95


def test_earthquake_in_the_ring_laser(examine):
    product, numbers = examine("ringlaser-g-3h")[1:]
    for tau, known in ((0.05, 1.6e-10), (0.5, 2.9e-11), (5.0, 1.3e-11), (10.0, 9.3e-12)):
        assert deviation(product, "z", tau, "rad/s")[0] == pytest.approx(known, rel=0.1)
    minutes = (product["time"].values - product["time_bounds"].values[0, 0]) / np.timedelta64(
        1, "m"
    )
    at_10 = deviation(product, "z", 10.0, "nrad/s")
    quiet = at_10[minutes < 31]  # these windows end before the waves arrive
    assert at_10[(minutes > 41) & (minutes < 85)].min() > 5 * np.median(quiet)
    assert 36 < minutes[at_10.argmax()] < 90
    assert at_10[minutes > 150].max() < 5 * np.median(quiet)
    assert numbers["rise"] > 40


def test_bursts_of_the_mpu6050(examine):
    text, matlab = (
        examine("mpu6050-static-temperature"),
        examine("mpu6050-static-temperature-matlab"),
    )
    for log, product, numbers in (text, matlab):
        assert 99.2 < numbers["hertz"] < 100.05
        assert np.isfinite(log["rate"]).sum() == 3 * 65_067
        assert 25.2 < numbers["cold"] < numbers["warm"] - 0.1 < 25.4
        assert float(product["temperature"][0] - product["temperature"][-1]) == pytest.approx(
            0.15, abs=0.1
        )
    assert {"accel_x", "accel_y", "accel_z"} <= set(matlab[1].data_vars)
    assert matlab[2]["n_x"] == pytest.approx(text[2]["n_x"], rel=0.01)
    assert any("bursts" in note for note in text[0].attrs["notes"])


def test_the_command_of_the_page_makes_the_same_product(examine, find_entry, tmp_path, capsys):
    product = examine("mpu6050-static-temperature-matlab")[1]
    words = shlex.split(SCRIPT.command(find_entry("mpu6050-static-temperature-matlab")))
    words[words.index("product.nc")] = str(tmp_path / "product.nc")
    assert main([*words[1:], "--quiet-progress"]) == 0
    xr.testing.assert_equal(gyrostab.open_product(tmp_path / "product.nc").load(), product)
    assert "bursts" in capsys.readouterr().err


def test_rocket_flight_with_a_pause(examine):
    log, product, numbers = examine("rocket-flight-temperature-launch-1")
    (gap,) = gyrostab.gap_table(log).itertuples()
    assert gap.seconds == pytest.approx(1068, abs=1)
    assert np.isfinite(log["rate"]).sum() == 3 * 6616
    empty = product["window_coverage"] == 0
    assert 0.9 < float(empty.mean()) < 0.95
    assert np.isnan(product["avar"].where(empty, drop=True)).all()
    assert np.isfinite(product["avar"].where(product["window_coverage"] == 1, 1.0)).all()
    assert (numbers["t_before"], numbers["t_after"]) == pytest.approx((26.5, 32.6), abs=0.2)


def test_rocket_flight_without_a_pause(examine):
    log, _, numbers = examine("rocket-flight-temperature-launch-3")
    assert (log.sizes["gap"], numbers["holes"], log.sizes["time"]) == (0, 0, 7646)
    assert np.isfinite(log["rate"]).all()
    assert numbers["high"] > 1000 * numbers["low"]  # on the pad, and in flight
    assert 49.4 <= numbers["cold"] < numbers["warm"] <= 50.2


def test_autopilot_with_dropouts(examine, recordings):
    log, product, numbers = examine("px4-bench-dropouts")
    stamps = (
        pd.read_csv(recordings("px4-bench-dropouts/sensor_combined.csv.gz"))["timestamp"].to_numpy()
        * 1e-6
    )
    steps = np.diff(stamps)
    assert numbers["holes"] == np.sum(steps > 0.0081) == 8
    assert numbers["lost"] == np.sum(
        np.rint(steps[steps > 0.0081] * log.attrs["sampling_rate_hz"]) - 1
    )
    assert numbers["during"] > 1000 * numbers["before"]
    assert numbers["after"] == pytest.approx(numbers["before"], rel=0.3)
    seconds = (product["time"].values - product["time_bounds"].values[0, 0]) / np.timedelta64(
        1, "s"
    )
    shaken = seconds[deviation(product, "x", 0.1, "rad/s") > 0.01]
    assert shaken.max() < 30
    assert shaken.max() - shaken.min() < 4 + 2 * 2 + 1  # 4 s of handling, seen by windows of 2 s


def test_stamps_rewritten_by_a_spreadsheet(examine):
    log, _, numbers = examine("mav-flight-adis16448")
    assert np.isfinite(log["rate"]).sum() == 3 * 36_820
    assert log.sizes["time"] == 36_820
    (note,) = [note for note in log.attrs["notes"] if "unreadable" in note]
    assert "7 of 36827 rows" in note
    assert all(str(line) in note for line in range(36_822, 36_829))
    assert numbers["quiet"] == pytest.approx(
        1.6968e-4, rel=0.15
    )  # the noise density of imu0_sensor.yaml, at 1 s
    assert numbers["flight"] > 100 * numbers["quiet"]


@pytest.mark.parametrize(
    ("name", "rows"),
    [("fog-hybrid-warmup-static", [5818]), ("fog-hybrid-warmup-turn", [1341, 1960, 2550])],
)
def test_restarts_of_the_hybrid_unit(examine, name, rows):
    log, product, numbers = examine(name)
    assert numbers["restarts"] == len(rows)
    named = [
        int(match.group(1))
        for note in log.attrs["notes"]
        if (match := re.search(r"time restarts at row (\d+):", note))
    ]
    assert named == rows
    assert {"temperature", "temperature_rate"} <= set(product.data_vars)


def test_fiber_optic_axis_of_the_hybrid_unit(examine):
    numbers = examine("fog-hybrid-warmup-static")[2]
    assert 20 < numbers["quieter"] < 30
    assert numbers["n_z"] == pytest.approx(0.013, rel=0.2)
    assert examine("fog-hybrid-warmup-turn")[2]["turn"] == pytest.approx(123, abs=1)


def test_fiber_optic_rotation_sensor_in_an_earthquake(examine):
    log, product, numbers = examine("fog-rotation-earthquake")
    assert log.sizes["time"] == 7400
    assert numbers["shaken"] > 20 * numbers["quiet"]
    assert product["axis"].values.tolist() == ["x", "y", "z"]


def test_drill_string_without_a_gyro(examine, find_entry, recordings):
    log, product, numbers = examine("drill-rig-stick-slip")
    message = SCRIPT.refusal(find_entry("drill-rig-stick-slip"))
    assert re.search(
        r"^drill_rig\.csv\.gz: no gyro column .*bit_speed, top_speed.*"
        r"--map \"bit_speed=gyro_x\" --unit",
        message,
    )
    table = pd.read_csv(recordings("drill-rig-stick-slip/drill_rig.csv.gz"))
    assert (numbers["low"], numbers["high"]) == pytest.approx(
        (table["bit_speed"].min(), table["bit_speed"].max())
    )
    assert float(log["rotation_rate"].mean()) == pytest.approx(
        6 * table["top_speed"].mean()
    )  # rpm in deg/s
    assert product["rotation_rate"].attrs["units"] == "degree s-1"
    assert (
        numbers["at_slip"] > 3 * numbers["at_full"]
    )  # a line at 2.7 Hz does not show at its period


def test_one_recording_on_the_page(find_entry, tmp_path):
    entry = find_entry("fog-hybrid-warmup-turn")
    row, section, followed = SCRIPT.describe("fog-hybrid-warmup-turn", entry, tmp_path)
    assert row.count("|") == 10
    assert "adamShiau/adamShiau_Python" in row
    assert "3 restarts of the clock" in section
    assert "left out" not in section
    assert followed == ""  # temperature is compared on the static run


def test_page_has_a_row_for_every_recording_and_no_path():
    page = (ROOT / "docs" / "real-recordings.md").read_text(encoding="utf-8")
    assert "make real-recordings" in page
    assert not re.search(r"(?<![\w.])/(work|home|tmp|usr|root)\b", page)
    for name, entry in ENTRIES.items():
        (row,) = [line for line in page.splitlines() if line.startswith(f"| [{name}]")]
        assert f"| {entry['source']} | {entry['licence']} |" in row


def test_sources_and_licences_are_those_of_the_recordings(recordings):
    lines = recordings("README.md").read_text(encoding="utf-8").splitlines()
    for entry in ENTRIES.values():
        folder = (
            entry["licence"]
            if entry["source"] == "SMAC-Group/wv"
            else entry["files"][0].split("/")[0]
        )
        rows = [line for line in lines if line.startswith("| ") and f"| {entry['source']}" in line]
        assert any(entry["licence"] in row.split("|")[-2] and folder in row for row in rows), entry[
            "source"
        ]
