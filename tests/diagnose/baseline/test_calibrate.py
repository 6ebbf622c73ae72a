"""Calibration of the noise on simulated logs, and baselines of models and simulations."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from gyrostab.diagnose.baseline.axis_means import AxisMeans
from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.baseline.expected_statistics import (
    common_variance,
    noise_powers,
    reduced_shape,
    white_variance,
)
from gyrostab.diagnose.baseline.posterior import BandPowers, _fit_noise_alone, fit_squares
from gyrostab.diagnose.baseline.quiescent import find_quiescent_blocks
from gyrostab.diagnose.evidence.wandering import no_processes
from gyrostab.diagnose.nulls.records import null_records
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.statistics import find_statistic
from gyrostab.diagnose.statistics.allan_surface import allan_surface
from gyrostab.errors import OptionError, SchemaError
from gyrostab.ingest.make_log import make_log
from gyrostab.kernels.spectra.expected import expected_powers, sample_covariance
from gyrostab.kernels.spectra.periodogram import band_edges, ordinates, taper
from gyrostab.noise import URAD_PER_S
from gyrostab.simulate import simulate
from gyrostab.simulate.noise import make_noise
from tests.support.repetitions import first_of

NOISE = {"N": 0.003, "B": 0.004, "K": 0.02}
WARM = {"profile": "ramps", "channel": "temperature", "unit": "degC"}
SHAKEN = {
    "profile": "vibration",
    "points": [[0, 0.02], [1199, 0.02], [1200, 6.0], [1500, 6.0], [1501, 0.02], [3600, 0.02]],
}


def log(
    noise=NOISE,
    *,
    seed=0,
    rate=10.0,
    duration="1h",
    axes=("x",),
    lost=0.0,
    effects=(),
    environment=(),
) -> xr.Dataset:
    model = {
        "log": {"axes": list(axes)},
        "noise": noise,
        "effect": list(effects),
        "environment": list(environment),
    }
    made = simulate(model, duration=duration, rate=rate, seed=seed).compute()
    if lost:
        kept = np.random.default_rng(seed).random(made.sizes["time"]) >= lost
        kept_rate = made["rate"].where(xr.DataArray(kept, dims="time"))
        made["rate"] = kept_rate.transpose("axis", "time")
    return made


@pytest.mark.parametrize(
    ("term", "size"), [("Q", 1.0 / URAD_PER_S), ("N", 1.0 / 60.0), ("B", 1.0), ("K", 60.0)]
)
def test_expected_powers_are_those_of_simulated_noise(term, size):
    length, rate, block_count = 500, 10.0, 800
    weights, edges = taper(length), band_edges(length)
    noise = make_noise(rate=rate, size=length * block_count, seed=5, **{term: size}).reshape(
        block_count, length
    )
    spectra = np.fft.rfft((noise - noise.mean(axis=1, keepdims=True)) * weights)[
        :, 1 : ordinates(length) + 1
    ]
    ratio = (
        (np.abs(spectra) ** 2).mean(axis=0)
        / (rate * (weights**2).sum())
        / expected_powers(weights, rate, ordinates(length))["QNBK".index(term)]
    )
    for low, high in zip(edges[:-1] - 1, edges[1:] - 1, strict=True):
        assert ratio[low:high].mean() == pytest.approx(
            1.0, abs=4.5 / np.sqrt(block_count * (high - low)) + 0.01
        )


@pytest.mark.slow
@pytest.mark.parametrize("lost", first_of(0.3, 0.0))
def test_coefficients_are_within_their_errors(lost):
    noise = {"Q": 0.5, "N": 0.003, "B": 0.004, "K": 0.1}
    axes = tuple("abcdefghijkl")
    blocks = reduce_log(log(noise, axes=axes, duration="2h", lost=lost, seed=3))
    baseline = calibrate_noise(blocks)
    for term, value in noise.items():
        z = ((baseline["coefficient"] - value) / baseline["stderr"]).sel(term=term).values
        assert (np.abs(z) < 2.0).mean() > 0.7, term
        assert np.abs(z.mean()) < 1.2, term
    assert float(baseline["stderr"].sel(term="N").max()) < 0.05 * noise["N"]
    level = (blocks["power"] / baseline["spectrum"]).mean(["axis", "block"])
    np.testing.assert_allclose(level, 1.0, atol=0.12)


def test_white_variance_is_that_of_block_means():
    noise = {"Q": 2.0, "N": 0.003}
    blocks = reduce_log(log(noise, axes=tuple("abcdef"), duration="2h", lost=0.3))
    expected = white_variance(blocks, np.tile([4.0, 9e-6, 0.0, 0.0], (6, 1)))
    ratio = (blocks["mean"].values ** 2).sum() / expected.sum()
    assert ratio == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / expected.size))


def test_common_variance_of_a_block_is_as_expected():
    blocks = reduce_log(log({"N": 0.003}, axes=tuple("abcdefgh"), duration="2h", lost=0.4))
    common, rest = common_variance(blocks)
    residual = (blocks["power"] / noise_powers(blocks)[..., 1] / 9e-6 - 1.0).values
    total = (residual * rest).sum(axis=2) / rest.sum(axis=2)
    expected = common + 1.0 / rest.sum(axis=2)
    assert total.var() == pytest.approx(expected.mean(), rel=0.2)
    assert common.mean() > 0.3 * expected.mean()
    whole, _ = common_variance(reduce_log(log({"N": 0.003})))
    assert np.abs(whole).max() < 1e-9


def test_blocks_with_vibration_rotation_or_heating_are_not_quiescent():
    warm = WARM | {"points": [[0, 30], [2700, 30], [3600, 60]]}
    blocks = reduce_log(log(environment=[SHAKEN, warm], duration="1h"))
    quiet = find_quiescent_blocks(blocks)
    middle = ((blocks["begin"] + blocks["end"]) / 2.0).values
    assert not quiet[0, (middle > 1210) & (middle < 1490)].any()
    assert not quiet[0, middle > 2900].any()
    assert quiet[0, middle < 1100].mean() > 0.9


def test_noisy_blocks_are_not_calibrated_on_without_channels():
    effect = {"name": "vibration_noise", "white": 0.0006, "driver": "vibration"}
    loud = reduce_log(log(effects=[effect], environment=[SHAKEN], rate=100.0)).drop_vars(
        "channel_vibration"
    )
    baseline = calibrate_noise(loud)
    middle = ((loud["begin"] + loud["end"]) / 2.0).values
    inside = (middle > 1220) & (middle < 1480)
    assert not baseline["quiet"].values[0, inside].any()
    assert baseline["quiet"].values[0, ~inside].mean() > 0.8
    value, error = (
        float(baseline[name].sel(axis="x", term="N")) for name in ("coefficient", "stderr")
    )
    assert abs(value - 0.003) < 4.0 * error
    assert (
        float(
            baseline["mean_variance"][0, inside].mean()
            / baseline["mean_variance"][0, middle < 1000].mean()
        )
        > 1.2
    )


def test_given_quiet_time_is_used_and_checked():
    blocks = reduce_log(log(rate=10.0))
    begin, end = blocks["begin"].values, blocks["end"].values
    for quiet in ((0.0, 1200.0), ("1970-01-01T00:00:00Z", "1970-01-01T00:20:00Z")):
        chosen = calibrate_noise(blocks, quiet=quiet)["quiet"].values[0]
        np.testing.assert_array_equal(chosen, (begin >= 0.0) & (end <= 1200.0))
    assert calibrate_noise(blocks, quiet=(0.0, 1200.0)).attrs["calibrated_on"] == [
        ["1970-01-01T00:00:00.000Z", "1970-01-01T00:20:00.000Z"]
    ]
    with pytest.raises(OptionError, match="'soon' is neither a time nor a duration"):
        calibrate_noise(blocks, quiet=("soon", "later"))


def test_error_names_an_axis_without_spectra():
    blocks = reduce_log(log(axes=("x", "y")))
    blocks["power"].loc[{"axis": "y"}] = np.nan
    with pytest.raises(SchemaError, match="axis y"):
        calibrate_noise(blocks)


def test_fit_maximises_the_likelihood_even_without_a_good_fit():
    from scipy.optimize import minimize

    f = np.array([
        0.025, 0.075, 0.125, 0.175, 0.225, 0.325, 0.475, 0.675, 0.975, 1.325, 1.875, 2.625, 3.675,
        5.125, 7.175,
    ])  # fmt: skip
    columns = np.stack([f**2, np.ones(f.size), 1.0 / f, 1.0 / f**2], axis=1)
    # waves below, a steep end above
    bump = [2e4, 2e3, 700, 350, 160, 50, 11, 5, 6, 10, 19, 35, 60, 105, 31]
    bands = BandPowers(
        np.array(bump, np.float64),
        columns,
        26.0 * np.array([1, 1, 1, 1, 2, 3, 4, 6, 6.5, 10, 14, 19, 26, 37, 50]),
    )

    def worse(logarithms):
        expected = columns @ np.exp(logarithms)
        return float((bands.weight * (np.log(expected) + bands.power / expected)).sum())

    rng = np.random.default_rng(0)
    best = min(
        minimize(worse, rng.uniform(-5, 5, 4), method="Nelder-Mead", options={"maxiter": 4000}).fun
        for _ in range(8)
    )
    square, *_ = fit_squares(bands)
    assert worse(np.log(np.maximum(square, 1e-12))) < best + 0.1


def test_a_fit_does_not_depend_on_those_beside_it():
    """Some need a few steps and others many."""
    rng = np.random.default_rng(2)
    f = np.geomspace(0.05, 5.0, 14)
    columns = np.stack([f**2, np.ones(14), 1.0 / f, f**-2], axis=1)
    low_pass = 1.0 / (1.0 + (f / np.array([[0.2], [0.5], [2.0], [9.0]])) ** 4)
    sets = np.concatenate([columns[None], columns * low_pass[:, :, None]])
    shape = np.full(14, 40.0)
    power = sets[2] @ [0.0, 2.0, 0.3, 0.0] * rng.gamma(shape) / shape
    together = _fit_noise_alone(BandPowers(power, columns, shape), sets)
    for place, own in enumerate(sets):
        alone = fit_squares(BandPowers(power, own, shape))
        for part, one in zip(together, alone, strict=True):
            np.testing.assert_allclose(part[place], one, rtol=1e-12)


# --------------------------------------------------------------------------------
# noise that five terms do not describe


def with_sines(record: xr.Dataset, amplitudes: dict[float, float]) -> xr.Dataset:
    """Add sines, frequency [Hz] -> amplitude [deg/h]."""
    second = np.arange(record.sizes["time"]) / float(record.attrs["sampling_rate_hz"])
    waves = sum(size * np.sin(2.0 * np.pi * f * second) for f, size in amplitudes.items())
    return record.assign(rate=record["rate"] + waves)


def test_strong_lines_do_not_raise_the_noise_of_means():
    plain = log({"N": 0.003}, rate=100.0, duration="30min")
    comb = {4.17 * order: 2.0 for order in range(1, 8)}
    without, given = (
        calibrate_noise(reduce_log(recording)).sel(axis="x")
        for recording in (plain, with_sines(plain, comb))
    )
    ratio = given["mean_variance"].mean() / without["mean_variance"].mean()
    assert abs(ratio - 1.0) < 0.05


def test_a_hump_within_blocks_does_not_raise_the_noise_of_their_means():
    plain = log({"N": 0.003}, rate=100.0, duration="30min")
    rng = np.random.default_rng(4)
    sway = np.convolve(
        rng.standard_normal(plain.sizes["time"]),
        np.sin(2.0 * np.pi * 3.0 * np.arange(100) / 100.0) * np.hanning(100),
        "same",
    )
    shaken = plain.assign(rate=plain["rate"] + sway)
    blocks = reduce_log(shaken)
    baseline = calibrate_noise(blocks)
    white = 3600.0 * 0.003**2 / float(blocks.attrs["block_s"])
    assert 0.8 < float(baseline["mean_variance"].median()) / white < 1.3
    (nulls,) = null_records(blocks, baseline, count=20, rng=rng)
    scatter = 0.5 * nulls["mean"].diff("block").var()
    assert 0.7 < float(scatter) / white < 1.6


def swell(seconds: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the rate of an angle that swings with periods of about 8 s."""
    rate, kernel = 1.0 / (seconds[1] - seconds[0]), np.arange(0.0, 40.0, seconds[1] - seconds[0])
    shape = np.sin(2.0 * np.pi * kernel / 8.0) * np.hanning(kernel.size)
    angle = np.convolve(rng.standard_normal(seconds.size + kernel.size), shape, "valid")
    return np.diff(angle / angle.std(), append=0.0)[: seconds.size] * rate


