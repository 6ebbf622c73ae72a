"""Writing the long variables of a log in chunks of one axis and about 20 minutes.

Samples that the source had as integer counts are stored as counts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.kernels.encoding.counts import to_counts
from gyrostab.store.lazy_slices import can_read_into, read_into, with_row_reader
from gyrostab.store.netcdf_lock import library_lock

__all__ = [
    "NotCountsError",
    "Progress",
    "append_netcdf",
    "append_zarr",
    "as_counts",
    "chunk_samples",
    "common_packing",
    "long_variables",
]

CHUNK_SECONDS = 1200.0
#: Least and most samples in one chunk, for very slow and very fast logs.
CHUNK_LIMITS = (2**16, 2**22)
#: Size [bytes] of the doubles that are computed at a time while a lazy log is written.
MAX_BATCH_BYTES = 2**26
FILL_VALUES = {"int16": -32767, "int32": -2147483647}  # the defaults of NetCDF


#: Function that is called with the share that is done.
Progress = Callable[[float], None]


class NotCountsError(ValueError):
    """A variable turns out not to consist of counts; `args` is its name."""


def chunk_samples(rate: float) -> int:
    """Number of samples in one chunk of a log of `rate` [Hz]: 20 minutes, within `CHUNK_LIMITS`.

    Examples
    --------
    >>> chunk_samples(400.0), chunk_samples(1.0)
    (480000, 65536)
    """
    return int(np.clip(round(CHUNK_SECONDS * rate), *CHUNK_LIMITS))


def as_counts(name: str, variable: xr.Variable) -> xr.Variable:
    """Convert a variable to counts of 16 or 32 bits if its encoding declares them.

    The encoding must hold an integer dtype and a scale factor; other variables stay unchanged.

    Raises
    ------
    Misfit
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
    data = variable.data
    lazy = variable.chunks is not None
    packed = (
        data.map_blocks(pack, dtype=dtype, meta=np.empty((0,) * variable.ndim, dtype))
        if lazy
        else pack(data)
    )
    if lazy and can_read_into(data):
        packed = with_row_reader(packed, partial(_read_counts_into, data, pack))
    return xr.Variable(
        variable.dims,
        packed,
        {
            **variable.attrs,
            "scale_factor": float(scale),
            "_FillValue": np.dtype(dtype).type(FILL_VALUES[dtype]),
        },
    )


def _pack_counts(
    values: NDArray[np.float64], *, name: str, scale: float, dtype: str
) -> NDArray[np.integer[Any]]:
    counts = to_counts(values, scale, dtype, FILL_VALUES[dtype])
    if counts is None:
        raise NotCountsError(name)
    return counts


def _read_counts_into(
    data: Any,
    pack: Callable[[NDArray[np.float64]], NDArray[np.integer[Any]]],
    row: int,
    begin: int,
    out: NDArray[np.integer[Any]],
) -> None:
    """Read counts of one row of `data` from `begin` on, without dask."""
    values = np.empty(out.size)
    read_into(data, row, begin, values)
    out[:] = pack(values)


def common_packing(encodings: Iterable[Mapping[Any, Any]]) -> dict[str, Any]:
    """Find the encoding of a variable of concatenated logs: counts if all are counts of one factor.

    Examples
    --------
    >>> common_packing([{"dtype": "i2", "scale_factor": 0.1}, {"dtype": "i4", "scale_factor": 0.1}])
    {'dtype': dtype('int32'), 'scale_factor': 0.1}
    >>> common_packing([{"dtype": "i2", "scale_factor": 0.1}, {}])
    {}
    """
    encodings = list(encodings)
    scales = {encoding.get("scale_factor") for encoding in encodings}
    scale = scales.pop() if len(scales) == 1 else None
    if scale is None or not all("dtype" in encoding for encoding in encodings):
        return {}
    return {
        "dtype": np.result_type(*(np.dtype(encoding["dtype"]) for encoding in encodings)),
        "scale_factor": float(scale),
    }


def long_variables(stored: xr.Dataset) -> dict[str, xr.Variable]:
    """Find the lazy variables along time, which are written in batches."""
    lazy = {
        str(name): array.variable
        for name, array in stored.data_vars.items()
        if array.chunks is not None and array.size
    }
    return {
        name: variable
        for name, variable in lazy.items()
        if str(variable.dims[-1]).startswith("time")
    }


def _dim_names(variable: xr.Variable) -> list[str]:
    return [str(dim) for dim in variable.dims]


def append_netcdf(
    path: Path,
    long: dict[str, xr.Variable],
    encoding: dict[Any, dict[str, Any]],
    *,
    progress: Progress | None = None,
) -> None:
    """Add lazy variables to a NetCDF file; `encoding` as for xarray."""
    import netCDF4

    lock = library_lock()
    with lock:
        file = netCDF4.Dataset(path, "a")
    try:
        targets = {}
        with lock:
            for name, variable in long.items():
                for dim, size in variable.sizes.items():
                    if dim not in file.dimensions:
                        file.createDimension(str(dim), size)
                options = dict(encoding[name])
                fill = variable.attrs.get("_FillValue", options.pop("_FillValue", None))
                targets[name] = file.createVariable(
                    name, variable.dtype, _dim_names(variable), fill_value=fill, **options
                )
                targets[name].setncatts(
                    {key: value for key, value in variable.attrs.items() if key != "_FillValue"}
                )
                targets[name].set_auto_maskandscale(False)

        def put(name: str, row: tuple[int, ...], part: slice, values: NDArray[Any]) -> None:
            with lock:
                targets[name][(*row, part)] = values

        _copy_variables(
            long, {name: encoding[name]["chunksizes"][-1] for name in long}, put, progress
        )
    finally:
        with lock:
            file.close()


