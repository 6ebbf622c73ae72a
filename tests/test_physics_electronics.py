"""Effects of optics, electronics and logger, and jumps, against their closed forms."""

from __future__ import annotations

import gzip
import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import butter, sosfreqz
from scipy.stats import kurtosis, norm

from gyrostab.davar import davar
from gyrostab.errors import OptionError, SchemaError
from gyrostab.log import make_log
from gyrostab.physics.base import Setup, Windows
from gyrostab.physics.jumps import step_means
from gyrostab.physics.lorentz import lorentz_density
from gyrostab.physics.registry import make_effect
from gyrostab.simulate import simulate

from .effect_bench import random_cuts, run, same_whatever_the_cuts

NRAD_PER_S = math.degrees(1e-9) * 3600.0  # deg/h


def avar(rates, rate, taus):
    """Allan variance of every row over the whole record."""
    log = make_log(np.atleast_2d(rates), rate=rate, unit="deg/h")
    return davar(log, window=log.sizes["time"], taus=[float(tau) for tau in taus], tau_max=float(max(taus))).avar.isel(time=0).values


def windows_of(size, rate, length, frequency=(1.0,), **more):
    edges = np.arange(0.0, size / rate + 1e-9, length)
    return Windows(edges[:-1], edges[1:], np.asarray(frequency, float), rate, more.pop("axes", ("x",)), **more)


def band_powers(rates, rate, edges):
    """Mean two-sided density between edges [Hz], of the mean periodogram of the rows."""
    rows = np.atleast_2d(rates)
    power = (np.abs(np.fft.rfft(rows, axis=1)) ** 2 / rows.shape[1] / rate).mean(axis=0)
    f = np.fft.rfftfreq(rows.shape[1], 1 / rate)
    return np.array([power[(f > low) & (f < high)].mean() for low, high in pairwise(edges)])


def said_density(effect, rate, edges, parameter, axes=("x",)):
    """The same of the density that the effect says, by fine bands."""
    fine = [np.linspace(low, high, 60)[1:-1] for low, high in pairwise(edges)]
    return np.array([effect.explain(windows_of(100, rate, 10.0 / rate, f, axes=axes)).spectrum[parameter][0].mean() for f in fine])


# ---------------------------------------------------------------------------------------------------------------- jumps


@settings(max_examples=40, deadline=None)
@given(st.lists(st.floats(0.0, 20.0), max_size=12), st.integers(0, 12))
def test_means_of_steps_are_integrals(positions, cut):
    positions = sorted(positions)
    levels = np.random.default_rng(3).normal(size=(len(positions) + 1, 2))
    found = np.concatenate([step_means(positions, levels, 0, cut), step_means(positions, levels, cut, 20 - cut)], axis=1)
    edges = np.array([0.0, *positions, 30.0])
    for i in range(20):
        inside = np.clip(np.minimum(edges[1:], i + 1) - np.maximum(edges[:-1], i), 0.0, None)
        np.testing.assert_allclose(found[:, i], inside @ levels, atol=1e-12)


def test_a_jump_has_the_allan_variance_of_a_step_and_looks_like_k():
    effect = {"name": "bias_jump", "step": 0.1, "at": 300, "axes": ["x"]}
    log = simulate({"effect": [effect], "noise": {}, "log": {"rate": 10, "duration": "600s"}})
    surface = davar(log, window="200s", step="50s", taus=[1.0, 5.0, 20.0]).sel(axis="x")
    tau, length = surface.tau.values, 200.0
    across = surface.isel(time=slice(3, 6)).avar.values  # 150..350, 200..400, 250..450
    np.testing.assert_allclose(across, np.tile(0.01 * tau / (3 * (length - 2 * tau)), (3, 1)), rtol=0.02)
    np.testing.assert_allclose(np.sqrt(3 * across[1, 0] / tau[0] * 3600), 0.1 / math.sqrt(length / 3600), rtol=0.02)
    assert surface.isel(time=slice(0, 3)).avar.values.max() < 1e-30
    np.testing.assert_allclose(surface.window_mean.values[[0, 4, -1]], [0.0, 0.05, 0.1], atol=1e-12)
    said = make_effect(effect).explain(Windows(np.array([0.0, 200, 400]), np.array([200.0, 400, 600]), np.ones(1), 10.0, ("x",)))
    np.testing.assert_allclose(said.mean["step"], [0.0, 0.5, 1.0])


def test_jumps_come_at_restarts_and_shocks_only():
    restarts = np.arange(1, 1000)[:, None] * 10 + np.array([0, 3])
    rates = run(make_effect({"name": "bias_jump", "restart": 0.2}), size=10_000, restarts=restarts, gaps=restarts)
    jumps = np.diff(rates, axis=1)
    assert set(np.unique(np.nonzero(jumps)[1] + 1)) == set(restarts[:, 1].tolist())
    sizes = jumps[:, restarts[:, 1] - 1]
    assert sizes.std() == pytest.approx(0.2, rel=0.04)
    assert abs(np.corrcoef(sizes)[0, 1]) < 0.12
    shocks = run(make_effect({"name": "bias_jump", "shock": 0.5, "shocks_per_hour": 3600}), size=20_000, rate=50.0)
    moved = np.diff(shocks, axis=1)
    times = np.flatnonzero(moved[0])
    assert times.size == pytest.approx(2 * 400, rel=0.1)  # a jump inside of a sample shows in two differences
    np.testing.assert_array_equal(times, np.flatnonzero(moved[1]))
    assert np.square(shocks[:, -1]).sum() > 0
    assert (
        make_effect({"name": "bias_jump", "shock": 0.5, "shocks_per_hour": 3}).say().endswith("by 0.5 deg/h rms at shocks, 3 in an hour.")
    )


def gauss_markov_avar(rms, time, tau):
    """IEEE Std 952, annex C, with q^2 = 2 rms^2 / T_c."""
    r = time / tau
    return 2 * rms**2 * r * (1 - r / 2 * (3 - 4 * np.exp(-1 / r) + np.exp(-2 / r)))


