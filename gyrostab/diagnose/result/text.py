"""Write sentences on mismatches and effects: what, where, when, by how much, and how sure."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

from gyrostab.diagnose.statistics import find_statistic
from gyrostab.diagnose.statistics.mismatch_wording import axes_text, capitalise_axes
from gyrostab.physics.registry import effects
from gyrostab.wording import join_words

#: Smallest probability that is printed: the extrapolated tail of the null records goes no further.
MIN_PRINTED_PROBABILITY = 1e-6
#: A stretch that starts and ends within this share of the record from its ends is the whole record.
END_TOLERANCE_SHARE = 0.02
_CHANCE = "noise alone would show this in {share} such records"
_CHANCE_PATTERN = re.compile(r" \(noise alone would show this in [^()]*\)(?=\.$)")


def plain_name(name: str) -> str:
    """Return what an effect is called in a sentence.

    Examples
    --------
    >>> plain_name("shupe"), plain_name("some_new_effect")
    ('a bias that follows the rate of change of temperature (Shupe effect)', 'some new effect')
    """
    kind = effects().get(name)
    return (kind.plain or kind.short) if kind else name.strip("~").replace("_", " ")


def chance(p_value: float) -> str:
    """Describe the probability that noise alone gives a result, no smaller than is known.

    Examples
    --------
    >>> chance(0.004)
    'noise alone would show this in 1 of 250 such records'
    >>> chance(1e-12)
    'noise alone would show this in fewer than 1 in a million such records'
    """
    return _CHANCE.format(share=chance_share(p_value))


def chance_share(p_value: float) -> str:
    """Write a probability as one of so many, no smaller than the null records support.

    Examples
    --------
    >>> chance_share(0.004), chance_share(0.03), chance_share(1e-12)
    ('1 of 250', '1 of 33', 'fewer than 1 in a million')
    """
    if p_value < MIN_PRINTED_PROBABILITY:
        return "fewer than 1 in a million"
    number = 1.0 / p_value
    if number < 99.5:
        return f"1 of {number:.2g}"
    size = 10.0 ** (math.floor(math.log10(number)) - 1)  # two digits
    return f"1 of {round(number / size) * size:,.0f}".replace(",", " ")


def clock(seconds: float) -> str:
    """Write the time since the start of the record as hours, minutes and seconds.

    Examples
    --------
    >>> clock(83.0), clock(5400.0), clock(0.5)
    ('1:23', '1:30:00', '0:00.5')
    """
    whole, tenths = divmod(round(seconds * 10), 10)
    minutes, second = divmod(int(whole), 60)
    hours, minute = divmod(minutes, 60)
    tail = f"{second:02d}" + (f".{int(tenths)}" if tenths and seconds < 60 else "")
    return f"{hours}:{minute:02d}:{tail}" if hours else f"{minute}:{tail}"


def span_text(begin: float, end: float, whole: float) -> str:
    """Write a stretch of a record [s since its start]; `whole` is the length of the record."""
    if begin <= END_TOLERANCE_SHARE * whole and end >= (1.0 - END_TOLERANCE_SHARE) * whole:
        return "over the whole record"
    return f"from {clock(begin)} to {clock(end)} after the start"


# ------------------------------------------------------------------------------------------------
# mismatches


def mismatch_statement(region: Mapping[str, Any], whole: float) -> str:
    """Write one sentence on a place where recording and simulation differ.

    It is a `gyrostab.diagnose.statistics.base.Region`, but with a list of axes.

    Examples
    --------
    >>> mismatch_statement({"statistic": "power", "quantity": "avar", "axes": ["x"],
    ...                     "begin": 1500.0, "end": 1800.0, "tau_min_s": 0.01, "tau_max_s": 3.0,
    ...                     "ratio": 1.8, "sign": 1, "p_value": 0.0004, "estimate": 1.8}, 3600.0)
    'Axis x is noisier than the simulation from 25:00 to 30:00 after the start: at averaging times
     of 10 ms to 3 s its Allan variance is 1.8 times the expected value (noise alone would show
     this in 1 of 2 500 such records).'
    """
    when = span_text(region["begin"], region["end"], whole)
    sentence = find_statistic(region["statistic"]).describe(region, when)
    return f"{sentence} ({chance(region['p_value'])})."


def motion_statement(axis: str, when: str, largest: float, followers: Sequence[str]) -> str:
    """Write a sentence on an axis that moves far beyond its noise and that no channel explains.

    `when` is from `span_text`, `largest` the largest deviation [deg/h]. The followers are axes that
    see the same motion through a misalignment.

    Examples
    --------
    >>> motion_statement("z", "from 1:00 to 5:00 after the start", 389.0, ["x"])
    'The rate of axis z moves far beyond its noise from 1:00 to 5:00 after the start, by up to
     389 deg/h. Axis x senses part of it, so it is real rotation of the tool; no channel records
     its true rate.'
    """
    size = f"by up to {largest:.3g} deg/h"
    text = f"The rate of axis {axis} moves far beyond its noise {when}, {size}"
    if followers:
        them = capitalise_axes(followers)
        return (
            f"{text}. {them} {'senses' if len(followers) == 1 else 'sense'} part of it, so it "
            "is real rotation of the tool; no channel records its true rate."
        )
    causes = " or ".join(plain_name(name) for name in ("real_motion", "scale_factor"))
    return f"{text}. No channel explains it; it may be {causes}."


def named_statement(
    statistic: str, effect: str, axes: Sequence[str], when: str, p_value: float
) -> str:
    """Write a sentence on a difference that shows only with the pattern of an effect.

    Examples
    --------
    >>> named_statement("mean", "shupe", ["y"], "over the whole record", 0.004)
    'The mean rate of axis y differs from the simulation over the whole record: no single place
     exceeds noise, but the whole has the pattern of a bias that follows the rate of change of
     temperature (Shupe effect) (noise alone would show this in 1 of 250 such records).'
    """
    quantity = _QUANTITIES.get(statistic, "The noise")
    return (
        f"{quantity} of {axes_text(axes)} differs from the simulation {when}: no single "
        f"place exceeds noise, but the whole has the pattern of {plain_name(effect)} "
        f"({chance(p_value)})."
    )


_QUANTITIES = {
    "mean": "The mean rate",
    "cross_axis": "The covariance",
    "spectrum": "The spectrum",
    "distribution": "The distribution of the samples",
}


def without_chance(statement: str) -> str:
    """Return a sentence on a mismatch without its probability, for lists that have it elsewhere.

    Examples
    --------
    >>> without_chance(f"Axis x has outliers ({chance(0.004)}).")
    'Axis x has outliers.'
    """
    return _CHANCE_PATTERN.sub("", statement)


# ------------------------------------------------------------------------------------------------
# effects


def unsized_statement(effect: str, axes: Sequence[str]) -> str:
    """Write a sentence on an effect whose size the record does not determine.

    Examples
    --------
    >>> unsized_statement("real_motion", ["z"])
    'The record shows real rotation of the tool, not a sensor error, on axis z, but does not
     determine the size.'
    """
    return (
        f"The record shows {plain_name(effect)}, on {axes_text(axes)}, but does not determine "
        "the size."
    )


def effect_statement(
    description: str, *, alternatives: Sequence[str] = (), intervals: Sequence[str] = ()
) -> str:
    """Describe an effect, when it acts, and what the record cannot distinguish it from.

    The description is from `Effect.say`, the intervals are from `span_text`, and the alternatives
    are names of effects.

    Examples
    --------
    >>> effect_statement("The bias jumps on axis x.", alternatives=["telegraph"],
    ...                  intervals=["from 1:00 to 2:00 after the start"])
    'The bias jumps on axis x. It is active from 1:00 to 2:00 after the start. This record cannot
     distinguish it from a bias that switches between two levels.'
    """
    sentences = [description]
    if intervals:
        sentences.append(f"It is active {', and '.join(intervals)}.")
    if alternatives:
        names = ", or ".join(plain_name(name) for name in alternatives)
        sentences.append(f"This record cannot distinguish it from {names}.")
    return " ".join(sentences)


def probability_text(effect: Mapping[str, Any]) -> str:
    """Say how probable the name of an effect is; empty for a diagnosis without probabilities.

    Examples
    --------
    >>> probability_text({"name": "shupe", "probability": 0.9314})
    'The name is right with a probability of 93 %.'
    """
    if effect.get("probability") is None:
        return ""
    return f"The name is right with a probability of {100 * effect['probability']:.0f} %."


def family_text(strongest: Mapping[str, Any], others: Sequence[Mapping[str, Any]]) -> str:
    """Say what family the strongest line belongs to, and where the other lines are.

    Examples
    --------
    >>> lines = [{"parameters": {"frequency": {"value": f}}} for f in (37.5, 25.0)]
    >>> family_text({"family": "harmonics of 12.5 Hz"}, lines)
    'It is the strongest of the harmonics of 12.5 Hz; the others are at 25 and 37.5 Hz.'
    """
    at = sorted({f"{line['parameters']['frequency']['value']:.4g}" for line in others}, key=float)
    are = "other is" if len(at) == 1 else "others are"
    return f"It is the strongest of the {strongest['family']}; the {are} at {join_words(at)} Hz."


def rejection_text(beaten_by: str, nats: float | None) -> str:
    """Say what beats an effect that was examined and not named, and by how much.

    Examples
    --------
    >>> rejection_text("supply_bias", 12.34)
    'the evidence of a bias that follows supply voltage or light power is 12.3 nats larger'
    >>> rejection_text("noise", 5.0), rejection_text("an impossible size", None)
    ('its evidence is 5.0 nats below the threshold', 'it would need an impossible size')
    """
    if beaten_by == "noise":
        return "" if nats is None else f"its evidence is {nats:.1f} nats below the threshold"
    if nats is None:
        is_zero = beaten_by == "a size of zero"
        return "its size may be zero" if is_zero else f"it would need {beaten_by}"
    winner = plain_name(beaten_by) if beaten_by in effects() else beaten_by
    if winner.startswith("the "):  # a nuisance alternative, which is a clause
        winner = f"a model in which {winner}"
    if nats < 0.0:
        return f"the order of similar effects puts {winner} first, with {-nats:.1f} nats less"
    return f"the evidence of {winner} is {nats:.1f} nats larger"


def next_measurement(name: str, alternatives: Sequence[str]) -> str:
    """Say what to measure to separate an effect from its alternatives; empty if nothing is known.

    Examples
    --------
    >>> next_measurement("g_sensitivity", ["vibration_rectification"])
    'To tell them apart, turn the tool over at rest: g-sensitivity changes sign with gravity,
     rectification does not.'
    """
    names = (name, *alternatives)
    measurements = {
        effect: effects()[effect].next_measurement for effect in names if effect in effects()
    }
    steps = list(dict.fromkeys(filter(None, map(measurements.get, names[:3]))))
    if not steps:
        return ""
    if {"vibration_rectification", "g_sensitivity"} <= set(names):
        steps = [measurements[name]]  # either measurement separates the two
    if alternatives:
        return f"To tell them apart, {'; or '.join(steps[:2])}."
    return f"To confirm it, {steps[0]}."
