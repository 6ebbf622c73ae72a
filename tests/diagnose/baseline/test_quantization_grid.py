"""Quantization grids of rounded rates and of rounded angles are distinguished."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.baseline.from_model import baseline_from_model
from gyrostab.diagnose.baseline.quantization_grid import angle_share, rounded_rates
from gyrostab.diagnose.estimate.joint_fit import fit_identifications
from gyrostab.diagnose.identify.identifiability import find_equivalent_effects
from gyrostab.diagnose.predict.candidates import Candidate, Component, Variant
from gyrostab.diagnose.predict.linear_model import initial_state
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.reduce.zero_bin import possibly_truncated_axes, truncated_axes
from gyrostab.diagnose.statistics import find_statistic
from gyrostab.ingest.make_log import make_log
from tests.support.named import name_effects, nulls

SCATTER = 0.003 * 60.0 * np.sqrt(10.0)  # of a sample at 10 Hz [deg/h]


def quantized_record(
    kind: str, steps: float, *, mean: float = 3.0, seed: int = 1, size: int = 18_000
) -> xr.Dataset:
    """White noise on two axes on a quantization grid, whose step is in scatters of a sample."""
    rng = np.random.default_rng(seed)
    rates = mean * np.array([[1.0], [-2.3]]) + SCATTER * rng.standard_normal((2, size))
    step = steps * SCATTER
    if kind == "angle":
        counted = (
            np.diff(np.floor(np.cumsum(rates, axis=1) / step + 0.3), axis=1, prepend=0.0) * step
        )
        return reduce_log(make_log(counted, rate=10.0, unit="deg/h"))
    return reduce_log(make_log(np.rint(rates / step) * step, rate=10.0, unit="deg/h"))


@pytest.mark.parametrize("steps", [0.85, 1.5, 4.0])
@pytest.mark.parametrize("mean", [3.0, 0.05])
def test_rounded_rates_and_angles_are_distinguished(steps: float, mean: float) -> None:
    for kind, expected in (("rate", True), ("angle", False)):
        blocks = quantized_record(kind, steps, mean=mean)
        np.testing.assert_allclose(blocks["quantization_step"], steps * SCATTER, rtol=1e-6)
        assert (rounded_rates(blocks, calibrate_noise(blocks)) == expected).all(), kind


@pytest.mark.parametrize("kind", ["rate", "angle"])
def test_fine_steps_are_undecided(kind: str) -> None:
    blocks = quantized_record(kind, 0.3)
    assert (blocks["quantization_step"] > 0).all()
    assert not rounded_rates(blocks, calibrate_noise(blocks)).any()


def test_a_filtered_angle_counter_is_not_a_rounded_rate() -> None:
    rng = np.random.default_rng(4)
    rates = 3.0 + SCATTER * rng.standard_normal((2, 18_001))
    step = 0.85 * SCATTER
    smooth = (
        0.8 * rates[:, 1:] + 0.2 * rates[:, :-1]
    )  # removes more at the highest frequencies than the steps add
    counted = np.diff(np.floor(np.cumsum(smooth, axis=1) / step), axis=1, prepend=0.0) * step
    blocks = reduce_log(make_log(counted, rate=10.0, unit="deg/h"))
    assert (blocks["quantization_step"] > 0).all()
    assert not rounded_rates(blocks, calibrate_noise(blocks)).any()


def test_axes_together_decide_what_one_axis_cannot() -> None:
    blocks = quantized_record("rate", 0.7)
    baseline = calibrate_noise(blocks)
    single_axes = [
        rounded_rates(blocks.isel(axis=[number]), baseline.isel(axis=[number]))
        for number in range(2)
    ]
    assert not np.concatenate(single_axes).any()
    assert rounded_rates(blocks, baseline).all()


def test_without_a_grid_no_rate_is_rounded() -> None:
    blocks = quantized_record("rate", 2.0)
    plain = blocks.assign(quantization_step=blocks["quantization_step"] * 0.0)
    assert not rounded_rates(plain, calibrate_noise(blocks)).any()


def test_the_decision_does_not_depend_on_the_model() -> None:
    model = {"noise": {"N": 0.003, "Q": 0.1}, "log": {"axes": ["x", "y"]}}
    for kind, expected in (("rate", True), ("angle", False)):
        blocks = quantized_record(kind, 2.0)
        assert (rounded_rates(blocks, baseline_from_model(blocks, model)) == expected).all()


@pytest.mark.parametrize("mean", [0.0, 0.13, 0.5])
@pytest.mark.parametrize("scatter", [0.1, 0.4, 1.0])
def test_angle_share_is_that_of_simulated_counters(mean: float, scatter: float) -> None:
    steps = mean + scatter * np.random.default_rng(1).standard_normal(400_000)
    angle = np.cumsum(steps)
    errors = np.diff(np.rint(angle + 0.37) - angle)
    assert float(angle_share(np.array([mean]), scatter)[0]) == pytest.approx(
        np.var(errors) * 6.0, rel=0.02
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "names"),
    [("angle", []), pytest.param("rate", ["rate_quantization"], marks=pytest.mark.full)],
)
def test_only_a_rounded_rate_is_named(kind: str, names: list[str]) -> None:
    blocks = quantized_record(kind, 2.0, size=9_000)
    baseline, records = nulls(blocks, 40)
    identifications = name_effects(blocks, baseline, records)
    assert [identification.effect for identification in identifications.identified] == names
    assert (
        "quantization grid" in identifications.examination.reasons.get("rate_quantization", "")
    ) == (kind == "angle")


def cut_record(
    how,
    *,
    step: float = 0.18,
    mean: tuple[float, float] = (0.3, -0.8),
    zone: float = 0.0,
    size: int = 24_000,
) -> xr.Dataset:
    """White noise of two axes on a quantization grid [scatters]; x has a dead zone before it."""
    rates = np.array(mean)[:, None] + np.random.default_rng(3).standard_normal((2, size))
    rates[0] = np.where(np.abs(rates[0]) < zone * step, 0.0, rates[0])
    return reduce_log(
        make_log(how(rates / step) * step * SCATTER, rate=10.0, unit="deg/h", axis=["x", "y"])
    )


@pytest.mark.parametrize("step", [0.05, 0.18, 0.5])
def test_the_zero_bin_shows_a_truncated_rate(step: float) -> None:
    for how, cut in ((np.trunc, True), (np.rint, False), (np.floor, False)):
        blocks = cut_record(how, step=step)
        assert (truncated_axes(blocks) == cut).all()
        assert (possibly_truncated_axes(blocks) == cut).all()
        width, error = blocks["bin_width"].values, blocks["bin_width_stderr"].values
        assert (np.abs(width - [2.0 if cut else 1.0, 1.0]) < 4.0 * error + 0.15).all()
        assert rounded_rates(blocks, calibrate_noise(blocks)).all() == cut or step > 0.4


@pytest.mark.parametrize("zone", [1.0, 2.0])
def test_samples_stuck_at_zero_are_missing_in_neighbouring_bins(zone: float) -> None:
    blocks = cut_record(np.rint, zone=zone)
    width = blocks["bin_width"].sel(axis="x", bin="next")
    assert abs(float(width) - max(1.5 - zone, 0.0)) < 0.1
    assert not truncated_axes(blocks).any()
    assert not possibly_truncated_axes(blocks).any()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("how", "zone", "names"),
    [
        (np.trunc, 0.0, ["rate_quantization"]),
        (np.rint, 1.0, ["dead_zone"]),
        pytest.param(np.rint, 0.0, [], marks=pytest.mark.full),
    ],
)
def test_truncation_and_dead_zone_are_distinguished(how, zone: float, names: list[str]) -> None:
    blocks = cut_record(how, zone=zone, size=15_000)
    baseline, records = nulls(blocks, 40)
    identifications = name_effects(blocks, baseline, records)
    assert [identification.effect for identification in identifications.identified] == names
    assert all(identification.alternatives == () for identification in identifications.identified)
    if names == ["rate_quantization"]:
        assert {
            fitted.effect.mode
            for fitted in fit_identifications(identifications, baseline)
            if fitted.effect
        } == {"zero"}


def test_both_names_are_given_if_the_bins_do_not_decide() -> None:
    """Three deviations from 0, a bin has three of 15 000 samples: its width is unknown."""
    blocks = cut_record(np.rint, step=0.04, mean=(-3.0, 2.8), zone=0.0, size=15_000)
    assert possibly_truncated_axes(blocks).all()
    assert not truncated_axes(blocks).any()
    variant = Variant({}, ("stuck",), np.empty(0))
    component = Component(
        Candidate("dead_zone", find_statistic("sample_counts"), (), (variant,)),
        variant,
        ("x",),
        20.0,
    )
    state = initial_state(blocks, calibrate_noise(blocks))
    assert "rate_quantization" in find_equivalent_effects([component], state)
    cut_blocks = cut_record(np.rint, zone=1.0, size=15_000)
    assert "rate_quantization" not in find_equivalent_effects(
        [component], initial_state(cut_blocks, calibrate_noise(cut_blocks))
    )
