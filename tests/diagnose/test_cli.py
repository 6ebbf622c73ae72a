"""A diagnosis from log to files, the command line, and its errors."""

from __future__ import annotations

import json
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import gyrostab
from gyrostab.diagnose.core import diagnose
from gyrostab.diagnose.nulls.scores import fit_best_evidence
from gyrostab.diagnose.predict.candidates import Candidate, Component, Variant
from gyrostab.diagnose.result.active_spans import join_blocks
from gyrostab.diagnose.result.content import check_diagnosis
from gyrostab.diagnose.settings import DEFAULTS
from gyrostab.diagnose.statistics import find_statistic
from gyrostab.diagnose.task import parse_quiescent_span
from gyrostab.errors import OptionError, SchemaError
from gyrostab.ingest.make_log import make_log
from gyrostab.io.datasets import to_netcdf
from gyrostab.report.diagnosis import FILES
from gyrostab.simulate import simulate
from tests.support.command_line import call

VIBRATED = {
    "log": {
        "axes": ["x"],
        "rate": 20.0,
        "duration": "16min",
        "start": "2026-03-14T08:00:00",
        "seed": 5,
    },
    "noise": {"N": 0.003},
    "environment": [
        {
            "profile": "vibration",
            "points": [[0, 0.02], [399, 0.02], [400, 6.0], [640, 6.0], [641, 0.02]],
        },
        {
            "profile": "steps",
            "channel": "supply_voltage",
            "unit": "V",
            "points": [[0, 28]],
            "sensor_rate": 0.5,
        },
        {
            "profile": "ramps",
            "channel": "temperature",
            "unit": "degC",
            "points": [[0, 20], [960, 24]],
            "sensor_rate": 0.2,
        },
    ],
    "effect": [{"name": "vibration_noise", "axes": ["x"], "white": 0.0006}],
}