def test_waves_faster_than_a_block_are_angle_noise_of_its_mean():
    """Means repeat the angles between blocks with opposite signs, and so do those of null records.

    Noise without waves shows none.
    """
    plain = log({"N": 0.003}, duration="3h")
    seconds = np.arange(plain.sizes["time"]) / 10.0
    rms = 5.0  # arcsec, far above the 0.8 arcsec that white noise adds in a block
    waves = plain.assign(rate=plain["rate"] + rms * swell(seconds, np.random.default_rng(8)))
    without, blocks = reduce_log(plain), reduce_log(waves)
    assert not calibrate_noise(without)["angle_variance"].any()
    baseline = calibrate_noise(blocks)
    assert np.sqrt(float(baseline["angle_variance"][0])) == pytest.approx(rms, rel=0.15)
    (nulls,) = null_records(blocks, baseline, count=20, rng=np.random.default_rng(2))
    for apart, expected in ((1, 6.0), (2, 4.0), (30, 4.0)):
        scatter = [
            float((record["mean"].shift(block=-apart) - record["mean"]).var()) * 20.0**2 / rms**2
            for record in (blocks, nulls)
        ]
        assert scatter == pytest.approx([expected, expected], rel=0.2), apart
    surface = allan_surface(nulls, baseline)
    of_means = surface["columns"]["tau_min_s"] >= 20.0
    ratio = (surface["observed"] / surface["expected"])[..., of_means]
    assert np.nanmean(ratio) == pytest.approx(1.0, abs=0.1)
    assert np.nanstd(find_statistic("mean").score(nulls, baseline)["z"]) == pytest.approx(
        1.0, abs=0.1
    )


