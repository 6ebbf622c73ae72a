"""Export: what is written is legal, exact and complete, and comes back as it was."""

from __future__ import annotations

import json
import tempfile
import tracemalloc
from pathlib import Path

import cf_units
import dask.array as da
import h5py
import hypothesis.extra.numpy as hnp
import netCDF4
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gyrostab import from_dataarray
from gyrostab.errors import FormatError, OptionError, SchemaError
from gyrostab.ingest.make_log import make_log
from gyrostab.io import datasets as export
from gyrostab.io.datasets import to_netcdf, to_zarr
from gyrostab.io.opening import open_dataset, open_log, open_product, open_surface
from gyrostab.noise import LAWS, TERMS, model_avar
from gyrostab.schema import VARIABLES, attributes
from gyrostab.store import read, write
from gyrostab.store.attributes import encode_attributes
from gyrostab.time.grid import TimeGridIndex, grid_times, time_coordinate
from gyrostab.units import INNER
from tests.support import synthetic
from tests.support.cf_checker import assert_follows_cf

KINDS = {"product": synthetic.product, "surface": synthetic.surface, "log": synthetic.log}
OPEN = {"product": open_product, "surface": open_surface, "log": open_log}


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("files")
    return {kind: to_netcdf(make(), folder / f"{kind}.nc") for kind, make in KINDS.items()}


def assert_same(before: xr.Dataset, after: xr.Dataset) -> None:
    assert set(before.variables) == set(after.variables)
    assert set(before.coords) == set(after.coords)
    for name, variable in before.variables.items():
        assert after[name].dims == variable.dims, name
        assert after[name].dtype == variable.dtype, name
        np.testing.assert_array_equal(after[name].values, variable.values, err_msg=str(name))
        for key, value in variable.attrs.items():
            np.testing.assert_array_equal(after[name].attrs[key], value)
    for key, value in before.attrs.items():
        if key != "history":
            assert after.attrs[key] == value
            assert type(after.attrs[key]) is type(value)
    assert after.attrs["history"].startswith(before.attrs.get("history", ""))


@pytest.mark.parametrize("write", [to_netcdf, to_zarr])
@pytest.mark.parametrize("kind", KINDS)
def test_comes_back_as_it_was(tmp_path, kind, write):
    before = KINDS[kind]()
    with OPEN[kind](write(before, tmp_path / "it")) as after:
        assert_same(before, after)
        copy = write(after, tmp_path / "again")
        with OPEN[kind](copy) as twice:
            assert_same(before, twice)
            assert (
                len(twice.attrs["history"].splitlines())
                == len(before.attrs["history"].splitlines()) + 2
            )


@pytest.mark.parametrize("kind", KINDS)
def test_cf_checker_has_no_remark(files, kind, caplog):
    assert_follows_cf(files[kind])
    assert not caplog.records


def test_layout_seen_by_plain_netcdf4(files):
    with netCDF4.Dataset(files["product"]) as file:
        assert not file.groups
        assert file["avar"].dimensions == ("axis", "tau", "time")
        assert file["observable"].dimensions == ("axis", "term", "time")
        assert file.Conventions == "CF-1.11, ACDD-1.3"
        for name, variable in file.variables.items():
            data = variable.dtype.kind == "f" and name not in ("time", "tau", "time_bounds")
            assert ("_FillValue" in variable.ncattrs()) is data, name
            if data:
                assert np.isfinite(variable._FillValue)
                assert variable.filters()["zlib"]
                assert variable.filters()["shuffle"]
            assert not any(
                isinstance(variable.getncattr(key), bool | type(None)) for key in variable.ncattrs()
            )
        assert file["time"].dtype == np.int64
        assert file["time"].units_metadata == "leap_seconds: unknown"
        assert file["estimator"].flag_meanings == "none strict_runs weighted_clusters"
        assert list(file["axis"][:]) == ["x", "y", "z"]
        assert file["avar"][:].mask.any()
        assert json.loads(file.notes) == synthetic.product().attrs["notes"]
        before = synthetic.product().avar.transpose("axis", "tau", "time").values
        np.testing.assert_array_equal(file["avar"][:].filled(np.nan), before)


def test_plain_xarray_selects_an_axis(files):
    with xr.open_dataset(files["product"]) as plain:
        np.testing.assert_array_equal(
            plain.avar.sel(axis="y").transpose("time", "tau"),
            synthetic.product().avar.sel(axis="y"),
        )
        np.testing.assert_array_equal(plain.time, synthetic.product().time)


