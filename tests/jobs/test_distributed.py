"""Runs on a real dask scheduler with two workers: same bits, also when a worker is killed."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from gyrostab import make_log, to_netcdf, to_zarr
from gyrostab.allan.davar import davar_parts
from gyrostab.cli import main
from gyrostab.errors import OptionError, WorkerError
from gyrostab.io.opening import open_log
from gyrostab.jobs import checkpoint, engine, fleet, schedule
from gyrostab.jobs.fleet import process_run
from gyrostab.jobs.fleet_table import read_table
from gyrostab.jobs.run import run
from gyrostab.jobs.schedule import Pool, check_scheduler, open_pool, run_calls
from tests.support.crashing import WINDOW, WINDOW_OPTIONS
from tests.support.stored import CHUNK, counts_log, spoil

distributed = pytest.importorskip("distributed")
PARTS = 5


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """Start a scheduler and two workers; see `start_cluster`."""
    with start_cluster(tmp_path_factory.mktemp("cluster"), workers=2) as scheduler:
        yield scheduler


@contextmanager
def start_cluster(folder: Path, *, workers: int) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """Start a scheduler and workers of one thread each as separate programs, as a user does.

    Yields the address of the scheduler, and its process.
    """
    where = folder / "scheduler.json"
    environment = {
        **os.environ,
        "DASK_DISTRIBUTED__WORKER__DAEMON": "False",
        "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "1",  # each starts a worker again
    }
    common = ["--scheduler-file", str(where), "--no-dashboard", "--host", "127.0.0.1"]
    worker = f"worker --nworkers {workers} --nthreads 1 --memory-limit 0 --local-directory".split()
    with ExitStack() as stack:
        process, _ = (
            stack.enter_context(_program("dask", *command, *common, env=environment))
            for command in (["scheduler", "--port", "0"], [*worker, str(folder)])
        )
        _wait_for(where)
        with distributed.Client(scheduler_file=str(where)) as client:
            client.wait_for_workers(workers, timeout=60)
            address = client.scheduler.address
        yield address, process


@pytest.fixture
def address(cluster):
    return cluster[0]


@contextmanager
def _program(
    module: str, *arguments: str, env: dict[str, str]
) -> Iterator[subprocess.Popen[bytes]]:
    """A program that runs during the tests, and ends with all that it has started."""
    command = [sys.executable, "-m", module, *arguments]
    started = subprocess.Popen(
        command,
        env=env,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        yield started
    finally:
        if started.poll() is None:
            os.killpg(started.pid, signal.SIGKILL)
        started.wait()


def _wait_for(path: Path) -> None:
    for _ in range(600):
        if path.exists() and path.stat().st_size:
            return
        time.sleep(0.1)
    pytest.fail(f"{path.name} does not appear: the scheduler has not started")


@pytest.fixture(autouse=True)
def small(monkeypatch):
    monkeypatch.setitem(davar_parts.__kwdefaults__, "samples", 1)
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")


def _log():
    rate = 5.0 + np.random.default_rng(7).standard_normal((1, 1_270_000))
    rate[:, 500_000:530_000] = np.nan
    return make_log(rate, rate=100.0, unit="deg/h", start="2026-05-01")


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> Path:
    return to_netcdf(_log(), tmp_path_factory.mktemp("log") / "tool.nc")


@pytest.fixture(scope="module")
def whole(log, tmp_path_factory) -> bytes:
    """The product of one thread."""
    path = tmp_path_factory.mktemp("whole") / "product.nc"
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(davar_parts.__kwdefaults__, "samples", 1)
        patch.setenv("SOURCE_DATE_EPOCH", "1700000000")
        run([log], path, windows=WINDOW, workers=1)
    return path.read_bytes()


@pytest.mark.full
def test_two_worker_processes_make_the_same_bytes(address, log, whole, tmp_path):
    run([log], tmp_path / "product.nc", windows=WINDOW, scheduler=address)
    assert (tmp_path / "product.nc").read_bytes() == whole
    assert [path.name for path in tmp_path.iterdir()] == ["product.nc"]
    with distributed.Client(address) as client:
        workers = client.run(_what_a_worker_knows)
        assert len(workers) == 2
        assert all("gyrostab.allan.davar" in loaded for loaded, _ in workers.values())
        assert all(threads is None for _, threads in workers.values()), (
            "a kernel has started threads"
        )


def _what_a_worker_knows():
    import sys

    import numba

    try:
        threads = numba.threading_layer()
    except ValueError:  # numba has none until a parallel kernel runs
        threads = None
    return list(sys.modules), threads


@pytest.mark.full
def test_zarr_store_and_text_on_workers(address, tmp_path):
    small = _log().isel(time=slice(0, 30_000))
    store = to_zarr(small, tmp_path / "log.zarr")
    text = tmp_path / "log.csv"
    rows = "\n".join(f"{i / 100:.2f},{v}" for i, v in enumerate(small["rate"].values[0]))
    text.write_text(f"time [s],gyro_x [deg/h]\n{rows}\n")
    made = {}
    for source in (store, text):
        for scheduler in ("threads", address):
            output = tmp_path / f"{source.suffix[1:]}-{scheduler[:3]}.nc"
            run(
                [source],
                output,
                windows=WINDOW,
                reading={"epoch": "2026-05-01"} if source == text else {},
                scheduler=scheduler,
            )
            made[source.suffix, scheduler] = output
    for suffix in (".zarr", ".csv"):
        assert_same_arrays(made[suffix, "threads"], made[suffix, address])


def assert_same_arrays(left: Path, right: Path) -> None:
    with (
        xr.open_dataset(left, decode_times=False) as a,
        xr.open_dataset(right, decode_times=False) as b,
    ):
        xr.testing.assert_equal(a, b)


def test_a_worker_tells_the_client_of_a_damaged_chunk(address, tmp_path):
    path = to_zarr(counts_log(samples=2 * CHUNK), tmp_path / "log.zarr")
    spoil(path, 1, 1, how="remove")

    def compute(client):
        rates = client.compute(log.rate.data).result()
        time.sleep(1.0)  # the message takes its own way
        return rates

    missing = r"axis y: the chunk from .* is missing: no file rate/1\.1"
    with (
        distributed.Client(address) as client,
        open_log(path) as log,
        pytest.warns(UserWarning, match=missing),
    ):
        rates = compute(client)
    assert np.isnan(rates[1, CHUNK:]).all()
    assert not np.isnan(rates[1, :CHUNK]).any()


def test_a_killed_worker_does_not_lose_the_run(address, log, whole, tmp_path, monkeypatch):
    killed = []

    def write(*arguments, **options):
        if not killed:
            with distributed.Client(address) as client:
                processes = client.run(os.getpid)
                os.kill(next(iter(processes.values())), signal.SIGKILL)
                killed.append(processes)
        return checkpoint.write_block(*arguments, **options)

    monkeypatch.setattr(engine, "write_block", write)
    monkeypatch.setattr(engine, "_MAX_HELD_SECONDS", 0.0)
    run([log], tmp_path / "product.nc", windows=WINDOW, scheduler=address)
    assert killed
    assert (tmp_path / "product.nc").read_bytes() == whole


def test_what_is_sent_is_small_whatever_the_length(log, monkeypatch, tmp_path):
    """No samples are sent: a part takes the same few bytes for ten times the samples."""
    sent: list[int] = []

    def spy(pool, calls):
        def watched():
            for call in calls:
                sent.append(len(pickle.dumps(call)))
                yield call

        return run_calls(pool, watched())

    @contextmanager
    def elsewhere(*arguments, **options):
        with ThreadPoolExecutor(1) as executor:
            yield Pool(executor.submit, lambda: 1, True, lambda value: value)

    monkeypatch.setattr(engine, "run_calls", spy)
    monkeypatch.setattr("gyrostab.jobs.run.open_pool", elsewhere)
    sizes = {}
    for samples in (130_000, 1_270_000):
        path = to_netcdf(open_log(log).isel(time=slice(0, samples)), tmp_path / f"log{samples}.nc")
        del sent[:]
        run([path], tmp_path / f"{samples}.nc", windows=WINDOW, scheduler="processes")
        sizes[samples] = list(sent)
    assert [len(messages) for messages in sizes.values()] == [1, PARTS]
    assert max(sizes[1_270_000]) <= max(sizes[130_000]) + 200
    assert max(sizes[1_270_000]) < 5000


# ------------------------------------------------------------------------------
# what goes wrong


def test_no_scheduler_there(log, tmp_path, capfd, monkeypatch):
    monkeypatch.setattr("gyrostab.jobs.schedule._CONNECT_TIMEOUT_S", 1.0)
    options = ["--window", "40s", "--scheduler", "127.0.0.1:9", "--quiet-progress"]
    assert main(["run", str(log), "-o", str(tmp_path / "p.nc"), *options]) == 2
    shown = capfd.readouterr().err
    assert "no dask scheduler answers there" in shown
    assert "Traceback" not in shown
    assert list(tmp_path.iterdir()) == []


def test_a_worker_that_does_not_see_the_files(address, tmp_path):
    with pytest.raises(
        WorkerError, match=r"does not see .*nowhere\.csv; all workers need the same file system"
    ):
        _open(address, tmp_path / "nowhere.csv")


def _open(address: str, path: Path) -> None:
    """Pretend that the file is there, as it is on another machine's disk."""
    from gyrostab.jobs import schedule

    real = schedule._find_size
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            schedule, "_find_size", lambda name: 100 if Path(name) == path else real(name)
        )
        with open_pool(address, files=[path]):
            pass


