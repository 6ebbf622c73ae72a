"""Samples that are stuck: at zero, at the ends of the range, or at the last value."""

from __future__ import annotations

import math

import numpy as np
import pytest
import xarray as xr
from scipy.special import ndtr

from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.estimate.conditioned_baseline import add_outlier_power, predict_baseline
from gyrostab.diagnose.estimate.joint_fit import fit_identifications
from gyrostab.diagnose.estimate.recalibrate import recalibrate
from gyrostab.diagnose.evidence.sample_counts import CountEvidence
from gyrostab.diagnose.identify.identifications import Identifications
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.result import finish as conclude
from gyrostab.diagnose.settings import Settings
from gyrostab.diagnose.statistics.sample_sizes import (
    are_simultaneous,
    centre_of_range,
    estimate_from_counts,
)
from gyrostab.ingest.make_log import make_log
from gyrostab.physics.registry import make_effect
from tests.support.effect_bench import run
from tests.support.named import name_effects, nulls
from tests.support.repetitions import first_of

SCATTER = 0.5  # deg/h, of a sample


def named(table: dict, *, axes: str = "xyz", mean: float = 0.0, seed: int = 1) -> Identifications:
    noise = mean + SCATTER * np.random.default_rng(seed).standard_normal((len(axes), 15_000))
    effect = make_effect(table)
    on = [axes.index(axis) for axis in effect.axes or axes]
    noise[on] = run(effect, size=noise.shape[1], axes=axes, signal=noise[on], seed=seed)
    blocks = reduce_log(make_log(noise, rate=10.0, unit="deg/h", axis=list(axes)))
    baseline, records = nulls(blocks, 40)
    return name_effects(blocks, baseline, records)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("table", "options"),
    [
        pytest.param(
            {"name": "dead_zone", "width": 0.002, "axes": ["x"]}, {}, marks=pytest.mark.full
        ),
        pytest.param(
            {"name": "dead_zone", "width": 0.2, "edge": "jump"}, {}, marks=pytest.mark.full
        ),
        pytest.param(
            {"name": "dead_zone", "width": 0.2, "edge": "jump", "axes": ["x"]},
            {"axes": "x"},
            marks=pytest.mark.slow,
        ),
        pytest.param(
            {"name": "held_samples", "per_hour": 60.0, "length": 0.4}, {}, marks=pytest.mark.full
        ),
        pytest.param(
            {"name": "held_samples", "per_hour": 60.0, "length": 0.4, "fill": "zero"},
            {},
            marks=pytest.mark.full,
        ),
        ({"name": "held_samples", "per_hour": 60.0, "length": 0.4, "fill": "zero"}, {"axes": "x"}),
        (
            {"name": "dead_zone", "width": 0.2, "centre": 0.3, "axes": ["x"]},
            {"mean": 0.5, "axes": "x"},
        ),
        ({"name": "clipping", "limit": 0.6, "axes": ["y"]}, {"axes": "y"}),
        pytest.param(
            {"name": "clipping", "limit": 1.75, "axes": ["y"]}, {}, marks=pytest.mark.full
        ),  # seven samples of 15 000
    ],
    ids=lambda value: "-".join(map(str, value.values())),
)
def test_stuck_samples_are_identified(table, options):
    identifications = named(table, **options)
    (identification,) = identifications.identified
    assert identification.effect == table["name"]
    assert identification.axes == tuple(table.get("axes", options.get("axes", "xyz")))
    is_exclusive = table["name"] == "dead_zone" and options.get("axes") == "x"
    assert identification.alternatives == (("held_samples",) if is_exclusive else ())
    if table["name"] == "held_samples":
        (fitted,) = fit_identifications(
            identifications, calibrate_noise(identifications.state.blocks)
        )[:1]
        assert fitted.effect is not None
        assert fitted.effect.fill == table.get("fill", "repeat")
    if "centre" in table:
        baseline = calibrate_noise(identifications.state.blocks)
        (fitted,) = fit_identifications(identifications, baseline)[:1]
        assert fitted.effect is not None
        assert fitted.effect.centre == table["centre"]
        assert fitted.effect.width == pytest.approx(table["width"], rel=0.1)


