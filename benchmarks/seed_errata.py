"""Errors of the three papers that gyrostab starts from, each with a number that shows it.

P16: Wang et al., Sensors 16 (2016). P15: Wang et al., Measurement 75 (2015) 263. L13: Li et al.,
Chin. J. Lasers 40 (2013) 0908004. The formulae are evaluated here as printed, and as they
should be.

    python benchmarks/seed_errata.py --output docs/seeds.md
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import xarray as xr
from page import make_parser, renew, table

from gyrostab.allan.davar import davar
from gyrostab.allan.fit import fit_noise
from gyrostab.arrays import Floats
from gyrostab.ingest.make_log import make_log
from gyrostab.noise import LAWS, model_avar
from gyrostab.simulate import simulate

#: Noise of the west gyro at rest, L13, Table 1.
_AT_REST = {"Q": 5.49020943, "N": 0.01657046, "B": 0.13814101, "K": 0.31584771, "R": 0.24861667}


class Erratum(NamedTuple):
    """One error: place, printed statement, correction, and a quantity with both values."""

    where: str
    printed: str
    right: str
    quantity: str
    as_printed: float
    in_truth: float


def errata() -> list[Erratum]:
    """Evaluate every slip, in the order of docs/seeds.md."""
    return [show() for show in _SHOWN]


def _white(size: int, *, mean: float = 0.0) -> Floats:
    return mean + np.random.default_rng(1).standard_normal(size)


def _averages(rate: Floats, k: int) -> Floats:
    return np.convolve(rate, np.full(k, 1.0 / k), mode="valid")


def _estimate_avar(values: Floats, k: int, *, kind: str = "rate", zero_fill: bool = False) -> float:
    """Allan variance of samples at 100 Hz over all of the record, as one window.

    With `zero_fill`, the sum is divided by the number of terms without gaps.
    """
    log = make_log(values, rate=100.0, unit="deg/h" if kind == "rate" else "deg", kind=kind)
    size = values.size - (kind == "angle")
    surface = davar(log, window=f"{size}samples", taus=[k / 100.0])
    return float((surface["avar"] * (surface["coverage"] if zero_fill else 1.0)).values.item())


def _filtered(density: Callable[[Floats], Floats], tau: float) -> float:
    """Integrate P16 Eq. 7 with df, 4 int S(f) sin^4(pi f tau) / (pi f tau)^2 df.

    The variable is pi f tau on a geometric grid.
    """
    u = np.geomspace(1e-5, 2e4, 2_000_001)
    weight = np.where(u < 300.0, np.sin(u) ** 4, 0.375) / u**2  # beyond, the mean of sin^4
    return float(
        np.trapezoid(4.0 * density(u / (math.pi * tau)) * weight / (math.pi * tau) * u, np.log(u))
    )


def _divided_twice() -> Erratum:
    rate, k, interval = _white(200_000), 10, 0.01
    mean = _averages(rate, k)
    printed = np.mean((mean[k:] - mean[:-k]) ** 2) / (2.0 * k**2 * interval**2)
    return Erratum(
        "P16 Eq. 5, 12",
        "differences of averages are divided by k² τ0²",
        "they are averages already; only the angle (Eq. 16, 17) is divided",
        "Allan variance of x1 at 0.1 s [deg²/h²]; 1/k = 0.1",
        float(printed),
        _estimate_avar(rate, k),
    )


def _one_average() -> Erratum:
    rate, k = np.arange(1000.0), 10
    mean = _averages(rate, k)
    return Erratum(
        "P16 Eq. 12",
        "ω̄[m+k] − ω̄[k]",
        "ω̄[m+k] − ω̄[m]",
        "Allan variance of a ramp of 1 deg/h a sample, k = 10 [deg²/h²]; k²/2 = 50",
        float(np.mean((mean[k:] - mean[k]) ** 2) / 2.0),
        _estimate_avar(rate, k),
    )


def _wrong_variable() -> Erratum:
    tau = 10.0
    right = _filtered(np.ones_like, tau)
    return Erratum(
        "P16 Eq. 7",
        "du",
        "df",
        "Allan variance of N = 1 at τ = 10 s, integrated over u = π f τ and over f; N²/τ = 0.1",
        right * math.pi * tau,
        right,
    )


def _quantization_unit() -> Erratum:
    arcsec = 1e6 * math.pi / 180.0 / 3600.0  # in urad
    c = float(LAWS["Q"].avar(1.0, arcsec))
    return Erratum(
        "P16 Eq. 9, P15 Eq. 4",
        'Q = 10⁶ π √C₋₂ / (180 · 3600 · √3) in "',
        "that is µrad (so L13 Eq. 3)",
        "Q of an angle rounded to 1 arcsec rms, in arcsec",
        1e6 * math.pi * math.sqrt(c) / (180.0 * 3600.0 * math.sqrt(3.0)),
        math.sqrt(c / 3.0),  # a degree per hour is an arcsec per second
    )


def _walk_density() -> Erratum:
    return Erratum(
        "P16 Table 1",
        "rate random walk K² / (2π f²)",
        "(K / 2π)² / f²",
        "Eq. 7 over K² τ/3 at τ = 1 s",
        3.0 * _filtered(lambda f: 1.0 / (2.0 * math.pi * f**2), 1.0),
        3.0 * _filtered(lambda f: 1.0 / (2.0 * math.pi * f) ** 2, 1.0),
    )


def _swapped_symbols() -> Erratum:
    return Erratum(
        "L13 Eq. 1",
        "B²/τ + (2 ln 2/π) δθ²",
        "N²/τ + (2 ln 2/π) B²",
        "Allan deviation of the second term at 1 s for its Table 1 at rest [deg/h]",
        _AT_REST["B"],
        math.sqrt(model_avar(1.0, {"N": _AT_REST["N"]})),
    )


def _added_deviations() -> Erratum:
    terms = [math.sqrt(float(law.avar(20.0, _AT_REST[symbol]))) for symbol, law in LAWS.items()]
    return Erratum(
        "P15 Eq. 3",
        "Allan deviations of the terms are added",
        "Allan variances are added",
        "Allan deviation at 20 s for L13 Table 1 at rest [deg/h]",
        sum(terms),
        math.hypot(*terms),
    )


def _growing_level() -> Erratum:
    log = simulate(
        {
            "log": {"rate": 100, "duration": "6000 s", "axes": ["x"]},
            "environment": [
                {
                    "profile": "ramps",
                    "channel": "level",
                    "unit": "g",
                    "points": [[0, 1], [6000, 11]],
                }
            ],
            "effect": [{"name": "vibration_noise", "driver": "level", "white": 1 / 600}],
        },
        seed=1,
    )
    spread = log["rate"].values.reshape(200, 3000).var(axis=1)
    return Erratum(
        "P16 Eq. 23, 24",
        "the variance of x2 is σ[n] = 1 + 10 n/L",
        "σ[n] is its standard deviation",
        "variance of the last 30 s of x2 [deg²/h²], with a scatter of 3",
        11.0,
        float(spread[-1]),
    )


def _canyon() -> Erratum:
    rate = _white(200_000)
    rate[(np.arange(rate.size) // 2500) % 2 == 1] = np.nan
    return Erratum(
        "P16 section 6",
        "lost differences are zero, the divisor stays N_w − 2k",
        "divide by the number of differences that are there",
        "Allan variance of x1 at 0.1 s, half of it lost [deg²/h²]; 0.1",
        _estimate_avar(rate, 10, zero_fill=True),
        _estimate_avar(rate, 10),
    )


def _angle_across_gaps() -> Erratum:
    rate = _white(200_000, mean=10.0)
    rate[(np.arange(rate.size) // 50) % 20 == 7] = np.nan
    angle = np.where(np.isnan(rate), np.nan, np.nancumsum(rate) / 360_000.0)
    return Erratum(
        "P16 Eq. 21, 22",
        "a difference counts if its three angles are there",
        "a log of rates loses the angle in a gap: all 2k samples must be there, or clusters be "
        "weighted",
        "Allan variance at 1 s over 0.01, mean rate 10 deg/h, 5 % lost",
        100.0 * _estimate_avar(angle, 100, kind="angle"),
        100.0 * _estimate_avar(rate, 100),
    )


def _windows(size: int, window: int, step: int, where: str, stated: int) -> Erratum:
    log = make_log(_white(size), rate=100.0, unit="deg/h")
    return Erratum(
        where,
        f"{stated} windows",
        "both ends count",
        f"windows of {window} in {size} samples, step {step}",
        float(stated),
        float(
            davar(log, window=f"{window}samples", step=f"{step}samples", taus=[0.01]).sizes["time"]
        ),
    )


def _shaken(duration: str, noise: float, **effect: object) -> xr.Dataset:
    return simulate(
        {
            "log": {"rate": 400, "duration": duration, "axes": ["x"]},
            "noise": {"N": noise},
            "environment": [
                {
                    "profile": "vibration",
                    "points": [[0, 0.02], [330, 13.39], [630, 0.02]],
                    "band": [700, 800],
                },
                {"profile": "gaps", "spans": [[432, 450]]},
            ],
            "effect": [effect],
        },
        seed=1,
    )


def _start_of_vibration() -> Erratum:
    shaken = _shaken("500 s", 0.006, name="aliased_vibration", sensitivity=3.73)
    surface = davar(shaken, window="1s", step="0.5s", taus=[0.05])
    begin = (surface["time_bounds"][:, 1] - shaken["time"][0]).values / np.timedelta64(1, "s")
    crest = surface["avar"].values[0, :, 0]
    lost = begin[surface["window_coverage"].values[0] < 1.0]
    return Erratum(
        "P16 section 8",
        "vibration begins at 432 s (and, elsewhere, at 330 s)",
        "432 s is the first lost sample",
        "end of the first window with a loss, and of the first with twice the Allan deviation [s]",
        float(lost[0]),
        float(begin[np.flatnonzero(crest > 4.0 * np.nanmedian(crest[:600]))[0]]),
    )


def _folded_band() -> Erratum:
    shaken = _shaken("430 s", 0.0, name="aliased_vibration", sensitivity=1.0)["rate"].values[
        0, 340 * 400 :
    ]
    power = np.abs(np.fft.rfft(shaken - shaken.mean())) ** 2
    below = np.fft.rfftfreq(shaken.size, 1 / 400.0) < 100.0
    return Erratum(
        "P16 section 8",
        "noise of the samples under vibration is the gyro's",
        "700-800 Hz folds onto 0-100 Hz at 400 Hz",
        "share of the power below 100 Hz: in the vibration, in its samples",
        0.0,
        float(power[below].sum() / power.sum()),
    )


def _step_for_walk() -> Erratum:
    step, hours = 0.27, 5.0 / 3600.0
    rate = 0.02 * _white(2000) + np.where(np.arange(2000) < 1000, 0.0, step)
    surface = davar(make_log(rate, rate=400.0, unit="deg/h"), window="2000samples")
    return Erratum(
        "P16 section 8",
        "K grows under vibration",
        f"a step D of the mean looks like K = D/√W ({step / math.sqrt(hours):.1f} for 0.27 deg/h "
        "in 5 s)",
        "K fitted to white noise with such a step, and its true K [deg/h^1.5]",
        float(fit_noise(surface, terms="NK", observed_only=False)["K"].values.item()),
        0.0,
    )


def _revolutions() -> Erratum:
    pull = [(2.0 * math.pi * turns) ** 2 * 0.02 / 9.80665 for turns in (300.0, 300.0 / 60.0)]
    return Erratum(
        "P16 section 2",
        "the tool turns at 300 rounds per second",
        "300 r/min, presumably",
        "centrifugal acceleration 2 cm off the axis [g]",
        *pull,
    )


_SHOWN: tuple[Callable[[], Erratum], ...] = (
    _divided_twice,
    _one_average,
    _wrong_variable,
    _quantization_unit,
    _walk_density,
    _swapped_symbols,
    _added_deviations,
    _growing_level,
    _canyon,
    _angle_across_gaps,
    lambda: _windows(6000, 1000, 30, "P16 Table 2, x1", 166),
    lambda: _windows(600_000, 2000, 300, "P16 Table 2, x2", 1993),
    _start_of_vibration,
    _folded_band,
    _step_for_walk,
    _revolutions,
)


def main() -> None:
    output = make_parser(__doc__).parse_args().output
    head = ["where", "printed", "right", "shown by", "as printed", "right"]
    rows = [[*slip[:4], f"{slip.as_printed:.4g}", f"{slip.in_truth:.4g}"] for slip in errata()]
    text = table(head, rows)
    print(text)
    renew(output, "errata", text)


if __name__ == "__main__":
    main()