def test_a_scheduler_without_workers(monkeypatch):
    monkeypatch.setattr("gyrostab.jobs.schedule._CONNECT_TIMEOUT_S", 1.0)
    cluster = distributed.LocalCluster(
        n_workers=0, dashboard_address=":0", processes=True, silence_logs=50
    )
    with (
        cluster,
        pytest.raises(WorkerError, match="has no workers; start some with 'dask worker"),
        open_pool(cluster.scheduler_address),
    ):
        pass


def test_distributed_is_not_installed(log, tmp_path, capfd, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    arguments = ["run", str(log), "-o", str(tmp_path / "p.nc"), "--scheduler", "tcp://127.0.0.1:1"]
    assert main(arguments) == 2
    assert "pip install 'gyrostab[distributed]'" in capfd.readouterr().err


@pytest.mark.parametrize("name", ["thread", "cluster", ""])
def test_a_scheduler_that_is_no_scheduler(name):
    with pytest.raises(OptionError, match="give threads, processes, or the address"):
        check_scheduler(name)


def test_a_worker_process_that_dies_is_explained():
    with (
        open_pool("processes", workers=1) as pool,
        pytest.raises(WorkerError, match="a worker process has died"),
    ):
        list(run_calls(pool, [(os._exit, 3)]))


def test_repeated_deaths_on_the_same_part_are_explained():
    future: Future[None] = Future()
    worker = SimpleNamespace(address="tcp://127.0.0.1:9")
    future.set_exception(distributed.scheduler.KilledWorker("part", worker, 1))
    pool = Pool(lambda *call: future, lambda: 1, True, lambda value: value)
    with pytest.raises(WorkerError, match="died repeatedly on the same part"):
        list(run_calls(pool, [(os._exit, 3)]))


@pytest.mark.slow
def test_a_part_that_kills_every_worker_is_explained(address):
    with (
        open_pool(address) as pool,
        pytest.raises(WorkerError, match="died repeatedly on the same part"),
    ):
        list(run_calls(pool, [(os._exit, 3)]))


@pytest.mark.slow
def test_worker_processes_end_with_a_killed_parent(tmp_path):
    code = (
        "import os, signal\n"
        "from gyrostab.jobs.schedule import open_pool, run_calls\n"
        "if __name__ == '__main__':\n"
        "    with open_pool('processes', workers=1) as pool:\n"
        "        [child] = [found for _, found in run_calls(pool, [(os.getpid,)])]\n"
        "        print(child, flush=True)\n"
        "        os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    script = tmp_path / "parent.py"
    script.write_text(code)
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=60)
    child = int(done.stdout)
    for _ in range(200):
        try:
            os.kill(child, 0)
        except ProcessLookupError:
            return
        if Path(f"/proc/{child}/stat").read_text().split()[2] == "Z":
            return
        time.sleep(0.05)
    pytest.fail("the worker lives on")


@pytest.mark.slow
def test_a_scheduler_that_dies_is_explained_and_resume_goes_on(
    cluster, log, whole, tmp_path, monkeypatch, capfd
):
    """Finished parts survive the death of the scheduler, and threads compute the rest.

    This is the last test that uses the scheduler of the others, because it ends it.
    """
    output = tmp_path / "out" / "product.nc"
    output.parent.mkdir()
    address, scheduler = cluster

    def write(*arguments, **given):
        if scheduler.poll() is None:
            os.killpg(scheduler.pid, signal.SIGKILL)
            scheduler.wait()
        return checkpoint.write_block(*arguments, **given)

    monkeypatch.setattr(engine, "write_block", write)
    monkeypatch.setattr(engine, "_MAX_HELD_SECONDS", 0.0)
    monkeypatch.setattr(schedule, "_CONNECT_TIMEOUT_S", 2.0)  # also that of a reconnection
    begun = time.monotonic()
    assert main(["run", str(log), "-o", str(output), "--scheduler", address, *WINDOW_OPTIONS]) == 2
    assert time.monotonic() - begun < 60
    shown = capfd.readouterr().err
    assert "the dask scheduler" in shown
    assert "--resume continues" in shown
    assert "please report" not in shown
    assert "Traceback" not in shown
    monkeypatch.setattr(engine, "write_block", checkpoint.write_block)
    assert main(["run", str(log), "-o", str(output), "--resume", *WINDOW_OPTIONS]) == 0
    (tmp_path / "whole.nc").write_bytes(whole)
    assert_same_arrays(output, tmp_path / "whole.nc")
    assert [path.name for path in output.parent.iterdir()] == [output.name]


@pytest.mark.slow
@pytest.mark.parametrize("is_real", [False, pytest.param(True, marks=pytest.mark.full)])
def test_a_fleet_whose_scheduler_dies_goes_on(tmp_path, monkeypatch, capfd, is_real):
    """The message says how many runs are done, and the same command computes the others.

    The test above has the error that the death of a real scheduler causes.
    """
    for number in range(6):
        folder = tmp_path / "archive" / f"run{number}"
        folder.mkdir(parents=True)
        to_netcdf(_log().isel(time=slice(0, 20_000 + number)), folder / "log.nc")
    command = ["fleet", str(tmp_path / "archive"), "-o", str(tmp_path / "fleet"), "--no-reports"]
    command += [*WINDOW_OPTIONS]
    monkeypatch.setattr(schedule, "_CONNECT_TIMEOUT_S", 2.0)  # also that of a reconnection
    real = fleet.run_calls
    cluster = start_cluster(tmp_path, workers=1) if is_real else nullcontext(("threads", None))
    with cluster as (address, scheduler):

        def kill_after_two(pool, calls):
            for number, answer in enumerate(real(pool, calls)):
                yield answer
                if number == 1:
                    if not is_real:
                        raise WorkerError("the dask scheduler has died")
                    os.killpg(scheduler.pid, signal.SIGKILL)
                    scheduler.wait()

        monkeypatch.setattr(fleet, "run_calls", kill_after_two)
        assert main([*command, "--scheduler", address]) == 2
        shown = capfd.readouterr().err
        assert "the dask scheduler" in shown
        assert "2 of 6 runs are done, and the same command continues" in shown
        assert "Traceback" not in shown
    monkeypatch.setattr(fleet, "run_calls", real)
    computed = []
    monkeypatch.setattr(
        fleet, "process_run", lambda *given: computed.append(given) or process_run(*given)
    )
    assert main([*command, "--scheduler", "threads"]) == 0
    assert len(computed) <= 4
    assert read_table(tmp_path / "fleet" / "index.parquet", content="runs")["error"].tolist() == (
        6 * [""]
    )
    assert not [path for path in (tmp_path / "fleet").rglob(".*")]
