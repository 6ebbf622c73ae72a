"""Command `doctor`: the state of the installation."""

from __future__ import annotations

import os
import platform
from collections import defaultdict
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

from gyrostab.cli.console import app
from gyrostab.cli.options import Common
from gyrostab.errors import GyrostabError

if TYPE_CHECKING:
    from packaging.requirements import Requirement

#: Extras that users install; the others are for developers.
_EXTRAS = (
    "ardupilot", "distributed", "dlis", "gcs", "http", "las", "matlab", "miniseed", "novatel",
    "rosbag", "s3", "tdms", "ulog",
)  # fmt: skip


@app.command(sort_key=15, help_epilogue="")
def doctor(*, common: Common = Common()) -> None:
    """Check the installation: versions, extras, compiled kernels and the NetCDF library.

    Prints what a bug report should contain. Exit code 2 if a required package is missing or too
    old.

    Example: gyrostab doctor
    """
    from gyrostab.io.datasets import has_zstd

    print(f"gyrostab {metadata.version('gyrostab')} in {_package_folder()}")
    print(f"Python {platform.python_version()}, {platform.platform()}, {_describe_machine()}")
    needed = _check_requirements()
    faults = [line for line, fault in needed[""] if fault]
    print(f"required packages: {', '.join(line for line, _ in needed['']) or 'unknown'}")
    for extra in _EXTRAS:
        lines = ", ".join(line for line, _ in needed[extra])
        missing = any(fault for _, fault in needed[extra])
        print(f"extra {extra}: {lines}" + f"; pip install 'gyrostab[{extra}]'" * missing)
    print(f"NetCDF with zstd: {'yes' if has_zstd() else 'no; logs are compressed with zlib'}")
    engines = metadata.entry_points(group="xarray.backends").names
    engine = "registered" if "gyrostab" in engines else "install gyrostab again"
    print(f"engine for xarray: {engine}")
    print(f"compiled kernels: {_describe_kernels()}")
    if faults:
        raise GyrostabError(f"{', '.join(faults)}: install gyrostab again with pip")


def _package_folder() -> Path:
    return Path(__file__).parents[2]


def _describe_machine() -> str:
    cores = f"{os.cpu_count()} processor cores"
    try:
        size = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):  # a system without sysconf
        return cores
    return f"{cores}, {size / 2**30:.1f} GiB of memory"


def _check_requirements() -> dict[str, list[tuple[str, bool]]]:
    """Compare installed versions with the requirements, by extra: text, and whether it is wrong."""
    from packaging.requirements import Requirement

    requirements = defaultdict(list)
    for text in metadata.requires("gyrostab") or ():
        need = Requirement(text)
        extras = [
            extra
            for extra in ("", *_EXTRAS)
            if need.marker is None or need.marker.evaluate({"extra": extra})
        ]
        if extras:
            requirements[extras[0]].append(_check_version(need))
    return requirements


def _check_version(need: Requirement) -> tuple[str, bool]:
    try:
        version = metadata.version(need.name)
    except metadata.PackageNotFoundError:
        return f"{need.name} missing", True
    if need.specifier.contains(version, prereleases=True):
        return f"{need.name} {version}", False
    return f"{need.name} {version} (needs {need.specifier})", True


def _describe_kernels() -> str:
    """Describe the cache of numba: where, how much, and whether it can be written."""
    configured = os.environ.get("NUMBA_CACHE_DIR")
    folder = Path(configured) if configured else _package_folder() / "kernels"
    files = [*folder.rglob("*.nbi"), *folder.rglob("*.nbc")]
    size = sum(file.stat().st_size for file in files) / 1e6
    state = f"{len(files)} files of {size:.0f} MB" if files else "none yet, compiled when first run"
    if os.access(folder, os.W_OK):
        return f"{state}, in {folder}"
    return f"{state}, in {folder}, which is read-only; set NUMBA_CACHE_DIR to a folder to write to"
