"""A recording against a model with an effect common to axes: spectra, null records, diagnosis."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import xarray as xr

import gyrostab
from gyrostab.diagnose.baseline.from_model import baseline_from_model
from gyrostab.diagnose.nulls.records import null_records
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.simulate import simulate

NOISE = {"N": 0.003, "K": 0.02}


def shared(size: float, **more: object) -> dict[str, object]:
    return {"name": "shared_source", "N": [size, size, -size], **more}


@cache
def log_of(seed: int, *sizes: float, minutes: int = 30) -> xr.Dataset:
    model = {
        "noise": NOISE,
        "effect": [shared(size) for size in sizes],
        "log": {"axes": ["x", "y", "z"]},
    }
    return simulate(model, duration=f"{minutes}min", rate=10.0, seed=seed).compute()


def lossy(log: xr.Dataset, share: float) -> xr.Dataset:
    """Lose random samples of the log, others on every axis."""
    gone = np.random.default_rng(5).random(log["rate"].shape) < share
    return log.assign(
        rate=log["rate"]
        .where(xr.DataArray(~gone, dims=log["rate"].dims))
        .assign_attrs(log["rate"].attrs)
    )


@pytest.mark.parametrize("lost", [0.0, 0.2])
def test_null_records_have_the_common_noise_of_the_model(lost):
    size = 0.0025
    records = [reduce_log(lossy(log_of(seed, size, minutes=60), lost)) for seed in range(1, 5)]
    baseline = baseline_from_model(records[0], {"noise": NOISE, "effect": [shared(size)]})
    pieces = list(null_records(records[0], baseline, count=40, rng=np.random.default_rng(1)))
    nulls = xr.concat(
        pieces, "record", data_vars="minimal", coords="minimal", compat="override", join="override"
    )
    raw = xr.concat(
        [record[["cross", "power", "mean"]] for record in records],
        "record",
        coords="minimal",
        compat="override",
        join="override",
    )
    expected = baseline["cross"].mean("block")
    assert np.sign(expected.real.values[:, 3]).tolist() == [1.0, -1.0, -1.0]
    bands = slice(4, None)
    correlations = {}
    for name, sample in (("raw", raw), ("drawn", nulls)):
        ratio = (sample["cross"].real.mean(["record", "block"]) / expected.real).isel(band=bands)
        assert float(np.abs(ratio - 1.0).max()) < 0.12, name
        level = (
            sample["power"].mean(["record", "block"]) / baseline["spectrum"].mean("block")
        ).isel(band=bands)
        assert float(np.abs(level - 1.0).max()) < 0.08, name
        steps = sample["mean"].diff("block")
        correlations[name] = float(
            (steps[:, 0] * steps[:, 2]).sum()
            / np.sqrt((steps[:, 0] ** 2).sum() * (steps[:, 2] ** 2).sum())
        )
    assert correlations["raw"] == pytest.approx(correlations["drawn"], abs=0.07)
    assert correlations["drawn"] == pytest.approx(-0.41 * (1.0 - lost), abs=0.05)
    for component in (
        lambda sample: sample["cross"].real,
        lambda sample: sample["cross"].imag,
        lambda sample: sample["power"],
    ):
        scatter = component(nulls).isel(band=bands).std(["record", "block"]) / component(raw).isel(
            band=bands
        ).std(["record", "block"])
        assert float(np.abs(scatter - 1.0).max()) < 0.15
    other = (nulls["power"][:, 0] * nulls["power"][:, 1]).mean(["record", "block"]) / expected[
        0
    ].real ** 2
    product_of_powers = (raw["power"][:, 0] * raw["power"][:, 1]).mean(
        ["record", "block"]
    ) / expected[0].real ** 2
    np.testing.assert_allclose(other[bands], product_of_powers[bands], rtol=0.12)


def test_phases_and_signs_of_axes_are_in_the_cross_spectra():
    line = {
        "name": "spectral_line",
        "amplitude": [0.5, 0.5, -0.25],
        "frequency": 1.3,
        "phase": [0.0, 90.0, 0.0],
    }
    sway = {"name": "real_motion", "direction": [1.0, -0.5, 0.0], "sway": 0.5, "frequency": 0.4}
    model = {"noise": NOISE, "effect": [line, sway], "log": {"axes": ["x", "y", "z"]}}
    blocks = reduce_log(simulate(model, duration="1h", rate=10.0, seed=3).compute())
    baseline = baseline_from_model(blocks, model)
    for frequency in (1.3, 0.4):
        band = int(
            np.flatnonzero((blocks["band_low"] <= frequency) & (frequency < blocks["band_high"]))[0]
        )
        recorded, expected = (
            statistics["cross"].isel(band=band).mean("block").values
            for statistics in (blocks, baseline)
        )
        scale = float(np.sqrt(baseline["spectrum"].isel(band=band).mean("block").max()) ** 2)
        assert np.abs(recorded - expected).max() < 0.15 * scale
    assert baseline["cross"].isel(band=band).mean("block").values[0].real < 0.0


@pytest.mark.full
@pytest.mark.parametrize("seed", [1, 2])
def test_common_noise_of_the_model_is_not_a_mismatch(seed):
    diagnosis = gyrostab.diagnose(
        log_of(seed, 0.0015), simulation={"noise": NOISE, "effect": [shared(0.0015)]}, nulls=100
    )
    assert diagnosis.verdict == "no mismatch", diagnosis.content["mismatches"]


@pytest.mark.slow
def test_common_noise_beyond_the_model_is_named_with_its_size():
    diagnosis = gyrostab.diagnose(
        log_of(3, 0.0015, 0.0012),
        simulation={"noise": NOISE, "effect": [shared(0.0015)]},
        nulls=100,
    )
    assert [effect["name"] for effect in diagnosis.effects] == ["shared_source"]
    for axis, sign in zip("xyz", (1, 1, -1), strict=True):
        assert diagnosis.effects[0]["parameters"][f"N.{axis}"]["value"] == pytest.approx(
            sign * 0.0012, rel=0.2
        )


@pytest.mark.full
def test_an_effect_missing_in_the_model_is_named_and_explains_the_powers():
    diagnosis = gyrostab.diagnose(log_of(4, 0.0015), simulation={"noise": NOISE}, nulls=100)
    assert [effect["name"] for effect in diagnosis.effects] == ["shared_source"]
    assert diagnosis.verdict == "explained", diagnosis.content["mismatches"]
    for axis, sign in zip("xyz", (1, 1, -1), strict=True):
        assert diagnosis.effects[0]["parameters"][f"N.{axis}"]["value"] == pytest.approx(
            sign * 0.0015, rel=0.15
        )
    held = diagnosis.content["held_out"]
    assert abs(held["misfit_after"] - 1.0) < 0.5 * abs(held["misfit_before"] - 1.0)


@pytest.mark.full
def test_low_pass_common_noise_is_not_a_filter():
    slow = {"name": "shared_source", "N": [0.0, 0.004, 0.004], "bandwidth": 0.8}
    model = {"noise": NOISE, "effect": [slow], "log": {"axes": ["x", "y", "z"]}}
    diagnosis = gyrostab.diagnose(
        simulate(model, duration="30min", rate=10.0, seed=5).compute(), nulls=100
    )
    assert [effect["name"] for effect in diagnosis.effects] == ["shared_source"]
    assert diagnosis.verdict == "explained", diagnosis.content["mismatches"]
