"""--from, --to and --exclude: cut a log to a part."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
import xarray as xr

import gyrostab
from gyrostab.cli import main
from gyrostab.errors import OptionError
from gyrostab.ingest.make_log import make_log
from gyrostab.ingest.uniform import cut_log, parse_instant
from gyrostab.jobs.run import load_log
from tests.reference import direct_surface

START = "2026-03-01T10:00:00"
RATE, SIZE = 10.0, 3000  # five minutes


def values(seed: int = 2) -> np.ndarray:
    x = np.random.default_rng(seed).standard_normal((2, SIZE))
    x[:, 1200:1230] = np.nan
    return x


def make(**options) -> xr.Dataset:
    return make_log(
        values(),
        rate=RATE,
        unit="deg/h",
        start=START,
        channels={"temperature": (np.arange(SIZE) / 100, "degC")},
        **options,
    )


def stored(log: xr.Dataset, path) -> str:
    return str(gyrostab.to_netcdf(log, path, overwrite=True))


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Write one log as regular log, as two of them, as text, and as text with a channel file."""
    folder = tmp_path_factory.mktemp("cut")
    log = make()
    stamps = pd.DatetimeIndex(log.time.values).strftime("%Y-%m-%dT%H:%M:%S.%f")
    table = pd.DataFrame(
        {"time": stamps, "gyro_x [deg/h]": log.rate[0], "gyro_y [deg/h]": log.rate[1]}
    ).dropna()
    table.to_csv(folder / "log.csv", index=False, float_format="%.17g")
    slow = pd.DataFrame({"time": stamps[::50], "temperature [degC]": np.arange(0, SIZE, 50) / 100})
    slow.to_csv(folder / "probe.csv", index=False)
    return {
        "own": [stored(log, folder / "log.nc")],
        "two": [
            stored(log.isel(time=slice(0, 1000)), folder / "a.nc"),
            stored(log.isel(time=slice(1000, None)), folder / "b.nc"),
        ],
        "text": [str(folder / "log.csv")],
        "probe": str(folder / "probe.csv"),
    }


def expected(low: int, high: int, *spans: tuple[int, int]) -> np.ndarray:
    x = values()
    for first, end in spans:
        x[:, first:end] = np.nan
    return x[:, low:high]


@pytest.mark.parametrize("kind", ["own", "two", "text"])
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_cut_works_for_every_source_of_a_log(files, kind):
    for given in (
        {"time_from": "1min", "time_to": "4min", "exclude": ["90s/100s"]},
        {
            "time_from": "2026-03-01T10:01",
            "time_to": "2026-03-01T10:04Z",
            "exclude": ["2026-03-01T10:01:30/2026-03-01T11:01:40+01:00"],
        },
    ):
        log = load_log(files[kind], **given)
        np.testing.assert_array_equal(log.rate.values, expected(600, 2400, (900, 1000)))
        assert log.time[0].values == np.datetime64("2026-03-01T10:01:00")
        rows = gyrostab.gap_table(log)
        assert str(rows.start[0].time()) == "10:01:30"
        assert "outside_range" in set(rows.cause)
        assert int(rows.samples[rows.cause == "outside_range"].sum()) == 100
        assert "from" in log.attrs["history"]


def test_ends_are_half_open_and_exact_to_the_sample():
    log = make()
    assert (
        cut_log(log, time_from="1s", time_to="2s").time.values[[0, -1]].tolist()
        == log.time.values[[10, 19]].tolist()
    )
    assert cut_log(log, time_from="1.05s").sizes["time"] == SIZE - 11
    assert cut_log(log, time_to="1.05s").sizes["time"] == 11
    assert cut_log(log, time_from="0s", time_to="300s").sizes["time"] == SIZE
    assert cut_log(log) is log
    odd = make_log(np.arange(1000.0), rate=300.0, unit="deg/h", start=START)
    for n in range(1, 1000, 37):
        stamp = odd.time[n].values
        assert cut_log(odd, time_from=stamp).rate.values[0, 0] == n
        assert cut_log(odd, time_to=stamp).rate.values[0, -1] == n - 1


def test_excluded_spans_are_merged_and_the_table_of_gaps_follows():
    log = cut_log(make(), exclude=["119s/121s", "120s/122s", "200s/201s"])
    x = expected(0, SIZE, (1190, 1220), (2000, 2010))
    np.testing.assert_array_equal(log.rate.values, x)
    assert np.isnan(log.temperature.values[1190:1220]).all()
    rows = gyrostab.gap_table(log)
    assert rows.samples.tolist() == [30, 10]
    assert set(rows.cause) == {"outside_range"}


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_channels_of_another_file_are_cut_too(files):
    log = load_log(
        files["text"],
        channel=[files["probe"]],
        time_from="1min",
        time_to="2min",
        exclude=["70s/80s"],
    )
    (name,) = [name for name in log.data_vars if str(name).startswith("temperature")]
    dim = log[name].dims[0]
    seconds = (log[dim].values - np.datetime64(START)) / np.timedelta64(1, "s")
    present = seconds[np.isfinite(log[name].values)]
    assert present.min() >= 60
    assert present.max() < 120
    assert not ((present >= 70) & (present < 80)).any()