def test_gauss_markov_has_the_allan_variance_of_the_standard():
    effect = make_effect({"name": "gauss_markov", "rms": [0.05, 0.1, 0.0], "correlation_time": 20})
    rates = run(effect, size=400_000, rate=5.0)
    taus = np.array([0.2, 2.0, 10.0, 37.8, 100.0])
    found = avar(rates, 5.0, taus)
    for row, rms in ((0, 0.05), (1, 0.1)):
        np.testing.assert_allclose(found[row], gauss_markov_avar(rms, 20.0, taus), rtol=0.06)
        assert rates[row].std() == pytest.approx(rms, rel=0.04)
    assert not rates[2].any()
    fine = np.linspace(1.0, 200.0, 4000)
    curve = np.sqrt(gauss_markov_avar(1.0, 20.0, fine))
    assert fine[curve.argmax()] / 20 == pytest.approx(1.89, abs=0.01)
    assert curve.max() == pytest.approx(0.617, abs=0.001)


def test_a_telegraph_is_a_gauss_markov_process_to_second_order_but_has_two_levels():
    effect = make_effect({"name": "telegraph", "step": 0.2, "low": 60, "high": 30})
    rates = run(effect, size=400_000, rate=5.0)
    assert effect.correlation_time == pytest.approx(20.0)
    share = 1 / 3
    assert (rates > 0.1).mean() == pytest.approx(share, abs=0.012)
    assert np.isin(rates, [0.0, 0.2]).mean() > 0.99
    assert rates.min() >= 0.0
    assert rates.max() <= 0.2
    switches = np.abs(np.diff(rates > 0.1, axis=1)).sum()
    assert switches == pytest.approx(3 * 2 * 80_000 / 90, rel=0.05)
    taus = np.array([0.2, 2.0, 10.0, 37.8, 100.0])
    expected = gauss_markov_avar(0.2 * math.sqrt(share * (1 - share)), 20.0, taus)
    np.testing.assert_allclose(avar(rates, 5.0, taus).mean(axis=0), expected, rtol=0.06)
    assert kurtosis(rates, axis=1).mean() == pytest.approx(1 / (share * (1 - share)) - 6, abs=0.15)
    assert abs(np.corrcoef(rates)[0, 1]) < 0.1


def test_a_hop_has_the_size_of_the_fringe_and_ends_when_power_does():
    table = {"name": "fringe_hop", "length": 500, "diameter": 0.04, "wavelength": 1550, "axes": ["z"]}
    fringe = 1550e-9 * 299_792_458 / (500 * 0.04) * math.degrees(1) * 3600
    assert fringe / 3600 == pytest.approx(1332, rel=1e-3)
    once = make_effect(table | {"order": -2, "at": 30.05})
    rates = run(once, size=1000, signal=7.0, restarts=np.array([[600, 620]]))[0]
    np.testing.assert_allclose(rates[[0, 299, 301, 599, 600, 999]], 7 - 2 * fringe * np.array([0, 0, 1, 1, 0, 0]), rtol=1e-12)
    assert rates[300] == pytest.approx(7 - fringe, rel=1e-9)  # half of this sample
    back = make_effect(table | {"at": 10, "hold": 20}).explain(windows_of(1000, 10.0, 10.0))
    np.testing.assert_allclose(back.mean["order"][:5], fringe * np.array([0, 1, 1, 0, 0]))
    many = run(make_effect(table | {"per_hour": 3600, "hold": 1}), size=100_000, rate=50.0)[0] / fringe
    whole = np.abs(many - np.round(many)) < 1e-9
    assert set(np.unique(np.round(many[whole]))) == {-1.0, 0.0, 1.0}
    assert whole.mean() > 0.95
    assert np.abs(many).mean() == pytest.approx(0.5, abs=0.03)  # up for a second, down for a second
    assert (many > 0.5).mean() == pytest.approx((many < -0.5).mean(), abs=0.05)
    with pytest.raises(OptionError, match=r"1\.5 is not a whole number of fringes"):
        make_effect(table | {"order": 1.5})


def test_supply_bias_follows_both_channels_and_ripple_folds():
    effect = make_effect({"name": "supply_bias", "voltage": 0.02, "power": -0.003, "axes": ["x"]})
    assert effect.needs() == ("supply_voltage", "light_power")
    found = run(effect, size=2, drivers={"supply_voltage": [25.0, 20.0], "light_power": [110e-6, 100e-6]})
    np.testing.assert_allclose(found, [[0.02 - 0.03, -0.08]], rtol=1e-9)
    ripple = make_effect({"name": "supply_bias", "ripple": 0.4, "frequency": 63.0})
    assert ripple.needs() == ()
    rates = run(ripple, size=2000, rate=50.0)[0]
    spectrum = np.abs(np.fft.rfft(rates)) / 1000
    assert np.fft.rfftfreq(2000, 1 / 50)[spectrum.argmax()] == pytest.approx(13.0)
    assert spectrum.max() == pytest.approx(0.4 * abs(np.sinc(63 / 50)), rel=1e-6)
    with pytest.raises(SchemaError, match="'supply_bias' needs the channel 'light_power'"):
        simulate({"effect": [{"name": "supply_bias", "power": 1}], "noise": {}, "log": {"rate": 1, "duration": "9s"}})


# ---------------------------------------------------------------------------------------------------------------- optics


def test_a_dead_zone_cuts_the_middle_out():
    signal = np.array([[-0.5, -0.2, -0.05, 0.0, 0.15, 0.5]])
    kept = run(make_effect({"name": "dead_zone", "width": 0.2}), size=6, axes="x", signal=signal)
    np.testing.assert_allclose(kept, [[-0.3, 0.0, 0.0, 0.0, 0.0, 0.3]], atol=1e-15)
    jump = run(make_effect({"name": "dead_zone", "width": 0.2, "edge": "jump", "centre": 0.1}), size=6, axes="x", signal=signal)
    np.testing.assert_allclose(jump, [[-0.5, -0.2, 0.1, 0.1, 0.1, 0.5]], atol=1e-15)
    said = make_effect({"name": "dead_zone", "width": 0.2}).explain(windows_of(30, 1.0, 10.0, own={"x": np.array([-3.0, 0.0, 3.0])}))
    np.testing.assert_array_equal(said.mean["width"], [[1.0, 0.0, -1.0]])


