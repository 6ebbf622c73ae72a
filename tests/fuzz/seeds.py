"""Small valid inputs of every format that gyrostab reads, which the harness then damages."""

from __future__ import annotations

import gzip
import json
import struct
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.ingest.field_files import WRITERS, write_wits0

ROWS = 80
RATE = 10.0
#: Placeholder in inputs for the folder that they are written to.
FOLDER = "@FOLDER@"
WINDOWS = ("--window", "4s", "--step", "1s", "--taus", "6")


@dataclass(frozen=True)
class Seed:
    """A valid input.

    Attributes
    ----------
    format : str
        Row of the result table.
    files : dict
        Name within a folder -> bytes.
    main : str
        File or folder to pass to the command.
    options : tuple of str
        Reading options that the format needs.
    commands : tuple of str
        Commands that accept it.
    keep : tuple of str
        Files that are not damaged.
    """

    format: str
    files: dict[str, bytes]
    main: str
    options: tuple[str, ...] = ()
    commands: tuple[str, ...] = ("scan", "scan", "scan", "ingest", "ingest", "run")
    keep: tuple[str, ...] = ()


def signals() -> tuple[np.ndarray, np.ndarray]:
    """Return two gyro axes [deg/h, counts] and a temperature [degC]."""
    generator = np.random.default_rng(11)
    return generator.integers(-2000, 2000, (2, ROWS)), np.round(20.0 + 0.01 * np.arange(ROWS), 2)


@contextmanager
def folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="gyrostab-seeds-") as name:
        yield Path(name)


def contents(path: Path, root: Path) -> dict[str, bytes]:
    """Return the bytes of a file, or of all files of a folder, by their name below `root`."""
    files = [path] if path.is_file() else sorted(item for item in path.rglob("*") if item.is_file())
    return {str(item.relative_to(root)): item.read_bytes() for item in files}


def text_seeds() -> Iterator[Seed]:
    (x, y), temperature = signals()
    names = "gyro_x [deg/h],gyro_y [deg/h],temperature [degC]"
    rows = [f"{a},{b},{t:.2f}" for a, b, t in zip(x, y, temperature, strict=True)]
    stamp = [f"2026-03-01T12:00:{index / RATE:06.3f}Z" for index in range(ROWS)]
    iso = (
        "\n".join(["time," + names, *(f"{s},{row}" for s, row in zip(stamp, rows, strict=True))])
        + "\n"
    )
    numeric = (
        "\n".join(
            [
                "# tool 7",
                "time [s]," + names,
                *(f"{i / RATE:.1f},{row}" for i, row in enumerate(rows)),
            ]
        )
        + "\n"
    )
    semicolon = "\n".join(
        [
            "time [ms];gyro_x [deg/s];gyro_y [deg/s]",
            *(
                f"{i * 100};{a / 7:.3f};{b / 7:.3f}".replace(".", ",")
                for i, (a, b) in enumerate(zip(x, y, strict=True))
            ),
        ]
    )
    bare = "\n".join(f"{i * 100} {a} {b}" for i, (a, b) in enumerate(zip(x, y, strict=True)))
    angle = "\n".join(
        ["time [s]\tangle_x [arcsec]", *(f"{i / RATE}\t{a}" for i, a in enumerate(np.cumsum(x)))]
    )
    quoted = "\n".join(
        [
            '"time [us]","gyro_x [rad/s]"',
            *(f'"{i * 100000}","{a * 1e-6:.3e}"' for i, a in enumerate(x)),
        ]
    )
    yield Seed("text", {"log.csv": iso.encode()}, "log.csv")
    yield Seed("text", {"log.csv": numeric.encode()}, "log.csv")
    yield Seed("text", {"log.txt": semicolon.encode()}, "log.txt")
    yield Seed(
        "text",
        {"log.dat": bare.encode()},
        "log.dat",
        ("--map", "0=time", "--map", "1=gyro_x", "--unit", "gyro=deg/h", "--unit", "time=ms"),
    )
    yield Seed("text", {"log.tsv": angle.encode()}, "log.tsv", ("--kind", "angle"))
    yield Seed("text", {"log.csv": quoted.encode()}, "log.csv")
    yield Seed(
        "text",
        {"log.csv": "\n".join([names, *rows]).encode()},
        "log.csv",
        ("--rate", "10", "--start", "2026-03-01"),
    )
    moments = list(zip(stamp, x, strict=True))
    pair = "\n".join(
        ["Date\tTime\tgyro_x [deg/h]", *(f"{s[:10]}\t{s[11:-1]}\t{a}" for s, a in moments)]
    )
    yield Seed("text", {"log.tsv": pair.encode()}, "log.tsv")
    dates = "\n".join(
        ["Zeit;gyro_x [deg/h]", *(f"1.3.2026 12:00:{s[-7:-1]};{a}" for s, a in moments)]
    )
    yield Seed("text", {"log.csv": dates.encode()}, "log.csv")
    yield Seed("text", {"log.csv.gz": gzip.compress(iso.encode(), mtime=0)}, "log.csv.gz")