def test_a_course_slower_than_a_block_is_no_angle_noise():
    """Its scatter is far above white noise, and above all of K and B that this noise would hide."""
    second = np.arange(3600) / 10.0
    turned = [0, 300, 900, 500, 1200, 800, 1100, 950, 1190, 700, 1000, 400, 0]  # deg/h
    rate = 0.5 * np.random.default_rng(1).standard_normal(second.size)
    rate += np.interp(second, np.linspace(0.0, 320.0, len(turned)), turned)
    blocks = reduce_log(make_log(rate, rate=10.0, unit="deg/h"))
    assert not calibrate_noise(blocks)["angle_variance"].any()


def test_equal_means_have_no_angle_noise():
    """As where the samples of a record repeat in every block."""
    n = 90
    values, present = np.full((n, 1), 3.0), np.ones(n, np.bool_)
    means = AxisMeans(values, None, np.ones(n), 20.0, present, no_processes(n))
    K = B = np.array([0.01, 1.0])
    with np.errstate(all="raise"):
        assert means.with_angle_noise(K, B, means.log_likelihood(K, B), 3.0) is means


@pytest.mark.parametrize("rest", first_of(0.0, 200.0))
def test_null_powers_are_those_expected_of_an_axis_that_moves(rest):
    """Its motion is no noise of one law, or a random walk beyond any that its means allow."""
    quiet_log = log({"N": 0.003, "K": 0.02})
    seconds = np.arange(quiet_log.sizes["time"]) / quiet_log.attrs["sampling_rate_hz"]
    motion = 2000.0 * np.sin(seconds / 70.0) ** 3 * (seconds > rest)
    moved = quiet_log.assign(rate=quiet_log["rate"] + xr.DataArray(motion, dims="time"))
    baseline = calibrate_noise(reduce_log(moved))
    assert baseline.attrs["slow_noise_apart"] == list(baseline["axis"].values)
    drawn = baseline["columns"].dot(baseline["posterior"].mean("draw"), dim="noise")
    np.testing.assert_allclose(drawn / baseline["spectrum"], 1.0, atol=0.1)