def test_noise_dithers_a_dead_zone_unless_the_loop_is_slow():
    noise = np.random.default_rng(2).normal(0.0, 2.0, (1, 40_000))
    options = {"size": 40_000, "rate": 100.0, "axes": "x", "signal": noise + 0.1}
    each_sample = run(make_effect({"name": "dead_zone", "width": 0.2}), **options)
    lost = 0.1 * (2 * norm.cdf(0.2 / 2.0) - 1)  # of a mean far inside of the noise
    assert (noise + 0.1).mean() - each_sample.mean() == pytest.approx(lost, rel=0.15)
    slow = run(make_effect({"name": "dead_zone", "width": 0.2, "bandwidth": 0.01}), **options)
    assert abs(slow.mean()) < 0.2 * 0.1
    assert slow.std() == pytest.approx(noise.std(), rel=0.01)


def test_a_sweep_through_a_dead_zone_has_odd_harmonics():
    wave = np.sin(2 * np.pi * np.arange(4000) / 400.0)[None]
    amplitude = np.abs(np.fft.rfft(run(make_effect({"name": "dead_zone", "width": 0.3}), size=4000, axes="x", signal=wave)[0])) / 2000
    assert amplitude[30] > 0.03
    assert amplitude[50] > 0.005
    assert amplitude[[20, 40, 60]].max() < 1e-12
    first = 1 - 2 / math.pi * (math.asin(0.3) + 0.3 * math.sqrt(1 - 0.09))  # describing function
    assert amplitude[10] == pytest.approx(first, rel=1e-4)


def reset_truth(effect, w, rate, size, fine=400):
    """The error by adding up impulse after impulse, at a rate that is given sample by sample [deg/h]."""
    turn, step = effect.turn * NRAD_PER_S, 1.0 / (rate * fine)  # deg/h s
    angle = np.concatenate([[0.0], np.cumsum(np.repeat(w, fine)) * step / turn])
    resets = np.diff(np.floor(angle))
    t = np.arange(resets.size) * step
    rates = resets * effect.kick * NRAD_PER_S / step
    for place in np.flatnonzero(resets):
        after = t[place:] - t[place]
        rates[place:] += resets[place] * effect.tail * NRAD_PER_S / effect.decay * np.exp(-after / effect.decay)
    phase = angle[:-1] % 1.0
    return (rates + effect.sawtooth * (1 - 2 * phase)).reshape(size, fine).mean(axis=1)


@pytest.mark.parametrize("part", [{"kick": 12.0}, {"tail": 18.0, "decay": 0.03}, {"sawtooth": 0.5}])
def test_resets_add_their_angles_whichever_way_it_turns(part):
    effect = make_effect({"name": "feedback_reset", "diameter": 0.2, **part})
    turn = effect.turn * NRAD_PER_S
    assert effect.turn == pytest.approx(1.45 * 1550e-9 / 0.2 * 1e9)
    t = np.arange(300) / 50.0
    w = turn * (9.3 * np.cos(2 * np.pi * t / 4.1) + 1.7)  # up to eleven resets in a second, forth and back
    found = run(effect, size=300, rate=50.0, axes="x", signal=w)[0] - w
    truth = reset_truth(effect, w, 50.0, 300)
    np.testing.assert_allclose(found, truth, atol=0.012 * np.abs(truth).max())
    assert found.min() < 0 < found.max()


def test_resets_faster_than_samples_are_a_scale_factor():
    effect = make_effect({"name": "feedback_reset", "kick": 5.0, "tail": 8.0, "decay": 0.001, "sawtooth": 1.0})
    w = 1e6 * effect.turn * NRAD_PER_S  # a million resets in a second
    error = run(effect, size=2000, rate=100.0, axes="x", signal=w)[0] - w
    np.testing.assert_allclose(error[5:], w * 13.0 / effect.turn, rtol=1e-4)
    said = effect.explain(windows_of(2000, 100.0, 10.0, own={"x": np.full(2, w)})).mean
    np.testing.assert_allclose(5 * said["kick"] + 8 * said["tail"], w * 13 / effect.turn, rtol=1e-12)


def test_the_comb_of_resets_moves_with_the_rate():
    effect = make_effect({"name": "feedback_reset", "sawtooth": 0.4, "kick": 3.0})
    places = []
    for w in (10.0, 25.0):
        rates = run(effect, size=20_000, rate=100.0, axes="x", signal=w)[0]
        spectrum = np.abs(np.fft.rfft((rates - rates.mean()) * np.hanning(rates.size))) ** 2
        f = np.fft.rfftfreq(rates.size, 0.01)
        edges = np.geomspace(1.0, 40.0, 60)
        said = effect.explain(windows_of(20_000, 100.0, 200.0, edges, own={"x": np.full(1, w)}))
        places.append(f[spectrum.argmax()])
        assert places[-1] == pytest.approx(said.line[0, 0], rel=0.01)
        total = sum(size**2 * said.spectrum[name][0] for name, size in (("sawtooth", 0.4), ("kick", 3.0)))
        assert edges[total.argmax()] == pytest.approx(places[-1], rel=0.07)
    assert places[1] / places[0] == pytest.approx(2.5, rel=0.01)


