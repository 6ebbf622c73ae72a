"""A live view: the product of rows that come bit by bit is that of a run over all of them."""

from __future__ import annotations

import io
import json
import platform
import shutil
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from gyrostab.cli import main
from gyrostab.errors import FormatError, OptionError, OutputError, ResumeError
from gyrostab.ingest.make_log import make_log
from gyrostab.io.datasets import to_netcdf, to_zarr
from gyrostab.io.opening import open_product
from gyrostab.jobs import follow as follow_module
from gyrostab.jobs import watch as module
from gyrostab.jobs.alarms import check_alarms, parse_alarm
from gyrostab.jobs.job import begin_job, job_folder, make_fingerprint
from gyrostab.jobs.live_page import LivePage
from gyrostab.jobs.load import check_run_options
from gyrostab.jobs.run import run
from gyrostab.jobs.watch import rows_folder, watch

RATE, ROWS = 50, 300_000  # two units of work of 2**18 samples
WINDOWS = {"window": "20s", "step": "20s", "taus": "8"}
HEADER = "time [s],gyro_x [deg/h],temperature [degC]\n"
GAP = slice(100_000, 104_000)


class Recorder:
    """Keeps what a live view shows, and calls `grow` after each window."""

    def __init__(self, grow=None):
        self.windows, self.alarms, self.notes = [], [], []
        self.grow = grow

    def show_window(self, window):
        self.windows.append(window)
        if self.grow is not None:
            self.grow()

    def show_alarm(self, event):
        self.alarms.append(event)

    def show_note(self, text):
        self.notes.append(text)


