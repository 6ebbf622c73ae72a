"""Every model that a diagnosis writes runs on the stamps and channels of its recording."""

from __future__ import annotations

import tomllib
import warnings
from typing import Any

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.baseline.from_model import baseline_from_model
from gyrostab.diagnose.estimate.joint_fit import _make_effect
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.result.diagnosis import model_text, tabulate_effect
from gyrostab.diagnose.result.tables import baseline_table, model_tables
from gyrostab.physics.registry import effects
from gyrostab.simulate import read_model, simulate

RATE, SIZE = 10.0, 300
#: Extremes of channels that a logger may write in addition to usual values, by the unit inside.
GLITCHES = {"degree_Celsius": (-90.0, 180.0), "W": (1e-9, 10.0), "V": (0.0, 100.0)}


def recording(kind: Any, seed: int) -> xr.Dataset:
    """Half a minute at 10 Hz with all channels of an effect, a glitch in each."""
    rng = np.random.default_rng(seed)
    log = simulate(
        {"log": {"axes": list("xyz")}, "noise": {"N": 0.003}},
        duration=SIZE / RATE,
        rate=RATE,
        seed=seed,
    ).compute()
    for name, unit in kind.channels.items():
        usual = {"degree_Celsius": 50.0, "W": 1e-4, "V": 24.0}.get(unit, 0.0)
        values = (
            usual * (1.0 + 0.01 * rng.standard_normal(SIZE))
            if usual
            else np.abs(rng.standard_normal(SIZE))
        )
        values[rng.integers(SIZE, size=2)] = GLITCHES.get(unit, (0.0, 1e3))
        log[name] = ("time", values, {"units": unit})
    return log


def simulate_sizes(name: str, scale: float, seed: int) -> xr.Dataset | None:
    """Simulate an effect of `scale` times the typical sizes like a recording; None without an
    effect."""
    kind = effects()[name]
    known = {item.name: item for item in kind.parameters()}
    sizes: dict[str, Any] = {}
    for size in dict.fromkeys([*kind.required(), *kind.size_parameters]):
        typical = float(
            np.ravel(known[size].typical if known[size].typical is not None else 1.0)[0]
        )
        value = typical * (scale if size in kind.size_parameters else 1.0)
        sizes[size] = [value, -value] if known[size].many else value
    effect = _make_effect(kind, sizes, ("x", "y"), ())
    if effect is None:
        return None
    text = model_text(
        {"noise": {axis: {"N": 0.003} for axis in "xyz"}, "effect": [tabulate_effect(effect)]}
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return simulate(
            read_model(tomllib.loads(text)), like=recording(kind, seed), seed=1
        ).compute()


@pytest.mark.parametrize(
    "name", sorted({*effects()} - {"logger_filter"})
)  # which needs one form of filter, not a size
def test_unusual_sizes_can_be_simulated(name: str):
    """Fitted sizes may be anything: they are brought within the range of the effect, and must then
    run."""
    made = [simulate_sizes(name, scale, seed=1) for scale in (-30.0, 300.0)]
    assert any(log is not None for log in made)
    assert all(np.isfinite(log["rate"].values).all() for log in made if log is not None)


@pytest.mark.parametrize(
    "name", sorted(name for name, kind in effects().items() if kind.stage == "noise")
)
@settings(max_examples=10)
@given(scale=st.floats(-1e5, 1e5), seed=st.integers(0, 2**16))
def test_any_noise_change_can_be_simulated(name: str, scale: float, seed: int):
    made = simulate_sizes(name, scale, seed)
    assert made is None or np.isfinite(made["rate"].values).all()


def test_falling_noise_stops_at_a_tenth():
    kind = effects()["temperature_noise"]
    log = recording(kind, 3)
    log["temperature"] = ("time", np.linspace(25.0, 65.0, SIZE), {"units": "degree_Celsius"})
    model = {"noise": {"N": 0.003}, "effect": [{"name": "temperature_noise", "linear": -0.05}]}
    with pytest.warns(UserWarning, match=r"less than 1 % of N\^2 at some values of temperature"):
        changed = simulate(model, like=log, seed=1).compute()
    plain = simulate(model | {"effect": []}, like=log, seed=1).compute()
    ratio = changed["rate"].values / plain["rate"].values
    np.testing.assert_allclose(
        ratio,
        np.sqrt(np.maximum(1.0 - 0.05 * (log["temperature"].values - 25.0), 0.01))[None].repeat(
            3, 0
        ),
    )


def test_tables_keep_the_flicker_band_and_give_a_ramp_no_error():
    noise = {"flicker_band": [1e-3, 0.1], "x": {"N": 0.003, "B": 0.004}}
    given = read_model({"log": {"axes": ["x"]}, "noise": noise})
    blocks = reduce_log(simulate(given, duration="10min", rate=10.0, seed=1))
    table = model_tables(baseline_from_model(blocks, given), [], given, blocks)
    assert read_model(table).flicker_band == (1e-3, 0.1)
    calibrated = baseline_table(calibrate_noise(blocks), [])["noise"]["x"]
    assert calibrated["R"]["stderr"] is None
    assert calibrated["N"]["stderr"] > 0.0
