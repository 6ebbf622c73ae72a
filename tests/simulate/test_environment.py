"""Environments against closed forms: chamber, trip, rotation, light, losses, power cuts."""

from __future__ import annotations

import numpy as np
import pytest

from gyrostab.ingest.grid.gaps import gap_table
from gyrostab.simulate import combine, simulate
from gyrostab.simulate import environment as env
from gyrostab.simulate.losses import gaps, losses, power_cuts
from gyrostab.simulate.turning import rotation


def test_chamber_is_the_test_of_li_et_al():
    """-40 to 60 degC at 1 degC/min with half an hour at each end, and back."""
    t = env.chamber(duration="260min").temperature.values
    assert t[: 1800 + 1].tolist() == [-40.0] * 1801
    np.testing.assert_allclose(np.diff(t[1800:7800]), 1 / 60, rtol=1e-9)
    assert t[7800:9601].tolist() == [60.0] * 1801
    np.testing.assert_allclose(np.diff(t[9600:15600]), -1 / 60, rtol=1e-9)


def test_a_lag_is_that_of_a_first_order_response():
    """On a ramp r the response trails by r times the lag, after the known transient."""
    lag, t = 300.0, np.arange(6000.0)
    felt = env.chamber(duration="130min", low=-40, high=60, hold=1, lag=lag).temperature.values[
        1:6001
    ]
    np.testing.assert_allclose(
        felt, -40 + (t - lag * (1 - np.exp(-t / lag))) / 60, rtol=0, atol=1e-9
    )


@pytest.mark.parametrize("sensor_rate", [1.0, 0.15, 0.01])
@pytest.mark.parametrize(
    "profile",
    [
        {
            "profile": "ramps",
            "channel": "temperature",
            "unit": "degC",
            "points": [[0, 20], [999, 50]],
        },
        {"profile": "chamber", "low": 20.0, "high": 50.0, "hold": 10.0, "lag": 60.0},
    ],
    ids=lambda profile: profile["profile"],
)
def test_a_channel_lasts_to_the_end_of_the_log(profile, sensor_rate):
    effects = [
        {"name": "temperature_bias", "sensitivity": 1.0},
        {"name": "shupe", "sensitivity": 0.5, "lag": 5.0},
    ]
    world = [profile | {"sensor_rate": sensor_rate}]
    short, long = (
        simulate({"effect": effects, "environment": world}, duration=seconds, rate=2.0)
        for seconds in (140.0, 300.0)
    )
    np.testing.assert_array_equal(short["rate"], long["rate"][:, :280])


def test_trip_reaches_the_rock_and_circulation_cools_it():
    down = env.trip(
        [[0, 0], [36000, 3000]],
        duration="40h",
        gradient=30,
        surface=15,
        circulation=[[90000, 144000]],
        cooling=0.4,
    )
    assert down.temperature.values[89999] == pytest.approx(105.0, abs=0.01)
    assert down.temperature.values[-2] == pytest.approx(15 + 0.6 * 90, abs=0.01)
    middle = down.temperature.values[18000:30000]
    # 300 m/h: 0.15 degC/min
    np.testing.assert_allclose(np.diff(middle) * 60, 300 * 0.03 / 60, rtol=1e-6)


@pytest.mark.parametrize("stick_slip", [0.0, 1.0])
@pytest.mark.parametrize("rise", [5, 0])
def test_toolface_is_the_integral_of_the_rate(stick_slip, rise):
    turning = rotation(
        [[0, 0], [3.0005, 40], [3.0005 + rise, 400], [10, 400]],
        duration=15.0,
        stick_slip=stick_slip,
        period=2.7,
        sensor_rate=2000,
        inclination=90,
    )
    rate = turning.rotation_rate.values
    angle = np.concatenate([[0], np.cumsum((rate[1:] + rate[:-1]) / 2) / 2000])
    error = 1e-5 if rise else 5e-3  # of the sum at a step
    np.testing.assert_allclose(turning.accel_x.values, np.cos(np.radians(angle)), atol=error)
    np.testing.assert_allclose(turning.accel_y.values, -np.sin(np.radians(angle)), atol=error)
    assert rate.min() >= 0.0
    np.testing.assert_allclose(turning.accel_z.values, 0.0, atol=1e-12)


