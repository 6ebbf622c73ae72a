"""The engine and the accessor: the same data and results as the functions of gyrostab."""

from __future__ import annotations

import pickle
import subprocess
import sys
import tomllib
import warnings
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import gyrostab
from gyrostab.errors import FormatError, OptionError, SchemaError
from gyrostab.io.datasets import to_netcdf, to_zarr
from gyrostab.io.opening import open_log, open_product, open_surface
from gyrostab.store import read
from gyrostab.store.private import is_in_memory
from gyrostab.time.grid import TimeGridIndex
from gyrostab.xarray import GyrostabBackend
from tests.support import synthetic

WRITERS = {"nc": to_netcdf, "zarr": to_zarr}
ROOT = Path(__file__).resolve().parents[1]
#: Samples of a log of several chunks.
LONG = 150_000


def long_log() -> xr.Dataset:
    counts = np.random.default_rng(1).integers(-3000, 3000, (2, LONG), dtype=np.int16)
    return gyrostab.make_log(counts, rate=10.0, unit="0.1 deg/h", start="2026-01-01")


CASES = {
    "log": (synthetic.log, open_log),
    "long": (long_log, open_log),
    "surface": (lambda: gyrostab.davar(long_log(), window="600s", taus="octave"), open_surface),
    "product": (synthetic.product, open_product),
}


@pytest.fixture(scope="module", params=[(name, form) for name in CASES for form in WRITERS])
def case(request, tmp_path_factory):
    """A file, and the function of gyrostab that opens it."""
    name, form = request.param
    make, opener = CASES[name]
    return WRITERS[form](make(), tmp_path_factory.mktemp(name) / f"{name}.{form}"), opener


def test_the_entry_point_names_the_class():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["entry-points"]["xarray.backends"] == {
        "gyrostab": "gyrostab.xarray:GyrostabBackend"
    }
    assert type(xr.backends.list_engines()["gyrostab"]) is GyrostabBackend


@pytest.mark.parametrize("chunks", [None, {}, {"time": 1000}])
@pytest.mark.filterwarnings("ignore:The specified chunks separate the stored chunks")
def test_the_engine_opens_what_gyrostab_opens(case, chunks):
    path, opener = case
    with xr.open_dataset(path, engine="gyrostab", chunks=chunks) as opened, opener(path) as own:
        assert opened.sizes == own.sizes
        lazy = [name for name in own if own[name].chunks]
        assert all((opened[name].chunks is None) is (chunks is None) for name in lazy)
        xr.testing.assert_identical(opened.compute(), own.compute())
        assert isinstance(opened.xindexes["time"], type(own.xindexes["time"]))
        if chunks == {}:
            assert all(opened[name].chunks == own[name].chunks for name in lazy)


@pytest.mark.parametrize("form", WRITERS)
def test_only_the_chunks_of_a_selection_are_read(tmp_path, form, monkeypatch):
    log, done = long_log(), []
    path = WRITERS[form](log, tmp_path / f"log.{form}")

    def count(path, name, place, **options):
        done.append((name, place))
        return read_chunk(path, name, place, **options)

    read_chunk = read.read_chunk
    monkeypatch.setattr(read, "read_chunk", count)
    with xr.open_dataset(path, engine="gyrostab") as opened:
        assert not done
        assert not is_in_memory(opened.rate.variable)
        part = opened.rate.sel(axis="y", time="2026-01-01T02:00:00")
        assert float(part) == float(log.rate[1, 72_000])
        assert done == [("rate", (1, 1))]
        for key in (np.s_[0, ::-30_000], np.s_[:, [5, 140_000, 1]], np.s_[1, 10:20:3]):
            np.testing.assert_array_equal(opened.rate[key].values, log.rate[key].values)


@pytest.mark.parametrize("opened", ["gyrostab", "netcdf4"])
def test_davar_reads_lazy_variables_in_parts(tmp_path, opened):
    log = long_log()
    with xr.open_dataset(to_netcdf(log, tmp_path / "log.nc"), engine=opened) as dataset:
        surface = gyrostab.davar(dataset, window="600s", taus="octave")
        assert not is_in_memory(dataset.rate.variable)
    xr.testing.assert_equal(surface, gyrostab.davar(log, window="600s", taus="octave"))


@pytest.mark.parametrize(("form", "engine"), [("nc", "netcdf4"), ("zarr", "zarr")])
def test_xarray_opens_files_with_its_own_engines(tmp_path, form, engine):
    path = WRITERS[form](synthetic.log(), tmp_path / f"log.{form}")
    assert not GyrostabBackend().guess_can_open(path)
    with xr.open_dataset(path) as guessed, xr.open_dataset(path, engine=engine) as expected:
        xr.testing.assert_identical(guessed, expected)
        assert not isinstance(guessed.xindexes["time"], TimeGridIndex)


