"""Sentences of a diagnosis state what the record determines, and once."""

from __future__ import annotations

import re

import numpy as np
import pytest
import xarray as xr

from gyrostab.diagnose.estimate.joint_fit import fit_identifications
from gyrostab.diagnose.identify.forward_search import name_effects
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.result.tables import effect_tables
from gyrostab.ingest.make_log import make_log
from tests.support.named import nulls

RATE = 50.0
pytestmark = pytest.mark.usefixtures("one_thread")


def shaken_blocks(seed: int, *, band_hz: tuple[float, float] | None) -> xr.Dataset:
    """Make two axes of white noise, with the same white noise added to both in vibration of 5 g."""
    rng = np.random.default_rng(seed)
    size = round(RATE * 1200)
    vibration = 5.0 * ((np.arange(size) // round(RATE * 100)) % 3 == 1)
    rates = rng.standard_normal((2, size)) + np.outer(
        [0.4, 0.3], vibration * rng.standard_normal(size)
    )
    log = make_log(rates, rate=RATE, unit="deg/h", channels={"vibration": (vibration, "g")})
    if band_hz:
        log["vibration"].attrs["band_hz"] = band_hz
    return reduce_log(log, block="20s")


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("band_hz", [None, (600.0, 725.0)])
def test_only_known_frequencies_of_aliased_vibration_are_stated(
    seed: int, band_hz: tuple[float, float] | None
) -> None:
    blocks = shaken_blocks(seed, band_hz=band_hz)
    baseline, records = nulls(blocks, 30)
    identifications = name_effects(blocks, baseline, records)
    (table,) = effect_tables(fit_identifications(identifications, baseline), blocks)
    assert table["name"] == "aliased_vibration"
    if band_hz:
        assert "Vibration at 600 to 725 Hz folds" in table["statement"]
        return
    assert not re.search("[78]00", table["statement"])
    ((low, high, x, y),) = re.findall(
        r"noise at (\S+) to (\S+) Hz of (\S+) and (\S+) deg/h/g", table["statement"]
    )
    assert (float(low), float(high)) == (0.0, RATE / 2.0)
    assert [float(x), float(y)] == pytest.approx([0.4, 0.3], rel=0.05)