@pytest.mark.parametrize("stick_slip", [0.0, 0.7])
@pytest.mark.parametrize("first", [3.3, -4.2])
def test_toolface_is_that_at_the_start_whenever_the_first_point_is(first, stick_slip):
    """Steady rotation is the same from any first point on."""
    options = {"duration": 12.0, "stick_slip": stick_slip, "toolface": 25.0, "inclination": 90.0}
    turning = rotation([[first, 100.0]], **options)
    np.testing.assert_allclose(turning["toolface"].values[0], 25.0)
    expected = rotation([[0, 100.0]], **options)
    for name in ("toolface", "accel_x", "accel_y"):
        np.testing.assert_allclose(turning[name], expected[name], rtol=0, atol=1e-9, err_msg=name)


def test_vertical_tool_has_gravity_on_its_axis():
    still = rotation([[0, 0]], duration=1.0, inclination=0.0)
    assert (still.accel_z.values == -1.0).all()  # z points down; what holds the tool pushes up
    np.testing.assert_allclose(still.accel_x.values, 0.0, atol=1e-15)


def test_light_power_is_a_loss_in_decibel():
    light = env.light_power(
        duration="1000h", power=1e-4, loss=3.0, sensor_rate=0.01
    ).light_power.values
    assert 10 * np.log10(light[0] / light[-1]) == pytest.approx(3.0, abs=1e-3)


def test_losses_have_their_rate_and_length_and_come_in_bursts():
    steady = losses(duration="500h", per_hour=5, bursts_per_hour=0, mean=3.0, seed=2)
    length = (steady.gap_end - steady.gap_start).values / np.timedelta64(1, "s")
    assert length.size == pytest.approx(2500, rel=0.08)
    assert length.mean() == pytest.approx(3.0, rel=0.08)
    burst = losses(duration="500h", per_hour=5, bursts_per_hour=1, burst=120, within=50, seed=2)
    counts = np.histogram(burst.gap_start.values.astype(np.int64) / 3.6e12, np.arange(501))[0]
    assert counts.var() > 2 * counts.mean()  # a Poisson process has them equal
    assert counts.mean() == pytest.approx(5 + 49 * 5 * 120 / 3600, rel=0.25)


def test_profiles_of_one_name_have_different_random_numbers():
    world = {"profile": "losses", "per_hour": 20, "bursts_per_hour": 0}
    frame = {"rate": 1.0, "duration": "50h", "axes": ["x"]}

    def lost(*profiles):
        log = simulate({"log": frame, "environment": list(profiles)}, seed=1)
        return np.isnan(log["rate"].values[0])

    first, both = lost(world), lost(world, world)
    assert both[first].all()
    assert both.mean() == pytest.approx(1.0 - (1.0 - first.mean()) ** 2, rel=0.05)
    np.testing.assert_array_equal(
        lost(world | {"seed": 5}, world | {"seed": 5}), lost(world | {"seed": 5})
    )


def test_random_power_cuts_are_restarts():
    cut = power_cuts(duration="240h", per_day=4, seed=1)
    assert cut.sizes["gap"] == pytest.approx(40, abs=20)
    log = simulate({"noise": {"N": 1}}, duration="240h", rate=0.1, environment=cut)
    assert set(gap_table(log).cause) == {"restart"}


@pytest.mark.parametrize("end", [60.0, 1e10, 1e300])
@pytest.mark.parametrize("table", [{"profile": "gaps"}, {"profile": "power_cuts"}])
def test_a_gap_may_end_any_time_after_the_log(table, end):
    key = "spans" if table["profile"] == "gaps" else "cuts"
    tables = {"environment": [table | {key: [[50, end], [2 * end, 3 * end]]}]}
    log = simulate(tables, duration="60s", rate=1.0, start="2261-01-01")
    assert log["gap_samples"].values.tolist() == [10]
    assert np.isnan(log["rate"].values[0]).tolist() == [False] * 50 + [True] * 10


@pytest.mark.parametrize("lost", [[50, 110], [150, 300], [20, 400]])
def test_lost_telemetry_does_not_move_a_loss_of_power(lost):
    def rates(world):
        effect = {"name": "warm_up", "amplitude": 1.0, "time": 600, "cooling": 90}
        log = simulate({"effect": [effect]}, duration="500s", rate=1.0, environment=world)
        return log["rate"].values[0]

    cut = power_cuts([[100, 160]], duration=500.0)
    plain, both = rates(cut), rates(combine(cut, gaps([lost])))
    expected = plain.copy()
    expected[lost[0] : lost[1]] = np.nan
    np.testing.assert_array_equal(both, expected)


def test_overlapping_gaps_are_merged():
    world = combine(gaps([[1, 3], [2, 5]]), power_cuts([[4.5, 6]], duration=10.0))
    table = gap_table(simulate({"noise": {"N": 1}}, duration="10s", rate=10.0, environment=world))
    assert table[["seconds", "cause"]].values.tolist() == [[5.0, "restart"]]