@pytest.mark.parametrize(
    ("name", "to", "number"),
    [
        ("avar", "radian2 s-2", (np.pi / 180 / 3600) ** 2),
        ("window_mean", "radian s-1", np.pi / 180 / 3600),
        ("Q", "radian", 1e-6),
        ("Q", "arcsecond", 0.648 / np.pi),
        ("N", "radian s-1", np.pi / 180 / 3600),
        ("B", "radian s-1", np.pi / 180 / 3600),
        ("K", "radian s-1", np.pi / 180 / 3600),
        ("R", "radian s-2", np.pi / 180 / 3600**2),
        ("N_squared", "radian2 s-1", (np.pi / 180) ** 2 / 3600),
        ("K_squared", "radian2 s-3", (np.pi / 180) ** 2 / 3600**3),
        ("tau", "s", 1.0),
        ("vibration", "m s-2", 9.80665),
        ("temperature", "K", 274.15),
        ("temperature_rate", "K s-1", 1 / 3600),
    ],
)
def test_udunits_reads_the_number(files, name, to, number):
    with netCDF4.Dataset(files["product"]) as file:
        for variable in [name, f"{name}_stderr", f"{name}_upper"]:
            if variable in file.variables:
                assert cf_units.Unit(file[variable].units).convert(1.0, to) == pytest.approx(
                    number, rel=1e-12
                )


def test_every_unit_written_is_read_rightly(files):
    for path in files.values():
        with netCDF4.Dataset(path) as file:
            for variable in file.variables.values():
                units = getattr(variable, "units", "1")
                if " since " not in units:
                    assert cf_units.Unit(units).is_convertible(cf_units.Unit(units))
                    assert "." not in units.replace("9.80665", "")
    for units in {INNER[q] for q in INNER} - {"g"} | {
        a["units"] for a in VARIABLES.values() if "units" in a
    }:
        frame = xr.Dataset({"it": ("time", np.ones(2), {"units": units})})
        with (
            tempfile.TemporaryDirectory() as folder,
            netCDF4.Dataset(to_netcdf(frame, Path(folder) / "u.nc")) as file,
        ):
            assert file["it"].units == units  # none of ours is banished to source_units


@pytest.mark.parametrize(("symbol", "hours"), [("N", 1.0), ("K", 3.0)])
def test_stored_coefficient_is_the_allan_deviation_at_its_reading_point(files, symbol, hours):
    with netCDF4.Dataset(files["product"]) as file:
        assert file[symbol].tau_ref == f"{hours:g} h"
        stored = file[symbol][:].compressed()
        assert stored.size > 50
        deviation = [np.sqrt(model_avar(hours * 3600.0, {symbol: value})) for value in stored]
        np.testing.assert_allclose(stored, deviation, rtol=1e-12)
        np.testing.assert_allclose(file[f"{symbol}_squared"][:].compressed(), stored**2)
        assert file[symbol].unit_label == LAWS[symbol].label
    assert np.sqrt(
        model_avar(hours * 3600.0, dict.fromkeys(TERMS, 0.0) | {symbol: 2.5})
    ) == pytest.approx(2.5)


@pytest.mark.parametrize(
    "units",
    [
        "deg/h",
        "degree hour-0.5",
        "degree hour^-0.5",
        "dph",
        "gal/min",
        "degree/sqrt(hour)",
        "0.1 arcsec/s",
        "K-1.5",
        "W/m K",
        "m/s-1",
    ],
)
def test_a_unit_that_udunits_refuses_or_misreads_is_not_written_as_units(tmp_path, units):
    frame = xr.Dataset({"it": ("time", np.ones(2), {"units": units})})
    path = to_netcdf(frame, tmp_path / "u.nc")
    with netCDF4.Dataset(path) as file:
        assert "units" not in file["it"].ncattrs()
        assert file["it"].source_units == units
    assert open_dataset(path)["it"].attrs["units"] == units


