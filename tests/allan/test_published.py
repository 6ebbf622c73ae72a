"""Published data sets of the field, with the deviations and intervals printed for them.

The frequency data are taken as a rate in deg/h at one sample per second.

W. J. Riley, Handbook of Frequency Stability Analysis, NIST Special Publication 1065 (2008), section
12: the nine frequencies of NBS Monograph 140 with Table 30, the 1000-point set (p. 107) with Table
31 (p. 108, seven digits), and its error bars in Table 32 (p. 109).

A caesium clock and an oven-controlled oscillator, with the deviations that Stable32 1.60 prints
(five digits): see published/README.md.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest

from gyrostab.allan.confidence import confidence_interval
from gyrostab.allan.davar import davar
from gyrostab.ingest.make_log import make_log
from gyrostab.kernels.allan.pairs import white_pair_sum
from tests.support.published import published_davar

#: Averaging factor: overlapping Allan, modified Allan and overlapping Hadamard deviation.
STABLE32_CS5071A = {
    1: (3.3171e-10, 3.3171e-10, 3.5076e-10),
    2: (1.5996e-10, 1.1187e-10, 1.6843e-10),
    4: (7.9910e-11, 3.8526e-11, 8.4076e-11),
    10: (3.2118e-11, 9.9741e-12, 3.3786e-11),
    20: (1.6180e-11, 3.8845e-12, 1.7016e-11),
    40: (8.1916e-12, 1.7654e-12, 8.6027e-12),
    100: (3.4040e-12, 8.7807e-13, 3.5636e-12),
    200: (1.7949e-12, 5.8480e-13, 1.8715e-12),
    400: (9.7900e-13, 3.9737e-13, 1.0148e-12),
    1_000: (4.7341e-13, 2.4555e-13, 4.8484e-13),
    2_000: (2.9244e-13, 1.7232e-13, 2.9366e-13),
    4_000: (1.9972e-13, 1.2874e-13, 2.0568e-13),
    10_000: (1.0126e-13, 6.4513e-14, 1.0293e-13),
    20_000: (6.9895e-14, 4.7421e-14, 6.8319e-14),
    40_000: (5.6125e-14, 3.9745e-14, 5.6186e-14),
    100_000: (2.6121e-14, 1.2329e-14, 2.1358e-14),
}
STABLE32_OCXO = {
    1: (7.6106e-11, 7.6106e-11, 7.9695e-11),
    2: (3.9920e-11, 2.8192e-11, 4.2593e-11),
    4: (1.8809e-11, 9.6349e-12, 1.9783e-11),
    8: (9.7501e-12, 4.2122e-12, 9.9479e-12),
    16: (6.2040e-12, 3.4773e-12, 5.5981e-12),
    32: (5.0608e-12, 3.6224e-12, 4.3552e-12),
    63: (5.0128e-12, 4.1450e-12, 4.2491e-12),
    128: (5.3832e-12, 4.4398e-12, 4.9231e-12),
    258: (5.0780e-12, 4.1267e-12, 4.4833e-12),
    511: (5.2149e-12, 4.3820e-12, 4.2791e-12),
    1_025: (6.5491e-12, 6.0043e-12, 4.8738e-12),
    2_032: (8.2079e-12, 7.0177e-12, 7.7952e-12),
    4_083: (9.1013e-12, 9.7860e-12, 8.4783e-12),
}
NBS_9_POINT = [892, 809, 823, 798, 671, 644, 883, 903, 677]


def minimal_standard(count: int) -> np.ndarray:
    """Generate n = 16807 n mod (2^31 - 1) from 1234567890, divided by the modulus."""
    numbers = [1234567890]
    while len(numbers) < count:
        numbers.append(16807 * numbers[-1] % 2147483647)
    return np.array(numbers) / 2147483647


def whole_record(frequencies, taus, run=davar, **options):
    log = make_log(np.asarray(frequencies, float), rate=1.0, unit="deg/h")
    whole = f"{len(frequencies)}samples"
    surface = run(log, window=whole, step=whole, taus=taus, tau_max=taus[-1], **options)
    return surface.isel(axis=0, time=0)


def test_generator_gives_the_printed_numbers():
    numbers = np.rint(minimal_standard(4) * 2147483647).astype(int)
    assert list(numbers[1:]) == [395529916, 1209410747, 633705974]
    assert minimal_standard(1)[0] == pytest.approx(0.5748904732, abs=5e-11)


@pytest.mark.parametrize("method", ["blocks", "direct", "recursive"])
@pytest.mark.parametrize(
    ("frequencies", "printed"),
    [
        (NBS_9_POINT, {1.0: 91.22945, 2.0: 85.95287}),
        (minimal_standard(1000), {1.0: 2.922319e-1, 10.0: 9.159953e-2, 100.0: 3.241343e-2}),
    ],
)
def test_overlapping_allan_deviations_are_the_printed_ones(frequencies, printed, method):
    run = davar if method == "blocks" else partial(published_davar, method=method)
    surface = whole_record(frequencies, list(printed), run)
    np.testing.assert_allclose(np.sqrt(surface["avar"]), list(printed.values()), rtol=2e-7)


def test_degrees_of_freedom_and_interval_are_the_printed_ones():
    """Table 32: 146.177 by an approximate formula for white noise, and a 95 % interval.

    Our degrees of freedom are those of the noise that the whole record shows. The printed
    bounds are those of chi-square quantiles that are right to 0.1 %.
    """
    exact = 981**2 / white_pair_sum(981, 10)
    assert exact == pytest.approx(146.177, rel=1e-3)
    log = make_log(minimal_standard(1000), rate=1.0, unit="deg/h")
    surface = davar(log, window="1000samples", step="1000samples", taus=[1.0, 10.0, 100.0])
    assert float(surface["edf"].sel(tau=10.0).item()) == pytest.approx(146.177, rel=0.02)
    limits = confidence_interval(surface).sel(tau=10.0)
    low, high = (float(np.sqrt(limits[f"avar_{end}"]).item()) for end in ("lower", "upper"))
    assert low == pytest.approx(8.223942e-2, rel=5e-3)
    assert high == pytest.approx(1.035201e-1, rel=5e-3)


def clock_frequencies(name: str) -> np.ndarray:
    """Relative frequencies of a clock, one a second, in units of 1e-12."""
    stored = np.load(Path(__file__).parent / "published" / f"{name}.npz")
    if name == "cs5071a_phase":
        return stored["steps"].astype(float)
    return (stored["offset"] - np.median(stored["offset"])) * 1e-2


@pytest.mark.parametrize(("place", "variance"), [(0, "avar"), (1, "modified"), (2, "hadamard")])
@pytest.mark.parametrize(
    ("name", "printed"),
    [("cs5071a_phase", STABLE32_CS5071A), ("ocxo_frequency", STABLE32_OCXO)],
)
def test_deviations_of_clocks_are_those_of_stable32(name, printed, variance, place):
    surface = whole_record(clock_frequencies(name), [float(k) for k in printed], variance=variance)
    expected = [1e12 * row[place] for row in printed.values()]
    np.testing.assert_allclose(np.sqrt(surface["avar"]), expected, rtol=5e-5)
