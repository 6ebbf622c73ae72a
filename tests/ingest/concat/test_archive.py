"""Hundreds of regular logs concatenated lazily to one."""

from __future__ import annotations

import pickle
import subprocess
import sys
from pathlib import Path

import dask.array as da
import numpy as np
import pytest
import xarray as xr
from hypothesis import assume, given
from hypothesis import strategies as st

from gyrostab import make_log
from gyrostab.errors import OptionError, TimeError, UnitError
from gyrostab.ingest import read_log
from gyrostab.ingest.concat.core import concatenate_logs
from gyrostab.ingest.concat.grid import runs_of
from gyrostab.ingest.grid.gaps import gap_table
from gyrostab.ingest.grid.place import append_runs
from gyrostab.ingest.grid.regularise import regularise
from gyrostab.io import datasets as export
from gyrostab.schema import GAP_CAUSES
from gyrostab.store.write import declare_counts
from gyrostab.time.grid import TimeGridIndex, grid_times
from tests.support.regular_logs import (
    RATE,
    SIZE,
    START,
    cut,
    log_of,
    nan_runs,
    rechunked,
    said,
    signal,
)


def names(logs: list[xr.Dataset]) -> list[str]:
    return [f"{chr(97 + place)}.nc" for place in range(len(logs))]


def join(*logs: xr.Dataset, **options) -> xr.Dataset:
    return concatenate_logs(list(logs), names(list(logs)), **options)


def table_of(log: xr.Dataset) -> np.ndarray:
    """Return first sample, end and length of every gap."""
    table = gap_table(log)
    index = log.xindexes["time"]
    assert isinstance(index, TimeGridIndex)
    first, end = (
        np.rint((table[name].to_numpy().astype(np.int64) - index.start) * RATE / 1e9)
        for name in ("start", "end")
    )
    return np.stack([first, end, table["samples"]], axis=1).astype(np.int64)


@pytest.mark.parametrize("suffix", [".nc", ".zarr"])
def test_stored_pieces_in_any_order_restore_the_whole_log(tmp_path: Path, suffix: str) -> None:
    values = signal()
    values[:, 1999:2001] = values[:, 4799] = 1.0  # pieces begin and end with a sample
    paths = []
    for place, (a, b) in enumerate([(4300, 6000), (0, 2000), (1900, 4000)]):
        log = log_of(values[:, a:b], a).assign(
            vibration=("time", np.arange(a, b) * 1.0, {"units": "g"})
        )
        log.attrs["source_files"] = [f"tool_{place}.csv"]
        write = export.to_netcdf if suffix == ".nc" else export.to_zarr
        paths.append(write(log, tmp_path / f"{place}{suffix}"))
    joined = read_log(paths)
    expected = np.where((np.arange(SIZE) >= 4000) & (np.arange(SIZE) < 4300), np.nan, values)
    assert joined.rate.chunks is not None
    np.testing.assert_array_equal(joined.rate, expected)
    np.testing.assert_array_equal(
        joined.vibration,
        np.where((np.arange(SIZE) >= 4000) & (np.arange(SIZE) < 4300), np.nan, np.arange(SIZE)),
    )
    np.testing.assert_array_equal(
        joined.time.values.astype(np.int64), grid_times(START, RATE, np.arange(SIZE))
    )
    np.testing.assert_array_equal(table_of(joined), nan_runs(expected)[:, :3])
    assert set(gap_table(joined)["cause"]) == {"missing"}
    assert joined.attrs["source_files"] == ["tool_1.csv", "tool_2.csv", "tool_0.csv"]
    assert "2.0 s from 2026-03-01T10:00:38.000 are in 1" in said(joined)