@pytest.mark.parametrize(("write", "name"), [(to_netcdf, "f.nc"), (to_zarr, "f.zarr")])
def test_flag_values_are_an_array_of_the_type_of_the_variable(tmp_path, write, name):
    attrs = {"flag_values": np.arange(2, dtype=np.int8), "flag_meanings": "no yes"}
    frame = xr.Dataset({"it": ("time", np.ones(2, np.int8), attrs)})
    write(frame, tmp_path / name)
    flags = open_dataset(tmp_path / name)["it"].attrs["flag_values"]
    assert isinstance(flags, np.ndarray)
    assert (flags.dtype, flags.tolist()) == (np.int8, [0, 1])


@pytest.mark.parametrize(
    ("units", "reference", "factor"),
    [
        ("bar", "Pa", 1e5),
        ("mbar", "Pa", 100.0),
        ("hPa", "Pa", 100.0),
        ("kPa", "Pa", 1e3),
        ("MPa", "Pa", 1e6),
        ("psi", "Pa", 6894.757),
        ("m/s", "m s-1", 1.0),
        ("m/s^2", "m s-2", 1.0),
        ("km/h", "m s-1", 1 / 3.6),
        ("L/min", "m3 s-1", 1e-3 / 60.0),
        ("mL", "m3", 1e-6),
        ("ms", "s", 1e-3),
        ("mm", "m", 1e-3),
        ("cm", "m", 1e-2),
        ("ft", "m", 0.3048),
        ("kN", "kg m s-2", 1e3),
        ("N/m", "kg s-2", 1.0),
        ("mV", "V", 1e-3),
        ("kV", "V", 1e3),
        ("A", "W V-1", 1.0),
        ("mA", "W V-1", 1e-3),
        ("ohm", "V2 W-1", 1.0),
        ("mW", "W", 1e-3),
        ("kW", "W", 1e3),
        ("mT", "T", 1e-3),
        ("nT", "T", 1e-9),
        ("kHz", "s-1", 1e3),
        ("rpm", "radian s-1", np.pi / 30.0),
    ],
)
def test_units_of_other_channels_are_written_as_udunits_reads_them(units, reference, factor):
    assert encode_attributes({"units": units}) == {"units": units}
    assert cf_units.Unit(units).convert(1.0, cf_units.Unit(reference)) == pytest.approx(factor)


@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    values=hnp.arrays(
        np.float64,
        hnp.array_shapes(min_dims=3, max_dims=3, max_side=4),
        elements=st.floats(allow_nan=True, allow_infinity=True),
    ),
    units=st.sampled_from([*INNER.values(), "degree2 hour-2", "rpm", "m s-2"]),
    stamps=st.lists(st.integers(-(2**62), 2**62), min_size=4, max_size=4, unique=True),
    notes=st.lists(
        st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=8),
        max_size=3,
    ),
    write=st.sampled_from([to_netcdf, to_zarr]),
)
def test_round_trip_of_anything(tmp_path, values, units, stamps, notes, write):
    times = np.sort(np.array(stamps[: values.shape[1]], dtype=np.int64)).view("datetime64[ns]")
    before = xr.Dataset(
        {
            "avar": (("axis", "time", "tau"), values, {"units": units}),
            "single": ("time", np.arange(values.shape[1], dtype=np.float32)),
        },
        coords={"time": times, "axis": [f"a{i}" for i in range(values.shape[0])]},
        attrs={
            "notes": notes,
            "arguments": {"window": 600.0, "gaps": None, "on": True},
            "samples": 5,
        },
    )
    assert_same(before, open_dataset(write(before, tmp_path / write.__name__, overwrite=True)))


@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    start=st.integers(-(2**60), 2**60),
    rate=st.sampled_from([300.0, 400.0, 99.3, 1.0, 1000 / 3, 0.1]),
    part=st.tuples(st.integers(0, 20), st.integers(30, 60), st.integers(1, 7)),
)
def test_computed_time_axis_comes_back_to_the_nanosecond(tmp_path, start, rate, part):
    whole = xr.Dataset(
        {"rate": (("axis", "time"), np.zeros((1, 60)), {"units": "degree hour-1"})},
        coords={"axis": ["x"]},
    )
    before = (
        whole.assign_coords(time_coordinate(start, rate, 60))
        .assign_attrs(sampling_rate_hz=rate)
        .isel(time=slice(*part))
    )
    after = open_log(to_netcdf(before, tmp_path / "grid.nc", overwrite=True))
    assert isinstance(after.xindexes["time"], TimeGridIndex)
    np.testing.assert_array_equal(
        after.time.values.view(np.int64), grid_times(start, rate, np.arange(60)[slice(*part)])
    )
    np.testing.assert_array_equal(after.time, before.time)


