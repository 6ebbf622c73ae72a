"""What the benchmarks share: options, new processes, tables, and the place in a page."""

from __future__ import annotations

import argparse
import os
import platform
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from datetime import date
from multiprocessing import get_context
from pathlib import Path
from typing import Any


def make_parser(description: str | None, *, has_page: bool = True) -> argparse.ArgumentParser:
    """Options of a script that prints its tables, and puts them into a page with --output."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    if has_page:
        parser.add_argument("--output", type=Path, help="page of which a part is renewed")
    return parser


def machine() -> str:
    """Processor, cores, Python, date and load in one line."""
    name, listing = platform.processor() or platform.machine(), Path("/proc/cpuinfo")
    if listing.exists():
        name = next(
            (
                line.split(":")[1].strip()
                for line in listing.read_text().splitlines()
                if line.startswith("model name")
            ),
            name,
        )
    return (
        f"{name}, {os.cpu_count()} cores, Python {platform.python_version()}; "
        f"{date.today()}, 1-minute load {os.getloadavg()[0]:.1f}"
    )


def in_new_process(work: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function of a script in a new process, which imports what it needs."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(work, *arguments).result()


def memory(key: str = "VmHWM") -> float:
    """Return the peak memory of this process, or another size of /proc/self/status [MiB].

    The peak that `resource.getrusage` gives a new process includes that of its parent.
    """
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith(key))


def table(head: Sequence[object], rows: Iterable[Iterable[object]]) -> str:
    """Return a Markdown table."""
    lines = [f"| {' | '.join(map(str, row))} |" for row in (head, *rows)]
    return "\n".join([lines[0], "|" + "---|" * len(head), *lines[1:]])


def renew(page: Path | None, name: str, text: str) -> None:
    """Put `text` between ``<!-- name: begin -->`` and ``<!-- name: end -->`` of a page, if any."""
    if page is None:
        return
    begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    whole = page.read_text(encoding="utf-8")
    if begin not in whole or end not in whole:
        raise SystemExit(f"{page}: put {begin} and {end} where the tables go")
    before, after = whole.split(begin)[0], whole.split(end)[1]
    page.write_text(f"{before}{begin}\n{text.strip()}\n{end}{after}", encoding="utf-8")
