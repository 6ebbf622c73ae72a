"""Lazy reading of the long variables of a log, chunk by chunk.

A damaged chunk becomes a gap, and a warning says where.
"""

from __future__ import annotations

import sys
import threading
import uuid
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from xarray.backends import ZarrStore

from gyrostab.arrays import Array, Ints
from gyrostab.errors import DamageError, FormatError, reading_of
from gyrostab.kernels.encoding.counts import from_counts
from gyrostab.store.damage import check_blosc_chunks, check_codecs, check_global_heaps
from gyrostab.store.layout import ChunkCache, ChunkDamage, is_readable, read_chunk
from gyrostab.store.lazy import FileVariable, RowSource, make_dask
from gyrostab.store.private import close_function
from gyrostab.store.remote import ROOT_METADATA, find_remote_kind, find_url, reaching
from gyrostab.store.times import decode_stamps, index_dim, parse_time_grids, replace_stamps
from gyrostab.wording import list_some

#: Values from which a variable is a dask array.
MIN_LAZY_VALUES = 2**17
#: Options to open a file with xarray, without decoding times and without indexes.
_AS_STORED: dict[str, Any] = {
    "chunks": None,
    "decode_times": False,
    "create_default_indexes": False,
}
#: Encodings that xarray decodes; gyrostab writes none of them in a log.
_FOREIGN_PACKING = {"_Unsigned", "add_offset", "missing_value"}
#: Bytes of the cache of chunks of which only a part was requested.
_CACHE_BYTES = 2**24


def open_stored(
    path: Path,
    *,
    strict: bool = False,
    check: Callable[[Path, Mapping[Any, xr.Variable]], None] | None = None,
) -> xr.Dataset:
    """Open a dataset as it is on disk: times not decoded, data lazy, chunks checked when read.

    Parameters
    ----------
    strict : bool
        Raise `FormatError` for a damaged chunk of a log instead of leaving a gap.
    check : callable, optional
        Called with the path and the variables before any of its values is read; it raises
        `FormatError` when the declared sizes are out of proportion.

    Raises
    ------
    FormatError
        When there is no such file, or when it is damaged as a whole.
    """
    if url := find_url(path):
        return _open_remote(path, url)
    if not path.exists():
        raise FormatError(f"{path}: there is no such file")
    with reading_of(path):
        return _open_dataset(path, strict=strict, check=check)


def _open_remote(path: Path, url: str) -> xr.Dataset:
    """Open a Zarr store at an address; the Zarr library reads its chunks."""
    if find_remote_kind(url) != "store":
        raise FormatError(f"{url}: is not a Zarr store; copy the file here, and give the copy")
    with reaching(url), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # without consolidated metadata
        stored = open_zarr(url.rstrip("/"), url, **_AS_STORED)
        return _make_variables_lazy(replace_stamps(stored, path), {}, path)


def open_zarr(
    target: str, where: str, *, consolidated: bool | None = None, **options: Any
) -> xr.Dataset:
    """Open a Zarr store with xarray, once its codecs are known to be harmless.

    xarray may decode a variable while it opens a store. `where` names the store in messages, and
    `options` are those of `xarray.open_dataset`.

    Raises
    ------
    FormatError
        See `gyrostab.store.damage.check_codecs`.
    """
    store = ZarrStore.open_group(target, mode="r", consolidated=consolidated)
    check_codecs(where, store.get_variables())
    return xr.open_dataset(store, engine="store", **options)