def append_zarr(
    path: Path,
    long: dict[str, xr.Variable],
    encoding: dict[Any, dict[str, Any]],
    *,
    progress: Progress | None = None,
) -> None:
    """Add lazy variables to a Zarr store, every chunk of them, and consolidate the metadata."""
    import zarr

    group = zarr.open_group(path, mode="r+", zarr_format=2)
    targets: dict[str, Any] = {}
    for name, variable in long.items():
        options = dict(encoding[name])
        fill = variable.attrs.get("_FillValue", options.pop("_FillValue", None))
        attrs = {key: value for key, value in variable.attrs.items() if key != "_FillValue"}
        targets[name] = group.create_array(
            name,
            shape=variable.shape,
            dtype=variable.dtype,
            fill_value=fill,
            attributes={"_ARRAY_DIMENSIONS": _dim_names(variable), **attrs},
            config={"write_empty_chunks": True},
            **options,
        )

    def put(name: str, row: tuple[int, ...], part: slice, values: NDArray[Any]) -> None:
        targets[name][(*row, part)] = values

    _copy_variables(long, {name: encoding[name]["chunks"][-1] for name in long}, put, progress)
    zarr.consolidate_metadata(path, zarr_format=2)


def _copy_variables(
    long: dict[str, xr.Variable],
    lengths: dict[str, int],
    put: Callable[[str, tuple[int, ...], slice, NDArray[Any]], None],
    progress: Progress | None,
) -> None:
    """Compute lazy variables in batches, and write each batch while the next one is computed."""
    import dask
    from dask.system import CPU_COUNT

    def write(
        parts: list[tuple[str, tuple[int, ...], int]], blocks: Sequence[NDArray[Any]]
    ) -> None:
        for (name, row, begin), block in zip(parts, blocks, strict=True):
            for at in range(0, block.shape[-1], lengths[name]):
                piece = block[..., at : at + lengths[name]]
                put(name, row, slice(begin + at, begin + at + piece.shape[-1]), piece)

    readers = ThreadPoolExecutor(
        dask.config.get("num_workers", None) or CPU_COUNT, thread_name_prefix="gyrostab-read"
    )
    with readers, ThreadPoolExecutor(1, thread_name_prefix="gyrostab-write") as pool:
        writing: Future[None] | None = None
        done, total = 0, sum(variable.size for variable in long.values())
        buffers: tuple[_Buffers, _Buffers] = ({}, {})  # one is written while the other is filled
        for number, parts in enumerate(_plan_batches(long, lengths)):
            blocks = _read_blocks(long, lengths, parts, readers, buffers[number % 2])
            if writing is not None:
                writing.result()
            writing = pool.submit(write, [part[:3] for part in parts], blocks)
            done += sum(span for _, _, _, span in parts)
            if progress is not None:
                progress(done / total)
        if writing is not None:
            writing.result()


#: Name, row, first sample and number of samples of a part of a variable; arrays by name and row
#: that every batch uses again.
_Segment = tuple[str, tuple[int, ...], int, int]
_Buffers = dict[tuple[str, tuple[int, ...]], NDArray[Any]]


def _read_blocks(
    long: dict[str, xr.Variable],
    lengths: dict[str, int],
    parts: list[_Segment],
    readers: ThreadPoolExecutor,
    buffers: _Buffers,
) -> list[NDArray[Any]]:
    """Read the parts of a batch, by row reader if there is one.

    dask computes the others, and walks its whole graph each time.
    """
    import dask

    lazy = [
        long[name].data[(*row, slice(begin, begin + span))]
        for name, row, begin, span in parts
        if not can_read_into(long[name].data)
    ]
    blocks: list[NDArray[Any]] = []
    reading: list[Future[None]] = []
    computed = iter(dask.compute(*lazy))
    for name, row, begin, span in parts:
        data = long[name].data
        if not can_read_into(data):
            blocks.append(next(computed))
            continue
        if buffers.get((name, row), _NO_VALUES).size < span:
            buffers[name, row] = np.empty(span, data.dtype)
        blocks.append(buffers[name, row][:span])
        for at in range(0, span, lengths[name]):
            reading.append(
                readers.submit(
                    read_into,
                    data,
                    row[0] if row else 0,
                    begin + at,
                    blocks[-1][at : at + lengths[name]],
                )
            )
    try:
        for future in reading:
            future.result()
    finally:
        for future in reading:
            future.cancel()
    return blocks


_NO_VALUES = np.empty(0)


def _plan_batches(
    long: dict[str, xr.Variable], lengths: dict[str, int]
) -> Iterator[list[tuple[str, tuple[int, ...], int, int]]]:
    """Plan batches of whole chunks of all variables on one time axis.

    Each part of a batch is a name, a row, the first sample and the number of samples.
    """
    for dim in dict.fromkeys(variable.dims[-1] for variable in long.values()):
        rows = [
            (name, row)
            for name, variable in long.items()
            if variable.dims[-1] == dim
            for row in np.ndindex(*variable.shape[:-1])
        ]
        name = rows[0][0]
        span = lengths[name] * max(1, MAX_BATCH_BYTES // (8 * len(rows) * lengths[name]))
        size = long[name].shape[-1]
        for begin in range(0, size, span):
            yield [(name, row, begin, min(span, size - begin)) for name, row in rows]
