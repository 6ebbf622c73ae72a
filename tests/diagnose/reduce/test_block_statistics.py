"""Block statistics against explicit sums and against the statistics of simulated noise."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from gyrostab.diagnose.reduce.block_statistics import choose_block_length, reduce_log
from gyrostab.diagnose.reduce.rotation_orders import noise_at_orders
from gyrostab.errors import OptionError, SchemaError
from gyrostab.ingest.make_log import make_log
from gyrostab.kernels.spectra.periodogram import band_covariance, band_edges, ordinates, taper
from gyrostab.noise import URAD_PER_S
from gyrostab.simulate import simulate

RATE = 100.0
WHITE_DENSITY = 1.0 / RATE  # of unit white noise [(deg/h)^2 / Hz]


def log_of(
    values: np.ndarray,
    *,
    rate: float = RATE,
    channels: dict[str, tuple[np.ndarray, str]] | None = None,
    **options,
) -> xr.Dataset:
    return make_log(np.atleast_2d(values), rate=rate, unit="deg/h", channels=channels, **options)


def with_gaps(
    values: np.ndarray, kind: str, rng: np.random.Generator, size: int = 400
) -> np.ndarray:
    """Lose samples at random, or in one interval of every block."""
    values = values.copy()
    if kind == "random":
        values[rng.random(values.shape) < 0.3] = np.nan
    elif kind == "stretches":
        for block in values.reshape(-1, size):
            first = rng.integers(0, size)
            block[first : first + rng.integers(size // 10, 7 * size // 10)] = np.nan
    return values


# --------------------------------------------------------------------------------
# the spectrum


@settings(max_examples=12)
@given(
    seed=st.integers(0, 2**31),
    size=st.sampled_from([96, 100, 135]),
    lost=st.floats(0.0, 0.6),
    offset=st.floats(-1e5, 1e5),
)
def test_powers_match_their_definition(seed: int, size: int, lost: float, offset: float):
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((2, 24 * size)) + offset
    x[rng.random(x.shape) < lost] = np.nan
    blocks = reduce_log(log_of(x), block=f"{size}samples")
    weights, edges, number = taper(size), band_edges(size), int(rng.integers(0, 24))
    component = x[:, number * size : (number + 1) * size]
    angle = np.exp(-2j * np.pi * np.outer(np.arange(ordinates(size) + 1), np.arange(size)) / size)
    for row in range(2):
        is_present = ~np.isnan(component[row])
        if is_present.mean() < 0.25:
            assert np.isnan(blocks.power.values[row, number]).all()
            continue
        mean = component[row][is_present].mean()
        # Every Fourier coefficient is a sum c . y over the samples; c subtracts the mean.
        c = (
            angle[:, is_present] * weights[is_present]
            - (angle[:, is_present] @ weights[is_present])[:, None] / is_present.sum()
        )
        ordinate, expected = c @ (component[row][is_present] - mean), (np.abs(c) ** 2).sum(axis=1)
        for band in range(edges.size - 1):
            k = slice(edges[band], edges[band + 1])
            assert blocks.power.values[row, number, band] == pytest.approx(
                (np.abs(ordinate[k]) ** 2).sum() / expected[k].sum() / RATE, rel=1e-6
            )
        assert blocks["mean"].values[row, number] == pytest.approx(mean, rel=1e-12, abs=1e-9)
    in_both = ~np.isnan(component).any(axis=0)
    if in_both.mean() >= 0.25:
        y = component[:, in_both] - component[:, in_both].mean(axis=1, keepdims=True)
        c = (
            angle[:, in_both] * weights[in_both]
            - (angle[:, in_both] @ weights[in_both])[:, None] / in_both.sum()
        )
        first, second = c @ y[0], c @ y[1]
        k = slice(edges[3], edges[4])
        joint = (np.abs(first[k]) ** 2).sum() * (np.abs(second[k]) ** 2).sum()
        coherency = (first[k] * second[k].conj()).sum() / np.sqrt(joint)
        expected_power = coherency * np.sqrt(blocks.power.values[:, number, 3].prod())
        assert blocks.cross.values[0, number, 3] == pytest.approx(
            expected_power, rel=1e-6, abs=1e-12
        )


@pytest.mark.parametrize(
    "gaps",
    [
        pytest.param("none", marks=pytest.mark.slow),
        pytest.param("random", marks=pytest.mark.full),
        "stretches",
    ],
)
def test_powers_of_white_noise_are_gamma_distributed(gaps: str):
    rng = np.random.default_rng(4)
    x = with_gaps(3.0 * rng.standard_normal(3000 * 400), gaps, rng)
    blocks = reduce_log(log_of(x), block="400samples")
    power, shape = blocks.power.values[0] / (9.0 / RATE), blocks["shape"].values[0]
    is_present = np.isfinite(power[:, 0])
    power, shape = power[is_present], shape[is_present]
    error = np.sqrt(1.0 / shape.mean(axis=0) / power.shape[0])
    assert np.all(np.abs(power.mean(axis=0) - 1.0) < 4.5 * error)
    spread = ((power - 1.0) ** 2 * shape).mean(axis=0)  # 1 for a gamma distribution of this shape
    assert np.all(np.abs(spread - 1.0) < 0.13)
    for band in range(3, power.shape[1]):
        assert (
            stats.kstest(
                stats.gamma.cdf(power[:, band] * shape[:, band], shape[:, band]), "uniform"
            ).pvalue
            > 1e-4
        )


def test_covariance_of_bands_is_that_of_the_taper():
    size, block_count = 50, 40_000
    x = np.random.default_rng(4).standard_normal((block_count, size))
    spectrum = np.fft.rfft((x - x.mean(axis=1, keepdims=True)) * taper(size), axis=1)[
        :, 1 : ordinates(size) + 1
    ]
    power = np.add.reduceat(np.abs(spectrum) ** 2, band_edges(size)[:-1] - 1, axis=1)
    covariance = np.cov((power / power.mean(axis=0)).T)
    scatter = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)) / block_count)
    np.fill_diagonal(covariance, 0.0)
    assert np.abs((covariance - band_covariance(size)) / scatter).max() < 4.5
    assert np.abs(covariance / scatter).max() > 6.0  # the test can fail


def test_full_blocks_lose_little_to_the_taper():
    blocks = reduce_log(
        log_of(np.random.default_rng(0).standard_normal(40_000)), block="1000samples"
    )
    widths = np.diff(band_edges(1000))
    share = blocks["shape"].values[0, 0] / widths
    assert np.all((share > 0.8) & (share <= 1.0))
    assert blocks.neighbours.values == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize(
    ("noise", "tolerance"), [({"Q": 5.0}, 0.05), ({"N": 0.003, "K": 5.0}, 0.12)]
)
def test_random_gaps_mix_densities_by_the_share_of_neighbours(
    noise: dict[str, float], tolerance: float
):
    log = simulate(
        {"noise": noise, "log": {"axes": ["x"]}}, duration="2h", rate=50.0, seed=8
    ).compute()
    lost = np.random.default_rng(1).random(log.rate.shape) < 0.4
    blocks = reduce_log(log.assign(rate=log.rate.where(~lost)), block="10s")
    f = blocks.frequency.values
    omega = 2.0 * np.pi * f
    density = np.zeros_like(f)
    fine = np.linspace(0.0, 25.0, 20001)[1:]
    if "Q" in noise:  # first difference of white angles
        level = (noise["Q"] * URAD_PER_S) ** 2 * 50.0
        density += level * (2.0 * np.sin(omega / 100.0)) ** 2
        mean = 2.0 * level
    else:
        white, walk = (noise["N"] * 60.0) ** 2, (noise["K"] / 60.0) ** 2
        density += white + walk / omega**2
        frequencies = fine[fine >= 0.05]  # block means are subtracted
        mean = white + np.sum(walk / (2 * np.pi * frequencies) ** 2) * (fine[1] - fine[0]) / 25.0
    share = float(blocks.neighbours.mean())
    assert share == pytest.approx(0.6, abs=0.01)
    expected_power = share * density + (1.0 - share) * mean
    power = blocks.power.mean("block").values[0]
    assert power[4:] == pytest.approx(expected_power[4:], rel=tolerance)


def test_a_sine_is_in_its_band_and_line():
    seconds = np.arange(60_000) / RATE
    blocks = reduce_log(log_of(2.0 * np.sin(2 * np.pi * 13.0 * seconds)), block="10s")
    power, width = blocks.power.values[0], (blocks.band_high - blocks.band_low).values
    band = int(np.searchsorted(blocks.band_low.values, 13.0) - 1)
    assert np.all(np.argmax(power, axis=1) == band)
    assert power[:, band] * width[band] * 2.0 == pytest.approx(
        2.0, rel=0.1
    )  # power 2**2 / 2, with the error of the taper
    lines = blocks.line_power.values[0]
    assert lines.shape[0] == 16
    assert np.all(blocks.line_frequency.values[np.argmax(lines, axis=1)] == 13.0)


def test_line_spectra_average_the_blocks_of_a_sixteenth():
    rng = np.random.default_rng(3)
    blocks = reduce_log(log_of(rng.standard_normal(240_000)), block="5s")  # 480 blocks
    assert blocks.line_weight.values == pytest.approx(30.0, rel=0.01)
    lines = blocks.line_power.values * RATE
    assert lines.mean() == pytest.approx(1.0, abs=0.02)
    assert lines.var() * 30.0 == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize("gaps", ["none", "random"])
def test_cross_spectra_contain_common_signals(gaps: str):
    rng = np.random.default_rng(7)
    shared, own = rng.standard_normal(200_000), rng.standard_normal((3, 200_000))
    x = own + np.array([[0.5], [-0.4], [0.0]]) * shared
    reference = shared + 0.1 * rng.standard_normal(shared.size)
    x = np.stack([with_gaps(row, gaps, rng) for row in x])
    reference = with_gaps(reference, gaps, rng)
    blocks = reduce_log(log_of(x, channels={"accel_x": (reference, "g")}), block="500samples")
    assert [
        (str(a), str(b))
        for a, b in zip(blocks["first"].values, blocks["second"].values, strict=True)
    ] == [
        ("x", "y"),
        ("x", "z"),
        ("y", "z"),
    ]
    cross = blocks.cross.mean("block").values * RATE
    assert cross[0].real == pytest.approx(-0.2, abs=0.15)
    assert np.mean(cross[0][-6:]).real == pytest.approx(-0.2, abs=0.02)
    assert np.abs(np.mean(cross[:, -6:], axis=1)[1:]).max() < 0.02
    coupling = (
        blocks.reference_cross.sel(axis="x", reference="accel_x").mean("block") * RATE
    ).values
    assert np.mean(coupling[-6:]) == pytest.approx(0.5, abs=0.02)
    assert (blocks.reference_power.mean("block").values[0] * RATE)[-6:] == pytest.approx(
        1.01, abs=0.03
    )


# --------------------------------------------------------------------------------
# phase-locked statistics and counts


def test_orders_are_the_amplitudes_at_the_tool_rotation():
    rng, size = np.random.default_rng(2), 120_000
    seconds = np.arange(size) / RATE
    speed = 90.0 + 40.0 * np.sin(2 * np.pi * seconds / 300.0)  # deg/s
    turns = (np.cumsum(speed) - speed / 2.0) / 360.0 / RATE
    x = (
        5.0 * np.cos(2 * np.pi * turns + 0.7)
        + 2.0 * np.cos(6 * np.pi * turns - 1.0)
        + 0.5 * rng.standard_normal(size)
    )
    x[rng.random(size) < 0.2] = np.nan
    blocks = reduce_log(log_of(x, channels={"rotation_rate": (speed, "deg/s")}), block="20s")
    order = blocks.order.values[0]
    assert np.abs(order[:, 0].mean() - 5.0 * np.exp(0.7j)) < 0.15
    assert np.abs(order[:, 2].mean() - 2.0 * np.exp(-1.0j)) < 0.15
    assert np.abs(order[:, 1].mean()) < 0.15


def test_orders_of_an_uneven_rotation_with_losses_show_one_harmonic_only():
    time = np.arange(6_000) / 10.0
    turns = 0.25 * time + 0.05 * np.sin(0.5 * np.pi * time)  # stick-slip, once per turn
    inside = np.diff(turns, append=2.0 * turns[-1] - turns[-2])
    rate = 5.0 * np.cos(2.0 * np.pi * (turns + inside / 2.0) + 0.7)
    rate[np.random.default_rng(1).random(rate.size) < 0.1] = np.nan
    channels = {"rotation_rate": (3600.0 * inside, "deg/s")}
    log = make_log(rate[None], rate=10.0, unit="deg/h", channels=channels)
    blocks = reduce_log(log, block="20s")
    order = blocks["order"].values[0]
    fitted = np.isfinite(order).all(axis=1)
    assert fitted.mean() > 0.9
    np.testing.assert_allclose(np.abs(order[fitted, 0]), 5.0, rtol=1e-6)
    assert np.abs(order[fitted, 1:]).max() < 1e-6
    # the mean of the samples that are present, which an even rotation would not have
    first = blocks["turn_mean"].values[0, :, 0]
    expected = (5.0 * first * np.exp(0.7j)).real
    np.testing.assert_allclose(blocks["mean"].values[0], expected, atol=0.03)
    assert np.abs(expected).max() > 0.5
    # and the side bands, with what the losses leave in all other bands
    power, wave = blocks["power"].values[0], blocks["turn_power"].values[0]
    np.testing.assert_allclose(25.0 * wave.sum(axis=0), power.sum(axis=0), rtol=0.2)
    line_power = blocks["line_power"].values[0].mean(axis=0)
    line_wave = blocks["turn_line_power"].values[0]
    strong = line_power > 0.01 * line_power.max()
    assert strong.sum() >= 5
    np.testing.assert_allclose(25.0 * line_wave[strong], line_power[strong], rtol=0.3)


@pytest.mark.parametrize("harmonic", [0, 1, 2])
def test_noise_near_orders_is_measured_without_bias_in_bursts_of_losses(turning_noise, harmonic):
    level = turning_noise["order_level"].values[0, :, harmonic]
    assert np.isfinite(level).mean() > 0.9
    assert np.nanmean(level) == pytest.approx(WHITE_DENSITY, rel=0.08)


def test_blocks_without_part_of_each_turn_have_neither_amplitude_nor_noise_next_to_it():
    time = np.arange(48_000) / RATE
    x = 5.0 * np.cos(2.0 * np.pi * time) + np.random.default_rng(1).standard_normal(time.size)
    x[(time // 20.0 == 3) & (time % 1.0 > 0.4)] = np.nan
    channels = {"rotation_rate": (np.full(time.size, 360.0), "deg/s")}
    blocks = reduce_log(log_of(x, channels=channels), block="20s")
    lost = np.arange(24) == 3
    for name in ("order", "order_level"):
        np.testing.assert_array_equal(np.isnan(blocks[name].values[0, :, 0]), lost)


def test_amplitudes_at_orders_have_the_error_of_so_many_samples():
    blocks = reduce_turning_noise(turns_per_stick=1.0, swing=0.9)
    order, samples = (blocks[name].values for name in ("order", "order_samples"))
    assert np.nanmean(np.abs(order) ** 2 * samples / 4.0) == pytest.approx(1.0, abs=0.07)
    present = blocks["samples"].values[..., None]
    assert 1.15 < np.mean(present / samples) < 1.5
    assert (samples <= present).all()


def test_power_of_an_order_itself_is_not_noise_next_to_it(turning_noise):
    expected = np.full(turning_noise["order_level"].shape, 3.0 * WHITE_DENSITY)
    noise = noise_at_orders(turning_noise, expected)
    np.testing.assert_allclose(noise.mean(axis=1), WHITE_DENSITY, rtol=0.08)
    rising = expected * np.linspace(0.5, 1.5, expected.shape[1])[:, None]
    noise = noise_at_orders(turning_noise, rising)
    np.testing.assert_allclose(noise[0, -1] / noise[0, 0], 3.0)


@pytest.fixture(scope="module")
def turning_noise() -> xr.Dataset:
    return reduce_turning_noise(turns_per_stick=3.3, swing=0.6)


def reduce_turning_noise(*, turns_per_stick: float, swing: float) -> xr.Dataset:
    """Reduce white noise of a tool that turns once a second with stick-slip, with losses."""
    size, length = 480_000, 2_000
    rng, time = np.random.default_rng(5), np.arange(size) / RATE
    speed = 360.0 * (1.0 + swing * np.sin(2.0 * np.pi / turns_per_stick * time))  # deg/s
    x = rng.standard_normal(size)
    for first in range(0, size, length):
        start = first + int(rng.integers(0, 1_400))
        x[start : start + 500] = np.nan
    channels = {"rotation_rate": (speed, "deg/s")}
    return reduce_log(log_of(x, channels=channels), block="20s")


def test_orders_use_a_slower_rotation_sensor_and_are_missing_at_rest():
    model = {
        "noise": {"N": 1e-4},
        "log": {"axes": ["x", "y"]},
        "effect": [{"name": "earth_rate", "latitude": 45.0}],
        "environment": [
            {
                "profile": "rotation",
                "points": [[0, 0], [590, 0], [600, 360], [1200, 360]],
                "sensor_rate": 10,
            }
        ],
    }
    log = simulate(model, duration="20min", rate=RATE, seed=1).compute()
    blocks = reduce_log(log, block="20s")
    order = blocks.order.values[..., 0]
    still, turning = blocks.end.values <= 580.0, blocks.begin.values >= 610.0
    assert np.isnan(order[:, still]).all()
    size = np.abs(order[:, turning])
    assert np.all(np.abs(size / size.mean() - 1.0) < 0.05)
    assert 1.0 < size.mean() < 15.05
    quarter = np.angle(order[1, turning] / order[0, turning])
    assert np.abs(np.abs(quarter) - np.pi / 2) == pytest.approx(0.0, abs=0.1)


def test_a_profile_shows_the_error_by_phase_of_the_ramp():
    rng, size = np.random.default_rng(6), 90_000
    ramp = rng.random(size) * 32767
    x = 4.0 * (ramp / 32767 > 0.75) + rng.standard_normal(size) + 1e5
    blocks = reduce_log(log_of(x, channels={"ramp": (ramp, "1")}), block="5s")
    weights = blocks.profile_samples.values[0]
    profile = (np.nan_to_num(blocks.profile.values[0]) * weights).sum(axis=0) / weights.sum(axis=0)
    assert weights.sum() == size
    assert profile == pytest.approx(np.where(blocks.phase.values > 0.75, 3.0, -1.0), abs=0.15)


# --------------------------------------------------------------------------------
# channels and spans


def test_channels_with_any_stamps_are_averaged_over_blocks():
    model = {
        "noise": {"N": 0.01},
        "log": {"axes": ["x"]},
        "environment": [
            {
                "profile": "ramps",
                "channel": "temperature",
                "unit": "degC",
                "points": [[0, 20], [1200, 60]],
                "sensor_rate": 0.1,
            },
            {
                "profile": "steps",
                "channel": "supply_voltage",
                "unit": "V",
                "points": [[0, 28], [600, 24]],
                "sensor_rate": 2.0,
            },
        ],
    }
    log = simulate(model, duration="20min", rate=RATE, seed=1).compute()
    log["vibration"] = ("time", np.tile([3.0, -4.0], 60_000), {"units": "g"})
    blocks = reduce_log(log, block="5s")
    centre = (blocks.begin + blocks.end).values / 2.0
    warm = blocks.channel_temperature
    assert warm.attrs["units"] == "degree_Celsius"
    assert np.isfinite(warm.values[:-2]).all()  # the last sample of the sensor is before the end
    assert warm.values[:-2] == pytest.approx(20.0 + centre[:-2] / 30.0, abs=0.1)
    assert blocks.channel_supply_voltage.values == pytest.approx(np.where(centre < 600, 28.0, 24.0))
    assert blocks.channel_vibration.values == pytest.approx(np.sqrt(12.5))


@pytest.mark.parametrize("own", [True, False], ids=["with own stamps", "with the rate"])
def test_temperatures_are_smoothed_within_blocks(own):
    rng = np.random.default_rng(4)
    log = log_of(rng.standard_normal(180_000))
    t = np.arange(180_000) / RATE
    true = 20.0 + np.clip(t - 801.0, 0.0, 400.0) / 30.0
    every = 100 if own else 1
    readings = true[::every] + (0.1 if own else 1.0) * rng.standard_normal(t[::every].size)
    if own:
        log["temperature"] = ("time_temperature", readings, {"units": "degree_Celsius"})
        log = log.assign_coords(time_temperature=log.time.values[::every])
    else:
        log["temperature"] = ("time", readings, {"units": "degree_Celsius"})
    log["supply_voltage"] = ("time", true, {"units": "V"})
    log["temperature_2"] = ("time_temperature_2", true[::900], {"units": "degree_Celsius"})
    log = log.assign_coords(time_temperature_2=log.time.values[::900])
    blocks = reduce_log(log)
    fine = blocks.fine_temperature
    assert fine.dims == ("block", "block_part")
    assert fine.attrs["units"] == "degree_Celsius"
    error = fine.values - true.reshape(*fine.shape, -1).mean(axis=2)
    raw = 0.1 / np.sqrt(180_000 / every / fine.size) * (1.0 if own else 10.0)
    assert error.std() < 0.6 * raw
    assert "fine_temperature_2" not in blocks  # sampled less often than the parts
    components = true.reshape(*fine.shape, -1).mean(axis=2)
    np.testing.assert_allclose(
        blocks.fine_supply_voltage.values, components, atol=0.05
    )  # a supply too, except at its corners


def test_a_channel_is_missing_in_its_long_gaps():
    log = log_of(np.random.default_rng(0).standard_normal(60_000))
    stamps = log.time.values[::100]
    keep = np.r_[0:200, 400:600]
    log["temperature"] = ("time_temperature", np.full(400, 50.0), {"units": "degree_Celsius"})
    log = log.assign_coords(time_temperature=stamps[keep])
    temperature = reduce_log(log, block="5s").channel_temperature.values
    assert np.isnan(temperature[41:79]).all()
    assert np.all(temperature[np.r_[0:39, 81:119]] == 50.0)


def test_long_gaps_and_restarts_are_listed_in_seconds():
    x = np.random.default_rng(0).standard_normal((2, 60_000))
    x[:, 10_000:10_050] = np.nan  # too short
    x[:, 20_000:20_300] = np.nan
    x[0, 30_000:32_000] = np.nan  # one axis only
    x[:, 39_950:41_000] = np.nan  # across the edge of a block
    blocks = reduce_log(log_of(x), block="10s")
    assert np.stack([blocks.gap_begin, blocks.gap_end], axis=1).tolist() == [
        [200.0, 203.0],
        [399.5, 410.0],
    ]
    assert np.stack([blocks.restart_begin, blocks.restart_end], axis=1).tolist() == [[399.5, 410.0]]
    assert blocks.samples.values[0, 30:32].tolist() == [0, 0]
    assert np.isnan(blocks["mean"].values[0, 30:32]).all()
    assert np.isfinite(blocks["mean"].values[1, 30:32]).all()
    assert blocks.attrs["missing_share"] == pytest.approx((50 + 300 + 1000 + 1050) / 60_000)


def test_restarts_listed_in_the_log_are_used():
    model = {
        "noise": {"N": 0.01},
        "log": {"axes": ["x"]},
        "environment": [{"profile": "power_cuts", "cuts": [[300, 302], [900, 930]]}],
    }
    log = simulate(model, duration="20min", rate=10.0, seed=1)
    blocks = reduce_log(log)
    assert blocks.restart_begin.values == pytest.approx([300.0, 900.0])
    assert blocks.restart_end.values == pytest.approx([302.0, 930.0])


@settings(max_examples=10)
@given(chunk=st.integers(300, 9000), seed=st.integers(0, 100))
def test_statistics_do_not_depend_on_chunks(chunk: int, seed: int):
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((2, 20_000))
    x[:, rng.random(20_000) < 0.1] = np.nan
    speed, ramp = 100.0 + rng.standard_normal(20_000), rng.random(20_000)
    log = log_of(x, channels={"rotation_rate": (speed, "deg/s"), "ramp": (ramp, "1")})
    whole, cut = reduce_log(log), reduce_log(log.chunk(time=chunk))
    for name in whole.variables:
        if whole[name].dtype.kind in "fc":
            np.testing.assert_allclose(
                cut[name].values, whole[name].values, rtol=1e-9, atol=1e-12, err_msg=str(name)
            )
        else:
            assert whole[name].identical(cut[name]), name


def test_an_angle_log_gives_the_statistics_of_its_rates():
    rates = np.random.default_rng(5).standard_normal((1, 30_000)) + 10.0
    angle = np.concatenate([[[0.0]], np.cumsum(rates, axis=1) / 3600.0 / RATE], axis=1)
    log = make_log(angle, rate=RATE, unit="deg", kind="angle")
    from_rates, from_angles = reduce_log(log_of(rates)), reduce_log(log.chunk(time=7001))
    assert from_angles.power.values == pytest.approx(from_rates.power.values, rel=1e-4)
    assert from_angles["mean"].values == pytest.approx(from_rates["mean"].values, abs=1e-6)


# --------------------------------------------------------------------------------
# options and errors


def test_block_length_depends_on_the_record():
    assert choose_block_length(5 * 3600 * 400, 400.0) == 8000
    days = choose_block_length(200 * 3600 * 400, 400.0)
    assert 200 * 3600 * 400 / days == pytest.approx(1000, rel=0.05)
    assert 7_400 / choose_block_length(7_400, 200.0) >= 24
    assert choose_block_length(360_000, 99.3) in range(1900, 1987)


def test_error_for_a_short_record_states_the_minimum():
    with pytest.raises(OptionError, match=r"record of 20 s .* too short .* 24 s at least"):
        reduce_log(log_of(np.zeros(2000)))
    with pytest.raises(OptionError, match="give a shorter block"):
        reduce_log(log_of(np.zeros(20_000)), block="60s")
    with pytest.raises(OptionError, match="needs 16"):
        reduce_log(log_of(np.zeros(20_000)), block="0.1s")


def test_a_single_file_name_is_one_entry():
    log = log_of(np.random.default_rng(1).standard_normal(24 * 100)).assign_attrs(
        source_files="run7.csv", notes="after a repair"
    )
    blocks = reduce_log(log)
    assert (blocks.attrs["source_files"], blocks.attrs["notes"]) == (
        ["run7.csv"],
        ["after a repair"],
    )


def test_an_invalid_log_is_refused():
    with pytest.raises(SchemaError):
        reduce_log(xr.Dataset())


def test_progress_reaches_its_end():
    calls = []
    reduce_log(
        log_of(np.random.default_rng(0).standard_normal((3, 50_000))),
        progress=lambda *given: calls.append(given),
    )
    assert calls[-1][2] == calls[-1][1] > 0.98 * 3 * 50_000
