"""A random walk that is present only under vibration is found in the block means."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.core import diagnose
from gyrostab.diagnose.identify.components import sum_evidence
from gyrostab.diagnose.identify.naming_order import SearchRound
from gyrostab.diagnose.predict.candidates import Candidate, Component, Variant
from gyrostab.diagnose.predict.linear_model import initial_state
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.settings import DEFAULTS
from gyrostab.diagnose.statistics import find_statistic
from gyrostab.diagnose.statistics.build_candidates import effect_candidates
from gyrostab.simulate import simulate
from tests.support.candidates import find_components
from tests.support.repetitions import first_of

SHAKE = {
    "profile": "vibration",
    "points": [
        *([0, 0.02], [900, 0.02], [901, 3.0], [1700, 3.0], [1701, 0.02], [2600, 0.02]),
        *([2601, 4.0], [3400, 4.0], [3401, 0.02], [4500, 0.02]),
    ],
}


def shaken_log(seed: int, effects: tuple[dict[str, object], ...]) -> xr.Dataset:
    model = {
        "log": {"axes": ["x"]},
        "noise": {"N": 0.003, "B": 0.004, "K": 0.02},
        "environment": [SHAKE],
        "effect": list(effects),
    }
    return simulate(model, duration="75min", rate=4.0, seed=seed).compute()


WALK = {"name": "vibration_random_walk", "sensitivity": 0.15}


def test_a_steady_walk_that_explains_more_is_not_that_of_vibration():
    """A size may have an error of form, which costs 1 % of the evidence here; a walk has none."""
    walk, mean = find_statistic("random_process"), find_statistic("mean")
    variant = Variant({}, ("size",), np.ones((1, 1, 4)))
    components = {
        name: [Component(Candidate(name, statistic, driver, (variant,)), variant, ("x",), nats)]
        for name, statistic, driver, nats in (
            ("~red", walk, (), 1000.0),
            ("vibration_random_walk", walk, ("vibration",), 995.0),
            ("temperature_bias", mean, ("temperature",), 992.0),
        )
    }
    examination = SimpleNamespace(settings=DEFAULTS, candidates=[])
    search = SearchRound(examination, None, components, {})
    assert search.order_rivals(list(components)) == ["temperature_bias"]
    components["~red"] = [replace(components["~red"][0], evidence_nats=997.0)]
    assert search.order_rivals(list(components)) == [
        "vibration_random_walk",
        "temperature_bias",
    ]


@pytest.mark.parametrize("seed", first_of(1, 2, 3))
def test_levels_between_quiescent_stretches_are_no_random_walk(seed: int) -> None:
    baseline = calibrate_noise(reduce_log(shaken_log(seed, (WALK,))))
    K = baseline.sel(axis="x", term="K")
    assert float(K.coefficient) < 0.02 + 3.0 * float(K.stderr)
    assert float(K.coefficient) + 3.0 * float(K.stderr) < 0.25


@pytest.mark.parametrize("seed", first_of(1, 2, 3))
def test_walk_under_vibration_has_evidence_in_the_means(seed: int) -> None:
    evidence = []
    for effects in ((WALK,), ()):
        blocks = reduce_log(shaken_log(seed, effects))
        baseline = calibrate_noise(blocks)
        walks = [
            candidate
            for candidate in effect_candidates(blocks, baseline["coefficient"])[0]
            if (candidate.effect, candidate.statistic.name)
            == ("vibration_random_walk", "random_process")
        ]
        components = find_components(walks, initial_state(blocks, baseline))
        evidence.append(sum(map(sum_evidence, components.values())))
    assert evidence[0] > 10.0
    assert evidence[1] < 3.0


@pytest.mark.full
def test_walk_under_vibration_is_named_and_sized() -> None:
    found = diagnose(shaken_log(2, (WALK,)), nulls=100)
    assert found.verdict == "explained"
    (effect,) = found.effects
    assert effect["name"] == "vibration_random_walk"
    size = effect["parameters"]["sensitivity"]
    assert abs(size["value"] - 0.15) < 3.0 * size["stderr"] < 0.15
    assert np.isfinite(found.content["held_out"]["log_likelihood_gain"])
