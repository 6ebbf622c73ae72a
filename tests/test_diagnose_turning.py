"""Earth rate in a tool that turns, whichever way round its axes stand."""

from __future__ import annotations

import numpy as np
import pytest

from gyrostab.diagnose.calibration.baseline import calibrate
from gyrostab.diagnose.effects.candidates import effect_candidates
from gyrostab.diagnose.effects.cells import begin_state
from gyrostab.diagnose.effects.explained import explain_away
from gyrostab.diagnose.effects.search import gains
from gyrostab.diagnose.gains.folds import fold_blocks
from gyrostab.diagnose.modelling.refit import fit_claims
from gyrostab.diagnose.naming.claims import Claim, Naming
from gyrostab.diagnose.naming.parts import by_key, gain_sum
from gyrostab.diagnose.reduction.reduced import reduce_log
from gyrostab.simulate import simulate


def _log(**effect):
    model = {
        "log": {"axes": ["x", "y"]},
        "noise": {"N": 0.003},
        "effect": [{"name": "earth_rate", **effect}],
        "environment": [{"profile": "rotation", "points": [[0, 108.0], [1200, 108.0]]}],
    }
    return simulate(model, duration="20min", rate=10.0, seed=5).compute()


@pytest.mark.parametrize("around", [90.0, -90.0])
def test_earth_rate_is_taken_out_and_made_again(around):
    log = _log(latitude=45.0, toolface=40.0, off=[90.0, 90.0], around=[0.0, around])
    reduced = reduce_log(log)
    baseline = calibrate(reduced)
    known, reasons = effect_candidates(reduced, baseline["coefficient"])
    orders = [one for one in known if one.view == "order"]
    start, folds = begin_state(reduced, baseline), fold_blocks(reduced)
    parts = by_key(gains(orders, reduced, start, folds))["earth_rate(rotation_rate)"]
    assert gain_sum(parts) > 1000.0
    state = explain_away(start, parts)
    assert max(gain_sum(one) for one in by_key(gains(orders, reduced, state, folds)).values()) < 5.0
    claim = Claim("earth_rate", parts[0].candidate.driver, ("x", "y"), tuple(parts), 500.0, 8.0)
    naming = Naming((claim,), (), 8.0, np.zeros(1), reasons, tuple(known), state, folds)
    (fitted,) = fit_claims(naming, baseline)
    made = {name: getattr(fitted.effect, name) for name in ("latitude", "toolface", "off", "around")}
    again = _log(**{name: list(value) if isinstance(value, tuple) else value for name, value in made.items()})
    assert float(np.abs(again["rate"] - log["rate"]).max()) < 0.01 * float(log["rate"].std())
