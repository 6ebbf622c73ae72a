"""Damaged global heaps of HDF5 files, on which the library does not return."""

from __future__ import annotations

import struct

import h5py
import pytest

from gyrostab.errors import FormatError
from gyrostab.store import damage
from gyrostab.store.damage import check_global_heaps

_FREE = struct.Struct("<HHIQ")


def _write_file(path, *, userblock=0, texts=30):
    with h5py.File(path, "w", userblock_size=userblock) as file:
        file["words"] = [f"word {number}" * (number + 1) for number in range(texts)]
        file["words"].attrs["remark"] = "text of variable length"
        file["numbers"] = range(1000)


def _free_space(data):
    """Return the place of the last object of the first collection, the free space."""
    begin = data.index(b"GCOL")
    length = int.from_bytes(data[begin + 8 : begin + 16], "little")
    at = begin + 16
    while _FREE.unpack_from(data, at)[0]:
        at += 16 + (_FREE.unpack_from(data, at)[3] + 7) // 8 * 8
        assert at < begin + length
    return at


@pytest.mark.parametrize("userblock", [0, 512, 2048])
def test_intact_files_pass(tmp_path, userblock):
    path = tmp_path / "log.h5"
    _write_file(path, userblock=userblock)
    check_global_heaps(path)


@pytest.mark.parametrize("userblock", [0, 512])
@pytest.mark.parametrize("size", [0, 8, 2**63, 2**64 - 8])
def test_free_space_that_does_not_advance_is_an_error(tmp_path, size, userblock):
    path = tmp_path / "log.h5"
    _write_file(path, userblock=userblock)
    data = bytearray(path.read_bytes())
    _FREE.pack_into(data, _free_space(data), 0, 0, 0, size)
    path.write_bytes(data)
    with pytest.raises(FormatError, match=r"log.h5: .*global heap at byte \d+.*copy it again"):
        check_global_heaps(path)


def test_an_object_of_the_largest_size_is_an_error(tmp_path):
    path = tmp_path / "log.h5"
    _write_file(path)
    data = bytearray(path.read_bytes())
    _FREE.pack_into(data, data.index(b"GCOL") + 16, 1, 1, 0, 2**64 - 16)
    path.write_bytes(data)
    with pytest.raises(FormatError, match="global heap"):
        check_global_heaps(path)


@pytest.mark.parametrize("block", [64, 100, 2**20])
def test_the_end_of_a_long_file_is_searched(tmp_path, monkeypatch, block):
    path = tmp_path / "log.h5"
    with h5py.File(path, "w") as file:
        file["numbers"] = range(100_000)
        file["words"] = ["word"] * 3
    data = bytearray(path.read_bytes())
    monkeypatch.setattr(damage, "_SEARCHED_BYTES", 2**14)
    monkeypatch.setattr(damage, "_BLOCK_BYTES", block)
    assert data.index(b"GCOL") > 2**14
    check_global_heaps(path)
    _FREE.pack_into(data, _free_space(data), 0, 0, 0, 0)
    path.write_bytes(data)
    with pytest.raises(FormatError, match="global heap"):
        check_global_heaps(path)


@pytest.mark.parametrize("content", [b"", b"time,gyro_x\n0,1\n", b"GCOL\x01\0\0\0" + bytes(99)])
def test_other_files_pass(tmp_path, content):
    path = tmp_path / "log.csv"
    path.write_bytes(content)
    check_global_heaps(path)
