"""The frame of the effects, and what every registered effect must do."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gyrostab.errors import OptionError, SchemaError
from gyrostab.physics.base import STAGES, Effect, Prediction, Windows
from gyrostab.physics.registry import effect_table, effects, make_effect
from gyrostab.simulate import simulate
from gyrostab.units import INNER
from tests.support.effect_bench import (
    build_effect,
    random_cuts,
    run,
    same_whatever_the_cuts,
    switch_off,
)
from tests.support.simulated import TYPICAL

EFFECTS = list(effects().values())
SIZE, RATE = 3000, 10.0
with_each_effect = pytest.mark.parametrize("kind", EFFECTS, ids=lambda kind: kind.name)


def drivers(kind: type[Effect]) -> dict[str, np.ndarray]:
    """A lively record of each of its channels."""
    t = np.arange(SIZE) / RATE
    channels = {}
    for number, (name, unit) in enumerate(kind.channels.items()):
        shape = 1.0 + 0.3 * np.sin(2 * np.pi * t / (40.0 + 7 * number)) + 0.2 * (t > 120.0)
        channels[name] = TYPICAL[unit] * shape
    return channels


def options(kind: type[Effect]) -> dict:
    rng = np.random.default_rng(5)
    return {
        "size": SIZE,
        "rate": RATE,
        "drivers": drivers(kind),
        "true": {
            axis: 15.0 * np.sin(np.arange(SIZE) / 90.0 + number)
            for number, axis in enumerate("xyz")
        },
        "signal": rng.normal(0.0, 3.0, (3, SIZE)) + 5.0,
        "noise": {"Q": 0.5, "N": 0.003, "B": 0.004, "K": 0.02, "R": 0.0},
        "gaps": np.array([[700, 760], [1500, 1900]]),
        "restarts": np.array([[1500, 1900]]),
    }


@with_each_effect
def test_declares_itself(kind):
    assert is_dataclass(kind)
    assert kind.stage in STAGES
    assert kind.short
    assert kind.size_parameters
    assert {item.name for item in kind.parameters()} >= set(kind.size_parameters)
    assert set(kind.channels.values()) <= set(INNER.values())
    assert kind.__doc__
    names = [item.name for item in fields(kind) if "parameter" not in item.metadata]
    assert names == ["axes", "driver"]
    for item in kind.parameters():
        assert item.meaning
        assert item.unit
        item.check(item.typical, kind.name)


@with_each_effect
def test_acts_at_its_typical_size(kind):
    given = options(kind)
    changed = run(kind.example(), **given)
    plain = run(switch_off(kind.example()), **given)
    if isinstance(changed, dict):
        assert any(np.any(changed[symbol] != plain[symbol]) for symbol in changed)
    else:
        assert changed.shape != plain.shape or np.any(changed != plain)


@with_each_effect
def test_zero_size_changes_nothing(kind):
    given = options(kind)
    off = switch_off(kind.example())
    done = run(off, **given)
    if kind.stage == "noise":
        for symbol, level in done.items():
            np.testing.assert_array_equal(level, given["noise"][symbol] ** 2)
    elif kind.stage in ("motion", "rate"):
        np.testing.assert_array_equal(done, 0.0)
    else:
        np.testing.assert_array_equal(done, given["signal"])


#: Effects with more than their typical parameters.
VARIANTS = [
    {"name": "ageing_bias", "slope": 1.0, "logarithmic": 0.2},
    {"name": "ageing_noise", "growth": 0.5, "exponent": 1.7},
    {"name": "aliased_vibration", "sensitivity": [1, 2, 3], "resonance": 650,
     "sampling": "average"},
    {"name": "bias_jump", "restart": 0.2, "shock": 0.1, "shocks_per_hour": 900,
     "step": [0.1, 0.0, -0.1], "at": 71.23},
    {"name": "clock_error", "error": 30_000, "drift": -9000},
    {"name": "clock_error", "error": -30_000, "reading": "average"},
    {"name": "dead_zone", "width": 2.0, "bandwidth": 0.3, "edge": "jump"},
    {"name": "earth_rate", "latitude": 30, "inclination": 50, "azimuth": 70},
    {"name": "feedback_reset", "kick": 3.0, "tail": 40.0, "decay": 0.5, "sawtooth": 0.3},
    {"name": "feedback_reset", "kick": 3.0, "tail": 40.0, "decay": 0.5, "sawtooth": 0.3,
     "phase": "channel", "full": 1.5},
    {"name": "fringe_hop", "per_hour": 600, "hold": 5},
    {"name": "fringe_hop", "at": 33.33, "hold": 5},
    {"name": "held_samples", "per_hour": 3600, "length": 0.8},
    {"name": "held_samples", "per_hour": 3600, "length": 0.8, "fill": "frame"},
    {"name": "held_samples", "per_hour": 3600, "length": 0.8, "fill": "zero"},
    {"name": "light_power_noise", "thermal": 0.3, "shot": 0.3},
    {"name": "logger_filter", "cutoff": 3.0, "order": 5, "length": 0.7},
    {"name": "real_motion", "sway": 3, "spin": 0.2, "x": 0.1, "z": -0.3,
     "direction": [1.0, 0.5, -0.5]},
    {"name": "rotation_line", "amplitude": [1, 2, 3], "harmonics": 4, "phase": [1, 2, 3]},
    {"name": "scale_factor", "linear": 30, "asymmetry": -10, "cubic": 0.5, "thermal": 2},
    {"name": "shared_source", "N": [0.1, 0.2, -0.1], "bandwidth": 0.5},
    {"name": "shupe", "sensitivity": 0.05, "transient": -0.3, "lag": 20},
    {"name": "shupe", "sensitivity": 0.05, "transient": -0.3, "lag": 20, "sensor_lag": 15},
    {"name": "spectral_line", "amplitude": 1, "frequency": 3.3, "quality": 30},
    {"name": "spikes", "kind": "outlier", "per_hour": 9000},
    {"name": "supply_bias", "voltage": 0.1, "ripple": 0.2, "frequency": 17.0},
    {"name": "supply_bias", "voltage": 0.1, "lag": 7.0},
    {"name": "telegraph", "step": 0.2, "low": 0.05, "high": 3.0},
    {"name": "temperature_noise", "linear": 1e-3, "quadratic": 1e-5},
    {"name": "thermal_gradient", "sensitivity": 0.05, "change": 0.2},
    {"name": "thermal_hysteresis", "sensitivity": 0.01, "width": 0.5},
    {"name": "vibration_noise", "white": 0.02, "quantization": 2.0, "exponent": 0.9},
    {"name": "vibration_noise", "white": 0.02, "resonance": 3.0, "quality": 4.0},
    {"name": "vibration_random_walk", "sensitivity": 0.7, "exponent": 1.3},
    {"name": "warm_up", "amplitude": 0.3, "slow_amplitude": 0.1, "gap": 2.0, "cooling": 30},
]  # fmt: skip


@pytest.mark.parametrize(
    "effect",
    [kind.example() for kind in EFFECTS] + [make_effect(table) for table in VARIANTS],
    ids=lambda effect: effect.name,
)
@given(st.integers(0, 10_000), st.sampled_from([0.3, RATE, 977.0]))
@settings(max_examples=6)
def test_chunks_do_not_matter(effect, seed, rate):
    given_rate = RATE if effect.name == "logger_filter" else rate  # its cutoff is in hertz
    given_options = options(type(effect)) | {"rate": given_rate, "seed": seed}
    same_whatever_the_cuts(effect, random_cuts(seed, SIZE), **given_options)


@with_each_effect
def test_a_state_is_no_view_of_a_block(kind, monkeypatch):
    states, generate = [], kind.generate

    def remember(effect, chunk, state):
        values, state = generate(effect, chunk, state)
        states.append(state)
        return values, state

    monkeypatch.setattr(kind, "generate", remember)
    more = {"length": 0.5} if kind.name == "logger_filter" else {}
    run(kind.example(**more), **options(kind))
    while states:
        item = states.pop()
        if isinstance(item, list | tuple):
            states += item
        elif isinstance(item, np.ndarray) and isinstance(item.base, np.ndarray):
            assert item.base.size <= item.size


@with_each_effect
def test_say_returns_one_sentence(kind):
    text = kind.example().say()
    assert text.endswith(".")
    assert text[0].isupper()
    assert len(text) > 20
    effect = kind.example()
    errors = {
        name: 0.125 for name in kind.size_parameters if isinstance(getattr(effect, name), float)
    }
    assert not errors or "0.12" in effect.say(errors)


def reduced_windows(kind, **more):
    """Return 15 windows of 20 s, with the channels that an effect follows."""
    edges = np.arange(0.0, SIZE / RATE + 1, 20.0)
    means = {name: values.reshape(-1, 200).mean(axis=1) for name, values in drivers(kind).items()}
    return Windows(
        begin=edges[:-1],
        end=edges[1:],
        frequency=np.geomspace(0.1, 5.0, 14),
        rate=RATE,
        axes=("x", "y", "z"),
        drivers=means,
        **more,
    )


@with_each_effect
def test_explains_reduced_data(kind):
    windows = reduced_windows(
        kind,
        own={axis: np.full(15, 10.0) for axis in "xyz"},
        gaps=np.array([[70.0, 76.0], [150.0, 190.0]]),
        restarts=np.array([[150.0, 190.0]]),
    )
    effect = kind.example()
    names = {item.name for item in kind.parameters()}
    prediction = effect.explain(windows)
    assert isinstance(prediction, Prediction)
    assert (
        set(prediction.mean)
        | set(prediction.spectrum)
        | {parameter for _, parameter in prediction.level}
        <= names
    )
    for design in [*prediction.mean.values(), *prediction.level.values()]:
        assert np.shape(design)[-1] == 15
        assert np.isfinite(design).all()
    for density in prediction.spectrum.values():
        assert np.broadcast_shapes(np.shape(density), (15, 14)) in ((15, 14), (3, 15, 14))
        assert np.all(density >= 0)
    grid = effect.nuisance(windows)
    assert set(grid) <= names
    for name, values in grid.items():
        for value in np.atleast_1d(values):
            kind.example(**{name: float(value)}).explain(windows)


@with_each_effect
def test_window_means_depend_neither_on_bands_nor_on_the_phase_of_the_ramp(kind):
    windows = reduced_windows(
        kind,
        own={axis: np.linspace(9.0, 11.0, 15) for axis in "xyz"},
        phase=(np.arange(16) + 0.5) / 16,
        turns=np.full(15, 0.3),
    )
    effect = kind.example()
    full = effect.explain(windows).mean
    fewer = replace(windows, frequency=windows.frequency[:1], phase=np.empty(0))
    fewer_means = effect.explain(fewer).mean
    assert fewer_means.keys() == full.keys()
    for name, values in full.items():
        np.testing.assert_array_equal(fewer_means[name], values)


@with_each_effect
def test_units_and_ranges_are_kept(kind):
    for item in kind.parameters():
        if item.choices:
            with pytest.raises(OptionError, match="is not one of"):
                kind.example(**{item.name: "nonsense"})
        else:
            with pytest.raises(OptionError, match="not a number"):
                kind.example(**{item.name: float("nan")})
        if np.isfinite(item.high):
            with pytest.raises(OptionError, match="outside of the allowed range"):
                kind.example(**{item.name: item.high * 2 + 1})


@with_each_effect
def test_missing_channel_is_named(kind):
    effect = kind.example()
    needs = effect.needs()
    table = {
        item.name: list(value) if isinstance(value := getattr(effect, item.name), tuple) else value
        for item in effect.parameters()
    }
    model = {
        "effect": [{"name": kind.name} | table],
        "noise": {},
        "log": {"rate": 10, "duration": "1s"},
    }
    if not needs:
        assert simulate(model).sizes["time"] == 10
        return
    with pytest.raises(
        SchemaError,
        match=f"effect '{kind.name}' needs the channel '{needs[0]}' .*; the log has no channels; "
        "add it to the environment",
    ):
        simulate(model)


@with_each_effect
def test_sizes_are_sourced(kind):
    for heading in ("References", "Examples"):
        assert f"{heading}\n" in kind.__doc__
    assert all(item.source for item in kind.parameters())


# --------------------------------------------------------------------------------
# models


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({}, "has no name"),
        ({"name": "shupi"}, "there is no effect 'shupi'"),
        (
            {"name": "temperature_bias"},
            r"lacks the parameter 'sensitivity' \(bias per degree\); give a number in deg/h/degC",
        ),
        (
            {"name": "temperature_bias", "sensitivty": 1},
            "did you mean 'sensitivity'.*it has sensitivity .deg/h/degC.*reference",
        ),
        (
            {"name": "temperature_bias", "sensitivity": "3 K"},
            "the unit 'K' is not known here; give the number in deg/h/degC",
        ),
        ({"name": "temperature_bias", "sensitivity": "much"}, "not a number with a unit"),
        ({"name": "temperature_bias", "sensitivity": True}, "True is not a number"),
        ({"name": "temperature_bias", "sensitivity": [1.0, 2.0]}, "give one number"),
        ({"name": "temperature_bias", "sensitivity": 2e4}, "outside .* range -10000 to 10000"),
        (
            {"name": "temperature_bias", "sensitivity": 1, "driver": ["a", "b"]},
            "driver names 2 channels; it takes temperature",
        ),
        (
            {"name": "temperature_bias", "sensitivity": 1, "axes": ["x", "y", "x"]},
            "names an axis twice",
        ),
    ],
)
def test_a_wrong_table_is_explained(table, words):
    with pytest.raises(OptionError, match=words) as error:
        make_effect(table, where="model.toml, effect 2")
    assert str(error.value).startswith("model.toml, effect 2")


def test_a_driver_may_name_the_needed_channels_alone():
    effect = build_effect("supply_bias", power=1e-3, driver="laser_power")
    assert effect.channel_names() == {
        "supply_voltage": "supply_voltage",
        "light_power": "laser_power",
    }
    assert switch_off(effect).channel_names()["light_power"] == "laser_power"


def test_units_are_converted():
    assert build_effect(
        "temperature_bias", sensitivity="0.1 deg/h/degC", reference="300 K"
    ).reference == pytest.approx(26.85)
    assert build_effect("thermal_hysteresis", sensitivity=1e-3, width="280 K").width == 280.0


def test_table_lists_every_parameter_of_every_effect():
    table = effect_table()
    assert set(table["effect"]) == set(effects())
    row = table[
        (table["effect"] == "temperature_bias") & (table["parameter"] == "sensitivity")
    ].iloc[0]
    assert row["unit"] == "deg/h/degC"
    assert row["required"]


# --------------------------------------------------------------------------------
# the two examples


def test_temperature_bias_is_its_polynomial():
    effect = effects()["temperature_bias"](
        sensitivity=0.002, quadratic=1e-4, cubic=-1e-6, reference=20.0
    )
    bias = run(effect, size=3, drivers={"temperature": [20.0, 30.0, 70.0]})
    np.testing.assert_allclose(bias[1], [0.0, 0.02 + 0.01 - 0.001, 0.1 + 0.25 - 0.125], rtol=1e-12)


def test_g_sensitivity_is_its_scalar_product_and_needs_only_what_it_uses():
    effect = effects()["g_sensitivity"](x=0.01, z=-0.02, axes="y")
    assert effect.needs() == ("accel_x", "accel_z")
    bias = run(effect, size=2, drivers={"accel_x": [1.0, 0.0], "accel_z": [0.0, 1.0]})
    np.testing.assert_allclose(bias, [[0.01, -0.02]], rtol=1e-12)
    assert (
        effect.say() == "The bias follows the acceleration on axis y, "
        "by 0.01 deg/h/g along x, -0.02 deg/h/g along z."
    )
