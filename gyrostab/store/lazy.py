"""Lazy arrays: values that are read from files, or derived from other arrays, when needed.

There is one mechanism. A `Source` reads any part of its values directly, in the calling thread.
`make_dask` wraps it in a dask array, which xarray and users handle like any other; the graph of
that array consists of the source and one task for each chunk. `find_source` returns the source of
such an array, so that code that needs a slice reads it without a task of dask (`read_slice`,
`read_into`): for one small slice, dask takes ten times as long. Arrays that are derived from it,
and arrays of other programs, have no source and are computed by dask.
"""

from __future__ import annotations

import uuid
from bisect import bisect_right
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from gyrostab.arrays import Array, Ints
from gyrostab.errors import reading_of


class Source:
    """Values that are read when they are needed; as much of an array as dask asks for."""

    #: Those of the whole array.
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    parts: Sequence[Any] = ()  # arrays that the values are derived from
    path: Path | None = None  # file that the values are read from

    @property
    def ndim(self) -> int:
        """Number of dimensions."""
        return len(self.shape)

    def __getitem__(self, box: Any) -> Array:
        """Return the values in a box: one slice for each dimension, each with start and stop."""
        raise NotImplementedError

    def read_into(self, row: int, begin: int, out: Array) -> None:
        """Read samples of one row (0 in one dimension) from `begin` on into `out`."""
        along = slice(begin, begin + out.size)
        out[:] = self[along] if self.ndim == 1 else self[row : row + 1, along][0]


class RowSource(Source):
    """A source of one or two dimensions that reads samples of one row; see `Source.read_into`."""

    def __getitem__(self, box: Any) -> Array:
        *above, last = box if isinstance(box, tuple) else (box,)
        begin, end, step = last.indices(self.shape[-1])
        rows: Any = range(self.shape[0])[above[0]] if above else range(1)
        values = np.empty((len(rows), max(end - begin, 0)), self.dtype)
        for row, line in zip(rows, values, strict=True):
            self.read_into(row, begin, line)
        values = values[:, ::step]
        return values if above else values[0]


def make_dask(source: Source, chunks: Any) -> Any:
    """Wrap a source in a dask array; `chunks` as for `dask.array.from_array`.

    Examples
    --------
    >>> make_dask(Converted(np.arange(10.0), np.asarray, float), 4)[3:6].compute()
    array([3., 4., 5.])
    """
    import dask.array as da

    return da.from_array(
        source,
        chunks=chunks,
        name=f"gyrostab-{uuid.uuid4().hex}",
        asarray=False,
        fancy=False,
        inline_array=False,  # the graph holds the source once, where `find_source` finds it
        meta=np.empty((0,) * source.ndim, source.dtype),
    )


#: Prefix that dask gives to the name of the layer of a graph that holds the wrapped array.
_LAYER = "original-"


def find_source(array: Any) -> Source | None:
    """Return the source of an array of `make_dask`; None for other arrays."""
    if isinstance(array, Source):
        return array
    graph = getattr(array, "dask", None)
    return None if graph is None else _source_in_layer(graph, f"{_LAYER}{array.name}")


def _source_in_layer(graph: Any, name: str) -> Source | None:
    layer = getattr(graph, "layers", {}).get(name, {})
    node = layer.get(name)
    if not isinstance(node, Source):
        node = getattr(node, "value", None)  # some versions of dask wrap data of a graph
    return node if isinstance(node, Source) else None


def find_files(array: Any) -> set[Path]:
    """Find the files that an array reads through sources; empty for an array in memory."""
    source = find_source(array)
    if source is not None:
        own_files = set() if source.path is None else {source.path}
        return own_files.union(*map(find_files, source.parts))
    return set().union(*map(find_files, _sources_of_graph(array).values()))


def _sources_of_graph(array: Any) -> dict[str, Source]:
    graph = getattr(array, "dask", None)
    names = [name for name in getattr(graph, "layers", ()) if name.startswith(_LAYER)]
    sources = {name: _source_in_layer(graph, name) for name in names}
    return {name: source for name, source in sources.items() if source is not None}


def keep_sources(array: Any, derived: Any) -> Any:
    """Return a derived dask array whose graph names the sources of `array`, for `find_files`.

    dask leaves unused layers of a graph out when it computes.
    """
    import dask.array as da
    from dask.highlevelgraph import HighLevelGraph

    sources = _sources_of_graph(array)
    layers = {**{name: {name: source} for name, source in sources.items()}, **derived.dask.layers}
    needs = {**{name: set() for name in sources}, **derived.dask.dependencies}
    return da.Array(
        HighLevelGraph(layers, needs), derived.name, derived.chunks, dtype=derived.dtype
    )


