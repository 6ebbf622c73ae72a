"""Finished parts of a product as files, which can be opened as one dataset.

A block file holds, in this order, a magic word, the length of a header, the header as JSON, the
arrays as they are in memory, and the SHA-256 of everything before. It is written under another
name, brought to the disk and then renamed. A file with a wrong checksum is not used.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from gyrostab.arrays import Array
from gyrostab.io.datasets import plan_chunks
from gyrostab.store.lazy import Source, make_dask
from gyrostab.store.output import replace_file

_MAGIC = b"GYROBLK1"
_ALIGN_BYTES = 64
_DIGEST_BYTES = hashlib.sha256().digest_size


class Block(NamedTuple):
    """A finished part of a product on disk."""

    path: Path
    part: slice  # windows
    #: Job, windows; dimensions, dtypes, shapes, places and attributes of the variables.
    header: dict[str, Any]
    begin: int  # byte at which the arrays begin


def block_path(folder: Path, part: slice) -> Path:
    """Return the path of the block file of a part."""
    return folder / f"windows-{part.start:010d}.block"


def write_block(folder: Path, part: slice, dataset: xr.Dataset, *, job: str) -> Block:
    """Write a part of a product, complete or not at all.

    `job` is the hash of inputs and options: a block of another job is not used.
    """
    described: dict[str, Any] = {}
    pieces: list[Any] = []
    place = 0
    for name, variable in dataset.variables.items():
        values = np.ascontiguousarray(variable.values)
        described[str(name)] = {
            "dims": list(variable.dims),
            "dtype": values.dtype.str,
            "shape": list(values.shape),
            "place": place,
            "attrs": _encode_attributes(variable.attrs),
        }
        pieces += [values.reshape(-1).view(np.uint8), bytes(-values.nbytes % _ALIGN_BYTES)]
        place += values.nbytes + len(pieces[-1])
    header = {
        "job": job,
        "part": [part.start, part.stop],
        "coords": [str(name) for name in dataset.coords],
        "attrs": _encode_attributes(dataset.attrs),
        "variables": described,
    }
    text = json.dumps(header).encode()
    begin = _find_arrays_offset(len(text))
    head = (_MAGIC + len(text).to_bytes(8, "little") + text).ljust(begin, b"\0")
    path, digest = block_path(folder, part), hashlib.sha256()
    with replace_file(path) as temporary, temporary.open("wb") as file:
        for piece in (head, *pieces):
            digest.update(piece)
            file.write(piece)
        file.write(digest.digest())
    return Block(path, part, header, begin)


def _find_arrays_offset(text: int) -> int:
    """Find the byte at which the arrays begin, after a header text of so many bytes."""
    return -(-(16 + text) // _ALIGN_BYTES) * _ALIGN_BYTES


def find_blocks(folder: Path, parts: Sequence[slice], *, job: str) -> dict[int, Block]:
    """Find the intact finished parts of the job, by their number in `parts`.

    A block that is cut short, altered, or of another job is left out and computed again.
    """
    blocks = {}
    for number, part in enumerate(parts):
        path = block_path(folder, part)
        text = _read_verified_header(path)
        header = json.loads(text) if text else {}
        if header and header["job"] == job and header["part"] == [part.start, part.stop]:
            blocks[number] = Block(path, part, header, _find_arrays_offset(len(text)))
    return blocks


def _read_verified_header(path: Path) -> bytes:
    """Read the header of a block file; empty when it is missing or its checksum is wrong."""
    try:
        content = path.read_bytes()
    except OSError:
        return b""
    digest = hashlib.sha256(memoryview(content)[:-_DIGEST_BYTES]).digest()
    if digest != content[-_DIGEST_BYTES:] or content[:8] != _MAGIC:
        return b""
    return content[16 : 16 + int.from_bytes(content[8:16], "little")]


def assemble_blocks(blocks: Sequence[Block]) -> xr.Dataset:
    """Assemble blocks in their order to one dataset.

    Its variables along time are dask arrays, in the chunks of the file that will be written.
    """
    first = blocks[0].header
    variables = {}
    for name, described in first["variables"].items():
        if "time" not in described["dims"]:
            data = _map_variable(blocks[0], name).copy()
        elif name in first["coords"]:
            parts = [_map_variable(block, name) for block in blocks]
            data = np.concatenate(parts, axis=described["dims"].index("time"))
        else:
            data = _make_lazy(blocks, name)
        attrs = _decode_attributes(described["attrs"])
        variables[name] = xr.Variable(described["dims"], data, attrs)
    dataset = xr.Dataset(variables, attrs=_decode_attributes(first["attrs"]))
    return dataset.set_coords(first["coords"])


def _map_variable(block: Block, name: str) -> Array:
    """Map a variable of a block file, for a copy: Windows does not remove a file that is mapped."""
    described = block.header["variables"][name]
    dtype, shape = np.dtype(described["dtype"]), tuple(described["shape"])
    begin = block.begin + described["place"]
    size = math.prod(shape) * dtype.itemsize
    values = np.memmap(block.path, mode="r")[begin : begin + size]
    if values.size < size:
        raise OSError(f"{block.path}: is cut short")
    return np.asarray(values.view(dtype).reshape(shape))


def _make_lazy(blocks: Sequence[Block], name: str) -> Any:
    """Make a dask array that reads a variable along time from the block files."""
    source = _BlockSource(blocks, name)
    sizes = dict(zip(source.dims, source.shape, strict=True))
    return make_dask(source, plan_chunks(sizes, "time"))


class _BlockSource(Source):
    """A variable along time in block files."""

    def __init__(self, blocks: Sequence[Block], name: str):
        described = blocks[0].header["variables"][name]
        self.blocks, self.name, self.dims = blocks, name, described["dims"]
        self.along, self.dtype = self.dims.index("time"), np.dtype(described["dtype"])
        self.edges = np.cumsum([0, *(block.part.stop - block.part.start for block in blocks)])
        shape = described["shape"]
        self.shape = (*shape[: self.along], int(self.edges[-1]), *shape[self.along + 1 :])

    def __getitem__(self, box: Any) -> Array:
        begin, end = box[self.along].start, box[self.along].stop
        pieces = []
        for i in range(
            int(np.searchsorted(self.edges, begin, side="right")) - 1,
            int(np.searchsorted(self.edges, end, side="left")),
        ):
            block, first = self.blocks[i], int(self.edges[i])
            inside = slice(max(begin - first, 0), end - first)
            chosen = [inside if n == self.along else part for n, part in enumerate(box)]
            pieces.append(_map_variable(block, self.name)[tuple(chosen)])
        return np.concatenate(pieces, axis=self.along)


def _encode_attributes(attrs: Mapping[Any, Any]) -> dict[str, Any]:
    """Encode attributes for JSON; arrays and numpy scalars are marked, to be restored."""
    return {
        str(name): {"dtype": value.dtype.str, "shape": list(value.shape), "values": value.tolist()}
        if isinstance(value, np.ndarray | np.generic)
        else value
        for name, value in attrs.items()
    }


def _decode_attributes(plain: Mapping[str, Any]) -> dict[str, Any]:
    return {
        name: np.array(value["values"], dtype=value["dtype"]).reshape(value["shape"])[()]
        if isinstance(value, dict) and value.keys() == {"dtype", "shape", "values"}
        else value
        for name, value in plain.items()
    }
