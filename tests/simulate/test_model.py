"""Models and the simulate command: units, error messages and shipped models."""

from __future__ import annotations

import re

import numpy as np
import pytest

from gyrostab.errors import FormatError, OptionError, SchemaError, TimeError
from gyrostab.ingest.grid.gaps import gap_table
from gyrostab.io.opening import open_log
from gyrostab.schema import check_log
from gyrostab.simulate import read_model, simulate
from gyrostab.simulate.model import PROFILES
from tests.conftest import ROOT
from tests.support.command_line import call
from tests.support.simulated import BIASED, LOG, WORLD, model

# --------------------------------------------------------------------------------
# models


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"effects": []}, r"no section 'effects' \(did you mean 'effect'\?\); there are \[log\]"),
        ({"effect": {"name": "shupe"}}, r"write effect as \[\[effect\]\]"),
        ({"noise": {"W": 1}}, r"no noise term 'W'; there are Q \[urad\], N \[deg/sqrt\(h\)\]"),
        (
            {"noise": {"N": "3 m"}},
            r"the unit 'm' is not known here; give the number in deg/sqrt\(h\)",
        ),
        ({"noise": {"x": {"N": -1}}}, r"\[noise.x\]: N = -1 is not a number from 0 to 1e\+100"),
        ({"noise": {"N": 1e300}}, r"\[noise\]: N = 1e\+300 is not a number from 0 to 1e\+100"),
        ({"noise": {"flicker_band": 3}}, "flicker_band is 3; write"),
        (
            {"log": {"rat": 10}},
            r"\[log\]: there is no 'rat' \(did you mean 'rate'\?\); there are rate, duration",
        ),
        ({"log": LOG | {"seed": 1.5}}, "seed = 1.5 is not a whole number"),
        ({"log": {"duration": "1h"}}, "there is no rate; give rate = 100"),
        ({"log": {"rate": 100}}, "there is no duration; give duration = 1h"),
        ({"log": LOG | {"rate": "fast"}}, "'fast' is not a number with a unit"),
        (
            {"log": LOG | {"axes": ["x"]}},
            "effect 'g_sensitivity': the log has no axis 'y'; it has x",
        ),
        ({"environment": [{}]}, "an environment has no profile; there are steps, ramps, vibration"),
        (
            {"environment": [{"profile": "vibratoin"}]},
            "no profile 'vibratoin' .did you mean 'vibration'",
        ),
        (
            {"environment": [{"profile": "chamber", "speeed": 1}]},
            r"no parameter 'speeed' .did you mean 'speed'.*speed \[degC/min\]",
        ),
        (
            {"environment": [{"profile": "vibration"}]},
            "lacks the parameter 'points'; it has points, ",
        ),
        ({"environment": [{"profile": "rotation"}]}, "stick_slip .*; see docs/simulate.md"),
        ({"environment": [{"profile": "vibration", "points": [[5, 1], [0, 1]]}]}, "do not rise"),
        (
            {"environment": [{"profile": "vibration", "points": [1, 2]}]},
            "is not a list of .time .s., vibration .g..",
        ),
        ({"environment": [WORLD[0], WORLD[0]]}, "the channel 'vibration' twice"),
        ({"environment": [WORLD[1] | {"channel": 3}]}, "channel = 3 is not text"),
        ({"environment": [WORLD[1] | {"channel": "axis"}]}, "channel 'axis': variables of gyrosta"),
        ({"environment": [WORLD[5] | {"cuts": 3}]}, "cuts = 3 is not a list"),
        ({"environment": [WORLD[5] | {"cuts": [[20, 10]]}]}, "each must end after it begins"),
        ({"environment": ["chamber"]}, "environment 1 is 'chamber', not a table"),
        ({"effect": [BIASED[0] | {"axes": 3}]}, "axes = 3 is not a list of names"),
        ({"effect": [BIASED[0] | {"driver": [3]}]}, r"driver = \[3\] is not a list of names"),
        ({"log": LOG | {"axes": ["x", "x"]}}, "is not a list of different names"),
        ({"log": LOG | {"duration": 1e300}}, "the duration 1e.300 is not valid"),
        ({"log": LOG | {"duration": 1e9, "rate": 1e6}}, "a duration of .* has more than 1e.10 "),
        ({"environment": [{"profile": "losses", "per_hour": 1e300}]}, "at most 1e8 gaps"),
        ({"environment": [{"profile": "losses", "seed": "x"}]}, "seed='x': give a whole number"),
        ({"delay": {"q": np.inf}}, r"\[delay\]: q = inf is not a number up to 86400; give one in "),
        ({"environment": [WORLD[0] | {"band": [1]}]}, r"band of vibration \[1\]: give \[lower, hi"),
        (
            {"environment": [WORLD[0] | {"band": [[1], [2]]}]},
            r"band of vibration \[\[1\], \[2\]\]:",
        ),
        (
            {"environment": [WORLD[1], WORLD[1] | {"channel": "time_temperature"}]},
            "a channel 'time_temperature', which is the name of the times of another",
        ),
        (
            {"environment": [{"profile": "chamber", "speed": 1e12, "hold": 0}]},
            "half a cycle takes 6e-09 s, less than the interval of a sensor with 1 Hz; give",
        ),
        ({"environment": [WORLD[2] | {"accelerations": "false"}]}, "'false' is not true or false"),
        ({"environment": [{"profile": "losses", "within": 0.5}]}, "within=0.5 must not be below 1"),
        ({"effect": [BIASED[0] | {"sensitivity": 10**400}]}, "'sensitivity': the number is too la"),
        ({("a",): 1}, "mapping of the model cannot be kept as text .*; give the tables of docs"),
        (
            {"environment": [{"profile": "chamber", "lag": "5 m"}]},
            "the unit 'm' is not known here; give the number in s",
        ),
    ],
)
def test_invalid_model_is_explained(wrong, words):
    with pytest.raises(OptionError, match=words):
        simulate(model() | wrong)


