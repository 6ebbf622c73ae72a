"""Fixtures that several test files share."""

from __future__ import annotations

import gc
import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from socket import socket
from threading import Thread

import pytest
from hypothesis import settings
from threadpoolctl import threadpool_limits

ROOT = Path(__file__).resolve().parents[1]

# The same examples in every run of `make test`; other ones, and more, in `make test-full`.
settings.register_profile(
    "fast", deadline=None, max_examples=15, derandomize=True, database=None, print_blob=True
)
settings.register_profile("full", deadline=None, max_examples=100, print_blob=True)
settings.load_profile("fast")


# Garbage collection searches all modules and tests again and again; they are never garbage.
gc.set_threshold(15 * gc.get_threshold()[0], *gc.get_threshold()[1:])


def pytest_collection_finish() -> None:
    gc.freeze()


#: Tests that start first. The first file compiles most kernels that others share; the next ones
#: need none of these, so that another worker does not compile the same kernels meanwhile.
_FIRST = (
    "tests/allan/test_band_limit.py",
    "tests/ingest/columns/test_read_dates.py",
    "tests/ingest/formats/",
    "tests/ingest/text/",
    "tests/ingest/grid/",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    def place(item: pytest.Item) -> int:
        return next((n for n, name in enumerate(_FIRST) if name in item.nodeid), len(_FIRST))

    items.sort(key=place)


@pytest.fixture(scope="session")
def recordings() -> Callable[[str], Path]:
    """Path of a real recording, or a skip that says where it was looked for."""
    base = Path(os.environ.get("GYROSTAB_RECORDINGS", ROOT.parent / "shared" / "recordings"))

    def find(name: str) -> Path:
        path = base / name
        if not path.exists():
            pytest.skip(
                f"real recording {name} is not in {base} (set GYROSTAB_RECORDINGS to its directory)"
            )
        return path

    return find


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    """Use one thread for the linear algebra, as `gyrostab.diagnose` does.

    Its threads wait for each other where every core runs a process of tests: small matrices then
    take five times the processor time.
    """
    with threadpool_limits(1, user_api="blas"):
        yield


@pytest.fixture
def serve_folder() -> Iterator[Callable[[Path], str]]:
    """Serve folders on this machine by HTTP until the test ends; the call returns the address."""

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

    with ExitStack() as stack:

        def serve(folder: Path) -> str:
            handler = partial(Quiet, directory=str(folder))
            server = stack.enter_context(ThreadingHTTPServer(("127.0.0.1", 0), handler))
            stack.callback(server.shutdown)
            Thread(target=server.serve_forever, daemon=True).start()
            return f"http://127.0.0.1:{server.server_port}"

        yield serve


@pytest.fixture(scope="session")
def s3_bucket() -> Iterator[str]:
    """Address of a bucket on a local server that speaks S3."""
    pytest.importorskip("s3fs")
    moto = pytest.importorskip("moto.server")
    server = moto.ThreadedMotoServer(port=0)
    server.start()
    host, port = server.get_host_and_port()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
        patch.setenv("AWS_ACCESS_KEY_ID", "test")
        patch.setenv("AWS_SECRET_ACCESS_KEY", "test")
        patch.setenv("AWS_DEFAULT_REGION", "us-east-1")
        pytest.importorskip("fsspec").filesystem("s3").mkdir("archive")
        yield "s3://archive"
    server.stop()


@pytest.fixture(scope="session")
def gs_bucket() -> Iterator[str]:
    """Address of a bucket on a local server that speaks the protocol of Google Cloud Storage."""
    pytest.importorskip("gcsfs")
    emulator = pytest.importorskip("gcp_storage_emulator.server")
    with socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    server = emulator.create_server("127.0.0.1", port, in_memory=True, default_bucket="archive")
    server.start()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("STORAGE_EMULATOR_HOST", f"http://127.0.0.1:{port}")
        # of an interface that the emulator does not have, which gcsfs awaits for a minute
        patch.setenv("GCSFS_EXPERIMENTAL_ZB_HNS_SUPPORT", "false")
        yield "gs://archive"
    server.stop()
