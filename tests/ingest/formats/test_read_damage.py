"""Damaged files that readers once accepted."""

from __future__ import annotations

import contextlib
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.io import loadmat, savemat

from gyrostab.errors import FormatError
from gyrostab.ingest.formats.matlab import read_arrays


@pytest.fixture(scope="module")
def matlab(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Return all that scipy writes: numbers, text, structures, cells, sparse and complex arrays."""
    import scipy.sparse

    folder = tmp_path_factory.mktemp("matlab")
    content = {
        "numbers": np.arange(12.0).reshape(3, 4),
        "counts": np.arange(5, dtype=np.int16),
        "one": 1.0,
        "empty": np.empty((0, 3)),
        "complex": np.array([1 + 2j, 3.0]),
        "text": "hello",
        "texts": np.array(["ab", "cde"], dtype=object),
        "flag": np.array([True, False]),
        "log": {"t": np.arange(4.0), "inner": {"x": np.float32(2.0), "name": "tool"}},
        "sparse": scipy.sparse.csc_array(np.eye(3)),
        "cells": np.array([1.0, "a", np.arange(3)], dtype=object),
        "long_name_of_a_variable": np.zeros((2, 2, 2)),
    }
    for packed in (False, True):
        savemat(
            folder / f"packed{packed}.mat", content, do_compression=packed, long_field_names=True
        )
    savemat(folder / "four.mat", {"x": np.arange(3.0)}, format="4")
    return sorted(folder.iterdir())


def test_arrays_of_whole_matlab_files_are_those_of_scipy(matlab: list[Path]) -> None:
    for path in matlab:
        objects: list[str] = []
        arrays, content = dict(read_arrays(path, objects)), loadmat(path)
        assert not objects
        if "log" in content:
            log = content["log"][0, 0]
            content |= {"log.t": log["t"], "log.inner.x": log["inner"][0, 0]["x"]}
        plain = {n: v for n, v in content.items() if n[0] != "_" and hasattr(v, "dtype")}
        plain = {name: value for name, value in plain.items() if value.dtype.kind in "biuf"}
        plain.pop("sparse", None)
        assert arrays.keys() == plain.keys()
        for name, values in plain.items():
            np.testing.assert_array_equal(arrays[name], values)


def test_structures_of_scalars_are_columns(tmp_path: Path) -> None:
    rows = np.zeros((1, 3), dtype=[("x", object), ("note", object)])
    for number, row in enumerate(rows[0]):
        row["x"], row["note"] = number / 4, "text"
    savemat(tmp_path / "rows.mat", {"rows": rows})
    ((name, values),) = read_arrays(tmp_path / "rows.mat", [])
    assert (name, values.tolist()) == ("rows.x", [0.0, 0.25, 0.5])


@settings(max_examples=200, derandomize=True, database=None)
@given(data=st.data())
def test_a_damaged_matlab_file_is_read_or_refused(matlab: list[Path], data: st.DataObject) -> None:
    whole = matlab[1].read_bytes()
    place = data.draw(st.integers(128, len(whole) - 4))
    number = data.draw(
        st.one_of(st.sampled_from([0, 1, 2**31 - 1, 2**31, 2**32 - 1]), st.integers(0, 2**32 - 1))
    )
    path = matlab[0].with_name("damaged.mat")
    path.write_bytes(whole[:place] + struct.pack("<I", number) + whole[place + 4 :])
    with contextlib.suppress(FormatError):
        list(read_arrays(path, []))


@pytest.mark.parametrize("size", [129, 200, 1000])
def test_a_matlab_file_that_is_cut_off_is_refused(
    matlab: list[Path], tmp_path: Path, size: int
) -> None:
    (tmp_path / "cut.mat").write_bytes(matlab[1].read_bytes()[:size])
    with pytest.raises(FormatError, match=r"cut\.mat: this MATLAB file is damaged or cut off"):
        list(read_arrays(tmp_path / "cut.mat", []))


def test_arrays_packed_too_tightly_need_a_limit(tmp_path: Path) -> None:
    """A few bytes must not fill the memory; a channel that hardly changes may be in a log."""
    path, zeros = tmp_path / "zeros.mat", {"x": np.zeros(30_000), "y": np.zeros(30_000)}
    savemat(path, zeros, do_compression=True)
    with pytest.raises(FormatError, match=r"zeros\.mat: arrays .* --limit chunk_bytes=4.9e\+05"):
        list(read_arrays(path, [], {"chunk_bytes": 4e5}))
    assert len(list(read_arrays(path, [], {"chunk_bytes": 5e5}))) == 2
    noise = np.random.default_rng(1).integers(-3, 4, 30_000).astype(float)
    savemat(path, zeros | {"rate": noise}, do_compression=True)
    arrays = dict(read_arrays(path, [], {"chunk_bytes": 1.0}))
    np.testing.assert_array_equal(arrays["rate"][0], noise)


def test_a_compressed_array_with_a_wrong_checksum_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "zeros.mat"
    savemat(path, {"x": np.zeros(50_000)}, do_compression=True)
    path.write_bytes(path.read_bytes()[:-1] + b"\xff")
    with pytest.raises(FormatError, match="damaged or cut off"):
        list(read_arrays(path, []))
