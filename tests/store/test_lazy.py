"""Samples read without dask equal those of dask, bit for bit."""

import sys
import warnings
from itertools import pairwise

import dask.array as da
import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st

from gyrostab import make_log, to_netcdf, to_zarr
from gyrostab.allan.fit import fit_noise, fit_part
from gyrostab.ingest.columns.pieces import Spool
from gyrostab.ingest.concat.core import concatenate_logs
from gyrostab.ingest.concat.lazy import place_on_grid
from gyrostab.ingest.grid.place import Placement
from gyrostab.ingest.grid.regularise import rows_on_grid
from gyrostab.io.opening import open_log
from gyrostab.jobs import checkpoint
from gyrostab.jobs.run import load_log, run
from gyrostab.store import write
from gyrostab.store.lazy import (
    concatenate_columns,
    find_source,
    make_dask,
    read_box,
    read_into,
    read_slice,
    select_part,
    stack_rows,
    transpose_lazy,
)
from tests.support.stored import InMemory, make_lazy

WINDOW = {"window": "40s", "step": "10s", "taus": "8"}


@st.composite
def placed(draw):
    """Rows of arrays with gaps, on parts of a grid that may overlap, and the size of the grid."""
    size = draw(st.integers(1, 60))
    rows = []
    for _ in range(draw(st.integers(1, 2))):
        parts = []
        for _ in range(draw(st.integers(1, 4))):
            values = np.array(
                draw(st.lists(st.sampled_from([1.5, -2.0, np.nan]), min_size=1, max_size=40))
            )
            length = draw(st.integers(1, min(values.size, size)))
            cut = draw(st.integers(1, length))
            first, own = (
                draw(st.integers(0, size - length)),
                draw(st.integers(0, values.size - length)),
            )
            runs = [[first, own, cut], [first + cut, own + cut, length - cut]]
            parts.append((values, None, np.array(runs[: 1 + (cut < length)], dtype=np.int64)))
        rows.append(parts)
    return rows, size


@given(placed(), st.data())
def test_joined_samples_are_those_of_dask(made, data):
    rows, size = made
    joined = place_on_grid(rows, size, data.draw(st.integers(1, size)))
    assert find_source(joined) is not None
    begin = data.draw(st.integers(0, size))
    for row, expected in enumerate(joined.compute(scheduler="synchronous")):
        target = np.full(data.draw(st.integers(0, size - begin)), 7.0)
        read_into(joined, row, begin, target)
        np.testing.assert_array_equal(target, expected[begin : begin + target.size])


def test_runs_that_follow_each_other_are_read_with_one_slice():
    reads = []

    class Counting(InMemory):
        def read_into(self, row, begin, out):
            reads.append((begin, out.size))
            super().read_into(row, begin, out)

    values = np.arange(300.0)
    array = make_dask(Counting(values), 300)
    runs = np.array([[4 * number, 3 * number, 3] for number in range(100)])
    joined = place_on_grid([[(array, None, runs)]], 400, 400)
    target = np.empty(400)
    read_into(joined, 0, 0, target)
    assert np.isnan(target[3::4]).all()
    np.testing.assert_array_equal(target[np.isfinite(target)], values)
    assert reads == [(0, 300)]


def test_what_is_derived_from_an_array_is_not_read_past_dask():
    joined = place_on_grid([[(np.arange(9.0), None, np.array([[0, 0, 9]]))]], 9, 4)
    doubled = 2.0 * joined
    assert find_source(doubled) is None
    assert find_source(joined[:, 1:]) is None
    target = np.empty(3)
    read_into(doubled, 0, 4, target)
    np.testing.assert_array_equal(target, [8.0, 10.0, 12.0])


def stored_logs(folder, form):
    """Three logs of counts with gaps, a slow channel, and an overlap of the last two."""
    rng = np.random.default_rng(4)
    paths = []
    for number, begin in enumerate((0, 70_000, 130_000)):
        values = 0.02 * np.rint(100.0 * rng.standard_normal((2, 80_000)))
        values[:, 30_000:31_000] = np.nan
        start = str(np.datetime64("2026-02-01") + np.timedelta64(begin * 10, "ms"))
        log = make_log(values, rate=100.0, unit="deg/h", start=start)
        log.rate.encoding = {"dtype": "int32", "scale_factor": 0.02}
        log = log.assign_coords(time_temperature=log["time"].values[::20])
        log["temperature"] = (
            "time_temperature",
            rng.standard_normal(4000),
            {"units": "degree_Celsius"},
        )
        paths.append(
            {"nc": to_netcdf, "zarr": to_zarr}[form](
                log.chunk(time=65_536), folder / f"{number}.{form}"
            )
        )
    return paths


