"""Where the figures of a benchmark go: between two marks of a page, with the machine named."""

from __future__ import annotations

import os
import platform
from datetime import date
from pathlib import Path


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


def renew(page: Path, name: str, text: str) -> None:
    """Put `text` between ``<!-- name: begin -->`` and ``<!-- name: end -->`` of a page."""
    begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    whole = page.read_text(encoding="utf-8")
    if begin not in whole or end not in whole:
        raise SystemExit(f"{page}: put {begin} and {end} where the tables go")
    before, after = whole.split(begin)[0], whole.split(end)[1]
    page.write_text(f"{before}{begin}\n{text.strip()}\n{end}{after}", encoding="utf-8")