@given(data=st.data())
def test_every_sample_of_any_piece_appears_once(data: st.DataObject) -> None:
    size = data.draw(st.integers(300, 900), label="samples")
    values = signal(size, seed=data.draw(st.integers(0, 99), label="seed"))
    spans = data.draw(
        st.lists(
            st.tuples(st.integers(0, size - 50), st.integers(50, 400)), min_size=2, max_size=6
        ),
        label="begin and length",
    )
    pieces = []
    expected = np.full_like(values, np.nan)
    for a, length in spans:
        part = values[:, a : a + length].copy()
        lost = data.draw(st.integers(0, part.shape[1] - 40), label="lost")
        part[:, lost : lost + data.draw(st.integers(0, 30), label="length of loss")] = np.nan
        window = expected[:, a : a + part.shape[1]]
        window[np.isnan(window)] = part[np.isnan(window)]
        pieces.append(rechunked(log_of(part, a), data.draw(st.integers(20, 500), label="chunk")))
    joined = join(*pieces)
    first, last = min(a for a, _ in spans), max(min(a + n, size) for a, n in spans)
    np.testing.assert_array_equal(joined.rate, expected[:, first:last])
    np.testing.assert_array_equal(
        joined.time[[0]].values.astype(np.int64), grid_times(START, RATE, [first])
    )
    missing = np.zeros(last - first, dtype=bool)
    for begin, end, samples in table_of(joined):
        assert samples == end - begin
        assert not missing[begin:end].any()
        missing[begin:end] = True
    np.testing.assert_array_equal(missing, np.isnan(expected[0, first:last]))


def test_table_of_gaps_keeps_causes_and_lists_gaps_between_logs() -> None:
    values = signal(1000, holes=0)
    values[:, 100:120] = values[:, 800:810] = np.nan
    first, second = cut(values, (0, 400), (600, 1000))
    first["gap_cause"][:] = GAP_CAUSES.index("unreadable")
    first["gap_rows"][:] = 20
    table = gap_table(join(second, first))
    assert table["cause"].tolist() == ["unreadable", "missing", "missing"]
    assert table["samples"].tolist() == [20, 200, 10]
    assert table["rows"].tolist() == [20, 0, 0]


def test_concatenated_logs_equal_a_log_of_all_source_files(tmp_path: Path) -> None:
    rng = np.random.default_rng(8)
    stamps = START + (np.arange(3000) * 1e9 / RATE + rng.uniform(0, 3e6, 3000)).astype(np.int64)
    values = np.round(rng.normal(size=3000), 4)
    paths = []
    for place, (a, b) in enumerate([(0, 1000), (990, 1800), (2100, 3000)]):
        rows = "".join(
            f"{stamp},{value}\n" for stamp, value in zip(stamps[a:b], values[a:b], strict=True)
        )
        paths.append(tmp_path / f"{place}.csv")
        paths[-1].write_text("time [ns],gyro_z [deg/h]\n" + rows)
    together = regularise(read_log(paths))
    joined = concatenate_logs([regularise(read_log(path)) for path in paths], paths)
    np.testing.assert_array_equal(joined.rate, together.rate)
    assert gap_table(joined)["samples"].tolist() == [300]


def test_it_is_lazy_and_its_graph_is_small(tmp_path: Path) -> None:
    values = signal()
    read: list[int] = []

    def block(part: np.ndarray) -> np.ndarray:
        read.append(part.shape[1])
        return part

    logs = cut(values, (0, 2000), (2000, 4000), (4500, 6000))
    lazy = [
        log.assign(
            rate=(
                log.rate.dims,
                log.rate.data.map_blocks(block, meta=np.empty((0, 0))),
                log.rate.attrs,
            )
        )
        for log in logs
    ]
    joined = join(*lazy)
    assert not read
    joined.rate[:1, :10].compute()
    assert read
    assert sum(read) < 7000  # the one chunk asked for
    paths = [export.to_zarr(log, tmp_path / f"{place}.zarr") for place, log in enumerate(logs)]
    graph = read_log(paths).rate.data.__dask_graph__()
    assert len(pickle.dumps(dict(graph))) < 30_000  # the values are 96 000 bytes
    assert len(dict(graph)) < 40


def test_chunks_have_one_length() -> None:
    values = np.zeros((2, 400_000))
    joined = join(
        *(rechunked(log, 70_000) for log in cut(values, (0, 140_000), (140_300, 400_000)))
    )
    assert joined.rate.chunks == ((1, 1), (70_000,) * 5 + (50_000,))