def make_rows(count: int = ROWS) -> list[str]:
    """Rows with a gap, every hundredth with a temperature, and some late ones."""
    noise = np.random.default_rng(3).standard_normal(count) * 8.0
    noise[: count // 2] += 2.0
    rows = [
        f"{i / RATE:.2f},{x:.3f},{25 + i / 1e5 if i % 100 == 0 else ''}\n"
        for i, x in enumerate(noise.tolist())
    ]
    for at, delay in ((500, 7), (1_500, 3), (90_000, 900), (200_000, 12)):
        if at + delay < count:
            rows.insert(at + delay, rows.pop(at))
    del rows[GAP]
    return rows


@pytest.fixture(scope="module")
def rows() -> list[str]:
    return make_rows()


@pytest.fixture(scope="module")
def whole(rows, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("whole")
    (folder / "log.csv").write_text(HEADER + "".join(rows))
    return run([folder / "log.csv"], folder / "product.nc", windows=WINDOWS)


@pytest.fixture(autouse=True)
def without_pauses(monkeypatch):
    monkeypatch.setattr(module, "_MAX_WORK_SHARE", 1.0)


def follow(source, output, listener=None, **options):
    listener = listener or Recorder()
    given = {"windows": WINDOWS, "idle": "0.3s", "poll": 0.02, **options}
    watch(str(source), output, listener=listener, **given)
    return listener


def assert_same_product(left: Path, right: Path) -> None:
    with open_product(left) as a, open_product(right) as b:
        assert a.sizes == b.sizes
        assert set(a.variables) == set(b.variables)
        for name, variable in a.variables.items():
            other = b.variables[name]
            assert variable.dims == other.dims, name
            assert variable.dtype == other.dtype, name
            assert bits(variable) == bits(other), name
            assert plain(variable.attrs) == plain(other.attrs), name
        own = {"history", "gyrostab_watch", "gyrostab_job", "date_created", "source", "notes"}
        own |= {"source_files", "row_start"}
        assert plain(a.attrs, own) == plain(b.attrs, own)


def bits(variable) -> bytes:
    """Values as bytes; of NaN, NetCDF does not keep the sign."""
    values = np.array(variable.values)
    if values.dtype.kind == "f":
        values[np.isnan(values)] = np.nan
    return values.tobytes()


def plain(attrs, left_out=()) -> dict:
    """Attributes with arrays as lists, as JSON holds them."""
    return {k: np.asarray(v).tolist() for k, v in attrs.items() if k not in left_out}


def test_a_growing_file_gives_the_bits_of_a_run_over_the_whole(rows, whole, tmp_path):
    """Rows come in pieces that end within a line, with a gap, late rows and a slow channel."""
    text = HEADER + "".join(rows)
    cuts = [0, len(text) // 3, len(text) // 3 + 1_000, int(0.9 * len(text)) + 7, len(text)]
    pieces = [text[a:b] for a, b in pairwise(cuts)]
    folder = tmp_path / "in"
    folder.mkdir()
    (folder / "log.csv").write_text(pieces.pop(0))

    def grow() -> None:
        if pieces:
            with (folder / "log.csv").open("a") as file:
                file.write(pieces.pop(0))

    recorder = follow(folder, tmp_path / "live.zarr", Recorder(grow))
    assert not pieces
    assert_same_product(tmp_path / "live.zarr", whole)
    with open_product(whole) as product:
        assert len(recorder.windows) == product.sizes["time"]
        assert [window["time"] for window in recorder.windows] == [
            str(stamp) for stamp in product["time"].values.astype("datetime64[ms]")
        ]
    assert any("out of order" in note for note in recorder.notes)


@pytest.mark.full
def test_a_file_that_comes_late_changes_earlier_windows(rows, tmp_path):
    """The file with the middle of the record comes last, and after a restart."""
    folder = tmp_path / "in"
    folder.mkdir()
    parts = [rows[:60_000], rows[80_000:], rows[60_000:80_000]]
    names = ["a.csv", "c.csv", "b.csv"]

    def grow() -> None:
        if parts:
            (folder / names.pop(0)).write_text(HEADER + "".join(parts.pop(0)))

    grow()
    first = follow(folder, tmp_path / "live.zarr")
    recorder = follow(
        folder, tmp_path / "live.zarr", Recorder(grow=None) if grow() else Recorder(grow)
    )
    run(sorted(folder.glob("*.csv")), tmp_path / "run.nc", windows=WINDOWS)
    assert_same_product(tmp_path / "live.zarr", tmp_path / "run.nc")
    assert not parts
    assert any("late rows changed 1 earlier part" in note for note in recorder.notes)
    assert len({window["time"] for window in first.windows + recorder.windows}) == len(
        first.windows + recorder.windows
    )


def test_a_file_that_is_cut_is_followed_on(tmp_path):
    rows, recorder = make_rows(12_000), Recorder()
    source, output = tmp_path / "log.csv", tmp_path / "live.zarr"
    view = module._View(output, check_run_options(windows=WINDOWS), {}, 0.0, [], recorder, None)
    for count in (8_000, 5_000, 6_500, 12_000):
        source.write_text(HEADER + "".join(rows[:count]))
        view.take_files(follow_module.list_files(str(source)))
        view.update()
        with open_product(output) as product:
            assert product.sizes["time"] == count // 1_000
            times = product["time"].values.astype("datetime64[ms]").astype(str).tolist()
    assert [window["time"] for window in recorder.windows] == times
    assert recorder.notes[-1] == (
        "a file was cut, replaced or removed, so the product is computed again; "
        f"windows up to {times[7]} are not shown again"
    )


def test_a_product_of_another_record_is_replaced_as_a_whole(tmp_path):
    """A store that is rewritten in place would have windows of both after a kill."""
    rows, stores = make_rows(8_000), []
    source, output = tmp_path / "log.csv", tmp_path / "live.zarr"
    view = module._View(output, check_run_options(windows=WINDOWS), {}, 0.0, [], Recorder(), None)
    for count in (5_000, 6_500, 4_000, 8_000):
        source.write_text(HEADER + "".join(rows[:count]))
        view.take_files(follow_module.list_files(str(source)))
        view.update()
        stores.append(output.stat().st_ino)
    begun, continued, replaced, continued_again = stores
    assert begun == continued != replaced == continued_again


def test_standard_input_is_kept_and_continued(tmp_path):
    rows = make_rows(20_000)
    text = HEADER + "".join(rows)
    cut = text.index("\n", 200_000) + 1
    output = tmp_path / "live.zarr"
    first = follow("-", output, stream=io.BytesIO(text[:cut].encode()))
    second = follow("-", output, stream=io.BytesIO(text[cut:].rstrip().encode()))
    pieces = sorted(rows_folder(output).iterdir())
    assert "".join(path.read_text() for path in pieces) == text[:cut] + HEADER + text[cut:].rstrip()
    run(pieces, tmp_path / "kept.nc", windows=WINDOWS)
    assert_same_product(output, tmp_path / "kept.nc")
    assert first.windows[-1]["time"] < second.windows[0]["time"]
    assert not any("earlier live view" in note for note in second.notes)
    shutil.rmtree(output)
    third = follow("-", output, stream=io.BytesIO(b""))
    (note,) = [note for note in third.notes if "earlier live view (2 files)" in note]
    assert str(rows_folder(output)) in note
    with pytest.raises(OutputError, match="rows of an earlier live view"):
        follow("-", output, stream=io.BytesIO(b""), overwrite=True)


def test_lateness_delays_a_window_and_the_end_writes_it(tmp_path):
    source = tmp_path / "log.csv"
    source.write_text(HEADER + "".join(make_rows(6_000)))
    sizes = []

    class Sizes(Recorder):
        def show_window(self, window):
            super().show_window(window)
            sizes.append(window["time"])
            if len(sizes) == 1:
                raise KeyboardInterrupt

    recorder = follow(source, tmp_path / "live.zarr", Sizes(), lateness="70s", idle=None)
    run([source], tmp_path / "run.nc", windows=WINDOWS)
    assert_same_product(tmp_path / "live.zarr", tmp_path / "run.nc")
    assert len(recorder.windows) == 6


@pytest.mark.parametrize("most", [5, 6, 11, 1000])
def test_rows_of_a_stream_are_kept_in_files_of_whole_rows(tmp_path, monkeypatch, most):
    monkeypatch.setattr(follow_module, "_MAX_ROW_FILE_BYTES", most)
    monkeypatch.setattr(follow_module, "_READ_BYTES", 4)
    text = b"t,a\n1,2\n3,4\n5,6\n7,8"
    keeper = follow_module.RowKeeper(io.BytesIO(text), tmp_path / "rows")
    while not keeper.ended:
        time.sleep(0.001)
    files = [path.read_bytes() for path in sorted((tmp_path / "rows").iterdir())]
    assert len(files) == {5: 3, 6: 3, 11: 2, 1000: 1}[most]
    assert b"".join([files[0], *(file.removeprefix(b"t,a\n") for file in files[1:])]) == text
    assert all(file.startswith(b"t,a\n") for file in files)
    assert keeper.error is None


def test_rows_of_a_stream_are_kept_where_an_earlier_file_was_removed(tmp_path):
    for number in (2, 10):
        (tmp_path / f"rows-{number:06d}.csv").write_text("t,a\n1,2\n")
    keeper = follow_module.RowKeeper(io.BytesIO(b"3,4\n"), tmp_path)
    while not keeper.ended:
        time.sleep(0.001)
    assert (tmp_path / "rows-000011.csv").read_text() == "t,a\n3,4\n"


def test_alarms_are_said_once_when_they_begin_and_end(tmp_path):
    noise = np.random.default_rng(0).standard_normal(12_000) * 3.0
    noise[4_000:8_000] *= 10.0
    body = "".join(f"{i / RATE:.2f},{v:.3f},{40 + i / 1000:.2f}\n" for i, v in enumerate(noise))
    source = tmp_path / "log.csv"
    source.write_text("time [s],gyro_x [deg/h],temperature [degC]\n" + body)
    alarms = ["N>0.05 deg/sqrt(h)", "x:N>9 deg/sqrt(h)", "temperature<313.65 K", "loss>5%"]
    recorder = follow(source, tmp_path / "a.zarr", alarms=[parse_alarm(text) for text in alarms])
    events = [(event["state"], event["text"].split(" (", 1)[1]) for event in recorder.alarms]
    assert events == [
        ("begins", "temperature<313.65 K)"),
        ("ends", "temperature<313.65 K)"),
        ("begins", "N>0.05 deg/sqrt(h))"),
        ("ends", "N>0.05 deg/sqrt(h))"),
    ]
    repeated = follow(source, tmp_path / "a.zarr", alarms=[parse_alarm(text) for text in alarms])
    assert (repeated.windows, repeated.alarms) == ([], [])


@pytest.mark.parametrize("units", ["L/min", "degree_Celsius hour-1"])
def test_a_channel_of_an_unknown_quantity_has_alarms_in_its_own_unit(units):
    window = {"time": "t", "axes": {}, "channels": {"flow": (2.0, units)}}
    alarm = parse_alarm(f"flow>1.5 {units}")
    check_alarms([alarm], window)
    assert alarm.update(window)[0]["text"].startswith(f"alarm begins: flow is 2 {units} (")
    for text in ("flow>1", "flow>1 deg/h", "flow>1 parsec"):
        with pytest.raises(OptionError, match=f"flow is in {units}; write flow>1 {units}, or"):
            check_alarms([parse_alarm(text)], window)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("N>0.01", "needs the unit 'deg/sqrt(h)'; write N>0.01 deg/sqrt(h)"),
        ("N>0.6 deg/h/sqrt(Hz)", "needs the unit 'deg/sqrt(h)'; convert it from deg/h/sqrt(Hz)"),
        ("N=3 deg/sqrt(h)", "write NAME>LIMIT UNIT"),
        ("misfit>3 deg", "has no unit"),
        ("x:temperature>3 degC", "has no axis"),
    ],
)
def test_alarms_that_cannot_be_read(text, says):
    with pytest.raises(OptionError, match="--alarm") as error:
        parse_alarm(text)
    assert says in str(error.value)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("z:misfit>3", "there is no axis z"),
        ("pressure>3 Pa", "is not one of Q, N.*the name that it has in the product"),
        ("temperature>3 V", "in degree_Celsius; write temperature>3 degree_Celsius, or"),
        ("temperature>3 parsec", "in degree_Celsius"),
    ],
)
def test_alarms_that_do_not_fit_the_log(text, says, tmp_path):
    (tmp_path / "log.csv").write_text(HEADER + "".join(make_rows(2_000)))
    with pytest.raises(OptionError, match=says):
        follow(tmp_path / "log.csv", tmp_path / "a.zarr", alarms=[parse_alarm(text)])
    assert not (tmp_path / "a.zarr").exists()