def test_the_comb_has_the_power_that_is_said():
    for part in ({"kick": 3.0}, {"tail": 3.0}, {"sawtooth": 0.4}):
        effect = make_effect({"name": "feedback_reset", **part})
        rates = run(effect, size=60_000, rate=100.0, axes="x", signal=11.15)[0]
        f = np.fft.rfftfreq(rates.size, 0.01)
        power = 2 * np.abs(np.fft.rfft(rates)) ** 2 / rates.size**2
        line = 11.15 / (effect.turn * NRAD_PER_S)
        near = np.abs(f - line) < 0.1
        bands = np.array([line / 1.05, line, line * 1.05])
        said = effect.explain(windows_of(60_000, 100.0, 600.0, bands, own={"x": np.full(1, 11.15)}))
        (name, size), width = next(iter(part.items())), line * (math.sqrt(1.05) - 1 / math.sqrt(1.05))
        assert power[near].sum() == pytest.approx(2 * width * size**2 * said.spectrum[name][0, 1], rel=0.02)


def test_the_resets_of_a_real_gyro_are_of_this_kind_and_size(recordings):
    with gzip.open(recordings("fog-blueseis-ramp/fog_ramp.csv.gz"), "rt") as file:
        columns = np.loadtxt(file, delimiter=",", skiprows=1)
    measured, ramp = columns[:, 1] * NRAD_PER_S, columns[:, 2]
    effect = make_effect({"name": "feedback_reset", "kick": 11.5, "tail": 18, "decay": 0.012, "phase": "channel", "full": -32768})
    assert effect.needs() == ("ramp",)
    model = run(effect, size=ramp.size, rate=200.0, axes="z", drivers={"ramp": ramp})[0]
    moved = -np.diff(ramp) / 32768
    turns = (moved - np.round(moved)).sum() / 359.995  # a second
    assert measured.mean() / NRAD_PER_S / turns == pytest.approx(effect.turn, rel=0.002)
    assert (11.5 + 18) * turns * NRAD_PER_S == pytest.approx(model.mean(), rel=0.01)
    parts = []
    for name in ("kick", "tail"):
        one = make_effect({"name": "feedback_reset", name: 1.0, "decay": 0.012, "phase": "channel", "full": -32768})
        parts.append(run(one, size=ramp.size, rate=200.0, axes="z", drivers={"ramp": ramp})[0])
    design = np.column_stack([*parts, np.ones(ramp.size)])
    kick, tail, _ = np.linalg.lstsq(design, measured, rcond=None)[0]
    assert kick == pytest.approx(11.5, rel=0.06)
    assert tail == pytest.approx(18.0, rel=0.08)
    before, after = avar([measured, measured - model], 200.0, [0.005, 0.02, 0.1, 1.0])
    np.testing.assert_allclose((after / before)[:2], [0.69, 0.18], rtol=0.05)  # the rest of the first is noise of its own

    def by_phase(rates):
        return np.array([rates[(ramp >= low) & (ramp < low + 2048)].mean() for low in range(0, 32768, 2048)])

    assert np.ptp(by_phase(measured)) > 0.2
    assert np.ptp(by_phase(measured - model)) < 0.02
    saw = np.linspace(-1.0, 1.0, 16)
    assert abs(np.polyfit(saw, by_phase(measured - model), 1)[0]) < 0.003


def test_own_rate_and_channel_agree():
    common = {"name": "feedback_reset", "kick": 3.0, "tail": 5.0, "sawtooth": 0.2}
    own = make_effect(common)
    w = np.full(500, 0.013 * 100 * own.turn * NRAD_PER_S)
    expected = run(own, size=500, rate=100.0, axes="x", signal=w)[0] - w
    ramp = 7.0 * ((0.013 * np.arange(1, 501)) % 1.0)
    found = run(make_effect(common | {"phase": "channel", "full": 7.0}), size=500, rate=100.0, axes="x", signal=w, drivers={"ramp": ramp})[
        0
    ]
    np.testing.assert_allclose(found[1:] - w[1:], expected[1:], atol=1e-9)
    with pytest.raises(SchemaError, match="'feedback_reset' needs the channel 'ramp'"):
        simulate({"effect": [common | {"phase": "channel"}], "noise": {}, "log": {"rate": 1, "duration": "9s"}})
    with pytest.raises(OptionError, match="0 is no ramp"):
        make_effect(common | {"full": 0})


def test_shared_noise_shows_in_the_cross_axis_covariance_only():
    effect = {"name": "shared_source", "N": [0.004, -0.003, 0.0], "axes": ["x", "y", "z"]}
    log = simulate({"effect": [effect], "noise": {"N": 0.005}, "log": {"rate": 20, "duration": "3h"}}, seed=5)
    x, y, z = log.rate.values
    taus = np.array([0.05, 0.5, 5.0])
    own = avar([x, y, z], 20.0, taus) * taus / 3600
    np.testing.assert_allclose(own[:, :2], np.tile([[0.005**2 + r**2] for r in (0.004, 0.003, 0)], (1, 2)), rtol=0.04)
    plus, minus = avar([x + y, x - y], 20.0, taus) * taus / 3600
    np.testing.assert_allclose((plus - minus)[:2] / 4, 0.004 * -0.003, rtol=0.12)  # negative: the modulation of y is turned
    plus, minus = avar([x + z, x - z], 20.0, taus) * taus / 3600
    assert np.all(np.abs(plus - minus)[:2] / 4 < 0.1 * 0.004 * 0.003)
    assert make_effect(effect).explain(windows_of(100, 20.0, 1.0)).coherent


# ----------------------------------------------------------------------------------------------------- means that are said


