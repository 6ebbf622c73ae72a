"""Small plans of the blind test, and a scenario of white noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gyrostab.blindtest.generator.scenario import draw_scenario
from gyrostab.blindtest.scenarios.plan import plan_case


def small(
    name: str | None,
    *,
    seed: int = 21,
    strength: float = 3.0,
    rate: float = 10.0,
    seconds: float = 900,
    **more,
) -> dict:
    names = [name] if name else []
    base = plan_case(4, seed=seed) | {
        "kind": "single" if name else "null",
        "names": names,
        "strengths": [strength] * len(names),
        "in_fitted_noise": False,
    }
    return base | {"rate": rate, "seconds": seconds, "gaps": 0.1, "degradation": None} | more


def white_scenario(*, rate: float = 10.0, seconds: float = 2000.0):
    scenario = draw_scenario(np.random.default_rng(1), rate=rate, seconds=seconds)
    noise = tuple({"N": n, "B": 0.0, "K": 0.0, "Q": 0.0} for n in (0.003, 0.004, 0.002))
    return replace(scenario, noise=noise, missing=np.zeros(scenario.size, dtype=bool))
