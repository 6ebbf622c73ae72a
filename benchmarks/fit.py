"""Time the fit of windows: the kernel, the limits, and what is made once for a surface.

    python benchmarks/fit.py --output docs/performance.md

Windows of 5 min at 400 Hz of quantization noise, angle and rate random walk; processor time of one
thread, the best of several runs.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import dask
import numpy as np
from page import machine, make_parser, renew, table

from gyrostab import davar, fit_noise, make_log
from gyrostab.allan import window_fit
from gyrostab.allan.fit_inputs import fit_inputs
from gyrostab.kernels.allan.clusters import cluster_strides
from gyrostab.kernels.fit.covariance import product_tables
from gyrostab.kernels.fit.freedoms import cell_freedoms, combine_diagonal
from gyrostab.kernels.fit.least_squares import identify_noise
from gyrostab.kernels.fit.mixture import Curves
from tests.support.noise_records import lose, mixture

RATE, SAMPLES = 400.0, 6_000_000


def best(call: Callable[[], object], repeats: int) -> float:
    """Least processor time of a call [s], after one that compiles and warms up."""
    call()
    seconds = []
    for _ in range(repeats):
        start = time.thread_time()
        call()
        seconds.append(time.thread_time() - start)
    return min(seconds)


def record(missing: bool) -> np.ndarray:
    rng = np.random.default_rng(2)
    x = mixture(rng, 1, SAMPLES, rate=RATE, N=0.01, Q=0.3, K=2.0)
    return lose(rng, x, 0.1, 1000.0) if missing else x


def measure(x: np.ndarray, taus: int, repeats: int) -> tuple[int, list[float]]:
    """Measure a fit: number of averaging times, then microseconds a window of each part.

    The parts are all, kernel, limits, the rest and the quick fit of davar; last come the seconds of
    the tables.
    """
    surface = davar(make_log(x, rate=RATE, unit="deg/h"), window="5min", step="15s", taus=taus)
    cells, ks, rate, window = fit_inputs(surface)
    flat = [np.ascontiguousarray(cell.reshape(-1, ks.size), dtype=np.float64) for cell in cells[:5]]
    trend, *responses, exact = (cell.reshape(-1) for cell in cells[5:])
    trends = [trend, np.stack(responses, axis=-1), exact]
    tables = window_fit.fit_tables(tuple(ks.tolist()), rate, window)
    noise_tables = (tables.columns, tables.weight, tables.to_samples)
    diagonal = combine_diagonal(
        *product_tables(window, ks, diagonal=True), cluster_strides(window, ks)
    )
    whole = best(lambda: fit_noise(surface), repeats)
    kernel = best(lambda: window_fit.run_kernel(flat, *trends, tables, 31), repeats)
    options = {"white_error": np.zeros(trends[0].size), "allowed": 31, "observed_only": True}
    block = best(lambda: window_fit.fit_block(flat, *trends, tables, **options), repeats)
    seconds = [
        whole,
        kernel,
        max(block - kernel, 0.0),
        max(whole - block, 0.0),
        best(
            lambda: cell_freedoms(
                identify_noise(Curves(*flat), *noise_tables),
                Curves(*flat),
                tables.columns,
                tables.to_samples,
                diagonal,
            ),
            repeats,
        ),
    ]
    once = best(lambda: window_fit.FitTables(ks, rate, window), 1)
    return ks.size, [1e6 * s / flat[0].shape[0] for s in seconds] + [once]


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    rows = []
    with dask.config.set(scheduler="sync"):
        for name in ("none", "10 % in bursts of 1000"):
            x = record(name != "none")
            for taus in (24, 40, 48):
                size, (whole, kernel, *parts, once) = measure(x, taus, arguments.repeats)
                times = [f"{whole:.0f}", f"{kernel:.0f}", *(f"{part:.1f}" for part in parts)]
                rows.append([name, size, *times, f"{once:.2f}"])
    head = ["gaps", "averaging times", "fit_noise, us a window", "kernel", "limits", "rest",
            "quick fit in davar", "tables, once, s"]  # fmt: skip
    text = f"{machine()}; best of {arguments.repeats}.\n\n{table(head, rows)}"
    print(text)
    renew(arguments.output, "fit", text)


if __name__ == "__main__":
    main()
