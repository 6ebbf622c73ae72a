"""Computation of a product in parts.

Parts are computed in parallel, in any order, and each is written to a block file once the inputs
are found unchanged.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import xarray as xr

from gyrostab.allan.band_limit import choose_windows
from gyrostab.allan.davar import davar_part, davar_sample
from gyrostab.allan.fit import find_band_limits, fit_part
from gyrostab.allan.plan import make_plan, units_of_work
from gyrostab.jobs.checkpoint import Block, write_block
from gyrostab.jobs.schedule import Pool, run_calls
from gyrostab.kernels.workspace import Workspace

#: Finished parts by their number.
Blocks = dict[int, Block]
# Results are held at most this long, or this large, before the inputs are checked again,
_MAX_HELD_SECONDS, _MAX_HELD_BYTES = 1.0, 2**26
# and at most as long as this number of checks takes, so that little is lost when a run is killed.
_MAX_HELD_CHECKS = 50


def compute_part(
    log: xr.Dataset,
    part: slice,
    windows: Mapping[str, Any],
    fitting: Mapping[str, Any] | None,
    space: Workspace | None = None,
) -> xr.Dataset:
    """Compute some windows of a product, or of a surface if `fitting` is None, in this thread."""
    surface = davar_part(log, part=part, space=space, **windows)
    if fitting is None:
        return surface
    return fit_part(surface, **fitting)


def find_record_bands(
    log: xr.Dataset, windows: Mapping[str, Any], fitting: Mapping[str, Any] | None
) -> Mapping[str, Any] | None:
    """Add to the options of a fit the band limit of each axis, from windows of the whole record."""
    if fitting is None:
        return None
    unit = make_plan(log, **windows).unit
    count = units_of_work(log.sizes["time"], unit)[-1].stop
    numbers = choose_windows(count, unit.window, unit.step).tolist()
    surface = davar_sample(log, numbers=numbers, **windows).assign_attrs(step_samples=unit.window)
    return {**fitting, "bands": find_band_limits(surface, **fitting)}


def compute_blocks(
    folder: Path,
    parts: Sequence[slice],
    blocks: Blocks,
    *,
    job: str,
    pool: Pool,
    call: Sequence[Any],
    check: Callable[[], None],
    advance: Callable[[], None],
) -> None:
    """Compute the missing parts and write each to its block file.

    Parameters
    ----------
    blocks : dict
        Finished parts; computed parts are added, even if an error follows.
    call : sequence
        Function and its first arguments; the part is the last one.
    check : callable
        Raises when an input has changed. A result is written only after a later check.
    advance : callable
        Called whenever parts have been written.
    """
    missing = [number for number in range(len(parts)) if number not in blocks]
    held: list[tuple[int, xr.Dataset]] = []
    last, check_seconds = time.monotonic(), 0.0

    def keep() -> None:
        nonlocal last, check_seconds
        if held:
            begun = time.monotonic()
            check()
            check_seconds = time.monotonic() - begun
        while held:
            number, result = held.pop()
            blocks[number] = write_block(folder, parts[number], result, job=job)
        advance()
        last = time.monotonic()

    function, *arguments = call
    numbers = {parts[number].start: number for number in missing}
    try:
        for done, result in run_calls(
            pool, ((function, *arguments, parts[number]) for number in missing)
        ):
            held.append((numbers[done[-1].start], result))
            if (
                time.monotonic() - last > min(_MAX_HELD_SECONDS, _MAX_HELD_CHECKS * check_seconds)
                or sum(result.nbytes for _, result in held) > _MAX_HELD_BYTES
            ):
                keep()
    except BaseException as error:
        if isinstance(error, Exception):
            check()  # that an input has vanished explains more than the error of reading it
        keep()
        raise
    keep()