def read_into(array: Any, row: int, begin: int, out: Array) -> None:
    """Read samples of one row of an array into `out`, in the calling thread.

    Parameters
    ----------
    array : ndarray, Source or dask.array.Array, shape (time,) or (row, time)
        The array.
    row : int
        The row; 0 for an array of one dimension.
    out : ndarray
        Receives as many samples as it has elements, converted to its type.
    """
    source = find_source(array)
    if source is not None and source.dtype == out.dtype:
        source.read_into(row, begin, out)
    else:
        box = (slice(row, row + 1), slice(begin, begin + out.size))
        out[:] = read_box(array, box[-array.ndim :]).reshape(out.shape)


def read_slice(array: Any, begin: int, end: int) -> Array:
    """Read samples `begin` to `end` along the last dimension of an array, in the calling thread.

    Examples
    --------
    >>> read_slice(np.arange(10.0), 3, 6)
    array([3., 4., 5.])
    """
    return read_box(array, (*(slice(None),) * (len(array.shape) - 1), slice(begin, end)))


def read_box(array: Any, box: Sequence[slice]) -> Array:
    """Read the values of an array in a box, one slice per dimension, in the calling thread.

    Examples
    --------
    >>> read_box(np.arange(12).reshape(3, 4), (slice(1, 3), slice(0, 2)))
    array([[4, 5],
           [8, 9]])
    """
    ends = tuple(slice(*part.indices(n)) for part, n in zip(box, array.shape, strict=True))
    source = find_source(array)
    selection = (array if source is None else source)[ends]
    return np.asarray(
        fill_masked(
            selection.compute(scheduler="synchronous")
            if hasattr(selection, "compute")
            else selection
        )
    )


class FileVariable(Source):
    """A variable that xarray opened without dask; failed reads name the file.

    Reading raises `gyrostab.errors.DamageError`.
    """

    def __init__(self, variable: Any, path: Path):
        self.variable, self.path = variable, path
        self.shape, self.dtype = variable.shape, variable.dtype

    def __getitem__(self, box: Any) -> Array:
        with reading_of(str(self.path)):
            return np.asarray(self.variable[box].values)


class Converted(Source):
    """An array whose values are converted when they are read."""

    def __init__(self, array: Any, convert: Callable[[Array], Array], dtype: Any):
        self.parts, self.convert = (array,), convert
        self.shape, self.dtype = array.shape, np.dtype(dtype)

    def __getitem__(self, box: Any) -> Array:
        return self.convert(read_box(self.parts[0], box if isinstance(box, tuple) else (box,)))


def convert_values(array: Any, convert: Callable[[Array], Array], dtype: Any) -> Any:
    """Return converted values, in dask if the array is; a source can still be read."""
    if not hasattr(array, "dask"):
        return convert(array)
    if find_source(array) is not None:
        return make_dask(Converted(array, convert, dtype), array.chunks)
    return array.map_blocks(convert, dtype=dtype, meta=np.empty((0,) * array.ndim, dtype))


def fill_masked(array: Any) -> Any:
    """Return an array with NaN in the place of masked values, lazy if it is; others unchanged.

    Examples
    --------
    >>> fill_masked(np.ma.array([1, 2], mask=[False, True]))
    array([ 1., nan])
    """
    if not isinstance(getattr(array, "_meta", array), np.ma.MaskedArray):
        return array
    if array.dtype.kind != "f":
        array = array.astype(np.float64)
    return (
        convert_values(array, fill_masked, array.dtype)
        if hasattr(array, "dask")
        else array.filled(np.nan)
    )


def hide_infinite(array: Any) -> Any:
    """Return an array with NaN in the place of infinite and masked values, lazy if it is."""
    array = fill_masked(array)
    if array.dtype.kind != "f":
        return array
    if hasattr(array, "dask"):
        return convert_values(array, hide_infinite, array.dtype)
    infinite = np.isinf(array)
    return np.where(infinite, array.dtype.type(np.nan), array) if infinite.any() else array


