"""Scale-factor errors and real rotation are distinguished by the share of the rotation."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.evidence.folds import fold_blocks
from gyrostab.diagnose.identify.components import group_components
from gyrostab.diagnose.identify.effect_candidates import effect_candidates
from gyrostab.diagnose.identify.forward_search import name_effects
from gyrostab.diagnose.identify.identifiability import find_plainer_effect, is_physical
from gyrostab.diagnose.predict.linear_model import initial_state
from gyrostab.diagnose.predict.search import compute_evidence
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.simulate import simulate
from tests.support.named import nulls

_TURNS = [
    [0, 0.0],
    [300, 0.0],
    [310, 108.0],
    [600, 108.0],
    [610, 40.0],
    [800, 40.0],
    [810, 0.0],
    [1000, 0.0],
    [1010, 90.0],
    [1200, 90.0],
]


def _reduce_share(share: float) -> xr.Dataset:
    """Reduce a log in which axis z senses a share of the rotation."""
    effect = {"name": "real_motion", "spin": share, "sway": 0.0, "axes": ["z"]}
    model = {
        "log": {"axes": ["x", "z"]},
        "noise": {"N": 0.003},
        "effect": [effect],
        "environment": [{"profile": "rotation", "points": _TURNS}],
    }
    return reduce_log(simulate(model, duration="20min", rate=10.0, seed=3).compute())


def _find_components(blocks: xr.Dataset):
    baseline = calibrate_noise(blocks)
    known = [
        candidate
        for candidate in effect_candidates(blocks, baseline["coefficient"])[0]
        if candidate.effect in ("scale_factor", "real_motion")
    ]
    state = initial_state(blocks, baseline)
    components = group_components(
        compute_evidence(
            [candidate for candidate in known if candidate.statistic.name == "mean"],
            blocks,
            state,
            fold_blocks(blocks),
        )
    )
    return {group[0].candidate.effect: group for group in components.values()}, state


@pytest.mark.parametrize(
    ("share", "plainer", "allowed"),
    [(3e-6, "scale_factor", False), (1e-3, "scale_factor", True), (0.5, None, True)],
)
def test_share_of_the_rotation_selects_the_effect(share, plainer, allowed):
    components, state = _find_components(_reduce_share(share))
    motion, error = components["real_motion"], components["scale_factor"]
    assert motion[0].row == ("z",)
    assert motion[0].evidence_nats > 30.0
    assert find_plainer_effect(motion, state) == plainer
    assert bool(is_physical(motion, state)) is allowed
    assert find_plainer_effect(error, state) is None


@pytest.mark.slow
def test_tiny_share_of_the_rotation_is_a_scale_factor_error():
    blocks = _reduce_share(1e-6)
    baseline, records = nulls(blocks, 40)
    identifications = name_effects(blocks, baseline, records)
    (identification,) = identifications.identified
    assert identification.effect == "scale_factor"
    assert identification.axes == ("z",)
    assert "real_motion" not in identification.alternatives
    assert np.isfinite(identification.evidence_nats)