def columns() -> dict[str, tuple[str, np.ndarray]]:
    """Return columns with units, for formats with typed columns."""
    (x, y), temperature = signals()
    return {
        "time": ("us", np.arange(ROWS, dtype=np.int64) * 100_000),
        "gyro_x": ("deg/h", x.astype(np.int32)),
        "gyro_y": ("deg/h", y.astype(np.float64)),
        "temperature": ("degC", temperature),
    }


UNITS = ("--unit", "time=us", "--unit", "gyro=deg/h", "--unit", "temperature=degC")


def parquet_seeds() -> Iterator[Seed]:
    import pyarrow as pa
    from pyarrow import parquet

    table_columns = columns()
    stamps = pa.array(table_columns["time"][1] * 1000, pa.timestamp("ns"))
    named = {f"{name} [{unit}]": values for name, (unit, values) in table_columns.items()}
    for table, options in (
        (pa.table(named), {}),
        (
            pa.table({**named, "time [us]": stamps}).rename_columns(["time", *list(named)[1:]]),
            {"compression": "zstd", "row_group_size": 30},
        ),
    ):
        with folder() as place:
            parquet.write_table(table, place / "log.parquet", **options)
            yield Seed("parquet", contents(place / "log.parquet", place), "log.parquet")


def foreign_netcdf(path: Path, form: str) -> None:
    import netCDF4

    with netCDF4.Dataset(path, "w", format=form) as file:
        file.createDimension("obs", ROWS)
        for name, (unit, values) in columns().items():
            kind = (
                "f8"
                if form.startswith("NETCDF3")
                and values.dtype.kind == "i"
                and values.dtype.itemsize == 8
                else values.dtype
            )
            variable = file.createVariable(name, kind, ("obs",))
            variable.units = "microseconds since 2026-03-01T12:00:00Z" if name == "time" else unit
            variable[:] = values


def regular_log() -> Any:

    from gyrostab.ingest.make_log import make_log

    (x, _), temperature = signals()
    return make_log(
        x * 0.5, rate=RATE, unit="deg/h", channels={"temperature": (temperature, "degC")}
    )


def netcdf_seeds() -> Iterator[Seed]:
    from gyrostab.io.datasets import to_netcdf
    from gyrostab.jobs.run import load_log

    for form, row in (
        ("NETCDF3_CLASSIC", "netcdf3"),
        ("NETCDF3_64BIT_OFFSET", "netcdf3"),
        ("NETCDF4", "netcdf4"),
    ):
        with folder() as place:
            foreign_netcdf(place / "log.nc", form)
            yield Seed(row, contents(place / "log.nc", place), "log.nc")
    with folder() as place:
        for seed in list(text_seeds())[:2]:
            (place / seed.main).write_bytes(seed.files[seed.main])
            to_netcdf(load_log([place / seed.main]), place / "log.nc", overwrite=True)
            yield Seed("netcdf4", contents(place / "log.nc", place), "log.nc")
        regular_log().to_netcdf(place / "xarray.nc", engine="netcdf4")
        yield Seed("netcdf4", contents(place / "xarray.nc", place), "xarray.nc")
        to_netcdf(regular_log(), place / "zlib.nc", compression="zlib")
        yield Seed(
            "netcdf4",
            contents(place / "zlib.nc", place),
            "zlib.nc",
            commands=("scan", "ingest", "run", "davar"),
        )


