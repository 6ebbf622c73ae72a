"""Blocks with anomalous samples are left out of all statistics, of one axis and of two."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from gyrostab.diagnose.predict.candidates import Candidate, Component, Variant
from gyrostab.diagnose.predict.condition import condition_on_components
from gyrostab.diagnose.predict.linear_model import cross_without, initial_state
from gyrostab.diagnose.statistics import find_statistic
from gyrostab.diagnose.statistics.sample_counts import mask_anomalous_blocks
from tests.support.reduced_records import baseline, records

BLOCKS = 40
PAIRS = [("x", "y"), ("x", "z"), ("y", "z")]


@pytest.fixture
def blocks() -> xr.Dataset:
    """Noise on x, y and z; an outlier on y in blocks 5 and 9, and one on z in block 9."""
    statistics = records(
        baseline(block_count=BLOCKS), 1, np.random.default_rng(1), block_count=BLOCKS
    ).isel(record=0)
    outliers = np.zeros((3, BLOCKS), np.int64)
    outliers[1, [5, 9]] = outliers[2, 9] = 1
    return statistics.assign(outliers=(("axis", "block"), outliers))


def spikes(axis: str) -> Component:
    variant = Variant({}, ("outliers",), np.ones((1, 1, 1)))
    return Component(
        Candidate("spikes", find_statistic("sample_counts"), (), (variant,)), variant, (axis,), 20.0
    )


def lost(after: xr.DataArray, before: xr.DataArray) -> set[tuple[str, int]]:
    """Return rows and blocks without data; the bands of a block are lost together."""
    gone = (after.isnull() & before.notnull()).transpose(
        ..., "block", *(["band"] if "band" in before.dims else [])
    )
    if "band" in gone.dims:
        assert (gone.all("band") == gone.any("band")).all()
        gone = gone.any("band")
    names = ["".join(pair) for pair in PAIRS] if "pair" in gone.dims else list("xyz")
    return {(names[row], int(block)) for row, block in np.argwhere(gone.values)}


def test_cross_spectrum_is_left_out_with_either_axis(blocks: xr.Dataset) -> None:
    left_out = np.zeros((3, BLOCKS), np.bool_)
    left_out[0, 3] = left_out[1, 7] = left_out[2, 7] = True
    assert list(zip(blocks["first"].values, blocks["second"].values, strict=True)) == PAIRS
    cross = cross_without(blocks, left_out)
    assert lost(cross, blocks["cross"]) == {("xy", 3), ("xz", 3), ("xy", 7), ("xz", 7), ("yz", 7)}
    assert cross.dims == blocks["cross"].dims
    assert cross_without(blocks, np.zeros((3, BLOCKS), np.bool_)).identical(blocks["cross"])


def test_blocks_with_named_spikes_are_left_out_of_all_statistics(
    blocks: xr.Dataset,
) -> None:
    on_y, on_both = (
        mask_anomalous_blocks(blocks, [spikes("y")]),
        mask_anomalous_blocks(blocks, [spikes("y"), spikes("z")]),
    )
    for name in ("mean", "power"):
        assert lost(on_y[name], blocks[name]) == {("y", 5), ("y", 9)}
        assert lost(on_both[name], blocks[name]) == {("y", 5), ("y", 9), ("z", 9)}
    assert lost(on_y["cross"], blocks["cross"]) == {("xy", 5), ("yz", 5), ("xy", 9), ("yz", 9)}
    assert lost(on_both["cross"], blocks["cross"]) == {
        ("xy", 5),
        ("yz", 5),
        ("xy", 9),
        ("xz", 9),
        ("yz", 9),
    }
    assert mask_anomalous_blocks(blocks, [spikes("x")]) is blocks  # it has no spikes


def test_blocks_with_spikes_are_left_out_in_the_next_search(blocks: xr.Dataset) -> None:
    state = initial_state(blocks, baseline(block_count=BLOCKS))
    masked = condition_on_components(state, [spikes("y")]).blocks
    for name in ("mean", "power"):
        assert lost(masked[name], blocks[name]) == {("y", 5), ("y", 9)}
    assert lost(masked["cross"], blocks["cross"]) == {("xy", 5), ("yz", 5), ("xy", 9), ("yz", 9)}
