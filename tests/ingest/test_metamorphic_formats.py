"""One log in many files: formats, packing, units, epochs and calendars do not change the log.

The truth is a grid of known samples. Each example draws how a file holds it; what comes back
through `read_log` and `regularise` is the grid to 1e-9, or an error that names the file. A file is
never read differently in silence.
"""

from __future__ import annotations

import gzip
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cf_units
import cftime
import h5py
import numpy as np
import pyarrow as pa
import pytest
import xarray as xr
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from pyarrow import parquet
from scipy.io import savemat

import gyrostab
from gyrostab.errors import GyrostabError
from gyrostab.ingest import read_log
from gyrostab.ingest.grid.regularise import regularise
from tests.support.columns import write_columns

#: Without the search for an explanation, which takes minutes after a failure.
PHASES = (Phase.explicit, Phase.reuse, Phase.generate, Phase.shrink)

N, RATE = 300, 100.0
PERIOD_NS = 10_000_000
START = np.datetime64("2026-03-01T06:00:00", "ns")
LOST = np.r_[40:45, 120:121]  # samples without a row
VOID = np.array([7, 200])  # rows whose x has no value
KEPT = np.setdiff1d(np.arange(N), LOST)
STAMPS = START.astype(np.int64) + PERIOD_NS * KEPT

#: Epochs that can be read in one way only, and how many seconds before the start they are in the
#: standard calendar.
EPOCHS = [
    "2026-03-01 06:00:00",
    "2026-3-1",
    "2026-03-01T00:00:00Z",
    "1970-01-01",
    "2026-03-01 01:00 +01:00",
    "20260301T000000",
]
GUESSED = ["now", "01-03-2026", "1/3/2026", "2026", "yesterday", "2026-02-30"]


def counts() -> np.ndarray:
    """Return whole numbers of both axes (x, y) on the whole grid."""
    return np.random.default_rng(11).integers(-90, 91, (2, N))


@dataclass(frozen=True)
class Law:
    """Conversion of stored numbers to rates: ``stored * scale + offset`` in a unit."""

    scale: float = 1.0
    offset: float = 0.0
    unit: str = "deg/h"

    @property
    def per_hour(self) -> float:
        """The unit in deg/h, by UDUNITS."""
        plain = {"deg/h": "degree/hour", "deg/s": "degree/s"}.get(self.unit, self.unit)
        return float(cf_units.Unit(plain).convert(1.0, cf_units.Unit("degree hour-1")))

    def rates(self) -> np.ndarray:
        """Return the ground truth: rates [deg/h] on the whole grid, NaN where missing."""
        grid = (counts() * self.scale + self.offset) * self.per_hour
        grid[:, LOST] = np.nan
        grid[0, VOID] = np.nan
        return grid


def check(paths: Path | list[Path], law: Law, *, within_ns: int = 1000, **options: Any) -> None:
    """Compare the log with the ground truth."""
    log = regularise(read_log(paths, **options))
    np.testing.assert_allclose(
        log.rate.sel(axis=["x", "y"]).values, law.rates(), rtol=1e-9, atol=1e-12 * law.per_hour
    )
    assert log.attrs["sampling_rate_hz"] == pytest.approx(RATE, rel=1e-9)
    begin = log.time.values[0].astype(np.int64)
    assert abs(begin - START.astype(np.int64)) <= within_ns
    assert sorted(np.unique(log.gap_cause.values)) == [0, 1]  # missing rows and unreadable cells


laws = st.builds(
    Law,
    scale=st.sampled_from([1.0, 0.25, 0.1, -0.5, 3.0]),
    offset=st.sampled_from([0.0, 100.0, -7.5]),
    unit=st.sampled_from(
        [
            "deg/h",
            "deg/s",
            "Degree/Second",
            "rad s-1",
            "rad.s^-1",
            "arcsec/s",
            "mrad/s",
            "radian per hour",
        ]
    ),
)


# Texts and tables: the values are written out.


def values_of(law: Law) -> np.ndarray:
    """Return the rates of the kept rows in the unit of the conversion, NaN where missing."""
    values = (counts() * law.scale + law.offset).astype(float)
    values[0, VOID] = np.nan
    return values[:, KEPT]


