"""Null records against raw logs that were simulated sample by sample and reduced."""

from __future__ import annotations

import functools
import tracemalloc

import numpy as np
import pytest
import xarray as xr

from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.baseline.from_model import baseline_from_model
from gyrostab.diagnose.nulls.records import null_records
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.reduce.outliers import EXPECTED_FALSE_OUTLIERS
from gyrostab.ingest.make_log import make_log
from gyrostab.kernels.spectra.periodogram import band_covariance
from gyrostab.simulate import simulate
from tests.support.evidence import mean_evidence, power_evidence
from tests.support.repetitions import first_of

NOISE = {"Q": 0.05, "N": 0.003, "B": 0.004, "K": 0.02}
RECORDS = 30


def raw(seed: int, lost: float, *, axes: str = "x", quantization_step: float = 0.0) -> xr.Dataset:
    """One hour at 10 Hz with the same gaps for every seed."""
    effect = [{"name": "rate_quantization", "step": quantization_step}] if quantization_step else []
    log = simulate(
        {"log": {"axes": list(axes)}, "noise": NOISE, "effect": effect},
        duration="1h",
        rate=10.0,
        seed=seed,
    ).compute()
    gone = np.random.default_rng(7).random((len(axes), log.sizes["time"])) < lost
    gone[:, 9000 : 9000 + int(4000 * lost)] = True
    log["rate"] = log["rate"].where(xr.DataArray(~gone, dims=("axis", "time")))
    return reduce_log(log)


def joined(records: list[xr.Dataset]) -> xr.Dataset:
    return xr.concat(
        records, "record", data_vars="minimal", coords="minimal", compat="override", join="override"
    )


@functools.cache
def both(lost: float) -> tuple[xr.Dataset, xr.Dataset]:
    """Raw records, and null records with the same, exactly known noise."""
    records = [raw(seed, lost, axes="xy") for seed in range(RECORDS)]
    baseline = baseline_from_model(records[0], {"noise": NOISE})
    nulls = joined(
        list(null_records(records[0], baseline, count=160, rng=np.random.default_rng(3)))
    )
    names = [name for name in nulls.data_vars if "record" in nulls[name].dims]
    return xr.concat(
        [record[names] for record in records],
        "record",
        coords="minimal",
        compat="override",
        join="override",
    ), nulls


def close(expected: xr.DataArray, drawn: xr.DataArray, *, rel: float) -> None:
    """Check that means and standard deviations agree within `rel` standard deviations."""
    scale = float(drawn.std())
    assert abs(float(expected.mean() - drawn.mean())) < rel * scale
    assert float(expected.std()) == pytest.approx(scale, rel=rel)


@pytest.mark.slow
@pytest.mark.parametrize("lost", [pytest.param(0.0, marks=pytest.mark.full), 0.3])
def test_statistics_match_those_of_raw_logs(lost):
    raw_records, nulls = both(lost)
    for name in ("power", "mean", "cross", "line_power", "kurtosis"):
        np.testing.assert_array_equal(
            np.isnan(raw_records[name].isel(record=0)), np.isnan(nulls[name].isel(record=0))
        )
    for band in (0, 4, -1):
        close(raw_records["power"].isel(band=band), nulls["power"].isel(band=band), rel=0.06)
        close(
            np.abs(raw_records["cross"].isel(band=band)) ** 2,
            np.abs(nulls["cross"].isel(band=band)) ** 2,
            rel=0.12,
        )
    share = raw_records["power"] / nulls["power"].mean(["record", "axis", "block"])
    other = nulls["power"] / nulls["power"].mean(["record", "axis", "block"])
    close(
        share.isel(band=slice(-4, None)).mean("band"),
        other.isel(band=slice(-4, None)).mean("band"),
        rel=0.06,
    )
    close(raw_records["mean"].diff("block"), nulls["mean"].diff("block"), rel=0.05)
    drift = [
        sample["mean"].isel(block=slice(60, 90)).mean("block")
        - sample["mean"].isel(block=slice(0, 20)).mean("block")
        for sample in (raw_records, nulls)
    ]
    close(*drift, rel=0.35)
    close(raw_records["kurtosis"], nulls["kurtosis"], rel=0.1)
    close(raw_records["line_power"].max("line"), nulls["line_power"].max("line"), rel=0.15)
    assert set(np.unique(nulls["extremes"].sum("block"))) == {2}
    assert (
        0.0
        < float(nulls["outliers"].sum(["axis", "block"]).mean())
        < 5.0 * EXPECTED_FALSE_OUTLIERS * nulls.sizes["axis"]
    )


@pytest.mark.full
@pytest.mark.parametrize("lost", first_of(0.3, 0.0))
def test_covariance_of_neighbouring_bands_matches_raw_logs(lost):
    shares = []
    for records in both(lost):
        left = (
            (records["power"] / records["power"].mean(["record", "block"]))
            .transpose("band", ...)
            .values.reshape(records.sizes["band"], -1)
        )
        left = left[:, np.isfinite(left).all(axis=0)]
        shares.append(np.corrcoef(left[:10]))
    neighbours = [
        np.mean([np.diagonal(share, apart).mean() for apart in (1, 2)]) for share in shares
    ]
    assert neighbours[1] == pytest.approx(neighbours[0], abs=0.006)
    assert neighbours[0] > 0.01