def opened(paths):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return load_log(paths)


@pytest.mark.parametrize("form", ["nc", "zarr"])
def test_stored_samples_are_those_of_dask(tmp_path, form):
    log = opened(stored_logs(tmp_path, form))
    rng = np.random.default_rng(5)
    for name in ("rate", "temperature"):
        data = log[name].data
        assert isinstance(data, da.Array)
        assert find_source(data) is not None
        whole = np.atleast_2d(data.compute())
        for begin, end in np.sort(rng.integers(0, data.shape[-1] + 1, (20, 2)), axis=1).tolist():
            for row, expected in enumerate(whole):
                target = np.full(end - begin, 7.0)
                read_into(data, row, begin, target)
                np.testing.assert_array_equal(target, expected[begin:end])


@pytest.mark.parametrize("form", ["nc", "zarr"])
@pytest.mark.parametrize("unit", [0.02, 0.05])
def test_a_joined_log_is_written_as_dask_would_give_it(tmp_path, monkeypatch, form, unit):
    monkeypatch.setattr(
        write, "MAX_BATCH_BYTES", 2**21
    )  # two stretches of 131072 samples of either axis, so that room is used again
    log = opened(stored_logs(tmp_path, form))
    log.rate.encoding = {**log.rate.encoding, "scale_factor": unit}
    slow = log.assign(
        {
            name: log[name].copy(data=log[name].data.map_blocks(np.array))
            for name in ("rate", "temperature")
        }
    )
    slow.rate.encoding = log.rate.encoding
    assert find_source(slow.rate.data) is None
    store = {"nc": to_netcdf, "zarr": to_zarr}[form]
    stored = []
    with warnings.catch_warnings():
        warnings.simplefilter(
            "error" if unit == 0.02 else "ignore"
        )  # of the other unit not every value is a multiple
        for name, source in (("quick", log), ("slow", slow)):
            stored.append(open_log(store(source, tmp_path / f"{name}.{form}")))
    assert stored[0].rate.encoding == stored[1].rate.encoding
    assert ("scale_factor" in stored[0].rate.encoding) == (unit == 0.02)
    xr.testing.assert_equal(stored[0].compute(), stored[1].compute())
    np.testing.assert_array_equal(stored[0].rate.values, log.rate.values)


def test_the_variables_of_a_product_are_written_without_dask(tmp_path, monkeypatch):
    paths, direct = stored_logs(tmp_path, "zarr"), []

    def watched(array, box):
        direct.append(find_source(array) is not None)
        return read_box(array, box)

    monkeypatch.setattr(write, "read_box", watched)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        run(paths, tmp_path / "product.nc", windows=WINDOW)
    assert direct
    assert all(direct)


def test_a_part_of_a_variable_in_blocks_is_that_of_the_whole(tmp_path):
    """Contiguous and other boxes of a block, across the edges of blocks."""
    rng, edges = np.random.default_rng(3), [0, 4, 5, 11]
    cube = rng.standard_normal((3, 11, 4))
    blocks = []
    for begin, end in pairwise(edges):
        part = xr.Dataset(
            {"avar": (("axis", "time", "tau"), cube[:, begin:end])},
            coords={"time": np.arange(begin, end)},
        )
        blocks.append(checkpoint.write_block(tmp_path, slice(begin, end), part, job="j"))
    array = checkpoint._make_lazy(blocks, "avar")
    np.testing.assert_array_equal(array.compute(), cube)
    for _ in range(200):
        place = tuple(
            slice(*np.sort(rng.choice(size + 1, 2, replace=False))) for size in cube.shape
        )
        np.testing.assert_array_equal(read_box(array, place), cube[place])
    turned = transpose_lazy(xr.Variable(("axis", "time", "tau"), array), ("tau", "axis", "time"))
    np.testing.assert_array_equal(
        read_box(turned.data, (slice(1, 3), slice(0, 1), slice(3, 9))),
        cube.transpose(2, 0, 1)[1:3, :1, 3:9],
    )
    assert find_source(turned.data) is not None
    blocks[1].path.write_bytes(blocks[1].path.read_bytes()[: blocks[1].begin + 5])
    with pytest.raises(OSError, match="is cut short"):
        read_box(array, (slice(0, 1), slice(0, 11), slice(0, 4)))


@pytest.mark.parametrize("options", [{}, {"terms": "NK"}, {"tau_min": "0.1s"}])
def test_a_part_is_fitted_as_the_whole(options):
    from gyrostab import davar

    rng = np.random.default_rng(6)
    values = rng.standard_normal((2, 40_000))
    values[0, rng.integers(0, 40_000, 4000)] = np.nan
    surface = davar(make_log(values, rate=100.0, unit="deg/h"), **WINDOW)
    xr.testing.assert_identical(
        fit_part(surface, **options), fit_noise(surface.chunk(time=5), **options).compute()
    )


