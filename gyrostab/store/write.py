"""Writing large variables chunk by chunk; those of a log in chunks of one axis and 20 minutes.

Samples that the source had as integer counts are stored as counts.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from itertools import product
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.arrays import Array, Floats
from gyrostab.kernels.encoding.counts import to_counts
from gyrostab.store.layout import find_hdf5_codecs
from gyrostab.store.lazy import convert_values, find_source, read_box
from gyrostab.store.private import library_lock
from gyrostab.store.threads import map_in_order

CHUNK_SECONDS = 1200.0
#: Least and most samples in one chunk, for very slow and very fast logs.
CHUNK_LIMITS = (2**16, 2**22)
#: Size [bytes] of the doubles that are computed at a time while a lazy log is written.
MAX_BATCH_BYTES = 2**26
#: Values from which the chunks of a variable are compressed in several threads.
_MIN_LARGE_VALUES = 2**15
#: Counts of missing values: the defaults of NetCDF, of 64 bits the least, which a double holds.
FILL_VALUES = {"int16": -32767, "int32": -2147483647, "int64": -(2**63)}

#: Function that is called with the share that is done.
Progress = Callable[[float], None]


class NotCountsError(ValueError):
    """A variable turns out not to consist of counts; `args` is its name."""


def chunk_samples(rate: float) -> int:
    """Number of samples in one chunk of a log of `rate` [Hz]: 20 minutes, within `CHUNK_LIMITS`.

    Examples
    --------
    >>> chunk_samples(400.0), chunk_samples(1.0), chunk_samples(1e5)
    (480000, 65536, 4194304)
    """
    return int(np.clip(round(CHUNK_SECONDS * rate), *CHUNK_LIMITS))


def as_counts(name: str, variable: xr.Variable) -> xr.Variable:
    """Convert a variable to counts of 16 or 32 bits if its encoding declares them.

    The encoding must hold an integer dtype and a scale factor; other variables stay unchanged. That
    of counts then holds the one for missing values.

    Raises
    ------
    NotCountsError
        When counts do not give the same doubles; for a lazy variable, when it is computed.
    """
    scale, declared = (
        variable.encoding.get("scale_factor"),
        np.dtype(variable.encoding.get("dtype", "f8")),
    )
    if (
        not scale
        or declared.kind not in "iu"
        or variable.dtype != np.float64
        or variable.encoding.get("add_offset")
    ):
        return xr.Variable(variable.dims, variable.data, variable.attrs)
    dtype = "int16" if declared.itemsize == 1 or declared == np.int16 else "int32"
    pack = partial(_pack_counts, name=name, scale=float(scale), dtype=dtype)
    packed = convert_values(variable.data, pack, dtype)
    attrs = {**variable.attrs, "scale_factor": float(scale)}
    fill = np.dtype(dtype).type(FILL_VALUES[dtype])
    return xr.Variable(variable.dims, packed, attrs, {"_FillValue": fill})


def _pack_counts(
    values: Floats, *, name: str, scale: float, dtype: str
) -> NDArray[np.integer[Any]]:
    counts = to_counts(values, scale, dtype, FILL_VALUES[dtype])
    if counts is None:
        raise NotCountsError(name)
    return counts


def declare_counts(dtype: Any, scale: float) -> dict[str, Any]:
    """Return the encoding of integer counts, in a signed type that has a count for missing values.

    Without such a count, xarray writes a missing value as 0.

    Examples
    --------
    >>> declare_counts("u2", 0.1)
    {'dtype': dtype('int32'), 'scale_factor': 0.1, '_FillValue': np.int32(-2147483647)}
    """
    signed = np.promote_types(dtype, np.int16)
    if signed.kind != "i":  # 64 bits without a sign
        signed = np.dtype(np.int64)
    fill = signed.type(FILL_VALUES[signed.name])
    return {"dtype": signed, "scale_factor": float(scale), "_FillValue": fill}


def pack_counts(reach: float, scale: float) -> dict[str, Any]:
    """Return the encoding of integer counts up to `reach`; without a type if they exceed 32 bits.

    Counts without a type are stored as doubles.

    Examples
    --------
    >>> pack_counts(40_000, 0.1)["dtype"], pack_counts(1e10, 0.1)
    (dtype('int32'), {'scale_factor': 0.1})
    """
    dtype = next((kind for kind in ("int16", "int32") if reach < np.iinfo(kind).max), None)
    return declare_counts(dtype, scale) if dtype else {"scale_factor": float(scale)}


def common_packing(encodings: Iterable[Mapping[Any, Any]]) -> dict[str, Any]:
    """Find the encoding of a variable of concatenated logs: counts if all are counts of one factor.

    Examples
    --------
    >>> common_packing([declare_counts("i2", 0.1), declare_counts("i4", 0.1)])["dtype"]
    dtype('int32')
    >>> common_packing([declare_counts("i2", 0.1), {}])
    {}
    """
    encodings = list(encodings)
    scales = {encoding.get("scale_factor") for encoding in encodings}
    scale = scales.pop() if len(scales) == 1 else None
    if scale is None:
        return {}
    if not all("dtype" in encoding for encoding in encodings):
        return {"scale_factor": float(scale)}
    dtypes = (np.dtype(encoding["dtype"]) for encoding in encodings)
    return declare_counts(np.result_type(*dtypes), scale)


def large_variables(stored: xr.Dataset) -> dict[str, xr.Variable]:
    """Find the numbers that are written chunk by chunk: lazy ones along time, and large data."""

    def is_lazy(variable: xr.Variable) -> bool:
        is_series = variable.ndim > 0 and str(variable.dims[-1]).startswith("time")
        return variable.chunks is not None and is_series

    return {
        str(name): variable
        for name, variable in stored.variables.items()
        if variable.dtype.kind in "iuf"
        and (
            (is_lazy(variable) and variable.size)
            or (name in stored.data_vars and variable.size >= _MIN_LARGE_VALUES)
        )
    }


def _dim_names(variable: xr.Variable) -> list[str]:
    return [str(dim) for dim in variable.dims]


def append_netcdf(
    path: Path,
    large: Mapping[str, xr.Variable],
    encoding: Mapping[Any, Mapping[str, Any]],
    *,
    progress: Progress | None = None,
) -> None:
    """Add variables to a NetCDF file, with the filters of `encoding`, which is as for xarray.

    The NetCDF library compresses one chunk after the other; here several threads do so, and the
    chunks are those of the library.
    """
    import h5py
    import netCDF4

    if not large:
        return
    lock = library_lock()
    with lock:
        with netCDF4.Dataset(path, "a") as file:
            for name, variable in large.items():
                _create_variable(file, name, variable, encoding[name])
        target = h5py.File(path, "r+")
        datasets = {name: target[name].id for name in large}
    creation = {name: dataset.get_create_plist() for name, dataset in datasets.items()}
    # not in the threads: a call of h5py there made the writing of chunks fail
    chunks = {name: plist.get_chunk() for name, plist in creation.items()}
    codecs = {name: find_hdf5_codecs(plist) for name, plist in creation.items()}

    def compress(name: str, values: Array) -> Any:
        fill = encoding[name]["_FillValue"]
        native = values.dtype.newbyteorder("=")  # that of the variable in the file
        chunk = np.full(chunks[name], 0 if fill is None else fill, native)
        inside = chunk[tuple(map(slice, values.shape))]
        inside[...] = values
        if fill is not None and values.dtype.kind == "f":
            inside[np.isnan(values)] = fill
        data: Any = chunk
        for _, codec in reversed(codecs[name]):
            data = codec.encode(data)
        return data

    def put(name: str, box: _Box, compressed: Any) -> None:
        with lock:
            datasets[name].write_direct_chunk(tuple(part.start for part in box), compressed)

    try:
        _copy_variables(large, chunks, compress, put, progress)
        with lock:
            target.flush()
    finally:
        with lock, suppress(RuntimeError):  # of a full disk, after the error that says so
            target.close()


def _create_variable(
    file: Any, name: str, variable: xr.Variable, encoding: Mapping[str, Any]
) -> None:
    """Create a variable and its dimensions in a NetCDF file."""
    for dim, size in variable.sizes.items():
        if dim not in file.dimensions:
            file.createDimension(str(dim), size)
    options = dict(encoding)
    fill, kind = options.pop("_FillValue"), variable.dtype.newbyteorder("=")
    made = file.createVariable(name, kind, _dim_names(variable), fill_value=fill, **options)
    made.setncatts(variable.attrs)


def append_zarr(
    path: Path,
    large: Mapping[str, xr.Variable],
    encoding: Mapping[Any, Mapping[str, Any]],
    *,
    progress: Progress | None = None,
) -> None:
    """Add variables to a Zarr store, every chunk of them, and consolidate the metadata."""
    import zarr

    group = zarr.open_group(path, mode="r+", zarr_format=2)
    targets: dict[str, Any] = {}
    for name, variable in large.items():
        options = dict(encoding[name])
        attrs = {
            key: value.tolist() if isinstance(value, np.ndarray | np.generic) else value
            for key, value in variable.attrs.items()
        }
        targets[name] = group.create_array(
            name,
            shape=variable.shape,
            dtype=variable.dtype,
            fill_value=options.pop("_FillValue"),
            attributes={"_ARRAY_DIMENSIONS": _dim_names(variable), **attrs},
            config={"write_empty_chunks": True},
            **options,
        )

    def put(name: str, box: _Box, values: Array) -> None:
        targets[name][box] = values

    chunks = {name: encoding[name]["chunks"] for name in large}
    _copy_variables(large, chunks, lambda _, values: values, put, progress)
    zarr.consolidate_metadata(path, zarr_format=2)


#: A chunk, of the last one along a dimension only the part that lies within the variable.
_Box = tuple[slice, ...]


def _copy_variables(
    large: Mapping[str, xr.Variable],
    chunks: Mapping[str, tuple[int, ...]],
    encode: Callable[[str, Array], Any],
    put: Callable[[str, _Box, Any], None],
    progress: Progress | None,
) -> None:
    """Read and encode chunks of variables in threads, and write them in order meanwhile."""

    def read(chunk: tuple[str, _Box, Array | None]) -> tuple[str, _Box, int, Any]:
        name, box, values = chunk
        values = read_box(large[name].data, box) if values is None else values
        return name, box, values.size, encode(name, values)

    done, total = 0, sum(variable.size for variable in large.values())
    for name, box, size, encoded in map_in_order(read, _list_chunks(large, chunks)):
        put(name, box, encoded)
        done += size
        if progress is not None:
            progress(done / total)


def _list_chunks(
    large: Mapping[str, xr.Variable], chunks: Mapping[str, tuple[int, ...]]
) -> Iterator[tuple[str, _Box, Array | None]]:
    """List all chunks in the order of time; dask computes those that only it can read.

    It computes many at a time, as it walks a whole graph each time.
    """
    ordered: list[tuple[float, str, _Box]] = []
    for name, variable in large.items():
        starts = [range(0, *pair) for pair in zip(variable.shape, chunks[name], strict=True)]
        for begin in product(*starts):
            corner = zip(begin, chunks[name], variable.shape, strict=True)
            box = tuple(slice(first, min(first + step, size)) for first, step, size in corner)
            ordered.append((begin[-1] / variable.shape[-1], name, box))
    ordered.sort(key=itemgetter(0))
    batch: list[tuple[str, _Box]] = []
    n_bytes = 0
    for _, name, box in ordered:
        data = large[name].data
        if isinstance(data, np.ndarray) or find_source(data) is not None:
            yield name, box, None
            continue
        batch.append((name, box))
        n_bytes += 8 * math.prod(part.stop - part.start for part in box)
        if n_bytes >= MAX_BATCH_BYTES:
            yield from _compute_chunks(large, batch)
            batch, n_bytes = [], 0
    if batch:
        yield from _compute_chunks(large, batch)


def _compute_chunks(
    large: Mapping[str, xr.Variable], batch: Sequence[tuple[str, _Box]]
) -> Iterator[tuple[str, _Box, Array]]:
    import dask

    arrays = dask.compute(*(large[name].data[box] for name, box in batch))
    for (name, box), values in zip(batch, arrays, strict=True):
        yield name, box, values
