"""Time-shifted surrogates of a channel, which an effect must exceed."""

from __future__ import annotations

import numpy as np

from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.baseline.from_model import baseline_from_model
from gyrostab.diagnose.evidence.folds import fold_blocks
from gyrostab.diagnose.identify import identifiability
from gyrostab.diagnose.identify.identifiability import passes_time_shift_test
from gyrostab.diagnose.predict.candidates import Component
from gyrostab.diagnose.predict.linear_model import initial_state
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.statistics.candidates import effect_candidates
from gyrostab.ingest.make_log import make_log
from gyrostab.simulate import simulate
from tests.support.candidates import find_components, select_candidate


def _run_time_shift_test(sensitivity: float, period: float) -> tuple[bool, float]:
    """Test a bias that follows a temperature with this period [s]."""
    swing = [
        [t, 40.0 + 20.0 * np.sin(2.0 * np.pi * t / period)]
        for t in np.arange(0.0, 1801.0, 15.0).tolist()
    ]
    model = {
        "log": {"axes": ["x"]},
        "noise": {"N": 0.003, "B": 0.004, "K": 0.02},
        "effect": [{"name": "temperature_bias", "sensitivity": sensitivity}],
        "environment": [
            {
                "profile": "ramps",
                "channel": "temperature",
                "unit": "degree_Celsius",
                "points": swing,
            }
        ],
    }
    blocks = reduce_log(simulate(model, duration="30min", rate=10.0, seed=5).compute())
    baseline = calibrate_noise(blocks)
    known, _ = effect_candidates(blocks, baseline["coefficient"])
    candidate = select_candidate(known, "temperature_bias", "mean")
    variant = next(variant for variant in candidate.variants if variant.columns == ("sensitivity",))
    return passes_time_shift_test(
        [Component(candidate, variant, ("x",), 50.0)],
        initial_state(blocks, baseline),
        fold_blocks(blocks),
    )


def test_periodic_channel_is_not_rejected_for_its_mirror_image():
    """Half a period later it is the same channel with the other sign, which a negative size follows
    as well."""
    beats, p_value, _ = _run_time_shift_test(0.02, 600.0)
    assert beats
    assert p_value == 0.0


def test_unrelated_channel_fails():
    beats, p_value, _ = _run_time_shift_test(0.0, 1300.0)
    assert not beats
    assert p_value > 0.01


def test_an_unrelated_channel_is_no_better_than_its_surrogates(monkeypatch):
    """An unrelated channel explains as much as half of its surrogates, whatever time constants are
    tried."""
    monkeypatch.setattr(identifiability, "TIME_SHIFTS", 60)
    model = {"noise": {"N": 0.003, "B": 0.004, "K": 0.02}, "log": {"axes": ["x"]}}

    def p_value(seed: int) -> float:
        rng = np.random.default_rng(seed)

        def wander() -> np.ndarray:
            course = np.convolve(rng.standard_normal(9599), np.hanning(600), "valid")
            return (course - course.mean()) / course.std()

        rate = 0.4 * rng.standard_normal(9000) + 0.05 * wander()
        channels = {"temperature": (40.0 + 5.0 * wander(), "degC")}
        blocks = reduce_log(make_log(rate, rate=5.0, unit="deg/h", channels=channels, axis=["x"]))
        state = initial_state(blocks, baseline_from_model(blocks, model))
        known, _ = effect_candidates(blocks, state.baseline["coefficient"])
        shupe = select_candidate(known, "shupe", "mean")
        components = find_components([shupe], state)[shupe.key]
        return passes_time_shift_test(components, state, fold_blocks(blocks))[1]

    assert np.mean([p_value(seed) for seed in range(4, 9)]) > 0.4