def test_lazy_log_stays_lazy():
    import dask.array as da

    held = []

    def block(block_info=None):
        held.append(block_info[None]["array-location"][1])
        return np.ones((1, 100_000))

    data = da.map_blocks(block, chunks=((1,), (100_000,) * 50), dtype=float, meta=np.zeros((0, 0)))
    log = make_log(data, rate=100.0, unit="deg/h", start=START)
    cut = cut_log(log, time_from="1h", time_to="13h", exclude=["2h/3h"])
    assert not held
    assert cut.sizes["time"] == 12 * 360_000
    inside = cut.rate[0, 350_000:370_000].values
    np.testing.assert_array_equal(np.isnan(inside), np.arange(350_000, 370_000) >= 360_000)
    assert len(held) <= 3


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            {"time_from": "10min"},
            r"--from 10min lies outside the record; the record goes from 2026-03-01T10:00:00 to "
            r".*T10:05:00 \(300 s\)",
        ),
        ({"time_from": "2026-02-01T00:00"}, "outside the record"),
        ({"time_to": 9e9}, "--to 9000000000.0 lies outside the record"),
        ({"time_to": np.timedelta64(90_000, "D")}, "lies outside the record"),
        ({"time_to": "2027-02-01T00:00"}, "--to 2027-02-01T00:00 lies outside the record"),
        (
            {"time_from": "3min", "time_to": "2min"},
            "--from 3min and --to 2min leaves no sample of the log",
        ),
        ({"time_from": "10:05:00"}, "neither a time nor a duration; write 2026-11-20T14:00"),
        ({"time_from": "60"}, "neither a time nor a duration"),
        ({"time_from": "soon"}, "neither a time nor a duration"),
        ({"time_from": "2026-13-45"}, "neither a time nor a duration"),
        ({"exclude": ["1min"]}, "write START/END"),
        ({"exclude": ["1min/"]}, "write START/END"),
        ({"exclude": ["2min/1min"]}, "its end comes before its start"),
        ({"exclude": ["10min/11min"]}, "lies outside the record"),
        ({"exclude": ["0s/5min"]}, "leaves nothing"),
    ],
)
def test_invalid_input_is_refused(given, message):
    with pytest.raises(OptionError, match=message):
        cut_log(make(), **given)


@pytest.mark.parametrize(
    ("given", "instant"),
    [
        ("36000s", 36000.0),
        ("20000 min", 1_200_000.0),
        (np.timedelta64(0, "s"), 0.0),
        (pd.Timedelta("2s"), 2.0),
        ("19700101", 0),
        ("19700101T000002", 2_000_000_000),
        ("1970-01-01", 0),
    ],
)
@pytest.mark.filterwarnings("error")
def test_durations_and_dates_are_distinguished(given, instant):
    assert parse_instant(given, "--from") == instant
    assert type(parse_instant(given, "--from")) is type(instant)


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_commands_accept_the_options(files, tmp_path, capsys):
    cut = ["--from", "1min", "--to", "4min", "--exclude", "90s/100s", "--exclude", "110s/111s"]
    assert main(["ingest", *files["text"], "-o", str(tmp_path / "cut.nc"), *cut]) == 0
    with gyrostab.open_log(tmp_path / "cut.nc") as log:
        x = expected(600, 2400, (900, 1000), (1100, 1110))
        np.testing.assert_array_equal(log.rate.values, x)
    options = ["--window", "20s", "--step", "20s", "--taus", "0.1s,1s"]
    assert main(["davar", *files["own"], "-o", str(tmp_path / "davar.nc"), *cut, *options]) == 0
    with gyrostab.open_surface(tmp_path / "davar.nc") as surface:
        avar, _ = direct_surface(x[0], 200, 200, [1, 10])
        strict = surface.estimator[0].values == 1
        np.testing.assert_allclose(surface.avar[0].values[strict], avar[strict], rtol=1e-9)
        assert surface.sizes["time"] == len(avar)
    capsys.readouterr()
    assert main(["scan", *files["own"], *cut]) == 0
    assert "2026-03-01T10:01:00" in capsys.readouterr().out
    assert main(["ingest", *files["own"], "-o", str(tmp_path / "none.nc"), "--from", "1h"]) == 2
    assert "outside the record" in capsys.readouterr().err
    (tmp_path / "some.toml").write_text('[ingest]\nfrom = "1min"\nexclude = ["90s/100s"]\n')
    assert (
        main(
            [
                "ingest",
                *files["own"],
                "-o",
                str(tmp_path / "some.nc"),
                "--config",
                str(tmp_path / "some.toml"),
            ]
        )
        == 0
    )
    with gyrostab.open_log(tmp_path / "some.nc") as log:
        np.testing.assert_array_equal(log.rate.values, expected(600, SIZE, (900, 1000)))


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_run_is_not_continued_with_another_part(files, tmp_path):
    from gyrostab.jobs.run import _describe_job

    names = {
        _describe_job(
            files["own"], tmp_path / "p.nc", {"reading": r, "windows": {}, "fitting": {}}
        ).name
        for r in ({}, {"time_from": "1min"}, {"exclude": ["1s/2s"]})
    }
    assert len(names) == 3
