"""Short quiescent intervals, alone and together with a simulation."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import xarray as xr

import gyrostab
from gyrostab.diagnose.baseline.calibrate import calibrate_noise, calibrate_on_training_blocks
from gyrostab.diagnose.baseline.from_model import baseline_from_model
from gyrostab.diagnose.baseline.from_simulation import baseline_from_simulation
from gyrostab.diagnose.baseline.quiescent import given_quiescent_blocks
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.errors import OptionError
from tests.diagnose.baseline.test_calibrate import NOISE, SHAKEN, log

SHAKE_NOISE = {"name": "vibration_noise", "white": 0.002, "axes": ["x"]}


def value_of(baseline, term, axis="x"):
    return tuple(
        float(baseline[name].sel(axis=axis, term=term)) for name in ("coefficient", "stderr")
    )


@pytest.mark.parametrize(
    "span",
    [
        ("2min", "4min"),
        (np.timedelta64(2, "m"), np.timedelta64(4, "m")),
        (np.datetime64("1970-01-01T00:02"), "1970-01-01T00:04:00Z"),
        (120, 240.0),
    ],
)
def test_the_ends_of_a_quiet_time_are_instants_or_durations(span):
    blocks = reduce_log(log({"N": 0.003}, duration="8min"))
    chosen = given_quiescent_blocks(blocks, span)
    inside = (blocks["begin"].values >= 120.0) & (blocks["end"].values <= 240.0)
    np.testing.assert_array_equal(chosen, np.broadcast_to(inside, chosen.shape))
    with pytest.raises(OptionError, match="neither a time nor a duration"):
        given_quiescent_blocks(blocks, ("0s", "soon"))


@pytest.mark.parametrize("block_count", [1, 2, 4, 15])
def test_a_short_quiet_time_calibrates_with_a_warning(block_count):
    blocks = reduce_log(log({"N": 0.003}, duration="30min"))
    step = blocks.attrs["block_s"]
    with pytest.warns(
        UserWarning, match=rf"holds {block_count} whole blocks? of {step:g} s: N is known to \d"
    ):
        baseline = calibrate_noise(blocks, quiet=(0.0, block_count * step + 1.0))
    value, error = value_of(baseline, "N")
    assert 0.0 < error < 0.25 * value
    assert abs(value - 0.003) < 4.0 * error
    assert np.isfinite(baseline["spectrum"].values).all()


def test_the_error_of_a_short_calibration_covers_the_truth():
    pulls = []
    for seed in range(8):
        blocks = reduce_log(log({"N": 0.003}, seed=seed, duration="20min"))
        with pytest.warns(UserWarning, match="N is known to"):
            value, error = value_of(calibrate_noise(blocks, quiet=(0.0, 45.0)), "N")
        pulls.append((value - 0.003) / error)
    assert np.abs(pulls).max() < 4.0


@pytest.mark.parametrize("left_out", [False, True])
def test_an_axis_without_spectra_in_the_training_blocks_is_not_calibrated_again(left_out):
    blocks = reduce_log(log({"N": 0.003}, duration="30min"))
    baseline = calibrate_noise(blocks)
    training = np.arange(blocks.sizes["block"]) % 4 > 0
    if left_out:
        blocks["power"].values[0, training] = np.nan
    again = calibrate_on_training_blocks(blocks, baseline, training)
    assert (again is baseline) == left_out


def test_quiet_time_scales_the_noise_of_a_model():
    """The noise of the model is 20 % too low: one factor corrects it, effects keep their size."""
    recording = log(effects=[SHAKE_NOISE], environment=[SHAKEN])
    blocks = reduce_log(recording)
    model = {"noise": {name: 0.8 * size for name, size in NOISE.items()}, "effect": [SHAKE_NOISE]}
    raw = baseline_from_model(blocks, model)
    with pytest.warns(UserWarning, match=r"simulation is multiplied by 1\.[23]\d* on axis x"):
        scaled = baseline_from_model(blocks, model, quiet=(0.0, 1100.0))
    assert value_of(raw, "N") == (pytest.approx(0.0024), 0.0)
    for term, size in NOISE.items():
        value, error = value_of(scaled, term)
        assert abs(value - size) < 4.0 * error
        assert error == pytest.approx(
            value * value_of(scaled, "N")[1] / value_of(scaled, "N")[0], rel=1e-6
        )
    assert scaled.attrs["source"] == "model"
    assert scaled.attrs["calibrated_on"] == [
        ["1970-01-01T00:00:00.000Z", "1970-01-01T00:18:20.000Z"]
    ]
    middle = ((blocks["begin"] + blocks["end"]) / 2.0).values
    shaken = (middle > 1220) & (middle < 1480)
    for expected, where in ((1.0, ~shaken), (1.0, shaken)):
        ratio = float((blocks["power"] / scaled["spectrum"])[0, where].mean())
        assert ratio == pytest.approx(expected, abs=0.1)
    assert (
        scaled["spectrum"].values[0, shaken].mean()
        > 1.5 * scaled["spectrum"].values[0, ~shaken].mean()
    )


def test_quiet_time_calibrates_with_an_active_effect():
    """Constant vibration: its noise is in the model and does not raise the noise level."""
    shaken = {"profile": "vibration", "points": [[0, 6.0], [3600, 6.0]]}
    blocks = reduce_log(log(effects=[SHAKE_NOISE], environment=[shaken]))
    model = {"noise": {name: 0.8 * size for name, size in NOISE.items()}, "effect": [SHAKE_NOISE]}
    value, error = value_of(baseline_from_model(blocks, model, quiet=(0.0, 1800.0)), "N")
    assert abs(value - 0.003) < 4.0 * error
    assert error < 0.15 * value


def test_a_simulated_log_is_scaled_to_quiet_time():
    blocks, simulated = (
        reduce_log(log(seed=1)),
        reduce_log(log({name: 0.8 * size for name, size in NOISE.items()}, seed=2)),
    )
    plain, scaled = (
        baseline_from_simulation(blocks, simulated),
        baseline_from_simulation(blocks, simulated, quiet=(0.0, 1800.0)),
    )
    assert abs(value_of(plain, "N")[0] - 0.0024) < 1e-4
    value, error = value_of(scaled, "N")
    assert abs(value - 0.003) < 4.0 * error
    assert float((blocks["power"] / scaled["spectrum"]).mean()) == pytest.approx(1.0, abs=0.05)
    assert scaled.attrs["calibrated_on"] == [
        ["1970-01-01T00:00:00.000Z", "1970-01-01T00:30:00.000Z"]
    ]


@pytest.mark.slow
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_simulation_and_quiet_time_can_be_combined():
    recording = log({"N": 0.003}, duration="15min")
    with pytest.warns(UserWarning, match=r"simulation is multiplied by 1\.[45]\d* on axis x"):
        diagnosis = gyrostab.diagnose(
            recording, simulation={"noise": {"N": 0.002}}, quiet=(0.0, 200.0), nulls=100
        )
    assert diagnosis.verdict == "no mismatch"
    assert diagnosis.content["baseline"]["source"] == "model"
    assert diagnosis.content["baseline"]["calibrated_on"]
    assert diagnosis.model["noise"]["x"]["N"] == pytest.approx(0.003, rel=0.1)


@pytest.mark.parametrize("simulation", [None, "model", "log"])
def test_a_quiet_time_too_short_to_use_is_ignored_with_a_note(simulation):
    """All that follows in a diagnosis uses the baseline, and not the quiet time."""
    blocks = reduce_log(log({"N": 0.003}, duration="15min"))
    make, *given = {
        None: (calibrate_noise,),
        "model": (baseline_from_model, {"noise": {"N": 0.002}}),
        "log": (
            baseline_from_simulation,
            reduce_log(log({"N": 0.002}, duration="15min", seed=5)),
        ),
    }[simulation]
    without_quiet = make(blocks, *given)
    with pytest.warns(UserWarning, match=r"holds 0 whole blocks of 10 s: 0 samples.*is ignored"):
        with_quiet = make(blocks, *given, quiet=(3.0, 9.0))
    xr.testing.assert_identical(with_quiet, without_quiet)


def test_a_quiet_time_that_is_lost_is_ignored_with_a_note():
    recording = log({"N": 0.003}, duration="30min").copy(deep=True)
    recording["rate"][:, : int(60 * recording.attrs["sampling_rate_hz"])] = np.nan
    blocks = reduce_log(recording)
    with pytest.warns(UserWarning, match="too few samples without losses for a spectrum.*ignored"):
        baseline = calibrate_noise(blocks, quiet=(0.0, 60.0))
    assert baseline.attrs["calibrated_on"] == calibrate_noise(blocks).attrs["calibrated_on"]


@pytest.mark.parametrize(
    ("quiet", "same", "is_noted"),
    [
        ((900.0, 4000.0), (900.0, 1800.0), True),
        (("1969-12-31T23:00", "1970-01-01T00:10"), (0.0, 600.0), True),
        ((900.0, 1800.0), (900.0, 1800.0), False),
        (("1970-01-01T00:00", "1970-01-01T00:30:01"), (0.0, 1800.0), False),
    ],
)
def test_a_quiet_time_beyond_the_record_is_used_within_it_with_a_note(quiet, same, is_noted):
    blocks = reduce_log(log({"N": 0.003}, duration="30min"))
    expected = given_quiescent_blocks(blocks, same)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        np.testing.assert_array_equal(given_quiescent_blocks(blocks, quiet), expected)
    notes = [str(warning.message) for warning in caught]
    assert bool(notes) == is_noted
    assert all(
        "extends beyond the record, which goes from 1970-01-01T00:00:00" in note for note in notes
    )


@pytest.mark.parametrize(
    ("quiet", "message"),
    [
        ((4000.0, 5000.0), "outside of the 1800 s of the record"),
        ((700.0, 100.0), "outside of the 1800 s of the record"),
        ((-50.0, -10.0), "-50.0 is neither a time nor a duration"),
    ],
)
def test_a_quiet_time_outside_the_record_is_refused(quiet, message):
    blocks = reduce_log(log({"N": 0.003}, duration="30min"))
    with pytest.raises(OptionError, match=message):
        calibrate_noise(blocks, quiet=quiet)