def write_text(path: Path, law: Law, form: str) -> dict[str, Any]:
    names = {
        "iso": "time",
        "s": "time [s]",
        "us": "time [us]",
        "h": "time [Hours Since 2026-03-01]",
    }
    since = STAMPS - np.datetime64("2026-03-01", "ns").astype(np.int64)
    cells = {
        "iso": [f"{stamp}Z" for stamp in STAMPS.view("M8[ns]")],
        "s": [f"{stamp // 10**9}.{stamp % 10**9:09d}" for stamp in STAMPS],
        "us": [str(stamp // 1000) for stamp in STAMPS],
        "h": [f"{stamp / 3.6e12:.13f}" for stamp in since],
    }[form]
    rows = [
        ",".join([cell, *("" if np.isnan(value) else repr(float(value)) for value in row)])
        for cell, row in zip(cells, values_of(law).T, strict=True)
    ]
    text = "\n".join([f"{names[form]},gyro_x [{law.unit}],gyro_y [{law.unit}]", *rows, ""]).encode()
    path.write_bytes(gzip.compress(text) if path.suffix == ".gz" else text)
    return {}


@pytest.mark.parametrize("suffix", [".csv", ".csv.gz"])
@given(law=laws, form=st.sampled_from(["iso", "s", "us", "h"]))
@settings(max_examples=8, phases=PHASES)
def test_text(suffix, law, form):
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"log{suffix}"
        check(path, law, **write_text(path, law, form))


@given(
    law=laws,
    stamps=st.sampled_from(["s", "ms", "us", "ns", "int", "zoned", "text"]),
    group=st.sampled_from([17, 100, 1000]),
    compression=st.sampled_from(["none", "snappy", "zstd"]),
    nulls=st.booleans(),
)
@settings(max_examples=15, phases=PHASES)
def test_parquet(law, stamps, group, compression, nulls):
    dates = STAMPS.view("M8[ns]")
    if stamps == "s":  # a second does not hold the stamps of this log
        stamps = "ms"
    time = {
        "int": lambda: pa.array(STAMPS // 1000),
        "zoned": lambda: pa.array(dates, pa.timestamp("ns", tz="Europe/Berlin")),
        "text": lambda: pa.array([f"{stamp}Z" for stamp in dates]),
    }.get(stamps, lambda: pa.array(dates.astype(f"M8[{stamps}]"), pa.timestamp(stamps)))()
    columns = {"time [us]" if stamps == "int" else "time": time}
    for name, values in zip("xy", values_of(law), strict=True):
        columns[f"gyro_{name} [{law.unit}]"] = pa.array(
            values, mask=np.isnan(values) if nulls else None
        )
    with TemporaryDirectory() as folder:
        path = Path(folder) / "log.parquet"
        parquet.write_table(pa.table(columns), path, row_group_size=group, compression=compression)
        check(path, law)


# Arrays with attributes: the values are packed.


@dataclass(frozen=True)
class Packed:
    """Storage of the axes."""

    dtype: str = "i2"
    void: str = "_FillValue"
    big: bool = False

    @property
    def is_unsigned(self) -> bool:
        return self.dtype == "unsigned"

    def store(self) -> tuple[np.ndarray, Any]:
        """Return the stored numbers of the kept rows, and the number that marks missing values."""
        stored = counts()
        void = {
            "i1": -127,
            "i2": -32000,
            "i4": -(2**30),
            "f4": -999.0,
            "f8": -999.0,
            "unsigned": 250,
        }[self.dtype]
        if self.is_unsigned:
            stored = stored + 100
        stored[0, VOID] = void
        kind = np.dtype("u1" if self.is_unsigned else self.dtype).newbyteorder(
            ">" if self.big else "<"
        )
        array = stored[:, KEPT].astype(kind)
        return (
            (array.view("i1"), np.uint8(void).view("i1"))
            if self.is_unsigned
            else (array, kind.type(void))
        )

    def attributes(self, law: Law, void: Any) -> dict[str, Any]:
        """Return the attributes by the CF conventions."""
        offset = law.offset - (100.0 * law.scale if self.is_unsigned else 0.0)
        attributes: dict[str, Any] = {"units": law.unit}
        if law.scale != 1.0 or offset:
            attributes["scale_factor"] = law.scale
        if offset:
            attributes["add_offset"] = offset
        if self.is_unsigned:
            attributes["_Unsigned"] = "true"
        low, high = (
            (np.uint8(5).view("i1"), np.uint8(195).view("i1"))
            if self.is_unsigned
            else (type(void)(-95), type(void)(95))
        )
        others = (
            np.array([197, 198], "u1").view("i1")
            if self.is_unsigned
            else np.array([97, 98], type(void))
        )
        marks = {
            "_FillValue": {"_FillValue": void},
            "missing_value": {"missing_value": void},
            "several": {"missing_value": np.array([others[0], void]), "_FillValue": others[1]},
            "valid_range": {"valid_range": np.array([low, high])},
            "valid_min": {"valid_min": low} if not self.is_unsigned else {"valid_max": high},
            "unpacked": {"valid_range": np.sort(np.array([-95.0, 95.0]) * law.scale + law.offset)},
        }
        if self.void == "unpacked" and (
            self.dtype in ("f4", "f8") or "scale_factor" not in attributes
        ):
            return attributes | marks["valid_range"]
        return attributes | marks[self.void]


@dataclass(frozen=True)
class Clock:
    """Storage of the stamps."""

    unit: str = "ms"
    epoch: str = "1970-01-01"
    calendar: str = ""
    dtype: str = "i8"
    packed: bool = False

    @property
    def is_refused(self) -> bool:
        return self.epoch in GUESSED or self.calendar in ("noleap", "360_day", "all_leap")

    def zero(self) -> int:
        """Return the epoch [ns since 1970], by cftime and by hand."""
        if self.is_refused:
            return 0
        day, hours = {
            "2026-03-01 06:00:00": (1, 6),
            "2026-3-1": (1, 0),
            "2026-03-01T00:00:00Z": (1, 0),
            "1970-01-01": (None, 0),
            "2026-03-01 01:00 +01:00": (1, 0),
            "20260301T000000": (1, 0),
        }[self.epoch]
        date = (1970, 1, 1) if day is None else (2026, 3, day)
        origin = cftime.datetime(1970, 1, 1, calendar="standard").toordinal()
        days = cftime.datetime(*date, calendar=self.calendar or "standard").toordinal() - origin
        return (days * 24 + hours) * 3600 * 10**9

    def store(self) -> tuple[np.ndarray, dict[str, Any]]:
        """Return the stored stamps and their attributes."""
        step = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1, "hours": 3600 * 10**9}[self.unit]
        since = STAMPS - self.zero()
        attributes: dict[str, Any] = {"units": f"{self.unit} Since {self.epoch}"}
        if self.calendar:
            attributes["calendar"] = self.calendar
        if self.packed:  # counts of the period, from the first row on
            scale, offset = PERIOD_NS / step, float(since[0]) / step
            attributes |= {
                "scale_factor": scale,
                "add_offset": offset,
                "valid_range": np.array([0, N], "i4"),
            }
            return ((since - since[0]) // PERIOD_NS).astype("i4"), attributes
        if self.dtype == "f8" or step > PERIOD_NS:
            return since / step, attributes
        return since // step, attributes


packings = st.builds(
    Packed,
    dtype=st.sampled_from(["i1", "i2", "i4", "f4", "f8", "unsigned"]),
    void=st.sampled_from(
        ["_FillValue", "missing_value", "several", "valid_range", "valid_min", "unpacked"]
    ),
    big=st.booleans(),
)
clocks = st.builds(
    Clock,
    unit=st.sampled_from(["s", "ms", "us", "ns", "hours"]),
    epoch=st.sampled_from([*EPOCHS, *EPOCHS, *GUESSED]),
    calendar=st.sampled_from(
        [
            "",
            "standard",
            "Gregorian",
            "proleptic_gregorian",
            "julian",
            "noleap",
            "360_day",
            "all_leap",
        ]
    ),
    dtype=st.sampled_from(["i8", "f8"]),
    packed=st.booleans(),
)


def tolerance(clock: Clock) -> int:
    """Return the rounding error of stamps in floating point [ns], with that of an offset."""
    return 2000 if clock.unit == "hours" or clock.dtype == "f8" or clock.packed else 1


def named_columns(
    law: Law, packed: Packed, time: tuple[Any, dict[str, Any]]
) -> dict[str, tuple[Any, dict[str, Any]]]:
    """Return the columns with their attributes."""
    stored, void = packed.store()
    axes = zip("xy", stored, strict=True)
    return {"time": time, **{f"gyro_{a}": (row, packed.attributes(law, void)) for a, row in axes}}


def write_netcdf(
    path: Path, law: Law, packed: Packed, clock: Clock, *, form: str, chunk: int, level: int
) -> None:
    stamps, time_attributes = clock.store()
    if form.startswith("NETCDF3") and stamps.dtype.kind == "i":
        stamps = stamps.astype("f8") if abs(stamps).max() >= 2**31 else stamps.astype("i4")
    extra = {"chunksizes": (chunk,), "zlib": level > 0, "complevel": max(level, 1)}
    columns = named_columns(law, packed, (stamps, time_attributes))
    write_columns(path, columns, form, **(extra if form == "NETCDF4" else {}))


@pytest.mark.parametrize("form", ["NETCDF4", "NETCDF3_CLASSIC", "NETCDF3_64BIT_DATA"])
@given(
    law=laws,
    packed=packings,
    clock=clocks,
    chunk=st.sampled_from([1, 37, 294]),
    level=st.sampled_from([0, 4]),
)
@settings(max_examples=15, phases=PHASES)
def test_netcdf(form, law, packed, clock, chunk, level):
    with TemporaryDirectory() as folder:
        path = Path(folder) / "log.nc"
        write_netcdf(path, law, packed, clock, form=form, chunk=chunk, level=level)
        if clock.is_refused:
            with pytest.raises(GyrostabError, match=r"log\.nc: .*'time'"):
                read_log(path)
        else:
            check(path, law, within_ns=2000 if form.startswith("NETCDF3") else tolerance(clock))


@given(
    law=laws,
    packed=packings,
    clock=clocks,
    chunk=st.sampled_from([1, 37, 294]),
    level=st.sampled_from([None, 4]),
)
@settings(max_examples=15, phases=PHASES)
def test_hdf5(law, packed, clock, chunk, level):
    columns = named_columns(law, packed, clock.store())
    with TemporaryDirectory() as folder:
        path = Path(folder) / "log.h5"
        groups = {f"imu/{name}": column for name, column in columns.items()}
        write_columns(path, groups, chunks=(chunk,), compression=level)
        names = {f"imu.{name}": name for name in ("time", "gyro_x", "gyro_y")}
        if clock.is_refused:
            with pytest.raises(GyrostabError, match=r"log\.h5: .*time"):
                read_log(path, map=names)
        else:
            check(path, law, within_ns=tolerance(clock), map=names)


@pytest.mark.parametrize("version", [2, 3])
@given(
    law=laws, packed=packings, clock=clocks, chunk=st.sampled_from([37, 294]), matrix=st.booleans()
)
@settings(max_examples=10, phases=PHASES)
@pytest.mark.filterwarnings(
    "ignore:The data type", "ignore:variable .* has multiple fill", "ignore:Consolidated metadata"
)
def test_zarr(version, law, packed, clock, chunk, matrix):
    stamps, time_attributes = clock.store()
    stored, void = packed.store()
    time = xr.Variable("obs", stamps, time_attributes)
    if matrix:
        gyro = xr.Variable(("obs", "axis"), stored.T, packed.attributes(law, void))
        raw = xr.Dataset({"gyro": gyro}, {"axis": ["x", "y"]})
    else:
        raw = xr.Dataset(
            {
                f"gyro_{axis}": ("obs", row, packed.attributes(law, void))
                for axis, row in zip("xy", stored, strict=True)
            }
        )
    raw["time"] = time
    encoding = {
        name: {"chunks": (chunk, *variable.shape[1:])}
        for name, variable in raw.variables.items()
        if name != "axis"
    }
    with TemporaryDirectory() as folder:
        path = Path(folder) / "log.zarr"
        raw.to_zarr(path, zarr_format=version, consolidated=False, encoding=encoding)
        if clock.is_refused:
            with pytest.raises(GyrostabError, match=r"log\.zarr: .*'time'"):
                read_log(path)
        else:
            check(path, law, within_ns=tolerance(clock))


@pytest.mark.parametrize("version", ["5", "7.3"])
@given(law=laws, matrix=st.booleans(), whole=st.booleans())
@settings(max_examples=6, phases=PHASES)
def test_matlab(version, law, matrix, whole):
    since = (STAMPS - STAMPS[0]) // 1000
    data: dict[str, np.ndarray] = {"time": since[:, None] if whole else since[:, None] / 1e6}
    if matrix:
        data["w"] = values_of(law).T
    else:
        data |= {
            f"gyro_{axis}": row[:, None] for axis, row in zip("xy", values_of(law), strict=True)
        }
    with TemporaryDirectory() as folder:
        path = Path(folder) / "log.mat"
        if version == "5":
            savemat(path, data)
        else:
            with h5py.File(path, "w", userblock_size=512) as file:
                for name, array in data.items():
                    file[name] = array.T  # MATLAB writes columns first
            with path.open("r+b") as raw:
                raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")
        options: dict[str, Any] = {
            "unit": {"gyro": law.unit, "time": "us" if whole else "s"},
            "epoch": "2026-03-01T06:00:00Z",
        }
        check(
            path, law, **options, **({"map": {"w/0": "gyro_x", "w/1": "gyro_y"}} if matrix else {})
        )


# Regular logs, of gyrostab and of others.


@given(
    law=laws,
    own=st.booleans(),
    store=st.sampled_from(["nc", "zarr2", "zarr3"]),
    packed=packings,
    chunk=st.sampled_from([50, 300]),
    epoch=st.sampled_from(EPOCHS),
)
@settings(max_examples=10, phases=PHASES)
@pytest.mark.filterwarnings(
    "ignore:The data type", "ignore:Consolidated metadata", "ignore:variable .* has multiple fill"
)
def test_regular_logs(law, own, store, packed, chunk, epoch):
    with TemporaryDirectory() as folder:
        path = Path(folder) / ("log.nc" if store == "nc" else "log.zarr")
        if own:
            text = Path(folder) / "log.csv"
            write_text(text, law, "iso")
            log = regularise(read_log(text))
            gyrostab.to_netcdf(log, path) if store == "nc" else gyrostab.to_zarr(log, path)
        else:
            law = Law(law.scale, law.offset, "degree hour-1")
            write_regular(path, law, packed, Clock("ms", epoch), store, chunk)
        opened = read_log(path)
        np.testing.assert_allclose(
            opened.rate.sel(axis=["x", "y"]).values,
            law.rates(),
            rtol=1e-9,
            atol=1e-12 * law.per_hour,
        )
        np.testing.assert_array_equal(opened.time.values, START + PERIOD_NS * np.arange(N))


def write_regular(
    path: Path, law: Law, packed: Packed, clock: Clock, store: str, chunk: int
) -> None:
    """Write a regular log like another program, with rows for lost samples."""
    stored, void = packed.store()
    whole = np.full((2, N), void)
    whole[:, KEPT] = stored
    attributes = packed.attributes(law, void)
    since = (START.astype(np.int64) + PERIOD_NS * np.arange(N) - clock.zero()) // 10**6
    log = xr.Dataset(
        {
            "rate": (("axis", "sample"), whole, attributes),
            "clock": ("sample", since, {"units": f"ms since {clock.epoch}"}),
        },
        coords={"axis": ["x", "y"]},
        attrs={"sampling_rate_hz": RATE},
    ).rename(sample="time", clock="time")
    log = log.set_coords("time").drop_indexes("time", errors="ignore")
    if store == "nc":
        encoding: dict[str, Any] = {"chunksizes": (1, chunk)}
        if "_FillValue" not in attributes:
            encoding["_FillValue"] = None
        log.to_netcdf(path, encoding={"rate": encoding})
    else:
        log.to_zarr(
            path,
            zarr_format=int(store[-1]),
            consolidated=False,
            encoding={"rate": {"chunks": (1, chunk)}},
        )


def test_the_surface_of_every_format_is_the_same(tmp_path):
    law = Law(0.25, 0.0, "deg/s")
    logs = {}
    for name in ("log.csv", "log.csv.gz"):
        write_text(tmp_path / name, law, "us")
        logs[name] = tmp_path / name
    for form in ("NETCDF4", "NETCDF3_CLASSIC"):
        logs[form] = tmp_path / f"{form}.nc"
        write_netcdf(
            logs[form],
            law,
            Packed("unsigned", "valid_range"),
            Clock("s", packed=True),
            form=form,
            chunk=37,
            level=4,
        )
    surfaces = [
        gyrostab.davar(regularise(read_log(path)), window="1s", step="0.5s")
        for path in logs.values()
    ]
    for surface in surfaces[1:]:
        np.testing.assert_allclose(surface.avar.values, surfaces[0].avar.values, rtol=1e-9)
        np.testing.assert_array_equal(surface["count"].values, surfaces[0]["count"].values)