def test_a_wrong_effect_names_file_and_place(tmp_path):
    path = tmp_path / "m.toml"
    path.write_text(
        '[noise]\nN = 1\n[[effect]]\nname = "temperature_bias"\nsensitivity = 1\n'
        '[[effect]]\nname = "shuppe"\n'
    )
    with pytest.raises(
        OptionError,
        match=rf"{re.escape(str(path))}, effect 2: there is no effect 'shuppe'.*; "
        "there are .*temperature_bias",
    ):
        read_model(path)
    path.write_text("[noise\n")
    with pytest.raises(FormatError, match="not a TOML file"):
        read_model(path)
    with pytest.raises(FormatError, match="cannot be read"):
        read_model(tmp_path / "none.toml")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[log]\nduration = -5", "duration -5 must be longer"),
        ("[log]\nstart = 'yesterday'", "start 'yesterday' is not a date"),
        (
            "[noise]\nB = 1\nflicker_band = [1, 0.1]",
            "the band of flicker noise 1 to 0.1 Hz is empty",
        ),
        ("[[environment]]\nprofile = 'vibration'\npoints = [[0, nan]]", "points of vibration: "),
        (
            "[[effect]]\nname = 'temperature_bias'\nsensitivity = 1",
            "needs the channel 'temperature'",
        ),
        ("[noise.x]\nN = 1\n[bias]\nq = 2", "there is no axis 'q' in this log; it has x"),
        ("[delay]\nvibration = '2 m/s'", "delay of vibration: the unit 'm/s' is not known"),
        ("[delay]\nvibration = 12", "[delay]: the log has no channel 'vibration'; it has none"),
        ("[log]\nstart = '2262-04-11T23:47:00'", "begin or end outside the years 1678 to 2262"),
        (
            "[log]\noversampling = 2\n[[effect]]\nname = 'feedback_reset'\nkick = 1\n"
            "phase = 'channel'\n[[environment]]\nprofile = 'ramps'\nchannel = 'ramp'\nunit = '1'\n"
            "points = [[0, 0]]",
            "a ramp that wraps cannot be interpolated to 2 samples",
        ),
    ],
)
def test_errors_of_a_simulation_name_the_file_of_the_model(text, words, tmp_path):
    path = tmp_path / "m.toml"
    path.write_text(text)
    duration = None if "duration" in text else "1min"
    with pytest.raises((OptionError, SchemaError, TimeError)) as error:
        simulate(path, duration=duration, rate=10.0)
    assert str(error.value).startswith(f"{path}: ")
    assert words in str(error.value)