@pytest.mark.slow
def test_worker_processes_tell_of_damage_as_threads_do(tmp_path):
    path = stored_logs(tmp_path, "zarr")[0]
    (path / "rate" / "1.0").unlink()
    for scheduler in ("threads", "processes"):
        with pytest.warns(
            UserWarning, match=r"axis y: the chunk from .* is missing: no file rate/1\.0"
        ):
            run(
                [path], tmp_path / f"{scheduler}.nc", windows=WINDOW, scheduler=scheduler, workers=1
            )


def test_logs_in_memory_join_as_before():
    parts = [
        make_log(np.full(4, float(n)), rate=1.0, unit="deg/h", start=f"2026-01-01T00:00:0{3 * n}")
        for n in range(2)
    ]
    joined = concatenate_logs(parts, ["a.nc", "b.nc"]).rate.data
    target = np.empty(7)
    read_into(joined, 0, 0, target)
    np.testing.assert_array_equal(target, joined.compute()[0])


def placed_by_hand(runs, size, rows):
    """The grid by its definition, sample by sample."""
    out = np.full((len(rows), size), np.nan)
    for sample, first, length in runs:
        for i in range(length):
            out[:, sample + i] = np.where(np.isinf(rows[:, first + i]), np.nan, rows[:, first + i])
    return out


@pytest.mark.parametrize("storage", ["memory", "disk", "both"])
@pytest.mark.parametrize(("scale", "unit"), [(1.0, None), (3.0, None), (2.0, 0.1)])
def test_rows_are_put_on_the_grid_directly_as_by_dask(storage, scale, unit, monkeypatch):
    monkeypatch.setattr(sys.modules["gyrostab.ingest.grid.regularise"], "MAX_PLAIN_NUMBERS", 10)
    rng = np.random.default_rng(8)
    rows = 0.1 * rng.integers(-50, 50, (2, 3000)).astype(float)
    rows[0, 5], rows[1, 1200] = np.inf, np.nan
    runs = np.array([[0, 0, 700], [705, 700, 1], [900, 800, 1000], [5000, 1900, 1100]])
    spool, cut = Spool(), 1234
    pieces = {
        "memory": [rows],
        "disk": [rows[:, :cut], rows[:, cut:]],
        "both": [rows[:, :cut], rows[:, cut:]],
    }[storage]
    on_disk = [
        storage == "disk" or (storage == "both" and number > 0) for number in range(len(pieces))
    ]
    columns = [
        [
            make_dask(spool.store(piece[row]), 2**21) if spooled else piece[row]
            for piece, spooled in zip(pieces, on_disk, strict=True)
        ]
        for row in (0, 1)
    ]
    raw = (
        rows
        if storage == "memory"
        else stack_rows([concatenate_columns(column, 500) for column in columns])
    )
    placed = rows_on_grid(
        raw, Placement(0, 1.0, runs, np.empty((0, 5), np.int64)), chunk=512, scale=scale, unit=unit
    )
    assert find_source(placed) is not None
    expected = placed_by_hand(runs, 6100, rows)
    if scale != 1.0:
        expected = expected * scale if unit is None else np.rint(expected / unit) * (unit * scale)
    np.testing.assert_array_equal(placed.compute(), expected)
    for begin, end in [
        (0, 6100),
        (3, 4),
        (701, 705),
        (690, 910),
        (1850, 5001),
        (2000, 2000),
        (6000, 6100),
    ]:
        np.testing.assert_array_equal(read_slice(placed, begin, end), expected[:, begin:end])
    np.testing.assert_array_equal(
        read_slice(select_part(placed, 1), 600, 1000), expected[1, 600:1000]
    )


def test_columns_of_unlike_types_are_converted_when_they_are_read():
    lazy = da.from_array(np.arange(2.0), chunks=1)  # of another program
    mixed = concatenate_columns([np.arange(3), make_lazy(np.arange(4.0, 6.0), 10), lazy], 3)
    assert mixed.dtype == np.float64
    np.testing.assert_array_equal(mixed.compute(), [0.0, 1.0, 2.0, 4.0, 5.0, 0.0, 1.0])
    np.testing.assert_array_equal(read_slice(mixed, 2, 6), [2.0, 4.0, 5.0, 0.0])
    stacked = stack_rows([lazy, np.array([7.0, 8.0])])
    np.testing.assert_array_equal(stacked.compute(), [[0.0, 1.0], [7.0, 8.0]])
