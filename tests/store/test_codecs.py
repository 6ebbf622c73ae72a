"""Codecs that a Zarr store names: those that restore objects, and could run code, are not used."""

from __future__ import annotations

import json
import pickle
import tracemalloc
from pathlib import Path

import numcodecs
import numpy as np
import pytest
import xarray as xr

from gyrostab import make_log, open_log, read_log, scan, to_zarr
from gyrostab.errors import FormatError
from gyrostab.store.layout import find_zarr_codecs

PICKLE = {"id": "pickle"}
VALUES = np.arange(600.0)[None, :]


class Touch:
    """An object that makes a file when it is restored."""

    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self):
        return (Path.touch, (self.path,))


def use_codecs(path: Path, changes: dict[str, object], *, consolidated: bool) -> None:
    """Change the metadata of the rate; without those of the store, if `consolidated` is false."""
    layout = path / "rate" / ".zarray"
    layout.write_text(json.dumps({**json.loads(layout.read_text()), **changes}))
    if not consolidated:
        (path / ".zmetadata").unlink()


@pytest.mark.parametrize("call", [scan, read_log, lambda path: open_log(path)["rate"].values])
@pytest.mark.parametrize(
    ("changes", "consolidated"),
    [
        ({"compressor": PICKLE, "filters": None}, True),
        ({"compressor": None, "filters": [PICKLE]}, True),
        ({"compressor": PICKLE, "filters": None}, False),
        (
            {"compressor": PICKLE, "filters": [{"id": "vlen-utf8"}], "dtype": "|O"}
            | {"fill_value": None},
            False,
        ),
    ],
)
def test_no_codec_that_restores_objects_is_used(tmp_path, monkeypatch, changes, consolidated, call):
    """Whatever numcodecs allows, and also where the metadata of the store name other codecs."""
    monkeypatch.setattr("numcodecs.pickles.ALLOW_UNSAFE_PICKLE_DECODE", True, raising=False)
    path = to_zarr(make_log(VALUES, rate=10.0, unit="deg/h"), tmp_path / "log.zarr")
    use_codecs(path, changes, consolidated=consolidated)
    (path / "rate" / "0.0").write_bytes(pickle.dumps(Touch(tmp_path / "touched")))
    with pytest.raises(FormatError) as refusal:
        call(path)
    assert not (tmp_path / "touched").exists()
    assert "ALLOW" not in str(refusal.value)


def test_the_codec_that_is_refused_is_named(tmp_path):
    path = to_zarr(make_log(VALUES, rate=10.0, unit="deg/h"), tmp_path / "log.zarr")
    codecs = {"compressor": PICKLE, "filters": [{"id": "vlen-utf8"}]}
    use_codecs(path, {**codecs, "dtype": "|O", "fill_value": None}, consolidated=False)
    with pytest.raises(FormatError, match=r"log\.zarr: rate is stored with the codec 'pickle'"):
        open_log(path)


@pytest.mark.parametrize(
    "codecs",
    [
        {"compressors": numcodecs.Zstd(3)},
        {"compressors": numcodecs.LZ4()},
        {"compressors": numcodecs.GZip(), "filters": [numcodecs.Delta("<f8")]},
        {"compressors": numcodecs.Blosc(), "filters": [numcodecs.Fletcher32()]},
        {"compressors": None},
    ],
)
def test_a_log_that_another_program_compressed_is_read(tmp_path, codecs):
    path = to_zarr(make_log(VALUES, rate=10.0, unit="deg/h"), tmp_path / "log.zarr")
    with xr.open_dataset(path, engine="zarr") as plain:
        plain = plain.load().drop_encoding()
    plain.to_zarr(tmp_path / "copy.zarr", encoding={"rate": codecs}, zarr_format=2)
    with open_log(tmp_path / "copy.zarr") as log:
        np.testing.assert_array_equal(log["rate"].values, VALUES)


@pytest.mark.parametrize(
    "codec", [numcodecs.Zlib(9), numcodecs.Zstd(9), numcodecs.Blosc("zstd", clevel=9)]
)
def test_a_chunk_that_grows_beyond_its_size_takes_no_memory(tmp_path, codec):
    path = to_zarr(make_log(VALUES, rate=10.0, unit="deg/h"), tmp_path / "log.zarr")
    changes = {"compressor": codec.get_config(), "filters": None}
    use_codecs(path, changes, consolidated=True)
    n_bytes = 32 << 20
    (path / "rate" / "0.0").write_bytes(codec.encode(np.zeros(n_bytes, np.uint8)))
    with open_log(path) as log:
        tracemalloc.start()
        with pytest.warns(UserWarning, match="more than the 4800 bytes of a chunk"):
            assert np.isnan(log["rate"].values).all()
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert peak < n_bytes / 4


@pytest.mark.parametrize("count", [1, 200, 256, 257, 65_792, 2_000_000])
def test_zstandard_content_of_every_length_is_read(count):
    (codec,) = find_zarr_codecs({"compressor": numcodecs.Zstd(1).get_config(), "filters": None})
    values = np.arange(count, dtype=np.uint8)
    packed = numcodecs.Zstd(1).encode(values)
    for data in (packed, np.frombuffer(packed, np.uint8)):
        np.testing.assert_array_equal(np.frombuffer(codec.decode(data, count), np.uint8), values)
    with pytest.raises(RuntimeError, match="more than the"):
        codec.decode(packed, count - 1)


def test_zstandard_content_without_its_length_has_that_of_the_chunk():
    """A frame as programs write it that do not know the length when they begin."""
    (codec,) = find_zarr_codecs({"compressor": {"id": "zstd"}, "filters": None})
    content = bytes(range(16))
    frame = bytes.fromhex("28b52ffd 00 58") + (1 | 16 << 3).to_bytes(3, "little") + content
    assert bytes(codec.decode(frame, 16)) == content
    with pytest.raises(RuntimeError):
        codec.decode(frame, 15)