def white(
    axes: int = 1, *, seconds: float = 600.0, rate: float = 10.0, seed: int = 1
) -> xr.Dataset:
    values = np.random.default_rng(seed).standard_normal((axes, round(seconds * rate)))
    return make_log(values, rate=rate, unit="deg/h", start="2026-03-14T08:00:00")


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    """Noise that rises with vibration, a constant channel, and one with gaps."""
    log = simulate(VIBRATED).compute()
    log["temperature"] = log["temperature"].where(
        (np.arange(log.sizes["time_temperature"]) // 20) % 3 != 1
    )
    return to_netcdf(log, tmp_path_factory.mktemp("recording") / "log.nc")


@pytest.fixture(scope="module")
def folder(recording, tmp_path_factory) -> Path:
    output = tmp_path_factory.mktemp("found") / "diagnosis"
    assert (
        call("diagnose", recording, "-o", output, "--nulls", 100, "--seed", 1, "--quiet-progress")
        == 0
    )
    return output


def test_command_writes_four_files(folder: Path):
    assert sorted(path.name for path in folder.iterdir()) == sorted(FILES)
    assert [path.name for path in folder.parent.iterdir()] == ["diagnosis"]


def test_simulated_effect_is_identified(
    folder: Path,
):
    content = json.loads((folder / "diagnosis.json").read_text())
    check_diagnosis(content)
    assert content["recording"]["axes"] == ["x"]
    assert set(content["recording"]["channels"]) == {"vibration", "supply_voltage", "temperature"}
    assert content["verdict"] == "explained", content["mismatches"]
    (effect,) = content["effects"]
    assert "vibration_noise" in [effect["name"], *effect["alternatives"]]
    assert effect["driver"] == "vibration"
    assert 0.0 < effect["probability"] < 1.0
    region = next(region for region in content["mismatches"] if region["view"] == "davar")
    assert effect["name"] in region["explained_by"]
    begin, end = (np.datetime64(region[name].removesuffix("Z")) for name in ("start", "end"))
    assert abs(begin - np.datetime64("2026-03-14T08:06:40")) < np.timedelta64(45, "s")
    assert abs(end - np.datetime64("2026-03-14T08:10:40")) < np.timedelta64(45, "s")
    assert content["baseline"]["noise"]["x"]["N"]["value"] == pytest.approx(0.003, rel=0.05)
    assert content["held_out"]["log_likelihood_gain"] > 10.0
    assert "supply_bias" in content["not_found"]


def test_model_reproduces_the_recording(folder: Path, recording: Path, tmp_path: Path):
    second_log = tmp_path / "again.nc"
    assert (
        call(
            "simulate",
            folder / "model.toml",
            "--like",
            recording,
            "-o",
            second_log,
            "--quiet-progress",
        )
        == 0
    )
    now, before = (
        gyrostab.open_log(second_log).rate.values[0],
        gyrostab.open_log(recording).rate.values[0],
    )
    loud = slice(8100, 12700)
    assert now[loud].std() == pytest.approx(before[loud].std(), rel=0.1)
    assert now[:7900].std() == pytest.approx(before[:7900].std(), rel=0.06)


def test_python_opens_the_output_folder(folder: Path):
    diagnosis = gyrostab.open_diagnosis(folder)
    assert diagnosis.effects
    assert list(diagnosis.surfaces["case"].values) == ["recording", "before", "after"]
    assert set(diagnosis.surfaces.data_vars) >= {
        "avar",
        "mean",
        "block_mean",
        "density",
        "line_density",
        "channel_vibration",
    }
    assert diagnosis.model["noise"].keys() == {"x"}
    assert (
        tomllib.loads((folder / "model.toml").read_text())["effect"][0]["name"]
        == diagnosis.effects[0]["name"]
    )


def test_noise_without_channels_has_no_mismatch_and_a_constant_axis_is_left_out():
    labels: list[str] = []
    log = white(2, seed=2)
    log["rate"][1] = 3.0
    with pytest.warns(UserWarning, match="the same on axis y: left out"):
        diagnosis = diagnose(
            log,
            nulls=100,
            block="20s",
            progress=lambda label, *rest, **more: labels.append(label),
        )
    check_diagnosis(diagnosis.content)
    assert diagnosis.verdict == "no mismatch"
    assert diagnosis.effects == []
    assert diagnosis.content["recording"]["channels"] == []
    assert diagnosis.content["recording"]["axes"] == ["x"]
    assert list(diagnosis.content["baseline"]["noise"]) == ["x"]
    assert diagnosis.content["not_found"]["shupe"]["upper_limit"] is None
    assert list(dict.fromkeys(labels)) == [
        "reducing",
        "calibrating",
        "naming",
        "comparing",
        "fitting",
    ]
    with pytest.raises(SchemaError, match="the same on axis y: without noise"):
        diagnose(log.isel(axis=[1]), nulls=100)


# --------------------------------------------------------------------------------
# manners


def test_axis_is_diagnosed_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
):
    noise = {"noise": {"N": 0.003}, "log": {"axes": ["x", "y"]}}
    path = to_netcdf(simulate(noise, duration="1min", rate=10.0, seed=1), tmp_path / "log.nc")
    axes: list[list[str]] = []

    def stop(log: xr.Dataset, *, simulation: xr.Dataset, **_: object) -> None:
        axes.extend(given["axis"].values.tolist() for given in (log, simulation))
        raise OptionError("this is enough")

    monkeypatch.setattr(sys.modules[diagnose.__module__], "diagnose", stop)
    options = ["--simulation", path, "-o", tmp_path / "found"]
    assert call("diagnose", path, "--axis", "up", *options) == 2
    assert "axis 'up' is not in the log; it has x, y" in capfd.readouterr().err
    assert call("diagnose", path, "--axis", "y", *options) == 2
    assert "this is enough" in capfd.readouterr().err
    assert axes == [["y"], ["y"]]


@pytest.mark.slow
def test_diagnosis_of_an_axis_has_this_axis_alone(tmp_path: Path):
    noise = {"noise": {"N": 0.003}, "log": {"axes": ["x", "y"]}}
    to_netcdf(simulate(noise, duration="5min", rate=10.0, seed=1), tmp_path / "log.nc")
    options = ["--nulls", "100", "-o", tmp_path / "found"]
    assert call("diagnose", tmp_path / "log.nc", "--axis", "y", *options) == 0
    content = json.loads((tmp_path / "found" / "diagnosis.json").read_text())
    assert list(content["baseline"]["noise"]) == ["y"]


def test_existing_folder_is_kept(folder: Path, recording: Path, capfd: pytest.CaptureFixture[str]):
    before = (folder / "diagnosis.json").read_bytes()
    capfd.readouterr()
    assert call("diagnose", recording, "-o", folder) == 2
    assert "--overwrite" in capfd.readouterr().err
    assert (folder / "diagnosis.json").read_bytes() == before


def test_short_recording_is_refused_with_the_required_length(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
):
    to_netcdf(white(seconds=60.0), tmp_path / "short.nc")
    assert call("diagnose", tmp_path / "short.nc", "-o", tmp_path / "found") == 2
    message = capfd.readouterr().err
    assert "too short to diagnose" in message
    assert "240 s at least" in message
    assert not (tmp_path / "found").exists()


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (
            lambda log: white(rate=20.0),
            "the sampling rate of the simulated log is 20 Hz, that of the recording 10 Hz",
        ),
        (
            lambda log: log.isel(time=slice(0, 5000)),
            "the number of samples of the simulated log is 5000, that of the recording 6000",
        ),
        (
            lambda log: white(axes=2),
            "the list of axes of the simulated log is x, y, that of the recording x",
        ),
        (
            lambda log: make_log(log.rate.values, rate=10.0, unit="deg/h", start="2027-01-01"),
            "the start of the simulated log is 2027-01-01",
        ),
    ],
)
def test_simulation_on_other_stamps_is_refused(change, complaint: str):
    log = white()
    with pytest.raises(OptionError) as raised:
        diagnose(log, simulation=change(log))
    assert complaint in str(raised.value)
    assert "--like RECORDING" in str(raised.value)