@pytest.mark.parametrize(
    ("shift", "sample"), [(100_000, 0), (7_000_000, 0), (-9_000_000, 0), (13_000_000, 1)]
)
def test_log_between_the_samples_takes_the_nearest(shift: int, sample: int) -> None:
    values = signal(1000, holes=0)
    first, second = *cut(values, (0, 500)), *cut(values, (600, 1000), shift=shift)
    joined = join(first, second)
    np.testing.assert_array_equal(joined.rate[:, 600 + sample : 1000 + sample], values[:, 600:])
    assert np.isnan(joined.rate[:, 500 : 600 + sample]).all()
    off = abs(shift / 2e7 - sample)
    assert ("between two samples" in said(joined)) == (off > 0.01)
    if off > 0.01:
        assert f"at most {off:.2g} of a sample ({off * 20:.3g} ms) away" in said(joined)


@pytest.mark.parametrize("ppm", [-80.0, -3.0, 3.0, 80.0])
def test_a_slightly_different_clock_is_followed_sample_by_sample(ppm: float) -> None:
    rate = RATE * (1 + ppm * 1e-6)
    size = 60_000
    values = np.arange(2.0 * size).reshape(2, size) + 1
    first, second = (
        log_of(values[:, :100]),
        log_of(values, 0, rate=rate, start=START + 4_000_000_000),
    )
    joined = join(first, second)
    position = 200 + np.arange(size) * RATE / rate
    samples = np.rint(position).astype(int)
    expected = np.full(joined.sizes["time"], np.nan)
    expected[:100] = values[0, :100]
    expected[samples[::-1]] = values[0, ::-1]  # the earlier of two samples for one
    np.testing.assert_array_equal(joined.rate[0], expected)
    assert f"up to {abs(ppm):.3g} parts per million" in said(joined)
    assert gap_table(joined)["samples"].sum() == np.isnan(expected).sum()


@given(
    off=st.floats(-0.5, 0.5),
    ratio=st.floats(-1e-2, 1e-2).map(lambda part: 1 + part),
    size=st.integers(1, 2000),
    first=st.integers(-9, 9),
)
def test_runs_are_the_nearest_samples(off: float, ratio: float, size: int, first: int) -> None:
    runs = runs_of(first, off, size, ratio)
    position = first + off + np.arange(size) * ratio
    assume(ratio != 1.0 and np.abs(position % 1 - 0.5).min() > 1e-9)
    samples: list[int] = []
    for sample, own, length in runs:
        assert (
            np.abs(np.arange(sample, sample + length) - position[own : own + length]).max()
            <= 0.5 + 1e-6
        )
        samples += range(sample, sample + length)
    assert sorted(samples) == sorted(set(np.rint(position).astype(int)))


def test_a_run_that_is_extended_twice_stays_one() -> None:
    runs: list[np.ndarray] = []
    for begin in range(0, 12, 4):
        append_runs(runs, np.arange(begin, begin + 4) + 7, np.arange(begin, begin + 4))
    assert np.concatenate(runs).tolist() == [[7, 0, 12]]


def test_logs_of_other_rates_and_kinds_are_refused_by_name() -> None:
    values = signal(200)
    first, second = log_of(values), log_of(values, 400, rate=RATE * 1.0002)
    with pytest.raises(TimeError, match=r"a.nc is a log of 50 Hz and b.nc one of 50.01 Hz"):
        join(first, second)
    angle = log_of(values, 400).rename(rate="angle").assign_attrs(kind="angle")
    angle["angle"].attrs["units"] = "degree"
    with pytest.raises(
        UnitError, match=r"a.nc holds a gyro signal of kind 'rate', b.nc of kind 'angle'"
    ):
        join(first, angle)


def test_common_samples_locate_a_log() -> None:
    values = signal(3000)
    joined = join(
        *cut(values, (0, 2000)), *cut(values, (1500, 3000), shift=70_000_000)
    )  # the second one's first stamp came late
    np.testing.assert_array_equal(joined.rate, values)
    assert "10.0 s from" in said(joined)


def test_damaged_copy_is_recognised() -> None:
    values = signal(2000, holes=0)
    first, second = values[:, :1200].copy(), values[:, 1000:].copy()
    first[:, 1100:1110] = np.nan
    second[:, 50:55] = 7777.0
    joined = join(log_of(first), log_of(second, 1000))
    np.testing.assert_array_equal(joined.rate, values)
    assert "5 of 190 compared samples differ; the samples of a.nc are kept" in said(joined)
    assert len(gap_table(joined)) == 0