def test_several_logs_are_one(tmp_path):
    log = long_log()
    paths = [
        to_netcdf(log.isel(time=part), tmp_path / f"{number}.nc")
        for number, part in enumerate((slice(0, 70_000), slice(70_000, None)))
    ]
    with xr.open_mfdataset(paths, engine="gyrostab", combine="nested", concat_dim="time") as opened:
        assert isinstance(opened.xindexes["time"], TimeGridIndex)
        np.testing.assert_array_equal(opened.rate.values, log.rate.values)
        np.testing.assert_array_equal(opened.time.values, log.time.values)


def test_options_of_the_engine(tmp_path):
    path = to_zarr(long_log(), tmp_path / "log.zarr")
    with xr.open_dataset(path, engine="gyrostab", drop_variables=["rate", "none"]) as opened:
        assert "rate" not in opened
    (path / "rate" / "0.1").write_bytes(b"damaged")
    with xr.open_dataset(path, engine="gyrostab", strict=True) as opened:
        assert np.isfinite(opened.rate[1]).all()
        with pytest.raises(FormatError, match=r"axis x: the chunk from .* is damaged"):
            opened.rate.load()


def test_a_dataset_of_the_engine_can_be_sent_to_another_process(tmp_path):
    log = long_log()
    with xr.open_dataset(to_netcdf(log, tmp_path / "log.nc"), engine="gyrostab") as opened:
        sent = pickle.loads(pickle.dumps(opened))
    np.testing.assert_array_equal(sent.rate[:, -5:].values, log.rate[:, -5:].values)


@pytest.mark.parametrize("chunks", [None, {}])
@pytest.mark.parametrize("form", WRITERS)
def test_what_the_engine_opened_can_be_written(tmp_path, form, chunks):
    path = WRITERS[form](long_log(), tmp_path / f"log.{form}")
    with xr.open_dataset(path, engine="gyrostab", chunks=chunks) as opened:
        copy = WRITERS[form](opened, tmp_path / f"again.{form}")
        with pytest.raises(OptionError, match="is also an input"):
            WRITERS[form](opened, path, overwrite=True)
    with open_log(path) as original, open_log(copy) as other:
        xr.testing.assert_equal(original.compute(), other.compute())


@pytest.mark.parametrize("source", ["open_log", "engine", "make_log", "read_log"])
@pytest.mark.parametrize("form", WRITERS)
def test_gaps_of_counts_stay_gaps_where_xarray_writes_them(tmp_path, form, source):
    log = long_log().isel(time=slice(5000))
    log["rate"][0, 7] = np.nan
    if source in ("open_log", "engine"):
        path = WRITERS[form](log, tmp_path / f"log.{form}")
        log = open_log(path) if source == "open_log" else xr.open_dataset(path, engine="gyrostab")
    elif source == "read_log":
        for part in (range(1000), range(1010, 2000)):
            rows = "".join(f"{i / 10},{i}\n" for i in part)
            (tmp_path / f"{part[0]}.csv").write_text(f"time [s],gyro_x [deg/h]\n{rows}")
        log = gyrostab.regularise(gyrostab.read_log(tmp_path / "*.csv"))
    copy = tmp_path / f"copy.{form}"
    log.to_zarr(copy, zarr_format=2) if form == "zarr" else log.to_netcdf(copy)
    with xr.open_dataset(copy) as plain, open_log(copy) as back:
        assert plain.rate.encoding["dtype"].kind == "i"
        assert np.isnan(plain.rate).any()
        np.testing.assert_array_equal(plain.rate.values, log.rate.values)
        np.testing.assert_array_equal(back.rate.values, log.rate.values)


@pytest.mark.parametrize("form", WRITERS)
@pytest.mark.parametrize("name", ["product", "surface"])
def test_what_xarray_wrote_is_opened(tmp_path, form, name):
    make, opener = CASES[name]
    data, path = make(), tmp_path / f"data.{form}"
    data.to_zarr(path) if form == "zarr" else data.to_netcdf(path)
    with opener(path) as own, xr.open_dataset(path, engine="gyrostab") as opened:
        xr.testing.assert_equal(own.compute(), data)
        xr.testing.assert_equal(opened.compute(), data)


