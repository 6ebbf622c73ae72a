"""Finished parts of a product as block files, which can be opened as one dataset.

A block file holds, in this order, a magic word, the length of a header, the header as JSON, the
arrays as they are in memory, and the SHA-256 of everything before. It is written under another
name, brought to the disk and then renamed. A file with a wrong checksum is not used.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.io.datasets import CHUNK_VALUES
from gyrostab.store.lazy_slices import with_box_reader
from gyrostab.store.output import replace_file

__all__ = ["Block", "assemble", "block_path", "find_blocks", "write_block"]

_MAGIC = b"GYROBLK1"
_ALIGN_BYTES = 64
_MAX_MEMORY_BYTES = 2**26  # bytes of blocks up to which a product is put together in memory


class Block(NamedTuple):
    """A finished part of a product on disk.

    Attributes
    ----------
    path : pathlib.Path
        Block file.
    part : slice
        Windows of the part.
    header : dict
        Dimensions, dtypes, shapes, places and attributes of its variables.
    begin : int
        Byte at which the arrays begin.
    """

    path: Path
    part: slice
    header: dict[str, Any]
    begin: int


def block_path(folder: Path, part: slice) -> Path:
    """Return the path of the block file of a part."""
    return folder / f"windows-{part.start:010d}.block"


def write_block(folder: Path, part: slice, dataset: xr.Dataset, *, job: str) -> Block:
    """Write a part of a product, complete or not at all.

    Parameters
    ----------
    folder : Path
        Job folder.
    part : slice
        Windows of the part.
    dataset : xarray.Dataset
        The part, in memory.
    job : str
        Hash of inputs and options; a block of another job is not used.

    Returns
    -------
    Block
        The block, as `find_blocks` finds it.

    Raises
    ------
    OutputError
        When it cannot be written, with the reason.
    """
    arrays = {
        str(name): np.ascontiguousarray(variable.values)
        for name, variable in dataset.variables.items()
    }
    described, place = {}, 0
    for (name, values), variable in zip(arrays.items(), dataset.variables.values(), strict=True):
        described[name] = {
            "dims": list(variable.dims), "dtype": values.dtype.str, "shape": list(values.shape),
            "place": place, "attrs": _encode_attributes(variable.attrs),
        }  # fmt: skip
        place += -(-values.nbytes // _ALIGN_BYTES) * _ALIGN_BYTES
    header = {
        "job": job, "part": [part.start, part.stop],
        "coords": [str(name) for name in dataset.coords],
        "attrs": _encode_attributes(dataset.attrs),
        "variables": described,
    }  # fmt: skip
    text = json.dumps(header).encode()
    head = (_MAGIC + len(text).to_bytes(8, "little") + text).ljust(
        _find_arrays_offset(len(text)), b"\0"
    )
    path = block_path(folder, part)
    with replace_file(path) as temporary, temporary.open("wb", buffering=0) as file:
        digest = hashlib.sha256()
        for piece in (
            head,
            *(
                piece
                for values in arrays.values()
                for piece in (values, bytes(-values.nbytes % _ALIGN_BYTES))
            ),
        ):
            view = (
                memoryview(piece)
                if isinstance(piece, bytes)
                else piece.reshape(-1).view(np.uint8).data
            )
            digest.update(view)
            _write_all(file, view)
        _write_all(file, memoryview(digest.digest()))
    return Block(path, part, header, len(head))


def _find_arrays_offset(text: int) -> int:
    """Find the byte at which the arrays begin, after a header text of so many bytes."""
    return -(-(16 + text) // _ALIGN_BYTES) * _ALIGN_BYTES


def _write_all(file: Any, view: memoryview) -> None:
    while view.nbytes:
        view = view[file.write(view) :]


def find_blocks(folder: Path, parts: Sequence[slice], *, job: str) -> dict[int, Block]:
    """Find the intact finished parts of the job, by their number in `parts`.

    A block that is cut short, altered, or of another job is left out and computed again.
    """
    found = {}
    for number, part in enumerate(parts):
        path = block_path(folder, part)
        text = _read_verified_header(path)
        header = json.loads(text) if text else {}
        if header and header["job"] == job and header["part"] == [part.start, part.stop]:
            found[number] = Block(path, part, header, _find_arrays_offset(len(text)))
    return found


def _read_verified_header(path: Path) -> bytes:
    """Read the header of a block file; empty when it is missing or its checksum is wrong."""
    try:
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size - hashlib.sha256().digest_size
            start = file.read(16)
            if size < 16 or start[:8] != _MAGIC:
                return b""
            digest, left = hashlib.sha256(start), size - 16
            text = file.read(min(int.from_bytes(start[8:], "little"), left))
            digest.update(text)
            left -= len(text)
            while left > 0 and (piece := file.read(min(left, 2**20))):
                digest.update(piece)
                left -= len(piece)
            if left or file.read() != digest.digest():
                return b""
            return text
    except OSError:
        return b""


def assemble(blocks: Sequence[Block]) -> xr.Dataset:
    """Assemble blocks to one dataset; long variables of a large one are read from the files lazily.

    Parameters
    ----------
    blocks : sequence of Block
        All parts, in order.

    Returns
    -------
    xarray.Dataset
        The product, in memory if it is small; otherwise with coordinates in memory, and dask arrays
        in the chunks of the file that will be written.
    """
    first = blocks[0].header
    small = sum(block.path.stat().st_size for block in blocks) <= _MAX_MEMORY_BYTES
    variables: dict[str, xr.Variable] = {}
    maps = [np.memmap(block.path, mode="r") for block in blocks] if small else []
    for name, described in first["variables"].items():
        dims, attrs = tuple(described["dims"]), _decode_attributes(described["attrs"])
        if "time" not in dims:
            # a copy: Windows does not remove a file that is mapped
            data = np.array(_map_variable(blocks[0], name))
        elif small:
            data = np.concatenate(
                [
                    _slice_variable(mapped, block, name)
                    for mapped, block in zip(maps, blocks, strict=True)
                ],
                axis=dims.index("time"),
            )
        elif name in first["coords"]:
            data = np.concatenate(
                [_map_variable(block, name) for block in blocks], axis=dims.index("time")
            )
        else:
            data = _make_lazy(blocks, name)
        variables[name] = xr.Variable(dims, data, attrs)
    whole = xr.Dataset(variables, attrs=_decode_attributes(first["attrs"]))
    return whole.set_coords(first["coords"])


def _slice_variable(mapped: NDArray[np.uint8], block: Block, name: str) -> NDArray[Any]:
    """Slice one variable from a block that is mapped as a whole."""
    described = block.header["variables"][name]
    dtype, shape = np.dtype(described["dtype"]), tuple(described["shape"])
    begin = block.begin + described["place"]
    return np.asarray(
        mapped[begin : begin + int(np.prod(shape)) * dtype.itemsize].view(dtype).reshape(shape)
    )


def _map_variable(block: Block, name: str) -> NDArray[Any]:
    """Map one variable of a block."""
    described = block.header["variables"][name]
    dtype, shape = np.dtype(described["dtype"]), tuple(described["shape"])
    if 0 in shape:
        return np.empty(shape, dtype)
    return np.memmap(
        block.path, dtype=dtype, mode="r", offset=block.begin + described["place"], shape=shape
    )


def _make_lazy(blocks: Sequence[Block], name: str) -> Any:
    """Make a dask array that reads a variable along time from the block files."""
    import dask.array as da

    described = blocks[0].header["variables"][name]
    along, dtype = described["dims"].index("time"), np.dtype(described["dtype"])
    edges = np.cumsum([0, *(block.part.stop - block.part.start for block in blocks)])
    shape = [int(edges[-1]) if i == along else size for i, size in enumerate(described["shape"])]
    dims = list(zip(described["dims"], shape, strict=True))
    inner = int(np.prod([size for dim, size in dims if dim not in ("axis", "term", "time")]))
    sizes = {"axis": 1, "term": 1, "time": max(1, min(shape[along], CHUNK_VALUES // max(1, inner)))}

    def part(place: tuple[slice, ...]) -> NDArray[Any]:
        begin, end = place[along].start, place[along].stop
        values = np.empty([one.stop - one.start for one in place], dtype)
        for i in range(
            int(np.searchsorted(edges, begin, side="right")) - 1,
            int(np.searchsorted(edges, end, side="left")),
        ):
            first, last = max(begin, int(edges[i])), min(end, int(edges[i + 1]))
            inside = [
                slice(first - int(edges[i]), last - int(edges[i])) if n == along else one
                for n, one in enumerate(place)
            ]
            _read_into(
                values[(slice(None),) * along + (slice(first - begin, last - begin),)],
                blocks[i],
                name,
                inside,
            )
        return values

    def read(block_info: Mapping[Any, Any]) -> NDArray[Any]:
        return part(tuple(slice(*ends) for ends in block_info[None]["array-location"]))

    chunks = da.core.normalize_chunks(
        [sizes.get(dim, size) for dim, size in dims], shape=tuple(shape)
    )
    # without a name, dask would hash everything that `read` refers to
    label = f"{blocks[0].header['job']}-{name}"
    return with_box_reader(
        da.map_blocks(
            read, chunks=chunks, dtype=dtype, meta=np.empty((0,) * len(shape), dtype), name=label
        ),
        part,
    )


def _read_into(out: NDArray[Any], block: Block, name: str, place: Sequence[slice]) -> None:
    """Read a part of a variable of a block; directly if it is contiguous, as mapping is slow."""
    shape = block.header["variables"][name]["shape"]
    # all of the dimensions after this one is read
    inner = max((i for i, size in enumerate(shape) if out.shape[i] < size), default=0)
    if out.flags.c_contiguous and out.size and all(size == 1 for size in out.shape[:inner]):
        first = int(np.ravel_multi_index([one.start for one in place], shape)) * out.itemsize
        with block.path.open("rb", buffering=0) as file:
            file.seek(block.begin + block.header["variables"][name]["place"] + first)
            if _read_exactly(file, out.reshape(-1).view(np.uint8).data):
                return
        raise OSError(f"{block.path}: is cut short")
    out[...] = _map_variable(block, name)[tuple(place)]


def _read_exactly(file: Any, view: memoryview) -> bool:
    """Read until the memory is full; False when the file ends before."""
    while view.nbytes and (count := file.readinto(view)):
        view = view[count:]
    return not view.nbytes


def _encode_attributes(attrs: Mapping[Any, Any]) -> dict[str, Any]:
    """Encode attributes for JSON; arrays and numpy scalars are marked, to be restored."""
    plain: dict[str, Any] = {}
    for name, value in attrs.items():
        array = isinstance(value, np.ndarray | np.generic)
        plain[str(name)] = (
            {"dtype": value.dtype.str, "shape": list(value.shape), "values": value.tolist()}
            if array
            else value
        )
    return plain


def _decode_attributes(plain: Mapping[str, Any]) -> dict[str, Any]:
    attrs: dict[str, Any] = {}
    for name, value in plain.items():
        marked = isinstance(value, dict) and value.keys() == {"dtype", "shape", "values"}
        attrs[name] = (
            np.array(value["values"], dtype=value["dtype"]).reshape(value["shape"])[()]
            if marked
            else value
        )
    return attrs
