"""Reduction of a log to block statistics in one pass over the recording."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from scipy.fft import prev_fast_len

from gyrostab.arrays import Bools
from gyrostab.diagnose.reduce.accumulate import Accumulator
from gyrostab.diagnose.reduce.label_statistics import label_statistics
from gyrostab.diagnose.reduce.log_blocks import count_samples, read_batches
from gyrostab.errors import OptionError
from gyrostab.progress import Stage, no_stage
from gyrostab.schema import check_log
from gyrostab.time.durations import duration_seconds, samples

_BLOCK_S = 20.0  # default block; design choice
_MIN_DEFAULT_BLOCKS = 90  # shorter blocks in shorter records; design choice
_MAX_BLOCKS = 1000  # longer blocks in records above 5.6 h; bounds memory and time
_MIN_BLOCK_SAMPLES = 100  # of a default block; design choice
MIN_BLOCKS = 24  # fewer are refused: held-out stretches and calibration need them


def choose_block_length(size: int, rate: float, block: Any = None) -> int:
    """Choose the block length: 20 s, less in short records, more beyond 5.6 h; in samples.

    The length is a product of small primes. A requested one is a duration, or a number of samples
    such as ``"2000samples"``.

    Raises
    ------
    OptionError
        When the record holds too few such blocks.

    Examples
    --------
    >>> choose_block_length(360_000, 100.0), choose_block_length(72_001, 200.0)
    (2000, 800)
    >>> choose_block_length(8_641, 100.0)
    100
    """
    if block is None:
        default_length = max(
            min(_BLOCK_S * rate, size / _MIN_DEFAULT_BLOCKS), size / _MAX_BLOCKS, _MIN_BLOCK_SAMPLES
        )
        length = 2 * prev_fast_len(int(default_length) // 2, real=True)  # of 2, 3 and 5
    else:
        length = samples(block, rate, "block")
        if length < 16:
            raise OptionError(
                f"block {block!r} holds {length} samples at {rate:g} Hz; "
                f"a block needs 16 ({16 / rate:g} s) at least"
            )
    if size < MIN_BLOCKS * length:
        raise OptionError(
            f"the record of {size / rate:.4g} s ({size} samples at {rate:g} Hz) is too short to "
            f"diagnose: it must hold {MIN_BLOCKS} blocks of {length / rate:g} s, "
            f"{MIN_BLOCKS * length / rate:g} s at least"
            + ("; give a shorter block" if block is not None else "")
        )
    return length


def reduce_log(
    log: xr.Dataset,
    *,
    block: Any = None,
    restart_gap: Any = 5.0,
    left_out: Bools | None = None,
    progress: Stage = no_stage,
) -> xr.Dataset:
    """Reduce a log to statistics of blocks of equal length: means, band powers, sample counts.

    Parameters
    ----------
    log : xarray.Dataset
        Regular log, in memory or lazy; it is read once, from front to back.
    block : str or timedelta, optional
        Length of a block; by default 20 s, or less in short records.
    restart_gap : str or float
        Shortest gap that counts as a power-off [s].
    left_out : ndarray of bool, shape (axis, block), optional
        Blocks that count as missing on an axis.
    progress : Stage
        Progress, in samples over all axes.

    Returns
    -------
    xarray.Dataset
        With the variables of `gyrostab.diagnose.reduce.schema.BLOCK_STATISTICS`, the channels, and
        coordinates ``time``, ``begin``, ``end`` [s] of the blocks, ``frequency`` [Hz] of the bands.

    Raises
    ------
    SchemaError
        If the log is not regular.
    OptionError
        If the record is too short.

    Notes
    -----
    Block means are subtracted and missing samples count as zero; powers are unbiased for white
    noise with any gaps (see `gyrostab.kernels.spectra.periodogram`). Under random gaps a density
    S(f) is seen as ``neighbours * S + (1 - neighbours) * mean(S)``.

    Examples
    --------
    >>> from gyrostab.ingest.make_log import make_log
    >>> noise = 0.18 * 10 * np.random.default_rng(1).standard_normal((1, 360_000))
    >>> blocks = reduce_log(make_log(noise, rate=100.0, unit="deg/h"))
    >>> blocks.sizes["block"], blocks.attrs["block_s"], float((blocks.power.mean() ** 0.5).round(2))
    (180, 20.0, 0.18)
    """
    check_log(log)
    rate, size = float(log.attrs["sampling_rate_hz"]), count_samples(log)
    length = choose_block_length(size, rate, block)
    work = Accumulator(log, length, size // length, rate)
    sample_count = work.row_count * work.block_count * length
    progress("reducing", sample_count)
    for batch in read_batches(log, length):
        stop = batch.first + batch.values.shape[1]
        if left_out is not None:
            batch.values[: work.axis_count][left_out[:, batch.first : stop]] = np.nan
        work.add(batch)
        progress("reducing", sample_count, work.row_count * stop * length)
    restart_gap_s = duration_seconds(restart_gap, "restart_gap")
    return label_statistics(work, log, restart_gap_s=restart_gap_s)