def test_other_options_and_foreign_outputs_are_refused(tmp_path):
    source = tmp_path / "log.csv"
    source.write_text(HEADER + "".join(make_rows(3_000)))
    follow(source, tmp_path / "a.zarr")
    with pytest.raises(OutputError, match="window is 30s, was 20s"):
        follow(source, tmp_path / "a.zarr", windows={**WINDOWS, "window": "30s"})
    follow(source, tmp_path / "a.zarr", windows={**WINDOWS, "window": "30s"}, overwrite=True)
    log = make_log(np.zeros(100), rate=1.0, unit="deg/h")
    to_zarr(log, tmp_path / "log.zarr")
    with pytest.raises(OutputError, match="exists already"):
        follow(source, tmp_path / "log.zarr")
    with pytest.raises(OptionError, match=r"must end in \.zarr"):
        follow(source, tmp_path / "a.nc")
    assert not list(tmp_path.glob(".*"))


def test_finished_parts_of_a_run_and_foreign_files_are_kept(tmp_path):
    source, output = tmp_path / "log.csv", tmp_path / "a.zarr"
    source.write_text(HEADER + "".join(make_rows(3_000)))
    folder = job_folder(output)
    folder.mkdir()
    (folder / "thesis.txt").write_text("mine")
    with pytest.raises(OutputError, match=r"thesis\.txt: .*gyrostab did not make what is there"):
        follow(source, output)
    assert [path.name for path in folder.iterdir()] == ["thesis.txt"]
    (folder / "thesis.txt").unlink()
    begin_job(folder, make_fingerprint([], check_run_options()), parts=5, overwrite=False)
    (folder / "windows-0000000000.block").write_bytes(b"an hour of work")
    with pytest.raises(ResumeError, match=r"a\.zarr: a run of it.*1 of 5 parts.*--resume"):
        follow(source, output)
    assert (folder / "windows-0000000000.block").read_bytes() == b"an hour of work"
    follow(source, output, overwrite=True)
    assert not folder.exists()