def zarr_seeds() -> Iterator[Seed]:
    import xarray as xr

    from gyrostab.io.datasets import to_zarr
    from gyrostab.jobs.run import load_log

    with folder() as place:
        seed = next(text_seeds())
        (place / seed.main).write_bytes(seed.files[seed.main])
        to_zarr(load_log([place / seed.main]), place / "log.zarr")
        yield Seed("zarr2", contents(place / "log.zarr", place), "log.zarr")
        foreign = xr.Dataset(
            {name: ("obs", values, {"units": unit}) for name, (unit, values) in columns().items()}
        )
        for form in (2, 3):
            regular_log().to_zarr(place / f"regular{form}.zarr", zarr_format=form)
            foreign.to_zarr(place / f"foreign{form}.zarr", zarr_format=form)
            for name in (f"regular{form}.zarr", f"foreign{form}.zarr"):
                yield Seed(f"zarr{form}", contents(place / name, place), name)


def hdf5_seeds() -> Iterator[Seed]:
    import h5py

    with folder() as place:
        for name, filters in (
            ("plain.h5", {}),
            ("deflated.h5", {"compression": "gzip", "chunks": (40,)}),
        ):
            with h5py.File(place / name, "w") as file:
                group = file.create_group("imu") if filters else file
                for label, (unit, values) in columns().items():
                    group.create_dataset(label, data=values, **filters).attrs["units"] = unit
            mapping = (
                [item for label in columns() for item in ("--map", f"imu.{label}={label}")]
                if filters
                else []
            )
            yield Seed("hdf5", contents(place / name, place), name, (*mapping, *UNITS))


def undate(path: Path) -> None:
    """Overwrite the date in the header of a MATLAB file."""
    with path.open("r+b") as file:
        file.write(b"MATLAB 5.0 MAT-file".ljust(116))


def matlab_seeds() -> Iterator[Seed]:
    import h5py
    from scipy.io import savemat

    variables = {name: values for name, (_, values) in columns().items()}
    table = np.stack([values.astype(float) for name, values in variables.items() if name != "time"])
    fields = ("gyro_x", "gyro_y", "temperature")
    with folder() as place:
        for number, packed in enumerate((False, True)):
            savemat(place / f"v{number}.mat", variables, do_compression=packed)
            undate(place / f"v{number}.mat")
            yield Seed(
                "matlab5", contents(place / f"v{number}.mat", place), f"v{number}.mat", UNITS
            )
        savemat(
            place / "s.mat",
            {
                "log": {"t": variables["time"], "DATA": table},
                "note": "text",
                "cells": np.array(["a", 1.0], dtype=object),
            },
        )
        undate(place / "s.mat")
        names = [
            item
            for place_, name in enumerate(fields)
            for item in ("--map", f"log.DATA/{place_}={name}")
        ]
        yield Seed(
            "matlab5",
            contents(place / "s.mat", place),
            "s.mat",
            ("--map", "log.t=time", *names, *UNITS),
        )
        with h5py.File(place / "hdf.mat", "w", userblock_size=512) as file:
            file["DATA"] = table
            file["stamp"] = variables["time"].reshape(1, -1)
        with (place / "hdf.mat").open("r+b") as raw:
            raw.write(b"MATLAB 7.3 MAT-file, Platform: none".ljust(124) + b"\x00\x02IM")
        names = [
            item
            for place_, name in enumerate(fields)
            for item in ("--map", f"DATA/{place_}={name}")
        ]
        yield Seed(
            "matlab7.3",
            contents(place / "hdf.mat", place),
            "hdf.mat",
            ("--map", "stamp=time", *names, *UNITS),
        )