@pytest.mark.parametrize(
    "table",
    [
        {"name": "supply_bias", "voltage": 0.02, "power": -0.003},
        {"name": "clock_error", "error": 100, "drift": -400},
        {"name": "bias_jump", "step": -0.2, "at": 33.3},
        {"name": "fringe_hop", "order": -2, "at": 41.7, "hold": 1e9},
        {"name": "dead_zone", "width": 0.3, "centre": 1.0},
        {"name": "dead_zone", "width": 0.3, "bandwidth": 0.05},
        {"name": "feedback_reset", "kick": 20.0, "tail": 30.0},
        {"name": "rate_quantization", "step": 0.01, "mode": "floor"},
    ],
    ids=lambda table: "-".join(map(str, table.values())),
)
def test_window_means_are_those_that_are_said(table):
    effect, t = make_effect(table), np.arange(6000) / 50.0
    drivers = {"supply_voltage": 25 + np.sin(t / 9), "light_power": 1e-4 + 1e-5 * np.cos(t / 7)}
    signal = np.array([[150.0], [-400.0]]) + 0.05 * np.sin(3 * t)
    done = run(effect, size=6000, rate=50.0, axes="xy", drivers=drivers, signal=signal)
    done = done - signal if effect.stage != "rate" else done
    means = {name: values.reshape(12, 500).mean(axis=1) for name, values in drivers.items()}
    own = {axis: values.reshape(12, 500).mean(axis=1) for axis, values in zip("xy", signal, strict=True)}
    said = effect.explain(windows_of(6000, 50.0, 10.0, axes=("x", "y"), drivers=means, own=own)).mean
    total = sum(np.atleast_1d(getattr(effect, name))[0] * design for name, design in said.items())
    found = done.reshape(2, 12, 500).mean(axis=2)
    tolerance = 0.04 if effect.name in ("feedback_reset", "rate_quantization", "clock_error") else 1e-6  # parts of a turn, a step, a sample
    np.testing.assert_allclose(found, np.broadcast_to(total, (2, 12)), rtol=1e-3, atol=tolerance * np.abs(total).max())


def test_what_has_a_memory_begins_as_if_it_had_been_there_long():
    many = [f"a{number}" for number in range(2500)]
    first = run(make_effect({"name": "telegraph", "step": 1.0, "low": 300, "high": 100}), size=1, axes=many)
    assert (first > 0.5).mean() == pytest.approx(0.25, abs=0.03)
    first = run(make_effect({"name": "gauss_markov", "rms": 2.0, "correlation_time": 50}), size=1, axes=many)
    assert first.std() == pytest.approx(2.0, rel=0.05)
    steady = run(make_effect({"name": "dead_zone", "width": 0.3, "bandwidth": 0.05}), size=3, signal=2.0)
    np.testing.assert_allclose(steady, 1.7, rtol=1e-12)
    stuck = run(make_effect({"name": "dead_zone", "width": 0.3, "bandwidth": 0.05}), size=3, signal=0.25)
    np.testing.assert_allclose(stuck, 0.0, atol=1e-15)


# -------------------------------------------------------------------------------------------------- densities that are said


@pytest.mark.parametrize(
    ("table", "parameter", "size"),
    [
        ({"name": "gauss_markov", "rms": 0.3, "correlation_time": 2.0}, "rms", 0.3),
        ({"name": "gauss_markov", "rms": 0.3, "correlation_time": 0.02}, "rms", 0.3),
        ({"name": "telegraph", "step": 0.3, "low": 1.0, "high": 3.0}, "step", 0.3),
        ({"name": "telegraph", "step": 0.3, "low": 0.05, "high": 0.1}, "step", 0.3),
        ({"name": "shared_source", "N": 0.01}, "N", 0.01),
        ({"name": "shared_source", "N": 0.01, "bandwidth": 1.0}, "N", 0.01),
    ],
)
def test_a_random_rate_has_the_density_that_it_says(table, parameter, size):
    effect = make_effect(table)
    rates = run(effect, size=60_000, rate=10.0)
    edges = np.array([0.02, 0.1, 0.5, 2.0, 4.0, 4.95])
    found = band_powers(rates, 10.0, edges)
    np.testing.assert_allclose(found, size**2 * said_density(effect, 10.0, edges, parameter), rtol=0.12)
    total = np.array([rates.var()])
    f = np.linspace(1e-4, 5.0, 40_000)
    said = effect.explain(windows_of(100, 10.0, 1.0, f)).spectrum[parameter][0]
    np.testing.assert_allclose(total, size**2 * 2 * np.trapezoid(said, f), rtol=0.06)


@pytest.mark.parametrize(
    ("table", "parameter", "size"),
    [
        ({"name": "rate_quantization", "step": 3.0}, "step", 3.0),
        ({"name": "spikes", "kind": "outlier", "size": 50.0, "per_hour": 1800}, "size", 50.0),
        ({"name": "spikes", "lsb": 0.5, "bits": 8, "per_hour": 3600}, "lsb", 0.5),
    ],
)
def test_what_the_logger_adds_has_the_density_that_it_says(table, parameter, size):
    effect = make_effect(table)
    signal = np.random.default_rng(4).normal(0.3, 4.0, (3, 60_000))
    edges = np.array([0.02, 1.0, 2.0, 3.0, 4.0, 4.95])
    found = band_powers(run(effect, size=60_000, rate=10.0, signal=signal) - signal, 10.0, edges)
    np.testing.assert_allclose(found, size**2 * said_density(effect, 10.0, edges, parameter), rtol=0.12)


def test_lorentz_density_folds_the_continuous_one():
    f, order = np.linspace(0.1, 4.9, 9), np.arange(-4000, 4001)
    for time in (0.003, 0.3, 30.0):
        every = f[:, None] + 10.0 * order
        folded = (2 * time / (1 + (2 * np.pi * every * time) ** 2) * np.sinc(every / 10.0) ** 2).sum(axis=1)
        np.testing.assert_allclose(lorentz_density(f, time, 10.0), folded, rtol=1e-3)


# ---------------------------------------------------------------------------------------------------------------- logger


def test_a_low_pass_has_the_response_of_its_design():
    effect = make_effect({"name": "logger_filter", "cutoff": 12.0, "order": 3})
    signal = np.random.default_rng(1).normal(size=(3, 100_000))
    edges = np.array([0.5, 4.0, 8.0, 12.0, 16.0, 20.0, 30.0, 45.0])
    found = band_powers(run(effect, size=100_000, rate=100.0, signal=signal), 100.0, edges) / band_powers(signal, 100.0, edges)
    fine = np.stack([np.linspace(low, high, 50) for low, high in pairwise(edges)])
    _, response = sosfreqz(butter(3, 12.0, fs=100.0, output="sos"), fine.ravel(), fs=100.0)
    expected = (np.abs(response) ** 2).reshape(fine.shape).mean(axis=1)
    np.testing.assert_allclose(found, expected, rtol=0.05)
    steady = run(effect, size=50, rate=100.0, signal=3.0)
    np.testing.assert_allclose(steady, 3.0, rtol=1e-12)