def _open_dataset(
    path: Path, *, strict: bool, check: Callable[[Path, Mapping[Any, xr.Variable]], None] | None
) -> xr.Dataset:
    if path.is_file():
        check_global_heaps(path)
    elif not any((path / name).exists() for name in ROOT_METADATA):
        inside = sorted(item.name for item in path.iterdir() if item.suffix in (".nc", ".zarr"))
        raise DamageError(
            f"{path}: is a folder, not a Zarr store (neither zarr.json nor .zgroup is in it)"
            + (f"; name a file in it: {list_some(inside)}" if inside else "")
        )
    name = "Zarr" if path.is_dir() else "NetCDF"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # without consolidated metadata
            if path.is_dir():
                stored = open_zarr(str(path), str(path), **_AS_STORED)
            else:
                stored = xr.open_dataset(path, engine="netcdf4", **_AS_STORED)
    except FormatError:
        raise
    except Exception as error:  # the backends raise errors of many kinds on damaged files
        raise DamageError(
            f"{path}: is not {name}, or is damaged or cut short ({error}); make or copy it again"
        ) from error
    if check is not None:
        check(path, stored.variables)
    is_log = stored.attrs.get("gyrostab_content") == "log"
    sampled_names = {
        name for name in stored.data_vars if is_log and _is_sampled(stored.variables[name])
    }
    if path.is_dir():
        check_blosc_chunks(path, skip=sampled_names | set(parse_time_grids(stored.variables, path)))
    close = close_function(stored)
    stored = replace_stamps(stored, path)
    stored.set_close(close)
    long = _find_long_variables(stored, path, strict=strict) if is_log else {}
    if path.is_dir() and sampled_names.difference(long):
        check_blosc_chunks(path, skip=list(long))
    opened = _make_variables_lazy(stored, long, path)
    if is_log:
        # opened again when needed: an archive of any length keeps only a few files open
        stored.close()
    return opened


def _make_variables_lazy(
    stored: xr.Dataset, long: dict[Any, xr.Variable], path: Path
) -> xr.Dataset:
    """Load small variables, and make dask arrays of the others, by the chunks on disk.

    A dask array takes time to make and to read.
    """
    short_variables = {
        name: stored.variables[name] for name in stored.data_vars if name not in long
    }
    ready = {  # text is always small, and dask cannot find the size of its chunks
        name: item.load()
        if item.size < MIN_LAZY_VALUES or item.dtype.kind in "OSU"
        else make_variable_lazy(item, path)
        for name, item in short_variables.items()
    }
    coords = xr.Coordinates(
        {name: stored.variables[name].load() for name in stored.coords}, indexes={}
    )
    lazy = xr.Dataset(
        {name: long.get(name, ready.get(name)) for name in stored.data_vars}, coords, stored.attrs
    )
    lazy.encoding = stored.encoding
    lazy.set_close(close_function(stored))
    return lazy


def make_variable_lazy(variable: xr.Variable, path: Path) -> xr.Variable:
    """Make a dask array, by the chunks on disk, of a variable that xarray has opened without."""
    cut = variable.encoding.get("preferred_chunks")
    chunks = tuple(cut[dim] for dim in variable.dims) if cut else "auto"
    lazy = make_dask(FileVariable(variable, path), chunks)
    return xr.Variable(variable.dims, lazy, variable.attrs, variable.encoding)


def _find_long_variables(stored: xr.Dataset, path: Path, *, strict: bool) -> dict[Any, xr.Variable]:
    """Find the long variables of a log, as arrays that handle damage."""
    labels = [str(label) for label in stored.variables["axis"].values]
    opened = uuid.uuid4().hex
    long: dict[Any, xr.Variable] = {}
    for name in stored.data_vars:
        variable = stored.variables[name]
        disk = variable.encoding
        chunks = disk.get("chunks" if path.is_dir() else "chunksizes")
        if not _is_sampled(variable) or chunks is None:
            continue
        dim = str(variable.dims[-1])
        is_known = all(size == 1 for size in chunks[:-1]) and is_readable(path, str(name))
        has_fill = "scale_factor" not in disk or "_FillValue" in disk
        if not is_known or not has_fill or _FOREIGN_PACKING & set(disk):
            continue  # some other program has written it anew
        array = _ChunkedVariable(
            path=path.absolute(),
            name=str(name),
            rows=tuple(f"axis {label}" for label in labels)
            if variable.ndim == 2
            else (f"channel {name}",),
            shape=variable.shape,
            dtype=variable.dtype,
            length=int(chunks[-1]),
            scale=disk.get("scale_factor"),
            missing=disk.get("_FillValue"),
            spans=_find_chunk_spans(stored, dim, int(chunks[-1]), path),
            strict=strict,
            opened=opened,
            zarr=path.is_dir(),
        )
        packing = (
            {
                "dtype": np.dtype(disk["dtype"]),
                "scale_factor": float(array.scale),
                "_FillValue": array.missing,
            }
            if array.scale is not None
            else {}
        )
        long[name] = xr.Variable(
            variable.dims, make_dask(array, tuple(chunks)), variable.attrs, packing
        )
    return long


