"""Published data sets of the field, with the deviations and intervals printed for them.

The frequency data are taken as a rate in deg/h at one sample per second.

W. J. Riley, Handbook of Frequency Stability Analysis, NIST Special Publication 1065 (2008), section
12: the nine frequencies of NBS Monograph 140 with Table 30, the 1000-point set (p. 107) with Table
31 (p. 108, seven digits), and its error bars in Table 32 (p. 109).
"""

from __future__ import annotations

import numpy as np
import pytest

from gyrostab.allan.confidence import confidence_interval
from gyrostab.allan.davar import davar
from gyrostab.ingest.make_log import make_log
from gyrostab.kernels.allan.pairs import white_pair_sum

NBS_9_POINT = [892, 809, 823, 798, 671, 644, 883, 903, 677]


def minimal_standard(count: int) -> np.ndarray:
    """Generate n = 16807 n mod (2^31 - 1) from 1234567890, divided by the modulus."""
    numbers = [1234567890]
    while len(numbers) < count:
        numbers.append(16807 * numbers[-1] % 2147483647)
    return np.array(numbers) / 2147483647


def whole_record(frequencies, taus, **options):
    log = make_log(np.asarray(frequencies, float), rate=1.0, unit="deg/h")
    whole = f"{len(frequencies)}samples"
    surface = davar(log, window=whole, step=whole, taus=taus, tau_max=taus[-1], **options)
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
    found = whole_record(frequencies, list(printed), method=method)
    np.testing.assert_allclose(np.sqrt(found["avar"]), list(printed.values()), rtol=2e-7)


def test_degrees_of_freedom_and_interval_are_the_printed_ones():
    """Table 32: 146.177 by an approximate formula for white noise, and a 95 % interval.

    Our degrees of freedom are those of the noise that the three averaging times show. The printed
    bounds are those of chi-square quantiles that are right to 0.1 %.
    """
    exact = 981**2 / white_pair_sum(981, 10)
    assert exact == pytest.approx(146.177, rel=1e-3)
    log = make_log(minimal_standard(1000), rate=1.0, unit="deg/h")
    surface = davar(log, window="1000samples", step="1000samples", taus=[1.0, 10.0, 100.0])
    assert float(surface["edf"].sel(tau=10.0).item()) == pytest.approx(146.177, rel=0.01)
    limits = confidence_interval(surface).sel(tau=10.0)
    low, high = (float(np.sqrt(limits[f"avar_{end}"]).item()) for end in ("lower", "upper"))
    assert low == pytest.approx(8.223942e-2, rel=2e-3)
    assert high == pytest.approx(1.035201e-1, rel=2e-3)