def test_a_moving_average_takes_noise_from_short_times_only():
    noise = np.random.default_rng(6).normal(size=(1, 200_000))
    done = run(make_effect({"name": "logger_filter", "length": 0.08}), size=200_000, rate=100.0, axes="x", signal=noise)
    np.testing.assert_allclose(done[0, 7:], np.convolve(noise[0], np.full(8, 1 / 8), "valid"), rtol=1e-9, atol=1e-12)
    ratio = avar(done, 100.0, [0.01, 0.08, 4.0])[0] / avar(noise, 100.0, [0.01, 0.08, 4.0])[0]
    np.testing.assert_allclose(ratio[0], 1 / 64, rtol=0.03)  # difference of neighbours: 2 / 64 instead of 2
    weights = np.convolve(np.repeat([1.0, -1.0], 8), np.full(8, 1 / 8))
    assert ratio[1] == pytest.approx((weights**2).sum() / 16, rel=0.03)
    assert ratio[2] == pytest.approx(1.0, abs=0.03)


def test_picking_without_a_filter_folds_and_means_do_not():
    common = {"noise": {"N": 0.01}, "log": {"rate": 20, "duration": "1000s", "oversampling": 8, "axes": ["x"]}}
    means = simulate(common).rate.values
    picked = simulate(common | {"effect": [{"name": "logger_filter", "pick": 1}]}).rate.values
    taus = [0.05, 0.5, 5.0]
    np.testing.assert_allclose(avar(means, 20, taus)[0][:2] * taus[:2] / 3600, 1e-4, rtol=0.08)
    np.testing.assert_allclose(avar(picked, 20, taus)[0][:2] * taus[:2] / 3600, 8e-4, rtol=0.08)
    line = {"name": "spectral_line", "amplitude": 1.0, "frequency": 53.0}
    folded = simulate(common | {"noise": {}, "effect": [line, {"name": "logger_filter", "pick": 1}]}).rate.values[0]
    f = np.fft.rfftfreq(folded.size, 0.05)
    spectrum = np.abs(np.fft.rfft(folded)) / folded.size * 2
    assert f[spectrum.argmax()] == pytest.approx(7.0)  # 53 - 3 * 20
    assert spectrum.max() == pytest.approx(np.sinc(53 / 160), rel=1e-3)  # the instrument averages over a 160th of a second


@pytest.mark.parametrize("table", [{"cutoff": 6.0, "order": 2}, {"cutoff": 14.0, "pick": 1}, {"length": 0.04, "pick": 1}, {"length": 0.1}])
def test_a_filter_shapes_the_spectrum_as_it_says(table):
    effect = {"name": "logger_filter", **table}
    common = {"noise": {"N": 0.01}, "log": {"rate": 20, "duration": "4000s", "oversampling": 20, "axes": ["x"]}}
    rates = simulate(common | {"effect": [effect]}).rate.values
    edges = np.array([0.1, 2.0, 4.0, 6.0, 8.0, 9.9])
    centre = [np.linspace(low, high, 40) for low, high in pairwise(edges)]
    said = [make_effect(effect).explain(windows_of(100, 20.0, 1.0, f)).response.mean() for f in centre]
    np.testing.assert_allclose(band_powers(rates, 20.0, edges), 0.36 * np.array(said), rtol=0.08)


def test_a_filter_that_cannot_be_is_refused():
    setup = Setup(rate=10.0, size=100, start=0, axes=("x",))
    rng = np.random.default_rng(1)
    with pytest.raises(OptionError, match="a cutoff of 5 Hz is not below half of the instrument's 10 Hz; raise oversampling"):
        make_effect({"name": "logger_filter", "cutoff": 5}).begin(setup, rng)
    with pytest.raises(OptionError, match="20000 samples of the instrument; give at most 10000"):
        make_effect({"name": "logger_filter", "length": 2000}).begin(setup, rng)
    with pytest.raises(OptionError, match=r"'order': 2\.5 is not a whole number"):
        make_effect({"name": "logger_filter", "cutoff": 1, "order": 2.5})


def test_the_lattice_adds_a_twelfth_of_its_square_or_swallows_all():
    signal = np.random.default_rng(7).normal(0.3, 1.0, (1, 100_000))
    done = run(make_effect({"name": "rate_quantization", "step": 2.0}), size=100_000, axes="x", signal=signal)
    assert set(np.unique(done / 2.0 % 1.0)) == {0.0}
    added = avar(done - signal, 10.0, [0.1, 1.0, 10.0])[0]
    np.testing.assert_allclose(added[:2], [4 / 12, 4 / 120], rtol=0.06)
    assert not run(make_effect({"name": "rate_quantization", "step": 20.0}), size=100_000, axes="x", signal=signal).any()
    below = run(make_effect({"name": "rate_quantization", "step": 2.0, "mode": "floor"}), size=100_000, axes="x", signal=signal)
    assert (below - signal).mean() == pytest.approx(-1.0, abs=0.02)
    assert make_effect({"name": "rate_quantization", "step": 2.0, "mode": "floor"}).explain(windows_of(9, 1.0, 3.0)).mean["step"][0] == -0.5


def test_a_real_gyro_stands_on_its_lattice(recordings):
    with gzip.open(recordings("mems-static-53min/ch104.csv.gz"), "rt") as file:
        measured = np.loadtxt(file, delimiter=",", skiprows=1, usecols=(0, 1, 2), max_rows=5000).T * 3600
    for step, stands in ((36.0, True), (72.0, False)):
        done = run(make_effect({"name": "rate_quantization", "step": step}), size=5000, rate=100.0, signal=measured)
        assert np.allclose(done, measured, atol=1e-6) == stands