def test_restarted_clock_is_not_an_overlap() -> None:
    first, second = signal(1000, seed=1, holes=0), signal(800, seed=2, holes=0)
    joined = join(log_of(first), log_of(second, 3))
    np.testing.assert_array_equal(
        joined.rate, np.concatenate([first, np.full((2, 1), np.nan), second], axis=1)
    )
    assert gap_table(joined)[["samples", "cause"]].to_numpy().tolist() == [[1, "restart"]]
    assert (
        "b.nc: time restarts: from 2026-03-01T10:00:19.980 to 2026-03-01T10:00:00.060, 19.9 s back"
        in said(joined)
    )


def test_a_long_pause_is_a_step_of_the_clock() -> None:
    values = signal(400, holes=0)
    distant = log_of(values, 20 * 86400 * 50)
    joined = join(log_of(values), distant, log_of(values, 20 * 86400 * 50 + 500))
    np.testing.assert_array_equal(joined.rate[:, 401:801], values)
    np.testing.assert_array_equal(joined.rate[:, 901:], values)
    assert gap_table(joined)["cause"].tolist() == ["clock_step", "missing"]
    assert "if the pause is real, raise max_gap" in said(joined)
    assert join(log_of(values), distant, max_gap="30D").sizes["time"] == 20 * 86400 * 50 + 400
    with pytest.raises(OptionError, match="max_gap 'long'"):
        join(log_of(values), distant, max_gap="long")


def test_small_overlap_is_not_a_step_of_the_clock() -> None:
    first, second = signal(500, seed=1, holes=0), signal(500, seed=2, holes=0)
    joined = join(log_of(first), log_of(second, 495))
    np.testing.assert_array_equal(joined.rate, np.concatenate([first, second[:, 5:]], axis=1))
    assert "b.nc: 5 samples lie on samples of a.nc and hold other values" in said(joined)


def test_axes_and_channels_that_some_logs_lack_are_missing_there() -> None:
    values = signal(1000, holes=0)
    first = log_of(values[:1, :500], axes="x").assign(
        vibration=("time", np.ones(500), {"units": "g"})
    )
    second = log_of(values[1:, 400:], 400, axes="y")
    joined = join(first, second)
    np.testing.assert_array_equal(
        joined.rate[0], np.where(np.arange(1000) < 500, values[0], np.nan)
    )
    np.testing.assert_array_equal(
        joined.rate[1], np.where(np.arange(1000) >= 400, values[1], np.nan)
    )
    np.testing.assert_array_equal(joined.vibration, np.where(np.arange(1000) < 500, 1.0, np.nan))
    assert "axis y is not in a.nc" in said(joined)
    assert "channel vibration is not in b.nc" in said(joined)
    wrong = second.assign(vibration=("time", np.ones(600), {"units": "m s-1"}))
    with pytest.raises(
        UnitError, match=r"'vibration' has different units: 'm s-1' in b.nc, 'g' in a.nc"
    ):
        join(first, wrong)
    other = wrong.assign(vibration=("time", np.full(600, 9.80665), {"units": "m s-2"}))
    assert np.ptp(join(first, other).vibration.values) < 1e-12


def with_temperature(log: xr.Dataset, seconds: np.ndarray) -> xr.Dataset:
    """Return a temperature equal to its own second, on separate stamps."""
    stamps = (START + seconds * 10**9).view("datetime64[ns]")
    return log.assign_coords(time_temperature=stamps).assign(
        temperature=("time_temperature", seconds * 1.0, {"units": "degree_Celsius"})
    )


@pytest.mark.parametrize("lazy", [False, True])
def test_channels_with_separate_stamps_are_concatenated_without_duplicates(lazy: bool) -> None:
    values = signal(3000, holes=0)
    spans, seconds = (
        [(0, 1500), (1000, 2000), (2500, 3000)],
        [np.arange(0, 30), np.r_[20:25, 28:40], np.arange(5, 60)],
    )
    logs = [
        with_temperature(log, own) for log, own in zip(cut(values, *spans), seconds, strict=True)
    ]
    logs = [log.chunk(time_temperature=7) for log in logs] if lazy else logs
    joined = join(*logs)
    assert (joined.temperature.chunks is not None) == lazy
    np.testing.assert_array_equal(
        joined.time_temperature.values.astype(np.int64), START + np.arange(60) * 10**9
    )
    np.testing.assert_array_equal(joined.temperature, np.arange(60.0))
    assert joined.temperature.dims == ("time_temperature",)