def _is_sampled(variable: xr.Variable) -> bool:
    """Whether a variable of a log has a value for each sample."""
    dim = str(variable.dims[-1]) if variable.dims else ""
    return dim.startswith("time") and variable.dtype.kind == "f" and variable.size > 0


def _find_chunk_spans(stored: xr.Dataset, dim: str, length: int, path: Path) -> Ints:
    """Find the first and last stamp [ns] of each chunk along a time axis; none without stamps."""
    size = stored.sizes[dim]
    first = np.arange(0, size, length)
    ends = np.stack([first, np.minimum(first + length, size) - 1], axis=1)
    for grid in parse_time_grids(stored.variables, path).values():
        if dim in (grid.dims[0], index_dim(grid.dims[0])):
            return grid.stamps_at(ends)
    if dim not in stored.variables:
        return ends[:0]
    stamps = decode_stamps(stored.variables[dim]).values.view(np.int64)
    return np.asarray(stamps[ends])


@dataclass(eq=False, kw_only=True)
class _ChunkedVariable(RowSource):
    """A variable on disk in chunks of one row and `length` samples."""

    path: Path
    name: str
    rows: tuple[str, ...]
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    length: int
    scale: float | None
    missing: Any
    spans: Ints
    strict: bool
    opened: str
    zarr: bool

    def read_into(self, row: int, begin: int, out: Array) -> None:
        """Read samples of one row; those of a damaged chunk are NaN."""
        end = begin + out.size
        for number in range(begin // self.length, -(-end // self.length)):
            first = number * self.length
            low, high = max(begin, first), min(end, first + self.length)
            place = out[low - begin : high - begin]
            try:
                is_whole = low == first and high == min(first + self.length, self.shape[-1])
                self._decode_samples(
                    self._read_chunk(row, number, is_whole=is_whole)[low - first : high - first],
                    place,
                )
            except ChunkDamage as damage:
                self._handle_damage(row, number, str(damage))
                place[:] = np.nan

    def _decode_samples(self, raw: Array, out: NDArray[np.floating[Any]]) -> None:
        if self.scale is not None:
            from_counts(raw, float(self.scale), int(self.missing), out=out)
            return
        out[:] = raw
        if self.missing is not None and self.missing == self.missing:
            out[raw == self.missing] = np.nan

    def _read_chunk(self, row: int, number: int, *, is_whole: bool) -> Array:
        """Read one chunk as it is on disk; one that is not used as a whole is cached.

        The last chunk of a row is longer than the row.
        """
        place = (number,) if self.ndim == 1 else (row, number)
        chunk = _CACHE.get((self.opened, self.name, place))
        if chunk is None:
            chunk = read_chunk(self.path, self.name, place, zarr=self.zarr, opened=self.opened)
            if not is_whole:
                _CACHE.put((self.opened, self.name, place), chunk)
        if chunk.size != self.length:
            raise ChunkDamage(f"is damaged: it holds {chunk.size} values in place of {self.length}")
        return chunk

    def _handle_damage(self, row: int, number: int, damage: str) -> None:
        """Warn of a damaged chunk, once, or raise `FormatError`."""
        stamps = self.spans[number : number + 1].ravel().view("datetime64[ns]")
        when = " to ".join(str(stamp).rstrip("0").rstrip(".") for stamp in stamps)
        problem = f"{self.path}: {self.rows[row]}: the chunk from {when} {damage}"
        if self.strict:
            raise FormatError(
                f"{problem}; copy it again, or leave out --strict to take these samples as missing"
            )
        with _WARNING_LOCK:
            _warn_once(self.opened, f"{problem}. Its samples are taken as missing; copy it again")


#: Chunks in which one part of a run ends and the next one begins.
_CACHE = ChunkCache(_CACHE_BYTES, _CACHE_BYTES // 2)

_WARNING_LOCK = threading.Lock()


@lru_cache(maxsize=2**16)
def _warn_once(opened: str, message: str) -> None:
    """Warn once per opening of a file; a worker of dask.distributed warns the client."""
    distributed = sys.modules.get("distributed")
    warn = getattr(distributed, "warn", warnings.warn)
    warn(message, UserWarning)
