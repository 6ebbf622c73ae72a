"""Logs and products at addresses: in memory, and on local servers that speak S3 and GCS."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from gyrostab import make_log
from gyrostab.cli import main
from gyrostab.errors import FormatError, OptionError, OutputError
from gyrostab.io.datasets import to_netcdf, to_zarr
from gyrostab.io.opening import open_log, open_product
from gyrostab.jobs.run import load_log, run
from gyrostab.store.lazy import find_source
from gyrostab.store.remote import find_url, upload

fsspec = pytest.importorskip("fsspec")
WINDOWS = {"window": "60s", "step": "60s", "taus": "8"}


def make_counts(count: int = 140_000):
    """A log of counts of 0.01 deg/h with a gap and a temperature."""
    values = np.round(np.random.default_rng(1).standard_normal((1, count)) * 8.0, 2)
    values[:, 5_000:7_000] = np.nan
    log = make_log(values, rate=50.0, unit="deg/h", start="2026-05-01")
    log["temperature"] = ("time", 20 + np.arange(count) / 1e5, {"units": "degree_Celsius"})
    log["rate"].encoding = {"dtype": "i2", "scale_factor": 0.01}
    return log


@pytest.fixture(scope="module")
def log():
    return make_counts()


@pytest.fixture(scope="module")
def local(log, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("local")
    to_zarr(log, folder / "log.zarr")
    return run([folder / "log.zarr"], folder / "product.nc", windows=WINDOWS)


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    memory = fsspec.filesystem("memory")
    memory.store.clear()
    memory.pseudo_dirs[:] = [""]


def assert_same_values(left, right) -> None:
    with open_product(left) as a, open_product(right) as b:
        xr.testing.assert_equal(a, b)


@pytest.mark.parametrize("stamps", [pytest.param(True, marks=pytest.mark.full), False])
def test_logs_and_products_in_memory_have_the_bits_of_local_ones(stamps, log, local):
    to_zarr(log, "memory://archive/log.zarr", stamps=stamps)
    opened = open_log("memory://archive/log.zarr")
    assert find_source(opened["rate"].data) is not None  # read chunk by chunk
    np.testing.assert_array_equal(opened["rate"].values, log["rate"].values)
    run(["memory://archive/*.zarr"], "memory://results/product.zarr", windows=WINDOWS)
    assert_same_values("memory://results/product.zarr", local)
    with pytest.warns(UserWarning, match="is complete already"):
        run(
            ["memory://archive/*.zarr"],
            "memory://results/product.zarr",
            windows=WINDOWS,
            resume=True,
        )
    assert not list(Path().iterdir())  # the job folder is removed


@pytest.mark.full
@pytest.mark.parametrize("bucket", ["s3_bucket", "gs_bucket"])
def test_commands_read_and_write_a_bucket(bucket, request, log, local, capsys):
    bucket = request.getfixturevalue(bucket)
    to_zarr(log, f"{bucket}/log.zarr")
    options = [part for name, value in WINDOWS.items() for part in (f"--{name}", value)]
    product = f"{bucket}/product.zarr"
    call = ["run", f"{bucket}/log.zarr", "-o", product, *options, "--quiet-progress"]
    assert main(call) == 0
    assert capsys.readouterr().out.splitlines()[-1] == product
    assert_same_values(product, local)
    assert main([*call, "--overwrite"]) == 2
    assert "nothing at an address is replaced" in capsys.readouterr().err
    assert main(["run", f"{bucket}/none.zarr", "-o", "a.nc"]) == 2
    assert "none.zarr: there is no such object; check the bucket" in capsys.readouterr().err
    assert (
        main(["run", bucket.replace("archive", "no-such-bucket") + "/log.zarr", "-o", "a.nc"]) == 2
    )
    assert "there is no such object; check the bucket" in capsys.readouterr().err
    assert not list(Path().iterdir())


def test_an_interrupted_upload_leaves_nothing_that_opens(log, monkeypatch):
    memory = type(fsspec.filesystem("memory"))
    put, calls = memory.put, []

    def fail_at_the_end(self, *arguments, **options):
        calls.append(arguments)
        if len(calls) == 2:
            raise OSError("the network is down")
        return put(self, *arguments, **options)

    monkeypatch.setattr(memory, "put", fail_at_the_end)
    with pytest.raises(OutputError, match="network is down"):
        to_zarr(log, "memory://archive/cut.zarr")
    with pytest.raises(FormatError, match="is not a Zarr store"):
        open_log("memory://archive/cut.zarr")
    with pytest.raises(FormatError, match="is a folder, not a Zarr store"):
        load_log(["memory://archive/cut.zarr"])
    to_zarr(log, "memory://archive/cut.zarr")
    assert open_log("memory://archive/cut.zarr").sizes == log.sizes


def test_files_of_other_formats_are_copied_and_read(log, tmp_path, serve_folder):
    to_netcdf(log, tmp_path / "log.nc")
    (tmp_path / "rows.csv").write_text("time [s],gyro_x [deg/h]\n0,1\n1,2\n2,3\n")
    address = serve_folder(tmp_path)
    assert load_log([f"{address}/rows.csv"]).rate.values.tolist() == [[1, 2, 3]]
    stored = load_log([f"{address}/log.nc"])
    np.testing.assert_array_equal(stored["rate"].values, log["rate"].values)
    assert stored.attrs["source_files"] == ["log.nc"]
    (tmp_path / "rows.csv").write_text("time [s],gyro_x [deg/h]\n0,1\n1,2\n2,3\n3,4\n")
    assert load_log([f"{address}/rows.csv"]).rate.values.tolist() == [[1, 2, 3, 4]]
    with pytest.raises(FormatError, match="no such object"):
        load_log([f"{address}/none.csv"])


def test_scan_prints_addresses_as_they_were_given(log, tmp_path, serve_folder, capsys):
    to_netcdf(log, tmp_path / "log.nc")
    address = f"{serve_folder(tmp_path)}/log.nc"
    assert main(["scan", address]) == 0
    shown = capsys.readouterr()
    assert shown.out.splitlines()[1].startswith(f"{address}\t")
    assert f"gyrostab run {address} -o " in shown.err


def test_what_cannot_be_done_is_said(log, monkeypatch):
    with pytest.raises(OutputError, match=r"only a Zarr store \(.zarr\) is written"):
        to_netcdf(log, "memory://archive/log.nc")
    with pytest.raises(FormatError, match="never:// is not known"):
        load_log(["never://archive/log.zarr"])
    with pytest.raises(FormatError, match="no file fits this pattern"):
        load_log(["memory://archive/*.zarr"])
    fsspec.filesystem("memory").pipe("/archive/other.zarr/.zgroup", b'{"zarr_format": 2}')
    with pytest.raises(FormatError, match="is a Zarr store of another program"):
        load_log(["memory://archive/other.zarr"])
    loaded = sys.modules["fsspec.registry"]._registry
    monkeypatch.delitem(loaded, "gs", raising=False)  # loaded by another test
    monkeypatch.setitem(sys.modules, "gcsfs", None)
    with pytest.raises(OptionError, match=r"pip install 'gyrostab\[gcs\]'"):
        load_log(["gs://archive/log.zarr"])
    assert main(["watch", "in", "-o", "memory://archive/a.zarr"]) == 2


def test_credentials_that_are_missing_are_said(monkeypatch):
    def refuse(*_, **__):
        raise PermissionError("Unable to locate credentials")

    monkeypatch.setattr(type(fsspec.filesystem("memory")), "exists", refuse)
    with pytest.raises(FormatError, match="access was refused, or no credentials were found"):
        load_log(["memory://archive/log.zarr"])


def test_a_failed_block_uploads_nothing():
    def fail():
        with upload("memory://archive/a.zarr") as folder:
            (folder / ".zgroup").write_text("{}")
            raise ValueError("stop")

    with pytest.raises(ValueError, match="stop"):
        fail()
    assert not fsspec.filesystem("memory").exists("/archive/a.zarr")


@pytest.mark.parametrize(
    ("path", "url"),
    [("s3://b/c", "s3://b/c"), (Path("https://h/a b.csv"), "https://h/a b.csv"), ("a/b:/c", None)],
)
def test_addresses_are_found_in_paths(path, url):
    assert find_url(path) == url


def test_a_run_over_an_address_returns_large_arrays(tmp_path, monkeypatch):
    """Chunks arrive in new arrays, which glibc would keep."""
    called = []
    monkeypatch.setattr("gyrostab.jobs.run.return_large_arrays", lambda: called.append(True))
    log = make_log(np.zeros((1, 600)), rate=10.0, unit="deg/h", start="2026-01-01")
    to_zarr(log, tmp_path / "log.zarr")
    to_zarr(log, "memory://archive/returned.zarr")
    run([tmp_path / "log.zarr"], tmp_path / "local.nc", windows={"window": "20s"})
    assert not called
    run(["memory://archive/returned.zarr"], tmp_path / "remote.nc", windows={"window": "20s"})
    assert called