def test_bit_errors_are_bits():
    counts = np.random.default_rng(8).integers(-100, 100, (2, 50_000)).astype(float)
    effect = make_effect({"name": "spikes", "per_hour": 3600, "lsb": 0.25, "bits": 8})
    done = run(effect, size=50_000, rate=20.0, axes="xy", signal=counts * 0.25) / 0.25
    wrong = done != counts
    assert wrong.sum() == pytest.approx(2 * 2500, rel=0.06)
    sizes = np.abs(done - counts)[wrong]
    found, number = np.unique(sizes, return_counts=True)
    np.testing.assert_array_equal(found, 2.0 ** np.arange(8))
    assert number.max() / number.min() < 1.5
    assert done.min() >= -128
    assert done.max() <= 127
    before, after = counts[wrong].astype(int) & 255, done[wrong].astype(int) & 255
    assert set(np.bitwise_count(before ^ after).tolist()) == {1}
    assert (wrong[0] & wrong[1]).sum() == pytest.approx(125, abs=45)  # by chance only
    assert kurtosis((done - counts)[0]) > 20


def test_held_samples_are_runs_that_raise_n_at_long_times():
    noise = np.random.default_rng(9).normal(size=(2, 400_000))
    effect = make_effect({"name": "held_samples", "per_hour": 720, "length": 0.4})  # at 10 Hz: every 50 samples, for 4
    done = run(effect, size=400_000, axes="xy", signal=noise)
    same = np.diff(done, axis=1) == 0
    np.testing.assert_array_equal(same[0], same[1])
    share = 4 / 54
    assert same.mean() == pytest.approx(share, rel=0.05)
    starts = np.flatnonzero(same[0][1:] & ~same[0][:-1]).size
    assert same[0].sum() / starts == pytest.approx(4.0, rel=0.05)
    ratio = (avar(done, 10.0, [0.1, 20.0]) / avar(noise, 10.0, [0.1, 20.0])).mean(axis=0)
    assert ratio[0] == pytest.approx(1 - share, rel=0.02)
    exact = (1 + 0.02 * (2 * 4 + 28)) / (1 + 0.02 * 4)  # E[(1 + h)^2] / E[1 + h], h geometric of mean 4 with the chance 1/50
    assert ratio[1] == pytest.approx(exact, rel=0.08)
    said = effect.explain(windows_of(1000, 10.0, 10.0)).level[("N", "per_hour")][0]
    assert 720 * said == pytest.approx(2 * 0.02 * 16, rel=1e-9)
    assert exact - 1 == pytest.approx(720 * said, rel=0.1)


def test_zeros_pull_the_mean_down():
    effect = make_effect({"name": "held_samples", "per_hour": 720, "length": 0.4, "fill": "zero"})
    done = run(effect, size=200_000, axes="x", signal=15.0)
    assert set(np.unique(done)) == {0.0, 15.0}
    assert done.mean() == pytest.approx(15 * (1 - 4 / 54), rel=0.01)
    said = effect.explain(windows_of(100, 10.0, 10.0, own={"x": np.full(1, 15.0)})).mean["per_hour"]
    assert 720 * said[0, 0] == pytest.approx(-15 * 4 / 50, rel=1e-9)


def test_clipping_cuts_the_tails():
    noise = np.random.default_rng(10).normal(2.0, 1.0, (1, 200_000))
    done = run(make_effect({"name": "clipping", "limit": 1.5, "centre": 2.0}), size=200_000, axes="x", signal=noise)
    assert done.min() == 0.5
    assert done.max() == 3.5
    assert (done == 3.5).mean() == pytest.approx(norm.sf(1.5), rel=0.03)
    inside = norm.cdf(1.5) - norm.cdf(-1.5) - 2 * 1.5 * norm.pdf(1.5)
    assert done.var() == pytest.approx(inside + 2 * 1.5**2 * norm.sf(1.5), rel=0.01)


# ----------------------------------------------------------------------------------------------------------------- clock


def test_a_fast_clock_reads_too_little_on_all_axes():
    effect = make_effect({"name": "clock_error", "error": 100})
    w = np.array([[3.888e6], [-1e6], [0.0]])
    done = run(effect, size=1000, signal=w)
    np.testing.assert_allclose(done - w, -1e-4 * np.broadcast_to(w, done.shape), rtol=1e-9)  # 100 ppm of 180 r/min: 388.8 deg/h
    own = {axis: np.full(10, value) for axis, value in zip("xyz", w[:, 0], strict=True)}
    said = effect.explain(windows_of(1000, 10.0, 10.0, axes=("x", "y", "z"), own=own)).mean["error"]
    np.testing.assert_allclose(100 * said[:, 0], -1e-4 * w[:, 0])
    rated = run(make_effect({"name": "clock_error", "error": 100, "output": "rate"}), size=1000, signal=w)
    np.testing.assert_allclose(rated - w, 0.0, atol=1e-9)


@pytest.mark.parametrize("reading", ["latest", "average"])
@pytest.mark.parametrize(("error", "drift"), [(2000, 0), (-2000, 0), (-3000, 1e4), (0, 8000), (1000, -1e4)])
def test_the_log_holds_what_was_there_at_the_time_of_the_clock(error, drift, reading):
    def motion(t):
        return 50.0 * np.sin(2 * np.pi * t / 60.0) + 0.2 * t

    rate, size = 100.0, 180_000  # half an hour
    effect = make_effect({"name": "clock_error", "error": error, "drift": drift, "output": "rate", "reading": reading})
    t = np.arange(size) / rate
    done = run(effect, size=size, rate=rate, axes="x", signal=motion(t))[0]
    ahead = (error * t + drift * t**2 / 7200) * 1e-6
    ahead -= min(ahead.min(), 0.0)
    known = t > ahead
    off = done - motion(t - ahead)
    assert np.abs(off[known]).max() < 5.5 * 0.011  # a sample at the steepest place
    assert np.abs(ahead).max() > 0.6
    np.testing.assert_array_equal(done[~known][:-1], motion(0.0))
    assert known.mean() > 0.99