def test_a_log_cut_by_another_program_is_refused(tmp_path):
    path = to_netcdf(synthetic.log(), tmp_path / "log.nc", stamps=False)
    with xr.open_dataset(path, decode_times=False) as plain:
        plain.isel(time_index=slice(100, 200)).to_netcdf(tmp_path / "cut.nc")
    with pytest.raises(
        FormatError, match=r"cut\.nc: has 100 samples on 'time_index', but was written with 3000"
    ):
        open_log(tmp_path / "cut.nc")


def test_whole_microseconds_are_readable_by_num2date(tmp_path):
    path = to_netcdf(
        synthetic.log(rate=400.0, start=1_790_000_000_000_002_000),
        tmp_path / "log.nc",
        stamps=False,
    )
    with netCDF4.Dataset(path) as file:
        assert "time" not in file.variables
        start = file["time_start"]
        assert start.units.startswith("microseconds since")
        first = netCDF4.num2date(start[...], start.units, start.calendar)
        assert first.strftime("%Y-%m-%dT%H:%M:%S.%f") == "2026-09-21T14:13:20.000002"


def test_missing_time_is_refused(tmp_path):
    log = synthetic.log()
    log["gap_start"] = ("gap", np.array(["NaT"], "datetime64[ns]"))
    with pytest.raises(SchemaError, match=r"gap_start.*1 missing"):
        to_netcdf(log, tmp_path / "log.nc")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("write", [to_netcdf, to_zarr])
def test_differences_of_times_come_back_in_seconds(tmp_path, write):
    log = synthetic.log()
    elapsed = (log["time"] - log["time"][0]).values
    log["elapsed"] = ("time", np.where(elapsed == elapsed[1], np.timedelta64("NaT"), elapsed))
    log["elapsed"].attrs = {"long_name": "time since the start"}
    expected = elapsed.astype(np.int64) / 1e9
    expected[1] = np.nan
    for made in (log, log.chunk(time=50)):
        stored = open_dataset(write(made, tmp_path / "log", overwrite=True))["elapsed"]
        np.testing.assert_allclose(stored, expected, rtol=1e-15)
        assert stored.attrs == {"long_name": "time since the start", "units": "s"}


@pytest.mark.parametrize("kind", [np.float16, np.longdouble])
def test_numbers_of_a_type_that_netcdf_has_not_are_converted(tmp_path, kind):
    log = synthetic.log()
    values = np.arange(log.sizes["time"]) % 1000 / 8
    log["other"] = ("time", values.astype(kind), {"units": "1"})
    stored = open_dataset(to_netcdf(log, tmp_path / "log.nc"))["other"]
    np.testing.assert_array_equal(stored, values)


@pytest.mark.parametrize(
    "values", [np.full(3, 1j), pd.Categorical(list("aba")), pd.period_range("2026", periods=3)]
)
def test_values_that_files_cannot_hold_are_refused(tmp_path, values):
    log = synthetic.log().assign(other=("other_row", values))
    with pytest.raises(SchemaError, match=r"'other' holds values of type .*\.astype\(str\)"):
        to_netcdf(log, tmp_path / "log.nc")
    assert not list(tmp_path.iterdir())


def test_metadata_of_units_come_back_where_they_are_not_of_times(tmp_path):
    log = synthetic.log()
    log["change"] = log["temperature"].assign_attrs(units_metadata="temperature: difference")
    stored = open_dataset(to_netcdf(log, tmp_path / "log.nc", stamps=True))
    assert stored["change"].attrs["units_metadata"] == "temperature: difference"
    assert "units_metadata" not in stored["gap_start"].attrs