def miniseed_seeds() -> Iterator[Seed]:
    from pymseed import DataEncoding, MS3TraceList

    (x, y), temperature = signals()
    start = int(np.datetime64("2026-03-01T12:00:00", "ns").astype(np.int64))
    for version, encoding in ((2, DataEncoding.STEIM2), (3, DataEncoding.STEIM1)):
        with folder() as place:
            with (place / "log.mseed").open("wb") as file:
                for code, values, kind, rate, packing in (
                    ("H_J_1", x.astype(np.int32), "i", RATE, encoding),
                    ("H_J_2", y.astype(np.int32), "i", RATE, encoding),
                    ("L_K_O", temperature[:8].astype(np.float64), "d", 1.0, DataEncoding.FLOAT64),
                ):
                    traces = MS3TraceList()
                    traces.add_data(f"FDSN:XX_TOOL__{code}", values, kind, rate, starttime=start)
                    for record in traces.generate(
                        max_record_length=256, encoding=packing, format_version=version
                    ):
                        file.write(record)
            mapping = (
                "--map",
                "HJ1=gyro_x",
                "--map",
                "HJ2=gyro_y",
                "--map",
                "LKO=temperature",
                "--unit",
                "gyro=0.5 deg/h",
                "--unit",
                "temperature=degC",
            )
            yield Seed("miniseed", contents(place / "log.mseed", place), "log.mseed", mapping)


def ulog_seeds() -> Iterator[Seed]:
    def message(kind: bytes, body: bytes) -> bytes:
        return struct.pack("<Hc", len(body), kind) + body

    (x, y), _ = signals()
    parts = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0), message(b"B", bytes(40))]
    parts.append(message(b"F", b"imu:uint64_t timestamp;float[3] gyro_rad;uint8_t[4] _padding0;"))
    parts.append(message(b"I", bytes([14]) + b"char[4] sys_id" + b"tool"))
    parts.append(message(b"A", struct.pack("<BH", 0, 1) + b"imu"))
    for index in range(ROWS):
        parts.append(
            message(
                b"D",
                struct.pack("<HQ3f", 1, 100_000 * index, x[index] * 1e-5, y[index] * 1e-5, 0.001),
            )
        )
        if index == 40:
            parts.append(message(b"O", struct.pack("<H", 20)))
    mapping = [
        item
        for place, axis in enumerate("xyz")
        for item in ("--map", f"gyro_rad[{place}]=gyro_{axis}")
    ]
    yield Seed("ulog", {"log.ulg": b"".join(parts)}, "log.ulg", (*mapping, "--unit", "gyro=rad/s"))


def las_seeds() -> Iterator[Seed]:
    (x, y), temperature = signals()
    rows = "\n".join(
        f"{k / RATE:.2f} {a} {b} {t}"
        for k, (a, b, t) in enumerate(zip(x, y, temperature, strict=True))
    )
    head = (
        "~V\nVERS. 2.0 :\nWRAP. NO :\n~W\nSTRT.S 0 :\nSTOP.S 7.9 :\nSTEP.S 0.1 :\nNULL. -999.25 :\n"
    )
    curves = (
        "~C\nTIME.S : time\nGYRO_X.deg/h : rate\nGYRO_Y.deg/h : rate\nTEMPERATURE.degC : in "
        "the tool\n~A\n"
    )
    yield Seed("las", {"log.las": (head + curves + rows + "\n").encode()}, "log.las")