@pytest.mark.slow
def test_covariance_of_the_lowest_bands_is_that_of_the_taper():
    record = reduce_log(
        simulate({"noise": {"N": 0.003}}, duration="1h", rate=10.0, seed=1).compute()
    )
    baseline = calibrate_noise(record)
    nulls = joined(list(null_records(record, baseline, count=400, rng=np.random.default_rng(2))))
    left = (
        nulls["power"]
        .transpose("axis", "band", ...)
        .values.reshape(record.sizes["axis"] * record.sizes["band"], -1)
    )
    shape = baseline["shape_alone"].isel(axis=0, block=5).values
    share = band_covariance(int(record.attrs["block_samples"]))[0, 3] * np.sqrt(shape[0] * shape[3])
    assert share == pytest.approx(0.018, abs=0.002)
    assert np.corrcoef(left)[0, 3] == pytest.approx(share, abs=4.0 / np.sqrt(left.shape[1]))


@pytest.mark.slow
def test_tails_of_the_kurtosis_match_samples():
    record = reduce_log(
        simulate({"noise": {"N": 0.003}}, duration="1h", rate=10.0, seed=1).compute()
    )
    nulls = joined(
        list(null_records(record, calibrate_noise(record), count=200, rng=np.random.default_rng(2)))
    )
    size = int(record.attrs["block_samples"])
    samples = np.random.default_rng(3).standard_normal((50_000, size))
    square = (samples - samples.mean(axis=1, keepdims=True)) ** 2
    kurtosis = (square**2).mean(axis=1) / square.mean(axis=1) ** 2 - 3.0
    for share, tolerance in ((1e-3, 0.025), (1e-2, 0.02), (0.5, 0.02), (0.99, 0.06), (0.999, 0.2)):
        assert float(nulls["kurtosis"].quantile(share)) == pytest.approx(
            np.quantile(kurtosis, share), abs=tolerance
        )


@pytest.mark.parametrize("kind", ["rounded", "normal"])
def test_noise_of_an_angle_may_be_rounding_or_normal(kind):
    rng = np.random.default_rng(5)
    angle = rng.random((3, 72_001)) if kind == "rounded" else rng.standard_normal((3, 72_001)) / 3.0
    rate = 0.1 * rng.standard_normal((3, 72_000)) + np.diff(angle, axis=1)
    record = reduce_log(make_log(rate, rate=20.0, unit="deg/h"))
    nulls = joined(
        list(null_records(record, calibrate_noise(record), count=50, rng=np.random.default_rng(1)))
    )
    usual, drawn = (record["kurtosis"].mean("block"), nulls["kurtosis"].mean("block"))
    scatter = drawn.std("record")
    assert (np.abs(usual - drawn.mean("record")) < 3.0 * scatter).all()
    assert bool((usual < -10.0 * scatter).all()) is (kind == "rounded")


def test_quantization_causes_repeats_zeros_and_extremes():
    record = raw(1, 0.0, quantization_step=0.5)
    nulls = joined(
        list(null_records(record, calibrate_noise(record), count=50, rng=np.random.default_rng(1)))
    )
    for name, scatter in (("repeats", 4.0), ("zeros", 4.0), ("stuck", 4.0), ("filled", 6.0)):
        many = float(nulls[name].sum("block").mean())
        assert float(record[name].sum()) == pytest.approx(many, abs=scatter * np.sqrt(many))
    extremes = nulls["extremes"].sum("block")
    assert int(extremes.min()) >= 2
    assert int(extremes.max()) > 2


def test_blocks_with_few_samples_may_have_repeats():
    log = simulate(
        {"log": {"axes": ["x"]}, "noise": {"N": 0.003}}, duration="1h", rate=10.0, seed=4
    ).compute()
    lost = np.zeros(log.sizes["time"], bool)
    for first in range(9000, 27_000, 200):  # four fifths of every block
        lost[first : first + 160] = True
    values = np.round((log["rate"] + 2.0) / 0.2) * 0.2  # no zero in these blocks without a mean
    log["rate"] = values.where(~xr.DataArray(lost, dims="time")).assign_attrs(log["rate"].attrs)
    record = reduce_log(log)
    sparse = np.isnan(record["neighbours"].values[0]) & (record["samples"].values[0] > 0)
    assert sparse.sum() > 30
    baseline = calibrate_noise(record)
    nulls = joined(list(null_records(record, baseline, count=100, rng=np.random.default_rng(2))))
    many = float(nulls["repeats"].values[:, 0, sparse].sum(axis=1).mean())
    repeats = float(record["repeats"].values[0, sparse].sum())
    assert many > 100
    assert repeats == pytest.approx(many, abs=4.0 * np.sqrt(many))
    assert ((nulls["repeats"] > nulls["adjacent"]).sum()) == 0
    zeros = nulls["zeros"].values[:, 0, sparse].sum(axis=1)
    assert float(record["zeros"].values[0, sparse].sum()) <= zeros.mean() + 5.0 * np.sqrt(
        zeros.mean() + 1.0
    )