class _Joined(RowSource):
    """Columns one after the other."""

    def __init__(self, columns: Sequence[Any]):
        self.parts = tuple(columns)
        self.dtype = np.result_type(*(column.dtype for column in columns))
        self.edges = np.cumsum([0, *(column.shape[-1] for column in columns)]).tolist()
        self.shape = (self.edges[-1],)

    def read_into(self, row: int, begin: int, out: Array) -> None:
        done, piece = 0, bisect_right(self.edges, begin) - 1
        while done < out.size:
            remaining = self.edges[piece + 1] - begin - done
            place = out[done : done + remaining]
            read_into(self.parts[piece], row, begin + done - self.edges[piece], place)
            done, piece = done + place.size, piece + 1


def concatenate_columns(columns: Sequence[Any], chunk: int) -> Any:
    """Concatenate columns; the result is a dask array if one of them is."""
    if all(isinstance(column, np.ndarray) for column in columns):
        return np.concatenate(columns)
    return make_dask(_Joined(columns), chunk)


class _Stacked(RowSource):
    """Arrays of one dimension as the rows of one array."""

    def __init__(self, rows: Sequence[Any]):
        self.parts, self.dtype = tuple(rows), rows[0].dtype
        self.shape = (len(rows), rows[0].shape[-1])

    def read_into(self, row: int, begin: int, out: Array) -> None:
        """Read samples of one row from `begin` on into `out`."""
        read_into(self.parts[row], 0, begin, out)


def stack_rows(rows: Sequence[Any]) -> Any:
    """Stack arrays of one dimension as the rows of one array; a dask array if one of them is."""
    lazy_rows = [row for row in rows if not isinstance(row, np.ndarray)]
    if not lazy_rows:
        return np.stack(rows)
    return make_dask(_Stacked(rows), (1, lazy_rows[0].chunks[0]))


class _Selected(RowSource):
    """Samples of one row or of all rows of an array, from one sample on."""

    def __init__(self, array: Any, row: int | None, begin: int, shape: tuple[int, ...]):
        self.parts, self.dtype, self.shape = (array,), array.dtype, shape
        self.row, self.begin = row, begin

    def read_into(self, row: int, begin: int, out: Array) -> None:
        source_row = row if self.row is None else self.row
        read_into(self.parts[0], source_row, self.begin + begin, out)


def select_part(array: Any, row: int | None, begin: int = 0, end: int | None = None) -> Any:
    """Select one row (all if None) and samples `begin` to `end`; a source can still be read."""
    part = array[..., begin:end] if row is None else array[row, begin:end]
    if find_source(array) is None:
        return part
    return make_dask(_Selected(array, row, begin, part.shape), part.chunks)


class _Taken(RowSource):
    """Samples of an array of one dimension at some places."""

    def __init__(self, array: Any, places: Ints):
        self.parts, self.dtype, self.shape = (array,), array.dtype, places.shape
        self.places = places

    def read_into(self, row: int, begin: int, out: Array) -> None:
        """Read samples from `begin` on into `out`, each run of neighbours at once."""
        places = self.places[begin : begin + out.size]
        edges = [0, *(np.flatnonzero(np.diff(places) != 1) + 1).tolist(), out.size]
        for first, end in pairwise(edges):
            if end > first:
                read_into(self.parts[0], 0, int(places[first]), out[first:end])


def take_samples(array: Any, places: Ints, chunk: int) -> Any:
    """Select the samples at `places` of an array of one dimension; a source can still be read."""
    if find_source(array) is None:
        return array[places]
    return make_dask(_Taken(array, places), chunk)


class _Transposed(Source):
    """A source with its dimensions in another order."""

    def __init__(self, source: Source, order: Sequence[int]):
        self.parts, self.order, self.dtype = (source,), order, source.dtype
        self.shape = tuple(source.shape[place] for place in order)

    def __getitem__(self, box: Any) -> Array:
        source_box = [box[self.order.index(place)] for place in range(self.ndim)]
        return np.asarray(self.parts[0][tuple(source_box)]).transpose(self.order)


def transpose_lazy(variable: Any, dims: Sequence[Any]) -> Any:
    """Transpose a variable of xarray; a source can still be read.

    `dims` as for `xarray.Variable.transpose`; those that the variable lacks are left out.
    """
    turned = variable.transpose(*dims, missing_dims="ignore")
    source = find_source(variable.data) if variable.chunks is not None else None
    if source is None or variable.dims == turned.dims:
        return turned
    order = [variable.dims.index(dim) for dim in turned.dims]
    return turned.copy(data=make_dask(_Transposed(source, order), turned.chunks))