def tdms_seeds() -> Iterator[Seed]:
    from nptdms import ChannelObject, RootObject, TdmsWriter

    (x, y), temperature = signals()
    start = np.datetime64("2026-03-01T12:00:00", "us")
    stamps = start + (np.arange(ROWS) * 100_000).astype("timedelta64[us]")
    for waveform in (True, False):
        clock = (
            {"wf_increment": 1 / RATE, "wf_start_time": start, "wf_start_offset": 0.0}
            if waveform
            else {}
        )
        axes = [
            ChannelObject(
                "imu", f"gyro_{axis}", values.astype(np.int32), {"unit_string": "deg/h", **clock}
            )
            for axis, values in zip("xy", (x, y), strict=True)
        ]
        own = [] if waveform else [ChannelObject("imu", "stamp", stamps)]
        slow = {"unit_string": "degC", "wf_increment": 1.0, "wf_start_time": start}
        with folder() as place:
            with TdmsWriter(str(place / "log.tdms")) as writer:
                writer.write_segment(
                    [
                        RootObject(),
                        *axes,
                        *own,
                        ChannelObject("probe", "temperature", temperature[:8], slow),
                    ]
                )
            yield Seed("tdms", contents(place / "log.tdms", place), "log.tdms")


LAYOUT = """header_bytes = 16
byte_order = "little"
fields = [
    {name = "time [ms]", type = "uint32"},
    {skip = 2},
    {name = "gyro_x [deg/h]", type = "int16"},
    {name = "gyro_y [0.5 deg/h]", type = "int32"},
    {name = "temperature [degC]", type = "float32"},
]
"""


def binary_seeds() -> Iterator[Seed]:
    (x, y), temperature = signals()
    table = np.zeros(
        ROWS, dtype=[("t", "<u4"), ("", "V2"), ("x", "<i2"), ("y", "<i4"), ("T", "<f4")]
    )
    table["t"], table["x"], table["y"], table["T"] = np.arange(ROWS) * 100, x, y, temperature
    files = {"log.bin": b"HEADER OF 16 BYT" + table.tobytes(), "log.bin.toml": LAYOUT.encode()}
    yield Seed("binary", files, "log.bin", keep=("log.bin.toml",))
    yield Seed("layout", files, "log.bin", keep=("log.bin",))


def field_seeds() -> Iterator[Seed]:
    """Return the files of the contract test of formats of rigs, robots and vehicles."""
    for name, write in {**WRITERS, "wits0": write_wits0}.items():
        with folder() as place:
            path, form, options = write(place)
            options |= {"map": {"0110": "gyro_x [deg/h]"}} if form == "wits0" else {}
            command = [
                text
                for key, value in options.items()
                for item in (
                    [f"{k}={v}" for k, v in value.items()] if isinstance(value, dict) else [value]
                )
                for text in (f"--{key}", str(item))
            ]
            yield Seed(name, contents(path, place), path.name, tuple(command), ("scan", "ingest"))


NOISE = """
[log]
axes = ["x", "y"]
seed = 3
[noise]
N = 0.003
flicker_band = [1e-4, 2.0]
[noise.x]
Q = 0.5
N = "0.005 deg/sqrt(h)"
B = 0.004
K = 0.02
R = 0.0
[[environment]]
profile = "steps"
channel = "temperature"
unit = "degC"
points = [[0.0, 20.0], [1.0, 25.0]]
[[effect]]
name = "shupe"
axes = ["x"]
driver = "temperature"
sensitivity = 0.4
lag = 1.0
"""
VIBRATION = """
[noise]
N = 0.01
[[environment]]
profile = "vibration"
points = [[0.0, 0.1], [2.0, 1.0]]
[[effect]]
name = "vibration_noise"
driver = "vibration"
white = 0.02
"""
JUMPS = """
[[effect]]
name = "spectral_line"
frequency = 2.0
amplitude = 0.5
[[effect]]
name = "telegraph"
step = 0.1
low = 1.0
high = 1.0
"""
LOSSES = """
[noise]
N = 0.01
K = 0.1
[[environment]]
profile = "losses"
per_hour = 4000
mean = "0.2s"
[[environment]]
profile = "gaps"
spans = [[1.0, 1.5]]
[[effect]]
name = "spikes"
per_hour = 3600
size = 20.0
"""
MODELS = (NOISE, VIBRATION, JUMPS, LOSSES)


def model_seeds() -> Iterator[Seed]:
    for text in MODELS:
        yield Seed(
            "model",
            {"model.toml": text.encode()},
            "model.toml",
            ("--duration", "4s", "--rate", "10"),
            ("simulate",),
        )