def test_a_lazy_channel_keeps_its_type() -> None:
    logs = [
        make_log(np.zeros(100), rate=10.0, unit="deg/h", start=f"2026-01-01T00:0{n}:00").assign(
            supply_voltage=(
                "time_supply_voltage",
                da.arange(5, dtype=np.float32, chunks=2),
                {"units": "V"},
            ),
            time_supply_voltage=np.datetime64(f"2026-01-01T00:0{n}:00", "ns")
            + np.arange(5) * np.timedelta64(2, "s"),
        )
        for n in range(2)
    ]
    channel = concatenate_logs(logs, ["a.nc", "b.nc"])["supply_voltage"]
    assert channel.dtype == np.float32
    assert channel.chunks is not None
    np.testing.assert_array_equal(channel, [*range(5)] * 2)


def test_a_channel_that_is_slow_in_one_log_only_lies_on_the_common_time() -> None:
    values = signal(1000, holes=0)
    first, second = cut(values, (0, 500), (500, 1000))
    first = first.assign(temperature=("time", np.arange(500.0), {"units": "degree_Celsius"}))
    joined = join(first, with_temperature(second, np.arange(10, 20)))
    expected = np.full(1000, np.nan)
    expected[:500] = np.arange(500)
    expected[500::50] = np.arange(10, 20)
    np.testing.assert_array_equal(joined.temperature, expected)


def test_counts_stay_counts_where_all_logs_have_the_same_factor() -> None:
    first, second = cut(signal(400) * 0.25, (0, 200), (200, 400))
    for log in (first, second):
        log.rate.encoding = declare_counts("int32", 0.25)
    assert join(first, second).rate.encoding == declare_counts("int32", 0.25)
    second.rate.encoding["scale_factor"] = 0.5
    assert not join(first, second).rate.encoding


@pytest.mark.slow
def test_two_hundred_logs_open_without_being_read() -> None:
    values = signal(200 * 300)
    logs = cut(values, *((a, a + 302) for a in range(0, 200 * 300, 300)))
    joined = join(*reversed(logs))
    np.testing.assert_array_equal(joined.rate, values)


# --- memory

READ_THROUGH = """
import sys, warnings
from pathlib import Path
import dask
from gyrostab.ingest import read_log

def most():
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))

def through(files):
    threads = dask.config.set(scheduler="threads", num_workers=2)
    with warnings.catch_warnings(), threads, read_log(files) as log:
        warnings.simplefilter("ignore")
        for begin in range(0, log.sizes["time"], 60_000):  # never whole chunks
            log.rate[:, begin : begin + 60_000].values
    return most()

files = sys.argv[1:]
few = [through(files[:16]) for _ in range(2)][-1]  # they fill the memory for chunks that are kept
print(few, through(files))
"""


@pytest.mark.skipif(
    not Path("/proc/self/status").exists(),
    reason="only Linux tells the peak of the memory this way",
)
@pytest.mark.full
def test_memory_does_not_grow_with_the_number_of_files(tmp_path: Path) -> None:
    """Files of six chunks of 256 KiB, the last of each axis short, which overlap a little."""
    size, paths = 70_000, []
    values = signal(size, holes=0)
    values[:, -100:] = values[:, :100]
    for place in range(48):
        log = log_of(np.concatenate([values, values[:1]]), place * (size - 100), axes="xyz")
        log["rate"].encoding = {"dtype": np.dtype("i4"), "scale_factor": 1.0}
        paths.append(export.to_netcdf(log.load(), tmp_path / f"{place:02d}.nc"))
    done = subprocess.run(
        [sys.executable, "-c", READ_THROUGH, *map(str, paths)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    few, many = map(int, done.stdout.split())
    assert (many - few) / 32 < 800, (
        f"{few / 1024:.0f} MiB with 16 files, {many / 1024:.0f} MiB with 48"
    )  # [KiB a file]