def test_a_product_of_another_source_or_of_files_that_are_gone_is_refused(tmp_path):
    output, probe = tmp_path / "live.zarr", tmp_path / "probe.csv"
    probe.write_text("time [s],pressure [Pa]\n0,1\n200,2\n")
    options = {"reading": {"channel": [probe]}}
    for name in ("run 7", "run 8"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "a.csv").write_text(HEADER + "".join(make_rows(3_000)))
    follow(tmp_path / "run 7", output, **options)
    before = {path: path.read_bytes() for path in output.rglob("*") if path.is_file()}
    with pytest.raises(OutputError, match=r"run 8 is given now.*run 7 was given before"):
        follow(tmp_path / "run 8", output, **options)
    (tmp_path / "run 7" / "a.csv").rename(tmp_path / "run 7" / "b.csv")
    with pytest.raises(OutputError, match=r"run 7 has no a\.csv any more"):
        follow(tmp_path / "run 7", output, **options)
    assert before == {path: path.read_bytes() for path in output.rglob("*") if path.is_file()}
    (tmp_path / "run 7" / "b.csv").rename(tmp_path / "run 7" / "a.csv")
    (tmp_path / "run 7" / "c.csv").write_text(HEADER + "".join(make_rows(6_000)[3_000:]))
    follow(tmp_path / "run 7", output, **options)
    with open_product(output) as product:
        assert product.sizes["time"] == 6
    follow(tmp_path / "run 8", output, **options, overwrite=True)
    with open_product(output) as product:
        assert product.sizes["time"] == 3