def test_other_files_are_refused(tmp_path):
    xr.Dataset({"a": ("x", [1.0])}).to_netcdf(tmp_path / "other.nc")
    with pytest.raises(FormatError, match=r"other\.nc: holds no log, surface or product"):
        xr.open_dataset(tmp_path / "other.nc", engine="gyrostab")
    (tmp_path / "log.csv").write_text("time [s],gyro_x [deg/h]\n0,1\n1,2\n", encoding="utf-8")
    with pytest.raises(FormatError, match=r"log\.csv: is a text file; gyrostab\.read_log reads"):
        xr.open_dataset(tmp_path / "log.csv", engine="gyrostab")
    with pytest.raises(FormatError, match="there is no such file"):
        xr.open_dataset(tmp_path / "nothing.nc", engine="gyrostab")
    (tmp_path / "fleet.zarr").mkdir()
    for name in ("nothing", "other.nc", "fleet.zarr"):
        with pytest.raises(FormatError, match=f"{name}: not a folder with products"):
            xr.open_datatree(tmp_path / name, engine="gyrostab")
    with pytest.raises(FormatError, match=r"other\.nc: holds no log"):
        xr.open_datatree(tmp_path, engine="gyrostab")


# ------------------------------------------------------------------------------
# accessor


def test_the_accessor_calls_the_functions(tmp_path):
    log = long_log()
    surface = gyrostab.davar(log, window="600s", taus="octave")
    product = gyrostab.fit_noise(surface, terms="QNB")
    xr.testing.assert_identical(log.gyro.davar(window="600s", taus="octave"), surface)
    xr.testing.assert_identical(
        log.rate.gyro.davar(window="600s", taus="octave").avar, surface.avar
    )
    xr.testing.assert_identical(surface.gyro.fit(terms="QNB"), product)
    xr.testing.assert_identical(
        log.gyro.fit(window="600s", taus="octave"), gyrostab.fit_noise(surface)
    )
    fitted = log.gyro.fit(window="600s", taus="octave", terms="QNB")
    xr.testing.assert_identical(fitted, product)
    assert [repr(data.gyro).split(":")[0] for data in (log, log.rate, surface, product)] == [
        "<gyrostab log", "<gyrostab log", "<gyrostab surface", "<gyrostab product",
    ]  # fmt: skip


def test_the_accessor_draws_what_it_is_given():
    log, surface = synthetic.log(), synthetic.product()
    for data, function in (
        (log, gyrostab.plot_signal),
        (log.rate, gyrostab.plot_signal),
        (surface.drop_vars("observable"), gyrostab.plot_davar),
        (surface, gyrostab.plot_coefficients),
    ):
        labels = [
            [panel.get_ylabel() for panel in draw.axes]
            for draw in (data.gyro.plot(), function(data))
        ]
        assert labels[0] == labels[1] != []
    assert len(surface.gyro.plot(axis="x").axes) < len(surface.gyro.plot().axes) + 1


def test_the_accessor_explains_what_it_cannot_do():
    with pytest.raises(SchemaError, match="holds either 'rate' or 'angle'"):
        xr.Dataset({"a": ("x", [1.0])}).gyro.davar()
    product = synthetic.product()
    assert repr(product.N.gyro).startswith("<gyrostab coefficient: axis")
    with pytest.raises(SchemaError, match=r"this is angle random walk .* by window, not a gyro"):
        product.N.gyro.plot()


@pytest.mark.parametrize(
    "code",
    [
        "import xarray as xr; import gyrostab",
        "import gyrostab; import xarray as xr; gyrostab.make_log",
        "import xarray as xr; import gyrostab.xarray",
        "import gyrostab; import xarray as xr; xr.backends.list_engines()",
    ],
)
def test_the_accessor_is_registered(code):
    done = subprocess.run(
        [sys.executable, "-c", f"{code}; print(hasattr(xr.Dataset(), 'gyro'))"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout == "True\n"


def test_looking_for_an_engine_loads_no_other_module():
    done = subprocess.run(
        [
            sys.executable,
            "-c",
            "import sys, xarray; xarray.backends.list_engines(); "
            "print(sorted(name for name in sys.modules if name.startswith('gyrostab')))",
        ],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout == "['gyrostab', 'gyrostab.xarray']\n"


def test_log_and_product_in_an_object_store(tmp_path: Path) -> None:
    fsspec = pytest.importorskip("fsspec")
    draw = np.random.default_rng(5)
    log = gyrostab.make_log(draw.standard_normal((2, 60_000)), rate=100.0, unit="deg/h")
    store = fsspec.filesystem("memory")
    store.put(str(to_zarr(log, tmp_path / "log.zarr")), "/archive/log.zarr", recursive=True)
    remote = xr.open_zarr("memory://archive/log.zarr")
    assert remote.rate.chunks is not None
    options = {"window": "60s", "step": "30s"}
    product = gyrostab.fit_noise(gyrostab.davar(remote, **options))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # zarr: strings and consolidated metadata in format 3
        product.to_zarr("memory://archive/product.zarr")
    expected = gyrostab.fit_noise(gyrostab.davar(log, **options))
    stored = xr.open_zarr("memory://archive/product.zarr")
    for name in ("avar", "N", "N_stderr"):
        np.testing.assert_array_equal(stored[name], expected[name])
