"""What a diagnosis says in plain words: where, when, how much, how sure, what else it could be, and what to measure next."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gyrostab.diagnose.result.verdict import failed_checks
from gyrostab.physics.registry import effects
from gyrostab.units import DAY, HOUR

__all__ = [
    "axes_text",
    "chance",
    "chance_share",
    "clock",
    "effect_statement",
    "length_text",
    "mismatch_statement",
    "motion_statement",
    "named_statement",
    "next_measurement",
    "plain_name",
    "span_text",
    "summary",
    "unsized_statement",
    "without_chance",
]

_SURE = 1e-6  # chances below that are not told apart
_CHANCE_WORDS = re.compile(r" \(noise alone does that in [^()]*\)(?=\.$)")

#: What each effect is called in a sentence.
_NAMES = {
    "temperature_bias": "a bias that follows temperature",
    "shupe": "a bias that follows the rate of change of temperature (Shupe effect)",
    "thermal_gradient": "a bias that follows a difference of two temperatures",
    "warm_up": "warming up after power-on",
    "thermal_hysteresis": "a bias that remembers earlier temperatures",
    "vibration_rectification": "a bias made by vibration (rectification)",
    "g_sensitivity": "a bias that follows acceleration",
    "scale_factor": "a scale-factor error",
    "misalignment": "rotation about another axis that leaks in",
    "earth_rate": "earth rate, turned by the tool",
    "dead_zone": "an output that sticks near zero rate",
    "feedback_reset": "an error of the feedback ramp",
    "fringe_hop": "steps of one fringe",
    "bias_jump": "a jump of the bias",
    "telegraph": "a bias that switches between two levels",
    "gauss_markov": "a slowly wandering bias",
    "supply_bias": "a bias that follows supply voltage or light power",
    "magnetic": "a bias that follows the magnetic field",
    "ageing_bias": "a bias that trends with time",
    "temperature_noise": "white noise that follows temperature",
    "light_power_noise": "white noise that follows light power",
    "vibration_noise": "noise that rises with vibration",
    "vibration_random_walk": "a random walk that rises with vibration",
    "ageing_noise": "white noise that trends with time",
    "shared_source": "noise that the axes share (one light source)",
    "spectral_line": "a steady line or resonance",
    "rotation_line": "lines locked to the tool's rotation",
    "logger_filter": "a filter in the logger",
    "aliased_vibration": "vibration folded down by sampling",
    "rate_quantization": "rounding of the output",
    "spikes": "bit errors or outliers",
    "held_samples": "samples that are repeated or filled with zeros",
    "clipping": "clipped extremes",
    "clock_error": "an error of the clock",
    "real_motion": "real rotation of the tool, not a sensor error",
}

#: What tells an effect from the others that look like it.
_NEXT = {
    "temperature_bias": "heat and cool once with a hold at each end: what follows temperature stays on the hold and returns later",
    "shupe": "hold the temperature after a ramp: what follows its rate of change dies away, and changes sign when the ramp is reversed",
    "thermal_gradient": "log a second temperature at the other end of the coil",
    "warm_up": "switch off and on again at a steady outer temperature: warming up repeats itself after every start",
    "thermal_hysteresis": "go round a closed temperature cycle twice: with hysteresis the two directions differ, and the loop repeats",
    "vibration_rectification": "repeat at twice the vibration: rectification grows fourfold, g-sensitivity twofold; "
    "then turn the tool over: g-sensitivity changes sign",
    "g_sensitivity": "turn the tool over, at rest: g-sensitivity changes sign with gravity, rectification does not",
    "scale_factor": "turn at two known rates in both directions: a scale-factor error is proportional to the rate",
    "misalignment": "turn about one axis at a time and look at the others",
    "earth_rate": "stop the rotation at four tool faces 90 degrees apart: earth rate follows the tool face",
    "dead_zone": "add a slow known rotation that carries the rate through zero",
    "feedback_reset": "log the phase of the feedback ramp, and repeat at another rotation rate: lines of the ramp move with it",
    "fringe_hop": "compare the size of the steps with the rate of one fringe of this coil",
    "bias_jump": "switch off and on several times without any other change, and compare the bias before and after",
    "telegraph": "record longer, for at least ten switches: two levels show in the histogram of the means",
    "gauss_markov": "record at rest for at least ten times the time over which the bias wanders",
    "supply_bias": "change the supply voltage in steps at a steady temperature",
    "magnetic": "turn a magnet, or the tool in the earth's field, and log a magnetometer",
    "ageing_bias": "reverse the temperature once: a trend with time goes on, what follows temperature returns",
    "temperature_noise": "return to the first temperature: noise that follows temperature returns too, ageing does not",
    "light_power_noise": "change the light power in steps at a steady temperature, and log it",
    "vibration_noise": "log an accelerometer at the full rate: its spectrum, and its coherence with the rate, tell noise from motion",
    "vibration_random_walk": "vibrate evenly for at least half an hour: a random walk goes on growing between the edges, a step does not",
    "ageing_noise": "repeat the record at the same temperature some days later",
    "shared_source": "log the light power of the source, or run the axes on separate sources",
    "spectral_line": "change the sampling rate: a folded line moves, a true one stays; change the rotation rate to see whether it follows",
    "rotation_line": "repeat at another rotation rate: what is locked to the tool moves with it",
    "logger_filter": "read the logger's settings, or log at a higher rate: a filter leaves the long averaging times as they are",
    "aliased_vibration": "log at a higher rate, or with an analogue filter: what is folded moves or goes",
    "rate_quantization": "log with one more bit, or in counts",
    "spikes": "log the raw words: bit errors change by powers of two counts",
    "held_samples": "log a counter with each sample",
    "clipping": "widen the range of the output",
    "clock_error": "log a second clock, or a known line such as the mains",
    "real_motion": "log accelerometers and a second gyro on the same block: both see real motion, a sensor error shows in one",
}


def plain_name(name: str) -> str:
    """What an effect is called in a sentence.

    Examples
    --------
    >>> plain_name("shupe"), plain_name("some_new_effect")
    ('a bias that follows the rate of change of temperature (Shupe effect)', 'some new effect')
    """
    if name in _NAMES:
        return _NAMES[name]
    return effects()[name].short if name in effects() else name.strip("~").replace("_", " ")


def axes_text(axes: Sequence[str]) -> str:
    """``"axis x"``, ``"axes x and y"``."""
    names = " and ".join(filter(None, [", ".join(axes[:-1]), axes[-1]])) if axes else ""
    return f"ax{'i' if len(axes) == 1 else 'e'}s {names}" if axes else "the record"


def chance(p_value: float) -> str:
    """A probability in words, never smaller than the null records can tell.

    Examples
    --------
    >>> chance(0.004), chance(1e-12)
    ('noise alone does that in 1 of 250 such records', 'noise alone does that in fewer than 1 of a million such records')
    """
    return f"noise alone does that in {chance_share(p_value)} such records"


def chance_share(p_value: float) -> str:
    """Give a probability as one in so many, never smaller than the null records can tell.

    Examples
    --------
    >>> chance_share(0.004), chance_share(0.03), chance_share(1e-12)
    ('1 of 250', '1 of 33', 'fewer than 1 of a million')
    """
    if p_value < _SURE:
        return "fewer than 1 of a million"
    number = 1.0 / p_value
    return f"1 of {number:.2g}" if number < 100 else f"1 of {_round(number)}"


def _round(number: float) -> str:
    size = 10.0 ** (math.floor(math.log10(number)) - 1)
    return f"{round(number / size) * size:,.0f}".replace(",", " ")


def clock(seconds: float) -> str:
    """Time since the start of the record, as hours, minutes and seconds.

    Examples
    --------
    >>> clock(83.0), clock(5400.0), clock(0.5)
    ('1:23', '1:30:00', '0:00.5')
    """
    whole, rest = divmod(round(seconds * 10), 10)
    minutes, second = divmod(int(whole), 60)
    hours, minute = divmod(minutes, 60)
    tail = f"{second:02d}" + (f".{int(rest)}" if rest and seconds < 60 else "")
    return f"{hours}:{minute:02d}:{tail}" if hours else f"{minute}:{tail}"


def motion_statement(axis: str, when: str, largest: float, followers: Sequence[str]) -> str:
    """Sentence for an axis that moves far above its noise [deg/h], with nothing in the record to say why.

    Examples
    --------
    >>> motion_statement("z", "from 1 min to 5 min after the start", 389.0, ["x"])[-95:]
    'xis x sees a share of it, so it is real rotation of the tool, whose true rate no channel tells.'
    """
    told = (
        f"The rate of axis {axis} moves far above its noise {when}, by {largest:.3g} deg/h at most"
    )
    if followers:
        sees = "sees a share" if len(followers) == 1 else "see shares"
        return f"{told}; {axes_text(followers)} {sees} of it, so it is real rotation of the tool, whose true rate no channel tells."
    near = " or ".join(plain_name(name) for name in ("real_motion", "scale_factor"))
    return f"{told}, and no channel says why; it may be {near}."


def span_text(begin: float, end: float, whole: float) -> str:
    """When something is there, for people: over the whole record, or from when to when since the start [s]."""
    if begin <= 0.02 * whole and end >= 0.98 * whole:
        return "over the whole record"
    return f"from {clock(begin)} to {clock(end)} after the start"


def length_text(seconds: float) -> str:
    """A length of time for people."""
    for size, name in ((DAY, "d"), (HOUR, "h"), (60.0, "min")):
        if seconds >= 2 * size:
            return f"{seconds / size:.3g} {name}"
    return f"{seconds:.3g} s" if seconds >= 0.1 else f"{seconds * 1e3:.3g} ms"


def mismatch_statement(region: Mapping[str, Any], whole: float) -> str:
    """One sentence on a place where recording and simulation differ.

    Parameters
    ----------
    region : mapping
        Fields of `gyrostab.diagnose.locate.mismatches.FIELDS`, with ``axes`` as a list.
    whole : float
        Length of the record [s].

    Examples
    --------
    >>> mismatch_statement({"view": "davar", "what": "avar", "axes": ["x"], "begin": 1500.0, "end": 1800.0, "tau_min_s": 0.01,
    ...                     "tau_max_s": 3.0, "ratio": 1.8, "sign": 1, "p_value": 0.0004, "estimate": 1.8, "frequency": np.nan}, 3600.0)
    'Axis x is noisier than simulated from 25:00 to 30:00 after the start, at averaging times of 10 ms to 3 s: its Allan variance is
     1.8 times the expected one (noise alone does that in 1 of 2 500 such records).'
    """
    axes, when = axes_text(region["axes"]), span_text(region["begin"], region["end"], whole)
    low, high = length_text(region["tau_min_s"]), length_text(region["tau_max_s"])
    taus = (
        f"averaging times of {low} to {high}"
        if region["tau_max_s"] > 1.01 * region["tau_min_s"]
        else f"an averaging time of {low}"
    )
    verb = "is" if len(region["axes"]) == 1 else "are"
    more = region.get("sign", 1) >= 0
    sure = chance(region["p_value"])
    begin = axes[0].upper() + axes[1:]
    one, estimate = len(region["axes"]) == 1, region.get("estimate", np.nan)
    if region["view"] == "davar" and str(region.get("what", "")).startswith("variance"):
        pace = length_text(float(str(region["what"]).split()[1]))
        size = f" by {100.0 * estimate:.2g} % (rms)" if np.isfinite(estimate) else ""
        return (
            f"The noise of {axes} goes up and down {when}, at {taus}: from one stretch of {pace} to another its power changes{size}, which "
            f"is {region['ratio']:.3g} times the scatter of steady noise ({sure})."
        )
    if region["view"] == "davar":
        what = "noisier" if more else "quieter"
        return (
            f"{begin} {verb} {what} than simulated {when}, at {taus}: {'its' if one else 'their'} Allan variance is "
            f"{region['ratio']:.3g} times the expected one ({sure})."
        )
    if region["view"] == "mean" and region.get("sign", 1) == 0:
        return f"The mean rate of {axes} wanders {when} by more than drift and noise allow, {abs(estimate):.3g} deg/h at most ({sure})."
    if region["view"] == "mean":
        size = f" by {abs(estimate):.3g} deg/h" if np.isfinite(estimate) else ""
        return f"The mean rate of {axes} is {'higher' if more else 'lower'}{size} {when} than drift and noise allow ({sure})."
    if region["view"] == "cross_axis" and region.get("what") == "slow":
        size = f" (correlation {estimate:.2g})"
        return f"{begin} wander together{size} {when}, at {taus}, which the random walks of independent gyros do not ({sure})."
    if region["view"] == "cross_axis":
        size = f" (coherency {estimate:.2g})" if np.isfinite(estimate) else ""
        return f"{begin} vary together{size} {when}, at {taus}, which independent gyros do not ({sure})."
    what = str(region.get("what", ""))
    if region["view"] == "spectrum" and what.startswith("order"):
        return (
            f"The rate of {axes} has a part of {estimate:.3g} deg/h that turns {what.removeprefix('order ')} times with every turn of the "
            f"tool {when} ({sure})."
        )
    if region["view"] == "spectrum" and what == "ramp phase":
        return f"The rate of {axes} has a part of {estimate:.3g} deg/h rms that follows the phase of the feedback ramp {when} ({sure})."
    if region["view"] == "spectrum" and what.startswith("drifting"):
        begins, ends = what.split()[1:]
        return f"The spectrum of {axes} has a line that moves {when}, from about {begins} Hz to about {ends} Hz ({sure})."
    if region["view"] == "spectrum":
        return (
            f"The spectrum of {axes} has a line at {region.get('frequency', np.nan):.5g} Hz {when}, {region['ratio']:.3g} times the level "
            f"of the noise ({sure})."
        )
    if region["view"] == "restart":
        return (
            f"The rate of {axes} does not begin where it ended when the power comes back ({sure})."
        )
    told = _MARKS.get(what, "an unusual distribution of its samples")
    return f"{begin} {'has' if one else 'have'} {told} {when} ({sure})."


def named_statement(
    statistic: str, effect: str, axes: Sequence[str], when: str, p_value: float
) -> str:
    """One sentence on what shows only when an effect says where to look.

    Examples
    --------
    >>> named_statement("mean", "shupe", ["y"], "over the whole record", 0.004)
    'The mean rate of axis y differs over the whole record, in no single place, but taken together as a bias that follows the
     rate of change of temperature (Shupe effect) would have it (noise alone does that in 1 of 250
     such records).'
    """
    what = _SHOWN.get(statistic, "The noise")
    return (
        f"{what} of {axes_text(axes)} differs {when}, in no single place, but taken together as {plain_name(effect)} would have it "
        f"({chance(p_value)})."
    )


_SHOWN = {
    "mean": "The mean rate",
    "cross_axis": "The covariance",
    "spectrum": "The spectrum",
    "distribution": "The distribution of the samples",
}

_MARKS = {
    "outliers": "samples that jump out",
    "repeats": "more repeated samples than noise makes",
    "extremes": "many samples at the same smallest or largest value",
    "zeros": "samples that are exactly zero",
    "kurtosis": "a distribution of samples that is not normal",
    "lattice": "values that stand on a coarse lattice",
}


def unsized_statement(effect: str, axes: Sequence[str]) -> str:
    """Say that the record shows an effect whose size it does not give.

    Examples
    --------
    >>> unsized_statement("real_motion", ["z"])
    'The record shows real rotation of the tool, not a sensor error, on axis z. It does not give a size.'
    """
    return f"The record shows {plain_name(effect)}, on {axes_text(axes)}. It does not give a size."


def without_chance(statement: str) -> str:
    """Return a statement on a mismatch without its closing words on chance, for lists that show the chance elsewhere.

    Examples
    --------
    >>> without_chance("Axis x is noisier than simulated (noise alone does that in 1 of 250 such records).")
    'Axis x is noisier than simulated.'
    """
    return _CHANCE_WORDS.sub("", statement)


def next_measurement(name: str, alternatives: Sequence[str]) -> str:
    """What to measure to tell an effect from those that the record cannot tell it from; empty when nothing is known.

    Examples
    --------
    >>> next_measurement("g_sensitivity", ["vibration_rectification"])
    'To tell them apart, turn the tool over, at rest: g-sensitivity changes sign with gravity, rectification does not.'
    """
    steps = list(dict.fromkeys(_NEXT[one] for one in (name, *alternatives[:2]) if one in _NEXT))
    if not steps:
        return ""
    if "vibration_rectification" in (name, *alternatives) and "g_sensitivity" in (
        name,
        *alternatives,
    ):
        steps = [_NEXT[name]]
    begin = "To tell them apart, " if alternatives else "To confirm it, "
    return begin + "; or ".join(steps[:2] if alternatives else steps[:1]) + "."


def effect_statement(
    said: str, *, alternatives: Sequence[str] = (), intervals: Sequence[str] = ()
) -> str:
    """What a named effect does and when, and what the record cannot tell it from.

    Parameters
    ----------
    said : str
        What `Effect.say` says, with its numbers.
    alternatives : sequence of str
        Names of the effects that look the same in this record.
    intervals : sequence of str
        When it acts, from `span_text`.

    Examples
    --------
    >>> effect_statement("The bias jumps on axis x.", alternatives=["telegraph"], intervals=["from 1:00 to 2:00 after the start"])
    'The bias jumps on axis x. It shows from 1:00 to 2:00 after the start. This record cannot tell it from a bias that
     switches between two levels.'
    """
    components = [said]
    if intervals:
        components.append(f"It shows {', and '.join(intervals)}.")
    if alternatives:
        components.append(
            f"This record cannot tell it from {', or '.join(plain_name(one) for one in alternatives)}."
        )
    return " ".join(components)


def summary(content: Mapping[str, Any]) -> str:
    """The verdict as one sentence for the head of a report."""
    axes = axes_text(content["recording"]["axes"])
    found, named, left = len(content["mismatches"]), content["effects"], content["unexplained"]
    if content["verdict"] == "no mismatch":
        level = 100.0 * content["false_alarm_level"]
        return f"On {axes} nothing differs from the simulation by more than noise does (chance of a false alarm: {level:g} %)."
    are, them = ("is", "it") if found == 1 else ("are", "them")
    places = (
        f"{found} place{'' if found == 1 else 's'} where the recording differs from the simulation"
    )
    if not named:
        return f"There {are} {places}; none of the known effects explains {them}."
    names, failed = _named_text(named), failed_checks(content["held_out"])
    but = (
        f" The named effects do not describe the record well: {'; '.join(failed)}."
        if failed
        else ""
    )
    if content["verdict"] == "unknown":
        return f"There {are} {places}. What was named does not explain {them}: {names}.{but}"
    if not left:
        return f"There {are} {places}. What explains {them}: {names}.{but}"
    rest = f"{len(left)} of them {'is' if len(left) == 1 else 'are'} not."
    return f"There {are} {places}. Part of {them} is explained: {names}. {rest}{but}"


def _named_text(named: Sequence[Mapping[str, Any]]) -> str:
    """List the named effects, each once for the axes that it acts on."""
    texts = [f"{plain_name(effect['name'])}, on {axes_text(effect['axes'])}" for effect in named]
    counts = {text: texts.count(text) for text in texts}
    return "; ".join(
        text if count == 1 else f"{text} ({count} times)" for text, count in counts.items()
    )