def test_a_lazy_log_is_never_held_whole(tmp_path):
    blocks = []

    def block(block_info=None):
        shape = block_info[None]["chunk-shape"]
        blocks.append(shape)
        return np.full(shape, float(len(blocks)))

    size = 9_000_000
    rate = da.map_blocks(
        block, chunks=((1, 1, 1), (450_000,) * 20), dtype=float, meta=np.empty((0, 0))
    )
    log = xr.Dataset(
        {"rate": (("axis", "time"), rate, {"units": "degree hour-1"})}, coords={"axis": list("xyz")}
    )
    log = log.assign_coords(time_coordinate(0, 300.0, size)).assign_attrs(sampling_rate_hz=300.0)
    import dask

    with dask.config.set(scheduler="synchronous"):
        tracemalloc.start()
        path = to_netcdf(log, tmp_path / "log.nc")
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert 60 <= len(blocks) <= 72  # a block is computed once, or twice where two stretches meet
    assert peak < 3 * size * 8
    with netCDF4.Dataset(path) as file:
        assert file["rate"].chunking()[0] == 1
    after = open_log(path)
    assert after.rate.chunks is not None
    assert int(after.time[-1].values.view(np.int64)) == int(grid_times(0, 300.0, size - 1))


def test_a_file_can_be_rewritten_from_itself(tmp_path, monkeypatch):
    path = to_netcdf(synthetic.product(), tmp_path / "p.nc")
    to_netcdf(open_product(path), path, overwrite=True)  # small variables are in memory
    assert_same(synthetic.product(), open_product(path))
    monkeypatch.setattr(read, "MIN_LAZY_VALUES", 0)
    with pytest.raises(OptionError, match=r"load the dataset first, with its load\(\)"):
        to_netcdf(open_product(path), path, overwrite=True)
    to_netcdf(open_product(path).load(), path, overwrite=True)
    assert_same(synthetic.product(), open_product(path))


