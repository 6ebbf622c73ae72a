"""Writing the long variables of a log in chunks of one axis and about 20 minutes.

Samples that the source had as integer counts are stored as counts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.kernels.encoding.counts import to_counts
from gyrostab.store.lazy import Converted, find_source, make_dask, read_into
from gyrostab.store.private import library_lock
from gyrostab.store.threads import MAX_WORKERS, map_in_order

__all__ = [
    "NotCountsError",
    "Progress",
    "append_netcdf",
    "append_zarr",
    "as_counts",
    "chunk_samples",
    "common_packing",
    "create_variables",
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
    >>> chunk_samples(400.0), chunk_samples(1.0), chunk_samples(1e5)
    (480000, 65536, 4194304)
    """
    return int(np.clip(round(CHUNK_SECONDS * rate), *CHUNK_LIMITS))


def as_counts(name: str, variable: xr.Variable) -> xr.Variable:
    """Convert a variable to counts of 16 or 32 bits if its encoding declares them.

    The encoding must hold an integer dtype and a scale factor; other variables stay unchanged.

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
    data = variable.data
    if variable.chunks is None:
        packed = pack(data)
    elif find_source(data) is not None:
        packed = make_dask(Converted(data, pack, dtype), data.chunks)
    else:
        packed = data.map_blocks(pack, dtype=dtype, meta=np.empty((0,) * variable.ndim, dtype))
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
        str(name): variable
        for name, variable in stored.variables.items()
        if variable.chunks is not None and variable.size
    }
    return {
        name: variable
        for name, variable in lazy.items()
        if str(variable.dims[-1]).startswith("time")
    }


def _dim_names(variable: xr.Variable) -> list[str]:
    return [str(dim) for dim in variable.dims]


def create_variables(
    file: Any, variables: Mapping[str, xr.Variable], encoding: Mapping[Any, Mapping[str, Any]]
) -> dict[str, Any]:
    """Create variables and their dimensions in a NetCDF file; `encoding` as for xarray."""
    created = {}
    for name, variable in variables.items():
        for dim, size in variable.sizes.items():
            if dim not in file.dimensions:
                file.createDimension(str(dim), size)
        options = dict(encoding[name])
        fill = variable.attrs.get("_FillValue", options.pop("_FillValue", None))
        made = file.createVariable(
            name, variable.dtype, _dim_names(variable), fill_value=fill, **options
        )
        made.setncatts({key: value for key, value in variable.attrs.items() if key != "_FillValue"})
        made.set_auto_maskandscale(False)
        created[name] = made
    return created


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
        with lock:
            targets = create_variables(file, long, encoding)

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
    """Read lazy variables in threads, in whole chunks, and write them in order meanwhile."""
    import dask
    from dask.system import CPU_COUNT

    direct = {name: v for name, v in long.items() if find_source(v.data) is not None}
    computed = {name: v for name, v in long.items() if name not in direct}
    segments = chain.from_iterable(_plan_batches(direct, lengths, 1))
    workers = min(dask.config.get("num_workers", None) or CPU_COUNT, MAX_WORKERS)
    batches = chain(
        map_in_order(partial(_read_segment, direct), segments, workers=workers),
        # dask walks a whole graph each time
        map_in_order(
            partial(_compute_batch, computed),
            _plan_batches(computed, lengths, MAX_BATCH_BYTES),
            workers=1,
        ),
    )
    done, total = 0, sum(variable.size for variable in long.values())
    for batch in batches:
        for (name, row, begin, span), block in batch:
            for at in range(0, span, lengths[name]):
                piece = block[at : at + lengths[name]]
                put(name, row, slice(begin + at, begin + at + piece.size), piece)
            done += span
        if progress is not None:
            progress(done / total)


#: Name, row, first sample and number of samples of a part of a variable.
_Segment = tuple[str, tuple[int, ...], int, int]
_Batch = list[tuple[_Segment, NDArray[Any]]]


def _read_segment(long: dict[str, xr.Variable], segment: _Segment) -> _Batch:
    """Read a segment of a variable with a source, in the calling thread."""
    name, row, begin, span = segment
    values = np.empty(span, long[name].dtype)
    read_into(long[name].data, row[0] if row else 0, begin, values)
    return [(segment, values)]


def _compute_batch(long: dict[str, xr.Variable], batch: list[_Segment]) -> _Batch:
    import dask

    lazy = [long[name].data[(*row, slice(begin, begin + span))] for name, row, begin, span in batch]
    return list(zip(batch, dask.compute(*lazy), strict=True))


def _plan_batches(
    long: dict[str, xr.Variable], lengths: dict[str, int], most_bytes: int
) -> Iterator[list[_Segment]]:
    """Plan batches of whole chunks of variables with the same chunks, each a list of segments."""
    kinds = {name: (variable.dims[-1], lengths[name]) for name, variable in long.items()}
    for kind in dict.fromkeys(kinds.values()):
        rows = [
            (name, row)
            for name, variable in long.items()
            if kinds[name] == kind
            for row in np.ndindex(*variable.shape[:-1])
        ]
        name = rows[0][0]
        span = lengths[name] * max(1, most_bytes // (8 * len(rows) * lengths[name]))
        size = long[name].shape[-1]
        for begin in range(0, size, span):
            yield [(name, row, begin, min(span, size - begin)) for name, row in rows]