def test_null_means_have_the_noise_of_means_where_it_is_apart():
    """Draws of the noise of the powers, four times as strong, do not change the means."""
    blocks = reduce_log(log({"N": 0.003}))
    baseline = calibrate_noise(blocks)
    louder = baseline.assign(posterior=4.0 * baseline["posterior"])
    ratio = {}
    for apart in (False, True):
        attrs = {"white_noise_of_means_apart": list(blocks["axis"].values) if apart else []}
        given = louder.assign_attrs(attrs)
        (nulls,) = null_records(blocks, given, count=40, chunk=40, rng=np.random.default_rng(2))
        steps = nulls["mean"].diff("block").var("block").mean() / 2.0
        ratio[apart] = float(steps / baseline["mean_variance"].mean())
    assert ratio[True] == pytest.approx(1.0, abs=0.15)
    assert ratio[False] > 2.0


@pytest.mark.parametrize("size", [16, 25, 100])
def test_expected_powers_are_the_quadratic_form_of_the_covariance(size):
    weights, rate, i = taper(size), 10.0, np.arange(size)
    covariance = sample_covariance(size, rate)[:, np.abs(i[:, None] - i)]
    expected = []
    for k in range(1, ordinates(size) + 1):
        row = weights * np.exp(-2j * np.pi * k * i / size)
        row -= row.mean()
        expected.append(((row @ covariance) * row.conj()).sum(axis=-1).real)
    expected = np.array(expected).T / np.array(expected)[:, 1]
    made = expected_powers(weights, rate, ordinates(size))
    np.testing.assert_allclose(made / made[1], expected, rtol=1e-9)