CONFIG = """
workers = 1
[run]
window = "4s"
step = "1s"
taus = "6"
terms = "QNBK"
[run.map]
wx = "gyro_x [deg/h]"
[scan]
epoch = "2026-03-01"
max_gap = "1h"
"""
MAP = """
tick = "time [ms]"
wx = "gyro_x [deg/h]"
T = "temperature [degC]"
"""


def option_seeds() -> Iterator[Seed]:
    (x, _), temperature = signals()
    log = "\n".join(
        [
            "tick,wx,T",
            *(f"{i * 100},{a},{t}" for i, (a, t) in enumerate(zip(x, temperature, strict=True))),
        ]
    ).encode()
    config = (
        "--config",
        f"{FOLDER}/options.toml",
        "--map",
        "tick=time",
        "--unit",
        "time=ms",
        "--map",
        "T=temperature [degC]",
        "--map",
        "wx=gyro_x [deg/h]",
    )
    yield Seed(
        "options",
        {"log.csv": log, "options.toml": CONFIG.encode()},
        "log.csv",
        config,
        ("scan", "run"),
        ("log.csv",),
    )
    yield Seed(
        "options",
        {"log.csv": log, "names.toml": MAP.encode()},
        "log.csv",
        ("--map", f"{FOLDER}/names.toml"),
        ("scan",),
        ("log.csv",),
    )


def move_job(data: bytes, old: str, new: str) -> bytes:
    """Move a job file to another folder; a valid checksum is recomputed."""
    from gyrostab.jobs.job import _hash_json

    moved = data.replace(old.encode(), new.encode())
    try:
        before, after = json.loads(data), json.loads(moved)
        if before.pop("sha256") != _hash_json(before):
            return moved
        after["sha256"] = _hash_json(
            {key: value for key, value in after.items() if key != "sha256"}
        )
        return json.dumps(after, indent=1).encode()
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return moved


def checkpoint_seeds() -> Iterator[Seed]:
    """Return a run that was stopped before its product was written."""
    import contextlib
    import io
    import os

    from gyrostab.cli import main
    from gyrostab.jobs import run as core

    def stop(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    log = next(text_seeds()).files["log.csv"]
    written = core._write_product
    core._write_product = stop
    try:
        with folder() as place, contextlib.redirect_stderr(io.StringIO()):
            (place / "log.csv").write_bytes(log)
            os.utime(place / "log.csv", ns=(CHANGED_NS, CHANGED_NS))
            assert (
                main(
                    [
                        "run",
                        str(place / "log.csv"),
                        "-o",
                        str(place / "out.nc"),
                        *WINDOWS,
                        "--workers",
                        "1",
                    ]
                )
                == 3
            )
            files = {"log.csv": log}
            for name, data in contents(place / ".out.nc.job", place).items():
                if not name.endswith("/lock"):
                    files[name] = (
                        move_job(data, str(place), FOLDER) if name.endswith(".json") else data
                    )
    finally:
        core._write_product = written
    yield Seed("checkpoint", files, "log.csv", (), ("resume",), ("log.csv",))


#: Time of change [ns since 1970] of every file of an input: a run that is continued looks at it.
CHANGED_NS = 1_767_225_600_000_000_000

MAKERS: tuple[Callable[[], Iterator[Seed]], ...] = (
    text_seeds,
    parquet_seeds,
    netcdf_seeds,
    zarr_seeds,
    hdf5_seeds,
    matlab_seeds,
    miniseed_seeds,
    ulog_seeds,
    las_seeds,
    tdms_seeds,
    binary_seeds,
    field_seeds,
    model_seeds,
    option_seeds,
    checkpoint_seeds,
)


def make_seeds() -> dict[str, list[Seed]]:
    """Return valid inputs by format."""
    seeds: dict[str, list[Seed]] = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SOURCE_DATE_EPOCH", "1767225600")
        for maker in MAKERS:
            for seed in maker():
                seeds.setdefault(seed.format, []).append(seed)
    return seeds
