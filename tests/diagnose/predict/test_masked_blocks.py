"""Blocks of odd samples say nothing of the rest, neither alone nor in what two axes share."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from gyrostab.diagnose.predict.candidates import Candidate, Variant
from gyrostab.diagnose.predict.condition import (
    Component,
    condition_on_component,
    mask_anomalous_blocks,
)
from gyrostab.diagnose.predict.linear_model import begin_state, cross_without
from tests.support.reduced_records import baseline, records

BLOCKS = 40
PAIRS = [("x", "y"), ("x", "z"), ("y", "z")]


@pytest.fixture
def reduced() -> xr.Dataset:
    """Noise on x, y and z; an outlier on y in blocks 5 and 9, and one on z in block 9."""
    found = records(baseline(blocks=BLOCKS), 1, np.random.default_rng(1), blocks=BLOCKS).isel(
        record=0
    )
    outliers = np.zeros((3, BLOCKS), np.int64)
    outliers[1, [5, 9]] = outliers[2, 9] = 1
    return found.assign(outliers=(("axis", "block"), outliers))


def spikes(axis: str) -> Component:
    variant = Variant({}, ("outliers",), np.ones((1, 1, 1)))
    return Component(Candidate("spikes", "marks", (), (variant,)), variant, (axis,), 20.0)


def lost(found: xr.DataArray, before: xr.DataArray) -> set[tuple[str, int]]:
    """Rows and blocks that are there no more; the bands of a block go together."""
    gone = (found.isnull() & before.notnull()).transpose(
        ..., "block", *(["band"] if "band" in before.dims else [])
    )
    if "band" in gone.dims:
        assert (gone.all("band") == gone.any("band")).all()
        gone = gone.any("band")
    names = ["".join(pair) for pair in PAIRS] if "pair" in gone.dims else list("xyz")
    return {(names[row], int(block)) for row, block in np.argwhere(gone.values)}


def test_what_two_axes_share_is_left_out_where_either_of_them_is(reduced: xr.Dataset) -> None:
    left_out = np.zeros((3, BLOCKS), np.bool_)
    left_out[0, 3] = left_out[1, 7] = left_out[2, 7] = True
    assert list(zip(reduced["first"].values, reduced["second"].values, strict=True)) == PAIRS
    found = cross_without(reduced, left_out)
    assert lost(found, reduced["cross"]) == {("xy", 3), ("xz", 3), ("xy", 7), ("xz", 7), ("yz", 7)}
    assert found.dims == reduced["cross"].dims
    assert cross_without(reduced, np.zeros((3, BLOCKS), np.bool_)).identical(reduced["cross"])


def test_blocks_of_named_spikes_are_left_out_of_means_powers_and_what_axes_share(
    reduced: xr.Dataset,
) -> None:
    on_y, on_both = (
        mask_anomalous_blocks(reduced, [spikes("y")]),
        mask_anomalous_blocks(reduced, [spikes("y"), spikes("z")]),
    )
    for name in ("mean", "power"):
        assert lost(on_y[name], reduced[name]) == {("y", 5), ("y", 9)}
        assert lost(on_both[name], reduced[name]) == {("y", 5), ("y", 9), ("z", 9)}
    assert lost(on_y["cross"], reduced["cross"]) == {("xy", 5), ("yz", 5), ("xy", 9), ("yz", 9)}
    assert lost(on_both["cross"], reduced["cross"]) == {
        ("xy", 5),
        ("yz", 5),
        ("xy", 9),
        ("xz", 9),
        ("yz", 9),
    }
    assert mask_anomalous_blocks(reduced, [spikes("x")]) is reduced  # it has none


def test_they_are_left_out_for_the_effects_that_are_sought_next(reduced: xr.Dataset) -> None:
    state = begin_state(reduced, baseline(blocks=BLOCKS))
    found = condition_on_component(state, spikes("y")).reduced
    for name in ("mean", "power"):
        assert lost(found[name], reduced[name]) == {("y", 5), ("y", 9)}
    assert lost(found["cross"], reduced["cross"]) == {("xy", 5), ("yz", 5), ("xy", 9), ("yz", 9)}