def test_a_stretch_without_noise_is_refused():
    rates = np.random.default_rng(1).standard_normal((2, 6000))
    rates[1, :2000] = 0.0
    blocks = reduce_log(make_log(rates, rate=10.0, unit="deg/h"))
    with pytest.raises(SchemaError, match="axis y: the quiescent blocks hold noise in 0 bands"):
        calibrate_noise(blocks, quiet=(0, 190))


def test_the_order_of_the_axes_does_not_matter():
    rates = np.random.default_rng(2).standard_normal((3, 6000))
    forth, back = (
        calibrate_noise(reduce_log(log.isel(axis=order)))
        for log in [make_log(rates, rate=10.0, unit="deg/h")]
        for order in ([0, 1, 2], [2, 1, 0])
    )
    for name in ("square", "mean_variance", "grid_K", "grid_B", "posterior"):
        np.testing.assert_array_equal(back[name].sel(axis=["x", "y", "z"]), forth[name])


@pytest.mark.parametrize("lost", [0.0, 0.3, 0.5])
def test_degrees_of_freedom_of_a_block_are_those_that_losses_leave(lost):
    """The scatter of the level of white noise over 1080 blocks, of which bands vary together."""
    rng = np.random.default_rng(8)
    rates = rng.standard_normal((3, 72_000))
    rates[:, rng.random(72_000) < lost] = np.nan
    blocks = reduce_log(make_log(rates, rate=10.0, unit="deg/h"), block="20s")
    power, shape = blocks["power"].values, blocks["shape"].values
    level = (shape * power).sum(axis=2) / shape.sum(axis=2)
    scatter = level.var() / level.mean() ** 2
    expected = (1.0 / reduced_shape(blocks).sum(axis=2)).mean()
    assert scatter == pytest.approx(expected, rel=0.25)
    if lost == 0.5:
        assert scatter > 1.4 * (1.0 / shape.sum(axis=2)).mean()