def test_axes_come_from_the_model():
    assert read_model({"noise": {"x": {"N": 1}, "w": {"N": 1}}}).axes == ("x", "w")
    assert read_model({"noise": {"N": 1, "x": {"N": 2}}}).axes == ()
    assert list(simulate({"noise": {"x": {"N": 1}}}, duration="1s", rate=10.0).axis.values) == ["x"]


def test_units_are_converted():
    made = read_model(
        {
            "noise": {"Q": "1 arcsec", "B": "0.001 deg/s"},
            "log": {"duration": "2 min", "rate": "1 kHz"},
        }
    )
    assert made.coefficients("x")["Q"] == pytest.approx(np.pi / 180 / 3600 * 1e6)
    assert made.coefficients("x")["B"] == pytest.approx(3.6)
    assert made.log == {"duration": 120.0, "rate": 1000.0}


# --------------------------------------------------------------------------------
# command


def test_command_writes_a_log_that_run_takes(tmp_path, capsys):
    path = tmp_path / "m.toml"
    path.write_text(
        '[noise]\nN = 0.02\n[[environment]]\nprofile = "chamber"\n'
        '[[effect]]\nname = "temperature_bias"\nsensitivity = 0.01\naxes = "x"\n'
    )
    out = tmp_path / "log.nc"
    options = ["--duration", "2min", "--rate", "50", "--seed", "3", "--quiet-progress"]
    assert call("simulate", path, "-o", out, *options) == 0
    log = open_log(out)
    assert log.sizes["time"] == 6000
    np.testing.assert_array_equal(
        log.rate.values, simulate(path, duration="2min", rate=50.0, seed=3).rate.values
    )
    assert call("run", out, "-o", tmp_path / "p.nc", "--window", "30s", "--quiet-progress") == 0
    second_log = tmp_path / "again.nc"
    assert (
        call("simulate", path, "-o", second_log, "--like", out, "--seed", "3", "--quiet-progress")
        == 2
    )  # temperature twice
    assert "the channel 'temperature' twice" in capsys.readouterr().err
    path.write_text("[noise]\nN = 0.02\n")
    assert (
        call("simulate", path, "-o", second_log, "--like", out, "--seed", "3", "--quiet-progress")
        == 0
    )
    assert (open_log(second_log).time.values == log.time.values).all()


# --------------------------------------------------------------------------------
# shipped models

MODELS = sorted((ROOT / "data" / "models").glob("*.toml"))


@pytest.mark.parametrize("path", MODELS, ids=lambda path: path.stem)
def test_shipped_models_make_logs(path):
    log = simulate(path)
    check_log(log)
    values = log.rate.isel(time=slice(0, 500)).values
    assert np.isfinite(values).all()
    assert (values.std(axis=1) > 0).all()


def test_shipped_models_are_complete():
    assert {"p16_vibration", "l13_vibration", "l13_temperature", "mwd_24h"} <= {
        path.stem for path in MODELS
    }


def test_p16_model_has_its_timeline():
    log = simulate(ROOT / "data" / "models" / "p16_vibration.toml")
    assert log.attrs["sampling_rate_hz"] == 400
    assert log.sizes["time"] == 930 * 400
    assert gap_table(log)[["seconds", "samples"]].values.tolist() == [[18.0, 7200]]
    shaken = log.vibration.values > 1
    assert (np.flatnonzero(shaken)[[0, -1]] == [330, 629]).all()
    x = log.rate.sel(axis="x").values.reshape(93, 4000)
    assert np.nanstd(x[33:43]) > 3 * np.nanstd(x[:33])


def test_the_guide_lists_every_profile():
    text = (ROOT / "docs" / "simulate.md").read_text(encoding="utf-8")
    for name in PROFILES:
        assert f"`{name}`" in text


@pytest.mark.parametrize(
    "option",
    [("--channel", "t.csv"), ("--map", "a=gyro_x"), ("--from", "1min"), ("--max-gap", "1h")],
)
def test_reading_options_without_a_recording_are_refused(option, tmp_path, capfd):
    path = tmp_path / "m.toml"
    path.write_text("[noise]\nN = 0.01\n")
    options = ["--duration", "1min", "--rate", "10", *option]
    assert call("simulate", path, "-o", tmp_path / "log.nc", *options) == 2
    assert "how to read the recording of --like" in capfd.readouterr().err
    assert not (tmp_path / "log.nc").exists()