def test_a_line_moves_by_the_error_of_the_clock():
    wave = np.sin(2 * np.pi * 7.0 * np.arange(100_000) / 100.0)
    for error in (5000, -5000):
        done = run(make_effect({"name": "clock_error", "error": error}), size=100_000, rate=100.0, axes="x", signal=wave)[0][1000:]
        spectrum = np.abs(np.fft.rfft(done * np.hanning(done.size)))
        assert np.fft.rfftfreq(done.size, 0.01)[spectrum.argmax()] == pytest.approx(7.0 * (1 - error * 1e-6), abs=0.0012)


def test_a_sample_is_skipped_or_doubled_as_often_as_the_error_says():
    count = np.arange(40_000.0)
    fast = run(make_effect({"name": "clock_error", "error": 1000, "output": "rate"}), size=40_000, axes="x", signal=count)[0]
    slow = run(make_effect({"name": "clock_error", "error": -1000, "output": "rate"}), size=40_000, axes="x", signal=count)[0]
    assert (np.diff(fast) == 0).sum() == pytest.approx(40, abs=1)
    assert (np.diff(slow) == 2).sum() == pytest.approx(40, abs=1)
    assert set(np.unique(np.diff(fast))) == {0.0, 1.0}


def test_the_clock_leaves_white_noise_as_it_is():
    noise = np.random.default_rng(11).normal(size=(3, 200_000))
    for reading, share in (("latest", 0.0), ("average", 1.0)):
        done = run(make_effect({"name": "clock_error", "error": 300, "reading": reading}), size=200_000, signal=noise)
        ratio = (avar(done, 10.0, [0.1, 1.0, 4.0]) / avar(noise, 10.0, [0.1, 1.0, 4.0])).mean(axis=0)
        # a jump of the weights between two samples, 1, 2 and 1 high, loses its square times f (1 - f), 1 / 6 on average over the place f
        np.testing.assert_allclose(ratio, 1.0 - share / (2 * np.array([1, 10, 40])), rtol=0.02)


def test_a_clock_that_is_far_off_is_refused():
    setup = Setup(rate=400.0, size=400 * 3600 * 200, start=0, axes=("x",))
    rng = np.random.default_rng(1)
    with pytest.raises(OptionError, match="gets wrong by 28800003 samples; make the log shorter"):
        make_effect({"name": "clock_error", "error": 1e5}).begin(setup, rng)
    with pytest.raises(OptionError, match="gets wrong by 210%"):
        make_effect({"name": "clock_error", "error": 1e5, "drift": 1e4}).begin(setup, rng)
    assert make_effect({"name": "clock_error", "error": -50, "drift": 1}).say() == (
        "The clock of the samples is slow by 50 ppm, more by 1 ppm/h on all axes."
    )


# ---------------------------------------------------------------------------------------------------------------- chunks

VARIANTS = [
    {"name": "dead_zone", "width": 2.0, "bandwidth": 0.3, "edge": "jump"},
    {"name": "feedback_reset", "kick": 3.0, "tail": 40.0, "decay": 0.5, "sawtooth": 0.3},
    {"name": "feedback_reset", "kick": 3.0, "tail": 40.0, "decay": 0.5, "sawtooth": 0.3, "phase": "channel", "full": 1.5},
    {"name": "fringe_hop", "per_hour": 600, "hold": 5},
    {"name": "fringe_hop", "at": 33.33, "hold": 5},
    {"name": "bias_jump", "restart": 0.2, "shock": 0.1, "shocks_per_hour": 900, "step": [0.1, 0.0, -0.1], "at": 71.23},
    {"name": "telegraph", "step": 0.2, "low": 0.05, "high": 3.0},
    {"name": "shared_source", "N": [0.1, 0.2, -0.1], "bandwidth": 0.5},
    {"name": "supply_bias", "voltage": 0.1, "ripple": 0.2, "frequency": 17.0},
    {"name": "logger_filter", "cutoff": 3.0, "order": 5, "length": 0.7},
    {"name": "spikes", "kind": "outlier", "per_hour": 9000},
    {"name": "held_samples", "per_hour": 3600, "length": 0.8},
    {"name": "held_samples", "per_hour": 3600, "length": 0.8, "fill": "zero"},
    {"name": "clock_error", "error": 30_000, "drift": -9000},
    {"name": "clock_error", "error": -30_000, "reading": "average"},
]


@settings(max_examples=60, deadline=None)
@given(st.sampled_from(VARIANTS), st.integers(0, 10_000))
def test_how_time_is_cut_does_not_matter(table, seed):
    size = 1200
    signal = np.random.default_rng(5).normal(4.0, 3.0, (3, size))
    drivers = {"ramp": np.arange(size) * 0.031 % 1.5, "supply_voltage": 24 + np.sin(np.arange(size) / 30)}
    restarts = np.array([[300, 340], [700, 720]])
    same_whatever_the_cuts(
        make_effect(table), random_cuts(seed, size), size=size, signal=signal, drivers=drivers, restarts=restarts, gaps=restarts, seed=seed
    )


def test_a_chain_of_the_electronics_is_the_same_in_any_blocks():
    names = ["feedback_reset", "fringe_hop", "clock_error", "logger_filter", "rate_quantization", "spikes", "held_samples"]
    sizes = [{"kick": 11.5, "tail": 18}, {"per_hour": 100, "hold": 3}, {"error": 900}, {"cutoff": 30, "pick": 1}, {"step": 0.5}]
    sizes += [{"per_hour": 1000}, {"per_hour": 2000}]
    effects = [{"name": name, **size} for name, size in zip(names, sizes, strict=True)]
    model = {"noise": {"N": 0.01}, "effect": effects, "log": {"rate": 50, "duration": "40s", "oversampling": 4}}
    whole, blocks = simulate(model, seed=9).rate.values, simulate(model, seed=9, chunk=173).rate.values
    np.testing.assert_array_equal(blocks, whole)
    assert np.isfinite(whole).all()
