"""The frame of the effects, and what every registered effect must do."""

from __future__ import annotations

from dataclasses import fields, is_dataclass

import numpy as np
import pytest

from gyrostab.errors import OptionError, SchemaError
from gyrostab.physics.base import STAGES, Effect, Prediction, Windows
from gyrostab.physics.registry import effect_table, effects, make_effect
from gyrostab.simulate import simulate
from gyrostab.units import INNER
from tests.support.effect_bench import build_effect, random_cuts, run, same_whatever_the_cuts

EFFECTS = list(effects().values())
SIZE, RATE = 3000, 10.0
with_each_effect = pytest.mark.parametrize("kind", EFFECTS, ids=lambda kind: kind.name)
_TYPICAL = {
    "degree_Celsius": 60.0,
    "g": 1.0,
    "degree s-1": 360.0,
    "V": 24.0,
    "W": 1e-4,
    "uT": 30.0,
    "Pa": 1e7,
    "1": 0.5,
}


def drivers(kind: type[Effect]) -> dict[str, np.ndarray]:
    """A lively record of each of its channels."""
    t = np.arange(SIZE) / RATE
    channels = {}
    for number, (name, unit) in enumerate(kind.channels.items()):
        shape = 1.0 + 0.3 * np.sin(2 * np.pi * t / (40.0 + 7 * number)) + 0.2 * (t > 120.0)
        channels[name] = _TYPICAL[unit] * shape
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
    plain = run(kind.example().switched_off(), **given)
    if isinstance(changed, dict):
        assert any(np.any(changed[symbol] != plain[symbol]) for symbol in changed)
    else:
        assert changed.shape != plain.shape or np.any(changed != plain)


@with_each_effect
def test_zero_size_changes_nothing(kind):
    given = options(kind)
    off = kind.example().switched_off()
    done = run(off, **given)
    if kind.stage == "noise":
        for symbol, level in done.items():
            np.testing.assert_array_equal(level, given["noise"][symbol] ** 2)
    elif kind.stage in ("motion", "rate"):
        np.testing.assert_array_equal(done, 0.0)
    else:
        np.testing.assert_array_equal(done, given["signal"])


@with_each_effect
@pytest.mark.parametrize("seed", [1, 2])
def test_chunks_do_not_matter(kind, seed):
    same_whatever_the_cuts(kind.example(), random_cuts(seed, SIZE), **options(kind))


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


@with_each_effect
def test_explains_reduced_data(kind):
    edges = np.arange(0.0, SIZE / RATE + 1, 20.0)
    means = {name: values.reshape(-1, 200).mean(axis=1) for name, values in drivers(kind).items()}
    windows = Windows(
        begin=edges[:-1],
        end=edges[1:],
        frequency=np.geomspace(0.1, 5.0, 14),
        rate=RATE,
        axes=("x", "y", "z"),
        drivers=means,
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
        match=f"effect '{kind.name}' needs the channel '{needs[0]}' .*add it to the environment",
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
    assert effect.switched_off().channel_names()["light_power"] == "laser_power"


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
