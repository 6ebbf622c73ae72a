"""Counts from every kind of source to the store, and the archives of the benchmarks."""

from __future__ import annotations

import warnings
from pathlib import Path

import netCDF4
import numpy as np
import pandas as pd
import pytest
import xarray as xr

import gyrostab
from gyrostab.io.datasets import to_netcdf
from gyrostab.io.opening import open_log
from tests.support.scripts import load_script
from tests.support.stored import WRITERS, same_bits, stored_kinds


def write_csv(
    path: Path, header: str, columns: list[np.ndarray], first: int = 0, step: int = 10_000_000
) -> Path:
    stamps = first + np.arange(len(columns[0])) * step
    rows = "\n".join(
        ",".join([str(t), *("" if c != c else f"{c:.10g}" for c in row)])
        for t, *row in zip(stamps, *columns, strict=True)
    )
    path.write_text(f"time [ns],{header}\n{rows}\n")
    return path


def ingested(*paths: Path, **reading: object) -> xr.Dataset:
    return gyrostab.regularise(gyrostab.read_log(list(paths), **reading))


@pytest.mark.parametrize("form", WRITERS)
def test_integer_columns_of_a_text_log_are_stored_as_counts(tmp_path, form):
    rng = np.random.default_rng(3)
    columns = [
        np.rint(rng.normal(0, 3000, 500)),
        np.rint(rng.normal(5, 3000, 500)),
        np.rint(rng.normal(20, 3, 500)),
        rng.normal(1, 0.1, 500),
    ]
    columns[0][7] = np.nan
    source = write_csv(
        tmp_path / "a.csv", "gyro_x,gyro_y,temperature [degC],vibration [g]", columns
    )
    log = ingested(source, unit={"gyro": "0.1 arcsec/s"})
    path = WRITERS[form](log, tmp_path / f"log.{form}")
    kinds = stored_kinds(path)
    assert (kinds["rate"], kinds["temperature"], kinds["vibration"]) == (
        "int16",
        "int16",
        "float64",
    )
    with open_log(path) as back:
        for name in ("rate", "temperature", "vibration"):
            assert same_bits(back[name], log[name])


def test_counts_through_every_door(tmp_path):
    """Several formats and files, increments, axes of different factors, fractions."""
    counts = np.rint(np.random.default_rng(3).normal(0, 3e5, 1000))
    time = np.arange(1000) * 10_000_000
    frame = pd.DataFrame({"time [ns]": time, "gyro_x [deg/s]": counts.astype(np.int32)})
    frame.to_parquet(tmp_path / "a.parquet")
    with netCDF4.Dataset(tmp_path / "b.nc", "w") as file:
        file.createDimension("n", 1000)
        file.createVariable("time", "i8", "n")[:] = time
        file["time"].units = "nanoseconds since 1970-01-01"
        gyro = file.createVariable("gyro_x", "i4", "n", fill_value=-1)
        gyro.setncatts({"units": "deg/s", "scale_factor": 0.0003})
        gyro.set_auto_scale(False)
        gyro[:] = np.where(counts == 0, 1, counts)
    from scipy.io import savemat

    savemat(tmp_path / "c.mat", {"time": time, "gyro_x": counts.astype(np.int32)})
    write_csv(tmp_path / "d1.csv", "gyro_x [deg/h]", [counts])
    write_csv(
        tmp_path / "d2.csv", "gyro_x [deg/h]", [np.rint(counts / 1e3)], first=10**10 + 50_000_000
    )
    write_csv(tmp_path / "e.csv", "angle_x", [np.rint(counts / 100)])
    write_csv(tmp_path / "f.csv", "gyro_x,gyro_y", [counts, counts])
    write_csv(tmp_path / "g.csv", "gyro_x [deg/h]", [np.append(counts[:-1], 0.5)])
    cases = {
        "a": (ingested(tmp_path / "a.parquet"), "int32"),
        "b": (ingested(tmp_path / "b.nc"), "int32"),
        "c": (ingested(tmp_path / "c.mat", unit={"time": "ns", "gyro": "0.3 arcsec/s"}), "int32"),
        "d": (ingested(tmp_path / "d1.csv", tmp_path / "d2.csv"), "int32"),
        "d2": (ingested(tmp_path / "d2.csv"), "int16"),
        "e": (ingested(tmp_path / "e.csv", unit={"angle": "0.07 arcsec"}, kind="rate"), "int16"),
        "f": (ingested(tmp_path / "f.csv", unit={"gyro_x": "deg/s", "gyro_y": "deg/h"}), "float64"),
        "g": (ingested(tmp_path / "g.csv"), "float64"),
    }
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # nothing that is declared as counts turns out to be none
        for name, (log, kind) in cases.items():
            path = to_netcdf(log, tmp_path / f"{name}-log.nc")
            assert stored_kinds(path)["rate"] == kind, name
            with open_log(path) as back:
                assert same_bits(back.rate, log.rate), name


def test_ingest_writes_the_working_store(tmp_path, capsys):
    from gyrostab.cli import main

    source = write_csv(
        tmp_path / "a.csv",
        "gyro_x [deg/s],temperature [degC]",
        [np.arange(900.0) % 7, np.full(900, 20.5)],
    )
    assert main(["ingest", str(source), "-o", str(tmp_path / "log.zarr"), "--quiet-progress"]) == 0
    assert (
        main(["ingest", str(source), "-o", str(tmp_path / "log.nc"), "--compression", "zlib"]) == 0
    )
    assert (
        main(["ingest", str(source), "-o", str(tmp_path / "b.zarr"), "--compression", "zlib"]) == 2
    )
    assert "--compression zlib is for NetCDF" in capsys.readouterr().err
    for name in ("log.nc", "log.zarr"):
        assert stored_kinds(tmp_path / name)["rate"] == "int16"
        with open_log(tmp_path / name) as log:
            np.testing.assert_array_equal(log.rate[0], np.arange(900) % 7 * 3600.0)


@pytest.mark.parametrize("form", ["nc", "zarr", "csv"])
def test_a_small_archive(tmp_path, form):
    """Archives of `benchmarks`: overlaps, gaps in and between files, read as one log."""
    archive = load_script("benchmarks/make_archive.py")
    archive.GAP_SECONDS = (0.5, 2.0)
    options = {"axes": "xy", "file_hours": 0.025, "gaps": 0.05, "overlap_s": 5.0}
    files = archive.make_archive(tmp_path / "a", form, 0.1, 50, **options)
    archive.make_archive(tmp_path / "b", form, 0.1, 50, **options)
    assert len(files) == 4
    log, second_log = (
        gyrostab.regularise(gyrostab.read_log(sorted((tmp_path / name).iterdir()))) for name in "ab"
    )
    assert same_bits(log.rate, second_log.rate)
    assert log.attrs["sampling_rate_hz"] == 50.0
    assert 0.95 * 18_000 < log.sizes["time"] <= 18_000
    present = log.rate.values[~np.isnan(log.rate.values)]
    assert 0.90 < present.size / log.rate.size < 0.97
    assert present.std() / 0.02 == pytest.approx(180, rel=0.05)
    np.testing.assert_array_equal(np.rint(present / 0.02) * 0.02, present)
    assert log.rate.encoding["scale_factor"] == 0.02
    assert 300 < log.temperature.size < 400
    assert (log.gap_samples.values > 0).sum() >= 4