def test_foreign_and_damaged_files(tmp_path, files):
    (tmp_path / "words.nc").write_text("time, gyro_x\n")
    (tmp_path / "half.nc").write_bytes(
        files["product"].read_bytes()[: files["product"].stat().st_size // 2]
    )
    (tmp_path / "store.zarr").mkdir()
    (tmp_path / "store.zarr" / "zarr.json").write_text("{")
    for name in ("words.nc", "half.nc", "store.zarr"):
        with pytest.raises(
            FormatError, match=rf"{name}: is not (NetCDF|Zarr), or is damaged or cut short"
        ):
            open_product(tmp_path / name)
    (tmp_path / "empty").mkdir()
    with pytest.raises(FormatError, match=r"empty: is a folder, not a Zarr store \([^)]*\)$"):
        open_product(tmp_path / "empty")
    with pytest.raises(FormatError, match=r"name a file in it: half\.nc, store\.zarr, words\.nc"):
        open_product(tmp_path)
    xr.Dataset({"sst": ("x", [1.0])}).to_netcdf(tmp_path / "sea.nc")
    for opener, kind in (
        (open_product, "a product"),
        (open_surface, "a DAVAR surface"),
        (open_log, "a regular log"),
    ):
        with pytest.raises(FormatError, match=f"sea.nc: does not hold {kind}"):
            opener(tmp_path / "sea.nc")
    with pytest.raises(FormatError, match=r"nothing\.nc: there is no such file"):
        open_log(tmp_path / "nothing.nc")


@pytest.mark.parametrize(
    ("kind", "opener"), [("surface", open_product), ("log", open_surface), ("product", open_log)]
)
def test_the_wrong_kind_is_named(files, kind, opener):
    with pytest.raises(FormatError, match=rf"holds a {kind}, not a .*; make one with 'gyrostab"):
        opener(files[kind])


def test_a_product_is_a_surface_too(files):
    assert "avar" in open_surface(files["product"])


def test_provenance(files):
    with netCDF4.Dataset(files["product"]) as file:
        assert file.history.splitlines()[0] == "2026-09-21T14:13:20Z read"
        assert "gyrostab" in file.history.splitlines()[1]
        assert file.source == "gyro log: bore_run_4a.csv, bore_run_4b.csv"
        assert json.loads(file.source_files) == ["bore_run_4a.csv", "bore_run_4b.csv"]
        assert file.title.startswith("Dynamic Allan variance")
        assert {"title", "summary", "keywords", "Conventions"} <= set(file.ncattrs())  # ACDD 1.3
        assert file.window_samples == 1800
        assert {
            "date_created",
            "gyrostab_version",
            "time_coverage_start",
            "time_coverage_end",
        } <= set(file.ncattrs())


def test_a_product_of_a_stored_surface_has_its_own_title_and_summary(tmp_path, files):
    product = synthetic.product().assign_attrs(open_surface(files["surface"]).attrs)
    attrs = open_product(to_netcdf(product, tmp_path / "p.nc")).attrs
    assert attrs["title"].endswith("Q, N, B, K and R of every window")
    assert "five noise terms" in attrs["summary"]
    given = {"title": "Run 7", "summary": "Oven test.", "keywords": "oven"}
    named = open_product(to_netcdf(product.assign_attrs(given), tmp_path / "n.nc"))
    assert given.items() <= named.attrs.items()


def test_attributes_of_the_schema_reach_the_file(files):
    with netCDF4.Dataset(files["product"]) as file:
        for name in ("avar", "edf", "N", "K_upper", "observable"):
            for key, value in attributes(name).items():
                np.testing.assert_array_equal(file[name].getncattr(key), value)


def test_a_flipped_bit_is_noticed(tmp_path):
    """Each compressed chunk has the checksum of zlib: a damaged copy is refused."""
    path = to_netcdf(synthetic.product(windows=400), tmp_path / "product.nc")
    data = path.read_bytes()
    with h5py.File(path) as stored:
        chunks = [stored[name].id.get_chunk_info(0) for name in ("avar", "N", "temperature")]
    for chunk in chunks:
        place = chunk.byte_offset + chunk.size // 2
        path.write_bytes(data[:place] + bytes([data[place] ^ 0x10]) + data[place + 1 :])
        with pytest.raises(FormatError, match=r"product\.nc: is damaged"):
            open_product(path).load()


@pytest.mark.parametrize("lazy", [False, True])
def test_chunks_that_threads_compress_are_those_of_the_library(tmp_path, monkeypatch, lazy):
    product = synthetic.product()
    product["avar"][0, 1, 2] = np.nan
    monkeypatch.setattr(export, "CHUNK_VALUES", 50)  # several chunks, the last of them not full
    monkeypatch.setattr(write, "_MIN_LARGE_VALUES", 10**9)
    by_library = to_netcdf(product, tmp_path / "library.nc")
    monkeypatch.setattr(write, "_MIN_LARGE_VALUES", 1)
    by_threads = to_netcdf(
        product.chunk({"axis": 1, "time": 3}) if lazy else product, tmp_path / "threads.nc"
    )
    with netCDF4.Dataset(by_library) as expected, netCDF4.Dataset(by_threads) as threaded:
        assert set(threaded.variables) == set(expected.variables)
        for name, reference in expected.variables.items():
            other = threaded[name]
            assert str({key: reference.getncattr(key) for key in reference.ncattrs()}) == str(
                {key: other.getncattr(key) for key in other.ncattrs()}
            )
            assert (reference.dtype, reference.dimensions, reference.chunking()) == (
                other.dtype,
                other.dimensions,
                other.chunking(),
            )
            assert reference.filters() == other.filters()
    multichunk = 0
    with h5py.File(by_library) as expected, h5py.File(by_threads) as threaded:
        for name in product.data_vars:
            reference, other = expected[name].id, threaded[name].id
            if expected[name].chunks is None:
                continue
            multichunk += reference.get_num_chunks() > 1
            assert reference.get_num_chunks() == other.get_num_chunks()
            for place in (
                reference.get_chunk_info(number).chunk_offset
                for number in range(reference.get_num_chunks())
            ):
                assert reference.read_direct_chunk(place) == other.read_direct_chunk(place)
    assert multichunk > 5


@pytest.mark.parametrize("kind", [">f8", ">f4", ">i2", ">i4"])
@pytest.mark.parametrize("form", ["nc", "zarr"])
@pytest.mark.filterwarnings("error:endian-ness")
def test_large_data_of_the_other_byte_order_come_back(tmp_path, kind, form):
    writer = to_netcdf if form == "nc" else to_zarr
    values = np.arange(40_000).astype(kind)
    channel = ("time", values, {"units": "V"})
    if np.dtype(kind).kind == "f":
        log = make_log(values.astype("f8"), rate=100.0, unit="deg/h")
        log["rate"] = (log.rate.dims, values[None, :], log.rate.attrs)
    else:
        log = make_log(values, rate=100.0, unit="deg/h")
    log["channel"] = channel
    with open_log(writer(log, tmp_path / f"log.{form}")) as back:
        np.testing.assert_array_equal(back.rate.values[0], values)
        np.testing.assert_array_equal(back.channel.values, values)


@pytest.mark.parametrize("write", [to_netcdf, to_zarr])
def test_lazy_numbers_and_arrays_in_attributes_can_be_written(tmp_path, write):
    log = make_log(np.arange(40_000.0), rate=100.0, unit="deg/h").chunk(time=10_000)
    log["mean"] = log.rate.mean()
    log.rate.attrs["valid_range"] = np.array([-1e5, 1e5])
    with open_log(write(log, tmp_path / "log")) as back:
        assert float(back["mean"]) == float(log["mean"])
        np.testing.assert_array_equal(back.rate.attrs["valid_range"], [-1e5, 1e5])


@pytest.mark.parametrize("write", [to_netcdf, to_zarr])
def test_values_of_numpy_in_attributes_can_be_written(tmp_path, write):
    attributes = {
        "installed": (np.datetime64("2026-01-01T06:00", "s"), "2026-01-01T06:00:00"),
        "serviced": (np.array(["2026-01-01"], "M8[D]"), ["2026-01-01"]),
        "is_used": (np.array([True, False]), [True, False]),
        "matrix": (np.eye(2), [[1.0, 0.0], [0.0, 1.0]]),
        "mixed": (np.array(["a", 1], dtype=object), ["a", 1]),
        "half": (np.array([0.5], np.float16), [0.5]),
        "long": (2**70, 2**70),
        "unsigned": (np.uint64(2**63 + 5), 2**63 + 5),
    }
    log = make_log(np.arange(3.0), rate=10.0, unit="deg/h")
    log["pressure"] = ("time", np.arange(3, dtype=np.float16), {"units": "Pa"})
    log.attrs |= {name: value for name, (value, _) in attributes.items()}
    log["pressure"].attrs |= {name: value for name, (value, _) in attributes.items()}
    with open_log(write(log, tmp_path / "log")) as back:
        for attrs in (back.attrs, back["pressure"].attrs):
            assert {name: attrs[name] for name in attributes} == {
                name: expected for name, (_, expected) in attributes.items()
            }
        np.testing.assert_array_equal(back["pressure"], [0.0, 1.0, 2.0])


@pytest.mark.parametrize("write", [to_netcdf, to_zarr])
def test_attributes_of_a_packed_variable_do_not_change_its_numbers(tmp_path, write):
    """As where netCDF4 has scaled the values, and its attributes are copied."""
    packing = {
        "scale_factor": 0.01, "add_offset": 3.0, "_FillValue": 5, "missing_value": 5.0,
        "_Unsigned": "true",
    }  # fmt: skip
    time = pd.date_range("2026-01-01", periods=4, freq="10ms")
    coords = {"time": ("time", time, packing)}
    data = xr.DataArray([1.0, 5.0, -2.0, 4.0], coords, dims="time")
    log = from_dataarray(data.assign_attrs(units="deg/h", comment="raw", **packing))
    log["temperature"] = ("time", [20.0, 5.0, 21.0, 5.0], {"units": "degree_Celsius", **packing})
    path = write(log, tmp_path / ("log.nc" if write is to_netcdf else "log.zarr"))
    engine = "netcdf4" if write is to_netcdf else "zarr"
    with xr.open_dataset(path, engine=engine) as plain, open_log(path) as back:
        for opened in (plain, back):
            np.testing.assert_array_equal(opened["rate"].values, [[1.0, 5.0, -2.0, 4.0]])
            np.testing.assert_array_equal(opened["temperature"].values, [20.0, 5.0, 21.0, 5.0])
            np.testing.assert_array_equal(opened["time"].values, time)
        assert back["rate"].attrs["comment"] == "raw"


@pytest.mark.parametrize("write", [to_netcdf, to_zarr])
def test_names_of_attributes_may_hold_blanks(tmp_path, write):
    attrs = {"tool info": ["a", "b"], "info": "run 7"}
    path = write(synthetic.log().assign_attrs(attrs), tmp_path / "log")
    with open_log(path) as back:
        assert {name: back.attrs[name] for name in attrs} == attrs


def test_names_of_attributes_of_an_earlier_version_are_read(tmp_path):
    path = to_netcdf(synthetic.log().assign_attrs(info=["a"]), tmp_path / "log.nc")
    with netCDF4.Dataset(path, "a") as file:
        file.json_attributes = " ".join(json.loads(file.json_attributes))
    with open_log(path) as back:
        assert back.attrs["info"] == ["a"]