def test_orders_and_profiles_have_the_scatter_of_noise():
    seconds = np.arange(36_000) / 10.0

    def made(seed: int) -> xr.Dataset:
        log = simulate(
            {"log": {"axes": ["x"]}, "noise": {"N": 0.003}}, duration="1h", rate=10.0, seed=seed
        ).compute()
        log["ramp"] = ("time", (seconds * 0.3) % 1.0, {"units": "1"})
        log["rotation_rate"] = ("time", np.full(seconds.size, 360.0 * 0.7), {"units": "degree s-1"})
        return reduce_log(log)

    records = [made(seed) for seed in range(6)]
    nulls = joined(
        list(
            null_records(
                records[0],
                baseline_from_model(records[0], {"noise": {"N": 0.003}}),
                count=50,
                rng=np.random.default_rng(1),
            )
        )
    )
    for name, rel in (("order", 0.08), ("profile", 0.05)):
        squares = np.concatenate([np.abs(record[name].values.ravel()) ** 2 for record in records])
        other = np.abs(nulls[name].values) ** 2
        assert np.nanmean(squares) == pytest.approx(np.nanmean(other), rel=rel), name


def test_the_same_generator_gives_the_same_records():
    record = raw(1, 0.3)
    baseline = calibrate_noise(record)
    first, second = (
        next(null_records(record, baseline, count=2, rng=np.random.default_rng(5)))
        for _ in range(2)
    )
    xr.testing.assert_identical(first, second)


def test_lines_of_a_steep_spectrum_are_those_of_raw_records():
    model = {"log": {"axes": ["x"]}, "noise": {"N": 0.003, "K": 3e4}}
    records = [
        reduce_log(simulate(model, duration="10min", rate=10.0, seed=seed)) for seed in range(20)
    ]
    baseline = baseline_from_model(records[0], {"noise": model["noise"]})
    nulls = next(null_records(records[0], baseline, count=100, rng=np.random.default_rng(1)))
    of_raw = np.mean([record["line_power"].values for record in records], axis=(0, 1, 2))
    of_nulls = nulls["line_power"].values.mean(axis=(0, 1, 2))
    upper = slice(3 * of_raw.size // 4, None)
    assert np.mean(of_nulls[upper] / of_raw[upper]) == pytest.approx(1.0, abs=0.08)


def test_drawing_many_lines_needs_little_memory_besides_the_records():
    log = simulate({"log": {"axes": ["x"]}, "noise": NOISE}, duration="10min", rate=400.0, seed=1)
    record = reduce_log(log)
    baseline = calibrate_noise(record)
    tracemalloc.start()
    nulls = next(null_records(record, baseline, count=200, chunk=200, rng=np.random.default_rng(5)))
    kept, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak - kept < nulls["line_power"].nbytes


def candidates(record: xr.Dataset) -> tuple[dict, dict]:
    n, bands = record.sizes["block"], record.sizes["band"]
    t, x = np.arange(n) / n, np.linspace(0.0, 1.0, bands)
    knots = np.stack(
        [np.interp(t, np.linspace(0, 1, 9), unit_vector) for unit_vector in np.eye(9)], axis=1
    )
    event = ((t > 0.4) & (t < 0.5)).astype(float)
    means = {
        "step": [(t > edge).astype(float) for edge in np.arange(0.1, 0.95, 0.1)],
        "trend": [t],
        "event": [event],
        "any": [knots],
    }
    flat = np.ones((n, bands))
    powers = {
        "trend": [t[:, None] * flat],
        "event": [event[:, None] * flat],
        "filter": [-(x**4) * flat],
        "band": [
            np.exp(-0.5 * ((x - place) / 0.07) ** 2) * event[:, None] for place in (0.5, 0.7, 0.9)
        ],
        "any": [knots[:, None, :] * flat[..., None]],
    }
    return means, powers


@pytest.mark.slow
@pytest.mark.parametrize("lost", first_of(0.3, 0.0))
def test_largest_evidence_of_raw_logs_matches_null_records(lost):
    """The rank of raw records among null records of their separate calibrations is uniform."""
    count, records = 29, 16
    ranks = {"mean": [], "power": []}
    for seed in range(records):
        record = raw(100 + seed, lost)
        baseline = calibrate_noise(record)
        nulls = joined(
            list(null_records(record, baseline, count=count, rng=np.random.default_rng(seed)))
        )
        means, powers = candidates(record)
        for statistic, gains, tried in (
            ("mean", mean_evidence, means),
            ("power", power_evidence, powers),
        ):
            own = float(gains(record, baseline, tried, axis="x").max())
            ranks[statistic].append(
                int((gains(nulls, baseline, tried, axis="x").max("candidate") >= own).sum())
            )
    for statistic, places in ranks.items():
        share = (np.array(places) + 0.5) / (count + 1)
        assert share.mean() == pytest.approx(0.5, abs=3.5 * np.sqrt(1.0 / 12.0 / records)), (
            statistic
        )
        assert (share < 0.1).sum() <= 6, statistic  # 1 in 2000 for a binomial of 16 and 0.1
