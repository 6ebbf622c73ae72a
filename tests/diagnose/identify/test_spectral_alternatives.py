"""Effects that differ in the spectrum only are separated where their forms fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from scipy.signal import bilinear, butter, lfilter, sosfilt

from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.result.verdict import name_probability
from gyrostab.diagnose.settings import DEFAULTS
from gyrostab.ingest.make_log import make_log
from tests.support.named import name_effects, nulls

RATE, SECONDS = 20.0, 1200
RESONANCE_HZ = 2.8


def shaken_record(kind: str, *, seed: int = 5) -> xr.Dataset:
    """Make white noise on one axis, with more noise of some kind while the tool vibrates."""
    rng = np.random.default_rng(seed)
    size = round(RATE * SECONDS)
    shaken = (np.arange(size) // round(RATE * 100)) % 3 == 1
    added = rng.standard_normal(size)
    if kind == "rising":  # N and Q
        added = 0.5 * added + np.diff(rng.standard_normal(size + 1))
    elif kind == "mount":
        omega = 2.0 * np.pi * RESONANCE_HZ
        mount = lfilter(*bilinear([omega**2], [1.0, omega / 4.0, omega**2], fs=RATE), added)
        added = 0.4 * mount
    else:
        hump = sosfilt(butter(2, [2.0, 4.0], "bandpass", fs=RATE, output="sos"), added)
        added = hump / hump.std()
    rates = rng.standard_normal(size) + shaken * added
    log = make_log(
        rates[None], rate=RATE, unit="deg/h", channels={"vibration": (5.0 * shaken, "g")}
    )
    return reduce_log(log, block="20s")


@pytest.mark.parametrize(
    ("kind", "is_separated"),
    [pytest.param("rising", True, marks=pytest.mark.slow), ("mount", False), ("hump", False)],
)
def test_vibration_noise_is_alone_only_if_its_spectrum_fits(kind: str, is_separated: bool) -> None:
    blocks = shaken_record(kind)
    baseline, records = nulls(blocks, 30)
    identified = name_effects(blocks, baseline, records).identified
    (identification,) = identified
    names = {"vibration_noise", "aliased_vibration"}
    assert identification.effect in names
    assert set(identification.alternatives) == (
        set() if is_separated else names - {identification.effect}
    )
    if kind == "mount":
        resonance = identification.components[0].variant.values["resonance"]
        assert resonance == pytest.approx(RESONANCE_HZ, rel=0.4)
    share = 1.0 if is_separated else 1.0 / (1.0 + DEFAULTS.alternative_weight)
    alone = replace(identification, alternatives=())
    assert name_probability(identification) == pytest.approx(share * name_probability(alone))