@pytest.mark.full
def test_periodic_pulse_is_lines_and_not_spikes():
    noise = SCATTER * np.random.default_rng(6).standard_normal((2, 15_000))
    noise[0, ::37] += 8.0 * SCATTER
    noise[1, np.random.default_rng(7).choice(15_000, 40, replace=False)] += 12.0 * SCATTER
    blocks = reduce_log(make_log(noise, rate=10.0, unit="deg/h", axis=["x", "y"]))
    baseline, records = nulls(blocks, 40)
    axes_by_effect = {
        identification.effect: identification.axes
        for identification in name_effects(blocks, baseline, records).identified
    }
    assert axes_by_effect["spectral_line"] == ("x",)
    assert axes_by_effect["spikes"] == ("y",)


def on_quantization_grid(held: int, *, seed: int = 21, size: int = 15_000) -> xr.Dataset:
    """Three axes, quantized to a seventh of their scatter: 1 of 20 samples is zero.

    z is lost in the second half.

    `held` stretches of six samples are filled with zeros.
    """
    rng = np.random.default_rng(seed)
    noise = SCATTER * (rng.standard_normal((3, size)) + np.array([[0.3], [-0.4], [0.2]]))
    noise = np.rint(noise / 0.07) * 0.07
    for first in rng.choice(np.arange(50, size - 100, 30), held, replace=False):
        noise[:, first : first + 6] = 0.0
    noise[2, size // 2 :] = np.nan
    noise[1, rng.random(size) < 0.1] = np.nan
    return reduce_log(make_log(noise, rate=10.0, unit="deg/h", axis=list("xyz")))


@pytest.mark.full
def test_zeros_of_a_quantization_grid_coincide_when_an_axis_is_lost():
    blocks = on_quantization_grid(0)
    zeros, samples = (blocks[name].sum("block").values for name in ("zeros", "samples"))
    assert (zeros / samples > 0.04).all()
    lost = blocks["begin"].values > 800.0
    baseline, records = nulls(blocks, 40)
    identifications = name_effects(blocks, baseline, records)
    assert identifications.identified == ()
    drawn = records[0]["filled"].mean("record").values[:, lost].mean(axis=1)
    np.testing.assert_allclose(drawn[:2], blocks["filled"].values[:2, lost].mean(axis=1), atol=0.12)


@pytest.mark.full
def test_zero_filled_samples_are_identified_when_an_axis_is_lost():
    blocks = on_quantization_grid(20)
    baseline, records = nulls(blocks, 40)
    (identification,) = name_effects(blocks, baseline, records).identified
    assert (identification.effect, identification.axes) == ("held_samples", ("x", "y", "z"))
    assert all(component.variant.columns == ("filled",) for component in identification.components)
    assert float(blocks["filled"].sel(axis="x").sum()) == pytest.approx(120, abs=25)


@pytest.mark.full
def test_axis_lost_early_keeps_blocks_with_anomalous_samples():
    """z has 20 of 92 blocks, with zeros in each: without them nothing would be left of it."""
    rng = np.random.default_rng(104)
    noise = SCATTER * rng.standard_normal((3, 15_000))
    noise[2, 3_240:] = np.nan
    for first in range(100, 3_240, 162):
        noise[:, first : first + 6] = 0.0
    blocks = reduce_log(make_log(noise, rate=10.0, unit="deg/h", axis=list("xyz")))
    assert (
        (blocks["filled"].sel(axis="z") > 0).sum()
        == np.isfinite(blocks["mean"].sel(axis="z")).sum()
        == 20
    )
    baseline, records = nulls(blocks, 40)
    (identification,) = name_effects(blocks, baseline, records).identified
    assert (identification.effect, identification.axes) == ("held_samples", ("x", "y", "z"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fill", "axes"), [("repeat", "x"), pytest.param("zero", "xyz", marks=pytest.mark.full)]
)
def test_number_and_length_of_held_samples_are_estimated(fill, axes):
    """Held stretches: 40 of 6 samples, and 20 of 2; zeros of one axis may be a dead zone."""
    rng = np.random.default_rng(8)
    noise = SCATTER * rng.standard_normal((len(axes), 15_000))
    for number, first in enumerate(
        np.sort(rng.choice(np.arange(50, 14_900, 30), 60, replace=False))
    ):
        length = 6 if number < 40 else 2
        noise[:, first : first + length] = noise[:, first - 1 : first] if fill == "repeat" else 0.0
    blocks = reduce_log(make_log(noise, rate=10.0, unit="deg/h", axis=list(axes)))
    baseline, records = nulls(blocks, 40)
    fitted_effects = fit_identifications(name_effects(blocks, baseline, records), baseline)
    assert [fitted.axes for fitted in fitted_effects] == [tuple(axes)]
    assert [fitted.effect.fill for fitted in fitted_effects if fitted.effect] == [fill]
    hours = float(blocks["samples"].sel(axis="x").sum()) / 36_000.0
    for fitted in fitted_effects:
        assert fitted.parameters["per_hour"].value == pytest.approx(60 / hours, rel=0.06)
        assert fitted.parameters["length"].value == pytest.approx(
            (40 * 6 + 20 * 2) / 60 / 10.0, rel=0.06
        )
        for name, true in (("per_hour", 60 / hours), ("length", 0.467)):
            assert fitted.parameters[name].low < true < fitted.parameters[name].high


@pytest.mark.full
def test_held_samples_of_independent_axes_are_separate_effects():
    """Axes x and y repeat their samples together; z repeats its own at other instants."""
    rng = np.random.default_rng(9)
    noise = SCATTER * rng.standard_normal((3, 9_000))
    for rows in ([0, 1], [2]):
        for first in rng.choice(np.arange(50, 8_900, 30), 40, replace=False):
            noise[rows, first : first + 5] = noise[rows, first - 1][:, None]
    blocks = reduce_log(make_log(noise, rate=10.0, unit="deg/h", axis=list("xyz")))
    baseline, records = nulls(blocks, 40)
    fitted_effects = fit_identifications(name_effects(blocks, baseline, records), baseline)
    assert [fitted.axes for fitted in fitted_effects] == [("x", "y"), ("z",)]


@pytest.mark.parametrize(
    ("number", "span", "step"),
    [(3, 36_000, 0.0), (60, 36_000, 0.0), (60, 3_000, 0.0), (240, 36_000, 0.5)],
)
@pytest.mark.parametrize("is_together", [True, False])
def test_instants_of_held_samples_are_compared_between_axes(number, span, step, is_together):
    """Few and many losses, all within a twelfth of the record, and on a quantization grid.

    The grid has a step of half the scatter: one sample in seven repeats the one before by chance.
    """
    rng = np.random.default_rng(3)
    rates = SCATTER * rng.standard_normal((2, 36_000))
    places = np.arange(10, span - 10, 10)
    for rows in ([0, 1],) if is_together else ([0], [1]):
        for first in rng.choice(places, number, replace=False):
            rates[rows, first : first + 4] = rates[rows, first - 1][:, None]
    usual = np.full((2, 180), 1e-3)
    if step:
        rates = step * SCATTER * (np.floor(rates / step / SCATTER) + 0.5)  # never zero
        edges = step * np.arange(-20, 21)
        usual[:] = 199.0 * (np.diff(ndtr(edges)) ** 2).sum()
    blocks = reduce_log(make_log(rates, rate=10.0, unit="deg/h", axis=["x", "y"]))
    counts = CountEvidence({"repeats": (usual, np.ones(2))})
    assert are_simultaneous(("x", "y"), "repeats", blocks, counts) == is_together


@pytest.mark.slow
@pytest.mark.parametrize("number", first_of(2, 20))
def test_frames_that_are_sent_twice_are_held_samples(number: int) -> None:
    noise = SCATTER * np.random.default_rng(8).standard_normal((1, 15_000))
    for first in np.linspace(1_000, 14_000, number).astype(int):
        noise[:, first : first + 4] = noise[:, first - 4 : first]
    blocks = reduce_log(make_log(noise, rate=10.0, unit="deg/h", axis=["x"]))
    baseline, records = nulls(blocks, 40)
    fitted_effects = fit_identifications(name_effects(blocks, baseline, records), baseline)
    assert {fitted.identification.effect for fitted in fitted_effects} == {"held_samples"}
    hours = float(blocks["samples"].sel(axis="x").sum()) / 36_000.0
    often = fitted_effects[0].parameters["per_hour"]
    assert 0.0 < often.low < number / hours < often.high
    assert fitted_effects[0].parameters["length"].value == pytest.approx(0.4)
    assert {fitted.effect.fill for fitted in fitted_effects if fitted.effect} == {"frame"}


@pytest.mark.parametrize(
    ("number", "kind"),
    [
        (6, "normal"),
        pytest.param(20, "normal", marks=pytest.mark.full),
        pytest.param(60, "normal", marks=pytest.mark.slow),
        pytest.param(6, "bits", marks=pytest.mark.slow),
        (20, "bits"),
    ],
)
def test_intervals_of_outliers_exclude_zero_and_contain_the_truth(number: int, kind: str) -> None:
    """Sizes of outliers of a normal law, and of flips of one of six bits, 7 times the noise.

    Flips of the lower bits are not seen, and nothing shows how many there are.
    """
    rng, size, samples = np.random.default_rng(5), 7.0, 15_000
    noise = SCATTER * rng.standard_normal((40, samples))
    for row in noise:
        places = rng.choice(samples, rng.poisson(number), replace=False)
        if kind == "normal":
            unit = rng.standard_normal(places.size)
        else:
            unit = rng.choice([-1.0, 1.0], places.size) * 2.0 ** rng.integers(0, 6, places.size)
            unit /= math.sqrt((4**6 - 1) / 18)
        row[places] += SCATTER * size * unit
    axes = [f"a{index}" for index in range(len(noise))]
    blocks = reduce_log(make_log(noise, rate=10.0, unit="deg/h", axis=axes))
    truth = {"per_hour": number / (samples / 36_000.0), "size": SCATTER * size}
    held = {name: [] for name in truth}
    for axis in axes:
        if float(blocks["outlier_count"].sel(axis=axis).sum()) < 3.0:  # too few to be identified
            continue
        sizes = estimate_from_counts(
            "spikes", "outlier_count", axis, blocks, CountEvidence({}), Settings()
        )
        for name, (_, _, low, high) in sizes.items():
            assert low > 0.0
            held[name].append(low < truth[name] < high)
    assert min(len(intervals) for intervals in held.values()) > 10
    assert np.mean(held["size"]) > 0.9
    assert np.mean(held["per_hour"]) > (0.9 if kind == "normal" else 0.7)


@pytest.mark.parametrize("is_two_sided", [False, True])
def test_limits_of_a_rate_that_moves_are_the_ends_of_the_record(is_two_sided):
    """The range is that of the record, not that of the noise about a moving mean."""
    motion = 5.0 * np.sin(2.0 * np.pi * np.arange(15_000) / 7_000.0)
    noise = SCATTER * np.random.default_rng(9).standard_normal(15_000)
    least = -5.5 if is_two_sided else -np.inf
    rate = np.clip(motion + noise, least, 5.5)
    blocks = reduce_log(make_log(rate[None], rate=10.0, unit="deg/h", axis=["x"]))
    estimated = estimate_from_counts(
        "clipping", "extremes", "x", blocks, CountEvidence({}), Settings()
    )
    limit, error, low, high = estimated["limit"]
    centre = centre_of_range(blocks.sel(axis="x"))
    assert centre + limit == pytest.approx(5.5)
    assert (
        centre - limit == pytest.approx(-5.5)
        if is_two_sided
        else centre - limit < rate.min() - 10.0
    )
    assert (error == 0.0) is is_two_sided
    assert low <= limit <= high
    assert blocks["range_end_samples"].values[0].tolist() == [
        int((rate == rate.min()).sum()),
        int((rate == 5.5).sum()),
    ]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effect", "mark", "name", "size"),
    [
        ("dead_zone", "zeros", "width", 0.0003),
        ("dead_zone", "zeros", "width", 0.003),
        ("clipping", "extremes", "limit", 1.8),
    ],
)
def test_intervals_of_a_few_stuck_samples_contain_the_truth(
    effect: str, mark: str, name: str, size: float
) -> None:
    noise = SCATTER * np.random.default_rng(3).standard_normal((40, 15_000))
    if effect == "dead_zone":
        noise[np.abs(noise) < size] = 0.0
    else:
        noise = np.clip(noise, -size, size)
    axes = [f"a{index}" for index in range(len(noise))]
    blocks = reduce_log(make_log(noise, rate=10.0, unit="deg/h", axis=axes))
    held = []
    for axis in axes:
        if float(blocks[mark].sel(axis=axis).sum()) < 2.0:
            continue
        estimated = estimate_from_counts(effect, mark, axis, blocks, CountEvidence({}), Settings())
        _, _, low, high = estimated[name]
        assert 0.0 < low <= high < math.inf
        held.append(low <= size <= high)
    assert len(held) > 20
    assert np.mean(held) > 0.87


@pytest.mark.full
def test_burst_of_bit_errors_has_the_size_of_its_power():
    rng = np.random.default_rng(4)
    noise = SCATTER * rng.standard_normal((3, 15_000))
    places = 6_000 + 3 * np.arange(14)
    flips = rng.choice([-1.0, 1.0], 14) * 2.0 ** rng.integers(3, 7, 14)
    noise[1, places] += flips
    blocks = reduce_log(make_log(noise, rate=10.0, unit="deg/h", axis=list("xyz")))
    baseline, records = nulls(blocks, 40)
    (identification,) = (identifications := name_effects(blocks, baseline, records)).identified
    assert (identification.effect, identification.axes) == ("spikes", ("y",))
    (fitted,) = fit_identifications(identifications, baseline)
    assert 0.5 < fitted.parameters["size"].value / np.sqrt(np.mean(flips**2)) < 2.0


@pytest.mark.full
def test_noise_rising_within_a_block_has_no_outliers():
    rng = np.random.default_rng(6)
    shaken = (np.arange(15_000) >= 31 * 162 + 120) & (
        np.arange(15_000) < 62 * 162 + 40
    )  # ends in the quiet half of a block
    noise = SCATTER * rng.standard_normal((2, 15_000)) * np.where(shaken, 8.0, 1.0)
    noise[1, rng.choice(4_000, 12, replace=False)] += 30.0
    log = make_log(
        noise,
        rate=10.0,
        unit="deg/h",
        axis=list("xy"),
        channels={"vibration": (3.0 * shaken, "g")},
    )
    baseline, records = nulls(reduce_log(log), 40)
    axes = {
        identification.effect: identification.axes
        for identification in name_effects(reduce_log(log), baseline, records).identified
    }
    assert axes.pop("spikes") == ("y",)
    assert list(axes.values()) == [("x", "y")]  # of what vibration does


def test_rising_and_falling_noise_has_no_spikes():
    rng = np.random.default_rng(100)
    for edge in (40, 81, 120):
        shaken = (np.arange(15_000) >= 31 * 162 + edge) & (np.arange(15_000) < 62 * 162 + edge)
        noise = SCATTER * rng.standard_normal((2, 15_000)) * np.where(shaken, 5.0, 1.0)
        assert (
            int(
                reduce_log(make_log(noise, rate=10.0, unit="deg/h", axis=list("xy")))[
                    "outliers"
                ].sum()
            )
            <= 1
        )


@pytest.mark.slow
def test_spikes_of_six_sigma_are_identified_and_counted():
    rng = np.random.default_rng(8)
    noise = SCATTER * rng.standard_normal((1, 15_000))
    noise[0, rng.choice(15_000, 20, replace=False)] += 6.0 * SCATTER * rng.choice([-1.0, 1.0], 20)
    blocks = reduce_log(make_log(noise, rate=10.0, unit="deg/h", axis=["y"]))
    baseline, records = nulls(blocks, 40)
    (identification,) = (identifications := name_effects(blocks, baseline, records)).identified
    assert (identification.effect, identification.axes) == ("spikes", ("y",))
    (fitted,) = fit_identifications(identifications, baseline)
    number = fitted.parameters["per_hour"].value * 15_000 / 36_000
    assert 10 < number < 40
    assert 0.5 < fitted.parameters["size"].value / (6.0 * SCATTER) < 2.0


@pytest.mark.slow
def test_spikes_in_most_blocks_keep_their_size_and_power():
    rng = np.random.default_rng(11)
    hit = rng.random((1, 15_000)) < 0.009
    noise = SCATTER * (
        rng.standard_normal((1, 15_000)) + 70.0 * rng.standard_normal((1, 15_000)) * hit
    )
    blocks = reduce_log(make_log(noise, rate=10.0, unit="deg/h", axis=["x"]))
    assert (blocks["outlier_count"] > 0).mean() > 0.6
    baseline, records = nulls(blocks, 40)
    (fitted,) = fit_identifications(
        identifications := name_effects(blocks, baseline, records), baseline
    )
    size, number = fitted.parameters["size"], fitted.parameters["per_hour"]
    assert size.low < 70.0 * SCATTER < size.high
    assert number.low < 0.009 * 36_000 < number.high
    clean = predict_baseline(identifications, recalibrate(identifications, baseline, [fitted]))
    whole = add_outlier_power(clean, blocks, [fitted])["spectrum"].mean()
    assert float(whole) == pytest.approx(float(blocks["power"].mean()), rel=0.4)
    assert float(clean["spectrum"].mean()) < 0.1 * float(whole)
    for lacking, known in (
        ([fitted], []),
        ([], [fitted]),
    ):  # effects of the recording alone, or of the simulation too
        surfaces = conclude._make_surfaces_with_outliers(
            blocks, conclude.FinalFit(identifications, clean, lacking, known), clean, clean
        )
        short = surfaces["avar"].isel(tau=0).mean(["axis", "window"])
        before, after = (
            float(short.sel(case=case) / short.sel(case="recording"))
            for case in ("before", "after")
        )
        assert after == pytest.approx(1.0, rel=0.4)
        assert before == pytest.approx(1.0, rel=0.4) if known else before < 0.1


@pytest.mark.full
def test_bursts_shorter_than_a_block_have_no_spikes():
    rng = np.random.default_rng(9)
    loud = np.ones(15_000)
    for first in rng.integers(0, 14_900, 10):
        loud[first : first + 40] = 8.0
    noise = SCATTER * loud * rng.standard_normal((1, 15_000))
    blocks = reduce_log(make_log(noise, rate=10.0, unit="deg/h", axis=["x"]))
    baseline, records = nulls(blocks, 40)
    assert "spikes" not in [
        identification.effect
        for identification in name_effects(blocks, baseline, records).identified
    ]
