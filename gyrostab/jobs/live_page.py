"""A page on this machine that shows a live view and updates itself."""

from __future__ import annotations

import json
import threading
from collections import deque
from collections.abc import Mapping
from datetime import UTC, datetime
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from typing import Any

from gyrostab.errors import OptionError
from gyrostab.noise import LAWS

_HOST = "127.0.0.1"
#: Windows, and alarms and notes, that the page shows at most.
_MAX_WINDOWS, _MAX_EVENTS = 500, 100
_POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; connect-src 'self'"
)


class LivePage:
    """Serves the latest windows, alarms and notes to browsers on this machine.

    The port is on 127.0.0.1; 0 for any that is free.
    """

    def __init__(self, port: int, title: str):
        self._lock = threading.Lock()
        self._windows: deque[Mapping[str, Any]] = deque(maxlen=_MAX_WINDOWS)
        self._events: deque[Mapping[str, str]] = deque(maxlen=_MAX_EVENTS)
        self._title, self._active = title, list[str]()
        try:
            self._server = ThreadingHTTPServer((_HOST, port), partial(_Handler, self))
        except (OSError, OverflowError) as error:
            raise OptionError(
                f"--serve {port}: the port cannot be used ({error}); give another one"
            ) from error
        self._server.daemon_threads = True
        self.port = self._server.server_port
        self.address = f"http://{_HOST}:{self.port}/"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def add_window(self, window: Mapping[str, Any]) -> None:
        """Add a window of `gyrostab.jobs.alarms.describe_windows`."""
        with self._lock:
            self._windows.append(window)

    def add_event(self, event: Mapping[str, str], active: list[str]) -> None:
        """Add an alarm or a note (``time``, ``state``, ``text``), and the alarms active now."""
        with self._lock:
            self._events.append(event)
            self._active = active

    def state(self) -> bytes:
        """Return what the page shows, as JSON."""
        with self._lock:
            content = {
                "title": self._title,
                "now": datetime.now(UTC).isoformat(timespec="seconds"),
                "units": {symbol: law.label for symbol, law in LAWS.items()},
                "windows": list(self._windows),
                "events": list(self._events),
                "active": self._active,
            }
        return json.dumps(content).encode()

    def close(self) -> None:
        """Stop serving."""
        self._server.shutdown()
        self._server.server_close()


class _Handler(BaseHTTPRequestHandler):
    """Answers two addresses: the page, and its state."""

    def __init__(self, page: LivePage, *arguments: Any):
        self.page = page
        super().__init__(*arguments)

    def do_GET(self) -> None:
        """Answer a request of a browser."""
        port = self.page.port
        # another name would be that of a foreign page whose name was pointed to this machine
        if self.headers.get("Host") not in (f"{_HOST}:{port}", f"localhost:{port}"):
            self.send_error(403)
        elif self.path == "/":
            text = resources.files("gyrostab.report").joinpath("live.html").read_bytes()
            self._send_reply(text, "text/html; charset=utf-8")
        elif self.path == "/state.json":
            self._send_reply(self.page.state(), "application/json")
        else:
            self.send_error(404)

    def _send_reply(self, content: bytes, kind: str) -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("Content-Security-Policy", _POLICY)
        self.send_header("X-Content-Type-Options", "nosniff")
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, *_: Any) -> None:
        """Print nothing."""