def test_invalid_options_are_refused(tmp_path: Path, capfd: pytest.CaptureFixture[str]):
    log = white()
    for options, complaint in (
        ({"nulls": 20}, "nulls=20"),
        ({"false_alarm_level": 0.7}, "false_alarm_level=0.7"),
        ({"seed": -1}, "seed=-1"),
        ({"seed": 1.5}, "seed=1.5: give a whole number"),
        ({"quiet": 5}, r"quiet=5: give \(start, end\)"),
        ({"simulation": 5}, "the model is of type int; give a TOML file"),
        ({"block": "1s"}, "needs 16"),
        ({"quiet": (1e5, 2e5)}, r"100000 s to 200000 s after the start is outside of the"),
        ({"simulation": {"noise": {"x": {"K": 0.0}}}}, "no noise"),
    ):
        with pytest.raises(OptionError, match=complaint):
            diagnose(log, **options)
    with pytest.raises(SchemaError):
        diagnose(xr.Dataset())
    to_netcdf(log, tmp_path / "log.nc")
    assert (
        call("diagnose", tmp_path / "log.nc", "--quiet", "morning", "-o", tmp_path / "found") == 2
    )
    assert "START/END" in capfd.readouterr().err
    assert (
        call(
            "diagnose",
            tmp_path / "log.nc",
            "--simulation",
            tmp_path / "no.toml",
            "-o",
            tmp_path / "found",
        )
        == 2
    )
    assert "no.toml" in capfd.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["log.nc"]


@pytest.mark.parametrize(
    "text", ["", "1h", "0s/", "0s/1h/2h", "dawn/dusk", "2026-13-40/2026-14-50"]
)
def test_unreadable_quiescent_stretches_are_refused(text: str):
    with pytest.raises(OptionError, match="quiet"):
        parse_quiescent_span(text)


def test_quiescent_stretch_is_read_like_other_spans():
    begin, end = parse_quiescent_span("2026-03-14T09:00+01:00/30min")
    assert (begin, end) == (np.datetime64("2026-03-14T08:00"), 1800.0)


# --------------------------------------------------------------------------------
# pieces


def test_intervals_are_few_or_the_whole_record():
    begin = np.arange(200.0)
    is_active = np.zeros(200, bool)
    is_active[50:80] = is_active[82:90] = True
    assert join_blocks(is_active, begin, begin + 1.0) == [(50.0, 90.0)]
    is_active[150:170] = True
    assert join_blocks(is_active, begin, begin + 1.0) == [(50.0, 90.0), (150.0, 170.0)]
    assert join_blocks(np.arange(200) % 12 < 3, begin, begin + 1.0) == [(0.0, 200.0)]


def test_line_explains_only_its_own_frequency():
    line = Component(
        Candidate("spectral_line", find_statistic("spectral_line"), (), ()),
        Variant({}, ("amplitude",), np.empty(0)),
        ("x",),
        50.0,
        line_index=116,
    )
    blocks = xr.Dataset(coords={"line_frequency": ("line", np.arange(1, 400) * 0.25)})
    region = {
        "view": "spectrum",
        "quantity": "line",
        "frequency": 29.25,
        "tau_min_s": 0.017,
        "tau_max_s": 0.017,
    }

    def can_explain(region):
        return line.statistic.can_explain(line, region, blocks, DEFAULTS)

    short = {
        "view": "davar",
        "quantity": "avar",
        "frequency": np.nan,
        "tau_min_s": 0.01,
        "tau_max_s": 0.02,
    }
    assert can_explain(region)
    assert not can_explain(region | {"frequency": 12.5})
    assert not can_explain(region | {"quantity": "ramp phase", "frequency": np.nan})
    assert can_explain(short)
    assert not can_explain(short | {"tau_min_s": 1.0, "tau_max_s": 9.0})
    assert not can_explain(short | {"view": "mean", "quantity": "mean"})


def test_p_value_is_extrapolated_beyond_the_null_records():
    null = fit_best_evidence(np.random.default_rng(1).exponential(size=400))
    chances = null.probability(np.linspace(0.0, 20.0, 60))
    assert np.all(np.diff(chances) <= 1e-12)
    assert null.probability(7.0) == pytest.approx(np.exp(-7.0), rel=0.9)
    assert null.probability(0.5) == pytest.approx(np.exp(-0.5), abs=0.06)
