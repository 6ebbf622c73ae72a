"""Plan the cases of a seed: kinds, effects, strengths, lengths, rates and gaps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from gyrostab.blindtest.generator.catalogue import CATALOGUE, OUT_OF_CATALOGUE
from gyrostab.blindtest.generator.scenario import stream

#: Kind of case -> its number in 20 cases. "single", "sub_threshold", "out_of_catalogue" and
#: "degraded_driver" hold one effect.
KINDS = {
    "null": 2,
    "single": 5,
    "sub_threshold": 2,
    "pair": 4,
    "triple": 1,
    "out_of_catalogue": 3,
    "degraded_driver": 3,
}

#: Sizes in units of the closed-form limit in known noise, for half of the cases.
STRENGTHS = (0.5, 1.0, 1.5, 2.5, 4.0, 8.0)

#: Least sizes in units of the limit in fitted noise, for the other half: three times the limit and
#: more are required to be detected and named, and few effects of `STRENGTHS` reach that.
STRONG_IN_FITTED_NOISE = (3.0, 5.0, 8.0)

#: Kinds of which all cases have sizes in known noise: their effects are to be invisible in a plot.
_NEVER_STRONG = ("null", "sub_threshold")

#: Degradations of the channel that drives an effect; see `degrade_driver`.
DEGRADATIONS = ("withheld", "substituted", "lagged", "confounded", "noisy", "clipped")

#: Effects that never share a record, because one makes the limit of the other meaningless.
INCOMPATIBLE = (
    {"logger_filter", "spikes"},
    {"rate_quantization", "dead_zone"},
    {"rate_quantization", "clipping"},
    {"rate_quantization", "spikes"},
    {"rate_quantization", "held_samples"},
    {"clipping", "spikes"},
    {"dead_zone", "misalignment"},
    {"gauss_markov", "telegraph"},
)


def _list_options(kind: str) -> list[tuple[str, float]]:
    if kind == "out_of_catalogue":
        return [(name, s) for name in OUT_OF_CATALOGUE for s in STRENGTHS[1:]]
    if kind == "degraded_driver":
        return [
            (name, s) for name, entry in CATALOGUE.items() if entry.channel for s in STRENGTHS[2:]
        ]
    if kind == "sub_threshold":
        return [
            (name, s)
            for name, entry in CATALOGUE.items()
            if entry.can_be_sub_threshold
            for s in (1.0, 1.5, 2.5)
        ]
    return [(name, s) for name in CATALOGUE for s in STRENGTHS]


def _deal_effect(seed: int, kind: str, turn: int) -> tuple[str, float]:
    """Choose effect and strength of case `turn` of its kind; each pair occurs once per round."""
    pool = _list_options(kind)
    lap, place = divmod(turn, len(pool))
    name, strength = pool[int(stream(seed, "deal", kind, lap).permutation(len(pool))[place])]
    return name, strength


def _draw_shape(rng: np.random.Generator, kind: str, index: int) -> tuple[float, float]:
    """Draw rate [Hz] and length [s]: mostly short records, one of a day in 400."""
    draw = float(rng.random())
    rate = float(rng.choice([10.0, 100.0, 400.0], p=[0.4, 0.45, 0.15]))
    if index % 400 == 150:
        return 10.0, 86400.0
    if kind == "sub_threshold":
        rate, shortest, longest = 10.0, 3000.0, 9000.0
    elif draw < 0.03:
        rate, shortest, longest = 10.0, 7200.0, 21600.0
    else:
        shortest, longest = 600.0, {10.0: 4500.0, 100.0: 2400.0, 400.0: 900.0}[rate]
    return rate, round(float(np.exp(rng.uniform(np.log(shortest), np.log(longest)))))


def plan_case(index: int, *, seed: int) -> dict[str, Any]:
    """Plan case `index` of a benchmark, from 0; the plan depends on index and seed only.

    ``in_fitted_noise`` is set if the strengths are; see `draw_scenario` for ``rate`` [Hz],
    ``seconds``, ``gaps``, ``cuts`` and ``heavy``, and `degrade_driver` for ``degradation``.
    """
    deck = [kind for kind, number in KINDS.items() for _ in range(number)]
    lap, place = divmod(index, len(deck))
    order = stream(seed, "kinds", lap).permutation(len(deck))
    kind = deck[int(order[place])]
    turn = sum(deck[int(order[i])] == kind for i in range(place)) + lap * KINDS[kind]
    rng = stream(seed, "plan", index)
    rate, seconds = _draw_shape(rng, kind, index)
    names, strengths = [], []
    if kind != "null":
        name, strength = _deal_effect(seed, kind, turn)
        names, strengths = [name], [strength]
    for _ in range({"pair": 1, "triple": 2}.get(kind, 0)):
        candidates = [
            candidate
            for candidate in CATALOGUE
            if candidate not in names
            and not any({candidate, name} in INCOMPATIBLE for name in names)
        ]
        names.append(str(rng.choice(candidates)))
        strengths.append(float(rng.choice(STRENGTHS)))
    in_fitted_noise = kind not in _NEVER_STRONG and bool(rng.random() < 0.5)
    if in_fitted_noise:
        strengths = [float(rng.choice(STRONG_IN_FITTED_NOISE)) for _ in names]
    channel = (CATALOGUE | OUT_OF_CATALOGUE)[names[0]].channel if names else None
    possible = [
        how for how in DEGRADATIONS if channel != "ramp" or how in ("withheld", "substituted")
    ]
    return {
        "index": index,
        "seed": seed,
        "kind": kind,
        "names": names,
        "strengths": strengths,
        "in_fitted_noise": in_fitted_noise,
        "rate": rate,
        "seconds": seconds,
        "gaps": float(rng.uniform(0.0, 0.4)) if rng.random() < 0.5 else 0.0,
        "cuts": int(rng.integers(1, 4)) if rng.random() < 0.3 else 0,
        "heavy": bool(rng.random() < {"null": 0.5, "sub_threshold": 0.0}.get(kind, 0.1)),
        "degradation": str(rng.choice(possible)) if kind == "degraded_driver" else None,
    }


def plan_cases(number: int, *, seed: int) -> list[dict[str, Any]]:
    """Plan the first `number` cases of a benchmark."""
    return [plan_case(index, seed=seed) for index in range(number)]


def plan_counterparts(plans: Sequence[dict[str, Any]], every: int) -> list[dict[str, Any]]:
    """Plan the noise-only counterpart of one in `every` cases with effects; of none for 0.

    Examples
    --------
    >>> plans = plan_cases(20, seed=3)
    >>> len(plan_counterparts(plans, 4)), len(plan_counterparts(plans, 0))
    (5, 0)
    """
    with_effects = [plan for plan in plans if plan["names"]]
    chosen = with_effects[::every] if every else []
    return [plan | {"copy": "counterpart"} for plan in chosen]