def test_what_cannot_be_followed_is_said(tmp_path):
    listener = Recorder()
    with pytest.raises(FormatError, match="no row was received"):
        follow(tmp_path / "nothing.csv", tmp_path / "a.zarr", listener)
    (note,) = listener.notes
    assert f"there is no file at {tmp_path / 'nothing.csv'} yet" in note
    short = tmp_path / "short.csv"
    short.write_text(HEADER + "".join(make_rows(500)))
    with pytest.raises(OptionError, match="longer than the record"):
        follow(short, tmp_path / "a.zarr")
    regular = to_netcdf(make_log(np.zeros(100), rate=1.0, unit="deg/h"), tmp_path / "log.nc")
    with pytest.raises(FormatError, match="regular log, which does not grow"):
        follow(regular, tmp_path / "a.zarr")


def test_the_page_serves_this_machine_only_and_data_as_data():
    page = LivePage(0, "gyrostab watch <script>alert(1)</script>")
    try:
        page.add_event({"time": "now", "state": "note", "text": "<b>"}, ["N>1"])
        with urllib.request.urlopen(page.address) as answer:
            assert "script" not in answer.headers["Content-Security-Policy"].split(";")[0]
            text = answer.read().decode()
        assert "innerHTML" not in text
        assert "alert(1)" not in text
        with urllib.request.urlopen(page.address + "state.json") as answer:
            state = json.load(answer)
        assert (state["active"], state["events"][0]["text"]) == (["N>1"], "<b>")
        for path, host in (("", "evil.example"), ("etc/passwd", None)):
            request = urllib.request.Request(page.address + path)
            if host:
                request.add_header("Host", host)
            with pytest.raises(urllib.error.HTTPError):
                urllib.request.urlopen(request)
        with pytest.raises(OptionError, match="cannot be used"):
            LivePage(int(page.address.rsplit(":", 1)[1].strip("/")), "")
    finally:
        page.close()


@pytest.mark.parametrize(
    "number",
    [
        pytest.param(signal.SIGINT, marks=pytest.mark.full),
        pytest.param(signal.SIGKILL, marks=pytest.mark.full),
    ],
)
def test_a_command_that_is_stopped_or_killed_is_continued(number, tmp_path):
    rows = make_rows(12_000)
    source, output = tmp_path / "log.csv", tmp_path / "live.zarr"
    source.write_text(HEADER + "".join(rows[:6_000]))
    options = [part for name, value in WINDOWS.items() for part in (f"--{name}", value)]
    command = ["watch", str(source), "-o", str(output), *options]
    code = (
        "import signal, sys\n"
        # a job in the background starts with the signal ignored
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from gyrostab.cli import main\n"
        "sys.exit(main())"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, *command], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline().split()[0] == "1970-01-01T00:00:10"
        process.send_signal(number)
        process.communicate(timeout=60)
    assert process.returncode == (0 if number == signal.SIGINT else -number)
    source.write_text(HEADER + "".join(rows))
    assert main([*command, "--idle", "0.3s"]) == 0
    run([source], tmp_path / "run.nc", windows=WINDOWS)
    assert_same_product(output, tmp_path / "run.nc")


_READING = """
import ctypes, gc, sys, warnings
from pathlib import Path
from gyrostab.jobs.follow import FileMemory, list_files
from gyrostab.jobs.run import load_log
from gyrostab.store.system import release_memory, return_large_arrays

warnings.simplefilter("ignore")
return_large_arrays()
memory, files = FileMemory(), list_files(sys.argv[1])
memory.ended = True
for count in range(2, len(files) + 1, 4):
    memory.update(dict(list(files.items())[:count]))
    load_log(list(memory.files), read=memory.read)
    gc.collect()
    release_memory()
    print(int(Path("/proc/self/statm").read_text().split()[1]) * 4 // 1024)
"""


@pytest.mark.full
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="is about the allocator of glibc")
def test_memory_does_not_grow_with_the_files_that_were_read(tmp_path):
    rows = 40_000
    cells = np.random.default_rng(1).standard_normal((rows, 2)).round(4).tolist()
    ends = [f"0,{x},{y}\n" for x, y in cells]
    for number in range(18):
        text = "".join(f"{number * rows + i}{end}" for i, end in enumerate(ends))
        (tmp_path / f"{number:02}.csv").write_text(
            f"time [ms],gyro_x [deg/h],gyro_y [deg/h]\n{text}"
        )
    done = subprocess.run(
        [sys.executable, "-c", _READING, str(tmp_path)], capture_output=True, text=True, check=True
    )
    sizes = [int(line) for line in done.stdout.splitlines()]  # MiB
    assert sizes[-1] - sizes[1] < 15
