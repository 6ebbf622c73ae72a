"""A recording against a model with lines: only power beyond the model is a line."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import xarray as xr

import gyrostab
from gyrostab.diagnose.baseline.from_model import baseline_from_model
from gyrostab.diagnose.baseline.from_simulation import baseline_from_simulation
from gyrostab.diagnose.baseline.known_lines import _line_leakage, remove_known_lines
from gyrostab.diagnose.evidence.spectral_lines import JUDGED_PARTS, expected_lines, line_evidence
from gyrostab.diagnose.nulls.records import null_records
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.statistics import find_statistic
from gyrostab.kernels.spectra.periodogram import ordinates
from gyrostab.simulate import simulate

NOISE = {"N": 0.003, "K": 0.02}
SIZE, PLACE = 0.3, 1.337


def model(size: float, **more: object) -> dict[str, object]:
    line = (
        [{"name": "spectral_line", "amplitude": size, "frequency": PLACE, **more}] if size else []
    )
    return {"noise": NOISE, "effect": line, "log": {"axes": ["x", "y"]}}


@cache
def log_of(seed: int, size: float, lost: float = 0.0) -> xr.Dataset:
    log = simulate(model(size), duration="30min", rate=10.0, seed=seed).compute()
    is_lost = np.random.default_rng(seed).random(log.sizes["time"]) < lost
    return log.assign(rate=log["rate"].where(~is_lost))


def evidence_nats(blocks: xr.Dataset, baseline: xr.Dataset) -> float:
    expected = expected_lines(baseline, blocks["line_frequency"].values)
    return float(
        line_evidence(
            blocks["line_power"].values[None], blocks["line_weight"].values, expected
        ).max()
    )


@pytest.mark.parametrize("amplitude", [0.03, 0.3, 3.0])
@pytest.mark.parametrize("frequency", [1.3, 1.312, 1.325])
def test_a_known_line_is_removed_at_any_frequency(amplitude, frequency):
    line = {"name": "spectral_line", "amplitude": amplitude, "frequency": frequency}
    made = {"noise": NOISE, "effect": [line], "log": {"axes": ["x"]}}
    blocks = reduce_log(simulate(made, duration="30min", rate=10.0, seed=7).compute())
    baseline = baseline_from_model(blocks, made)
    freed = remove_known_lines(blocks, baseline)
    assert evidence_nats(freed, baseline) < 6.0
    assert float(np.nanmax(find_statistic("spectral_line").score(freed, baseline)["z"])) < 5.0
    if amplitude > 0.1:
        assert (
            evidence_nats(
                blocks, baseline_from_model(blocks, model(0.0) | {"log": {"axes": ["x"]}})
            )
            > 50.0
        )


@pytest.mark.parametrize("lost", [0.0, 0.4])
def test_only_a_line_well_above_the_model_is_reported(lost):
    def left(factor: float) -> float:
        blocks = remove_known_lines(reduce_log(log_of(1, factor * SIZE, lost)), baseline)
        return evidence_nats(blocks, baseline)

    baseline = baseline_from_model(reduce_log(log_of(1, SIZE, lost)), model(SIZE))
    assert left(1.03) < 6.0
    assert left(1.5) > 20.0


def test_more_power_than_that_of_a_known_line_is_judged_in_the_parts_of_a_steady_line():
    blocks = reduce_log(log_of(1, SIZE))
    baseline = baseline_from_model(blocks, model(SIZE))
    frequency = blocks["line_frequency"].values
    line = int(np.argmin(np.abs(frequency - PLACE)))
    noise = float(expected_lines(baseline, frequency)[0, line])
    most = float(baseline["lines_most"][0, line])
    assert blocks.sizes["part"] == 2 * JUDGED_PARTS
    weight = float(blocks["line_weight"][0].mean())
    # six standard errors above what is known, of one part of the spectrum
    excess = 0.1 * most + 6.0 * np.sqrt((noise**2 + 2.0 * noise * most) / weight)

    def left(parts: slice) -> np.ndarray:
        power = blocks["line_power"].copy(deep=True)
        power[0, :, line] = noise + most
        power[0, parts, line] += excess
        return remove_known_lines(blocks.assign(line_power=power), baseline)["line_power"][
            0, :, line
        ]

    assert float(left(slice(4, 5)).max()) == pytest.approx(noise)
    both = left(slice(4, 6))
    assert np.flatnonzero(both > 1.01 * noise).tolist() == [4, 5]


@pytest.mark.parametrize("sampling", ["point", "average"])
def test_aliased_vibration_of_a_model_is_no_resonance(sampling):
    """It has the quality of a mount, and a power that follows the vibration."""
    shake = {"profile": "vibration", "points": [[0, 1.0], [850, 1.0], [851, 3.0], [1800, 3.0]]}
    effect = {"name": "aliased_vibration", "low": 63.0, "high": 67.0, "sampling": sampling}
    effect |= {"sensitivity": 1.0 if sampling == "point" else 20.0}
    made = {"noise": NOISE, "effect": [effect], "environment": [shake], "log": {"axes": ["x"]}}
    blocks = reduce_log(simulate(made, duration="30min", rate=10.0, seed=4).compute())
    expected = baseline_from_model(blocks, made)["spectrum"].values[0]
    noise = baseline_from_model(blocks, made | {"effect": []})["spectrum"].values[0]
    late = blocks["begin"].values > 900.0
    for part in (late, ~late):
        means = [values[part].mean(axis=0) for values in (blocks["power"].values[0], expected)]
        np.testing.assert_allclose(means[0][-4:], means[1][-4:], rtol=0.15)
    assert expected[late, -4:].mean() > 3.0 * noise[late, -4:].mean()


def test_null_records_have_the_peaks_of_the_model():
    made = model(0.5, quality=30.0)
    blocks = reduce_log(simulate(made, duration="1h", rate=10.0, seed=2).compute())
    baseline = baseline_from_model(blocks, made)
    nulls = next(null_records(blocks, baseline, count=25, rng=np.random.default_rng(1)))
    drawn = nulls["line_power"].isel(axis=0).mean(["record", "part"])
    recorded = blocks["line_power"].isel(axis=0).mean("part")
    is_near_line = np.abs(blocks["line_frequency"].values - PLACE) < 0.1
    assert float(recorded[is_near_line].sum()) == pytest.approx(
        float(drawn[is_near_line].sum()), rel=0.25
    )
    assert float(drawn[is_near_line].max()) > 5.0 * float(drawn[~is_near_line].median())
    is_elsewhere = np.abs(blocks["line_frequency"].values - PLACE) > 0.3
    assert float((recorded[is_elsewhere] / drawn[is_elsewhere]).mean()) == pytest.approx(
        1.0, abs=0.05
    )


@pytest.mark.full
@pytest.mark.parametrize(
    ("seed", "inside", "known", "left"),
    [
        (2, SIZE, SIZE, 0.0),
        (3, SIZE, 0.0, SIZE),
        (4, 2 * SIZE, SIZE, 3**0.5 * SIZE),
    ],
)
def test_power_beyond_the_model_is_named(seed, inside, known, left):
    diagnosis = gyrostab.diagnose(log_of(seed, inside), simulation=model(known), nulls=100)
    if not left:
        assert diagnosis.verdict == "no mismatch", diagnosis.content["mismatches"]
        return
    assert [effect["name"] for effect in diagnosis.effects] == ["spectral_line"]
    for axis in "xy":
        assert diagnosis.effects[0]["parameters"][f"amplitude.{axis}"]["value"] == pytest.approx(
            left, rel=0.1
        )
    assert diagnosis.effects[0]["parameters"]["frequency"]["value"] == pytest.approx(
        PLACE, abs=0.03
    )


@pytest.mark.parametrize(
    ("amplitude", "frequency", "lost"),
    [
        (0.07, 1.3, 0.0),
        (0.07, 1.312, 0.0),
        (0.07, 1.325, 0.0),
        (0.3, 1.3, 0.0),
        (0.3, 1.312, 0.4),
        (0.3, 1.325, 0.0),
    ],
)
def test_a_known_sine_is_no_sine_of_the_recording(amplitude, frequency, lost):
    line = {"name": "spectral_line", "amplitude": amplitude, "frequency": frequency}
    made = {"noise": NOISE, "effect": [line], "log": {"axes": ["x"]}}
    log = simulate(made, duration="30min", rate=10.0, seed=8).compute()
    is_lost = np.random.default_rng(8).random(log.sizes["time"]) < lost
    blocks = reduce_log(log.assign(rate=log["rate"].where(~is_lost)))
    assert float(blocks["sine_nats"].max()) > 10.0
    known = remove_known_lines(blocks, baseline_from_model(blocks, made))
    assert float(known["sine_nats"].max()) < 3.0
    weaker = made | {"effect": [line | {"amplitude": amplitude / 4.0}]}
    too_small = remove_known_lines(blocks, baseline_from_model(blocks, weaker))
    assert float(too_small["sine_nats"].max()) > 10.0
    place = int(too_small["sine_nats"].values[0].argmax())
    left, all_of_it = (float(reduced["sine_square"][0, place]) for reduced in (too_small, blocks))
    assert all_of_it - left == pytest.approx((amplitude / 4.0) ** 2, rel=0.1)


def test_lines_of_a_simulated_log_are_known_with_other_gaps():
    simulated = reduce_log(log_of(10, SIZE))
    recorded = reduce_log(log_of(9, SIZE, 0.4))
    for first, second in [(recorded, simulated), (simulated, recorded)]:
        known = remove_known_lines(first, baseline_from_simulation(first, second))
        power = known["line_power"].mean("part")
        is_near = np.abs(first["line_frequency"].values - PLACE) < 0.1
        assert float(power[:, is_near].max()) < 2.0 * float(power[:, ~is_near].median())


def test_a_weak_sine_of_a_simulated_log_is_known():
    recorded, simulated = (reduce_log(log_of(seed, size)) for seed, size in ((9, 0.06), (10, 0.06)))
    plain = reduce_log(log_of(11, 0.0))
    with_sine = remove_known_lines(recorded, baseline_from_simulation(recorded, simulated))
    without = remove_known_lines(recorded, baseline_from_simulation(recorded, plain))
    assert float(with_sine["sine_nats"].max()) < 3.0
    assert float(without["sine_nats"].max()) > 10.0


@pytest.mark.parametrize("size", [162, 250, 251, 400, 2000])
def test_a_line_leaks_into_as_many_lines_as_a_block_has(size):
    assert all(leak.size % 2 and leak.size <= ordinates(size) for leak in _line_leakage(size))
