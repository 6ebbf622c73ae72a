"""Write what a diagnosis says of the whole record: its verdict, its effects and the noise."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np

from gyrostab.diagnose.result.families import group_families
from gyrostab.diagnose.result.text import plain_name
from gyrostab.diagnose.result.verdict import doubtful_names, failed_checks
from gyrostab.diagnose.settings import Settings, stored_settings
from gyrostab.diagnose.statistics.mismatch_wording import axes_text
from gyrostab.wording import format_rounded, format_value, join_words


def summary(content: Mapping[str, Any]) -> str:
    """Write the verdict as the first sentences of a report."""
    if content["verdict"] == "no mismatch":
        axes = axes_text(content["recording"]["axes"])
        level = 100.0 * content["false_alarm_level"]
        return (
            f"On {axes} the recording agrees with the simulation within noise (false-alarm "
            f"probability: {level:g} %)."
        )
    count = len(content["mismatches"])
    places, them = ("1 place", "it") if count == 1 else (f"{count} places", "them")
    differs = f"The recording differs from the simulation in {places}"
    if not content["effects"]:
        return f"{differs}; none of the known effects explains {them}."
    names = _list_effects(content["effects"])
    failed = failed_checks(
        content["held_out"], settings=stored_settings(content.get("settings", {}))
    )
    doubt = f" The effects do not describe the record well: {'; '.join(failed)}." if failed else ""
    doubt += "".join(f" {text}" for text in _doubt_texts(content["effects"]))
    if content["verdict"] == "unknown":
        return f"{differs}. The effects that were found do not explain {them}: {names}.{doubt}"
    unexplained_count = len(content["unexplained"])
    if not unexplained_count:
        return f"{differs}. Explanation: {names}.{doubt}"
    remainder = "1 place is" if unexplained_count == 1 else f"{unexplained_count} places are"
    return f"{differs}. Partial explanation: {names}. {remainder} not explained.{doubt}"


def _doubt_texts(named: Sequence[Mapping[str, Any]]) -> list[str]:
    """Say what else a doubtful name may be, a sentence for each.

    Examples
    --------
    >>> bias = {"name": "temperature_bias", "alternatives": ["thermal_hysteresis"]}
    >>> _doubt_texts([bias | {"probability": 0.098}])
    ['It may instead be a bias with temperature hysteresis: the probability of a bias that follows
      temperature is only 10 %.']
    >>> _doubt_texts([{"name": "dead_zone", "alternatives": [], "probability": 0.0}])
    ['The probability that it is a dead zone near zero rate is only 0 %.']
    """
    texts = []
    for name in doubtful_names(named):
        effect = min(
            (effect for effect in named if doubtful_names([effect]) == [name]),
            key=lambda effect: effect["probability"],
        )
        share = f"{100 * effect['probability']:.0f} %"
        others = " or ".join(map(plain_name, effect["alternatives"]))
        texts.append(
            f"It may instead be {others}: the probability of {plain_name(name)} is only {share}."
            if others
            else f"The probability that it is {plain_name(name)} is only {share}."
        )
    return texts


def joined_statements(group: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the statements of one effect on several axes, with what they have in common once.

    Examples
    --------
    >>> tail = " It is active from 1:00 to 2:00 after the start."
    >>> joined_statements([
    ...     {"axes": [axis], "statement": f"The bias of 0.{size} deg/h is on axis {axis}.{tail}"}
    ...     for axis, size in (("x", 1), ("y", 1))])
    ['The bias of 0.1 deg/h is on axes x and y. It is active from 1:00 to 2:00 after the start.']
    >>> joined_statements([
    ...     {"axes": [axis], "statement": f"The bias of 0.{size} deg/h is on axis {axis}.{tail}"}
    ...     for axis, size in (("x", 1), ("y", 2))])
    ['The bias of 0.1 deg/h is on axis x.', 'The bias of 0.2 deg/h is on axis y.', 'It is active
      from 1:00 to 2:00 after the start.']
    """
    split = [re.split(r"(?<=\.) (?=[A-Z])", effect["statement"]) for effect in group]
    common = 0
    while common < min(map(len, split)) - 1 and len({row[-1 - common] for row in split}) == 1:
        common += 1
    heads = [" ".join(row[: len(row) - common]) for row in split]
    tail = " ".join(split[0][len(split[0]) - common :])
    places = [axes_text(effect["axes"]) for effect in group]
    if len({head.replace(place, "") for head, place in zip(heads, places, strict=True)}) == 1:
        together = axes_text(sorted({axis for effect in group for axis in effect["axes"]}))
        return [f"{heads[0].replace(places[0], together)} {tail}".rstrip()]
    return [*heads, tail] if tail else heads


def join_axes(groups: Iterable[Sequence[Mapping[str, Any]]]) -> list[list[Mapping[str, Any]]]:
    """Join the tables of one effect that was identified on several axes at once.

    Such tables have equal evidence, times and alternatives. A family of lines stays as it is.
    """
    keys = ("name", "driver", "intervals", "held_out_gain", "alternatives", "probability")
    joined: list[list[Mapping[str, Any]]] = []
    for group in groups:
        first = group[0]
        same = [
            others
            for others in joined
            if first.get("family") is None
            and others[0].get("family") is None
            and all(first.get(key) == others[0].get(key) for key in keys)
            and not set(first["axes"]) & {axis for other in others for axis in other["axes"]}
        ]
        if same:
            same[0].extend(group)
        else:
            joined.append(list(group))
    return joined


def delay_texts(content: Mapping[str, Any]) -> list[str]:
    """Say which channels were moved in time, a sentence for each.

    Examples
    --------
    >>> print(*delay_texts({"channel_delays": [{"name": "vibration", "delay_s": 103.0}]}))
    The time stamps of channel vibration are 103 s late; the diagnosis uses the channel that much
    earlier.
    """
    return [
        f"The time stamps of channel {channel['name']} are {abs(channel['delay_s']):g} s "
        + (
            "late; the diagnosis uses the channel that much earlier."
            if channel["delay_s"] > 0.0
            else "early; the diagnosis uses the channel that much later."
        )
        for channel in content.get("channel_delays", [])
    ]


def noise_texts(content: Mapping[str, Any]) -> list[str]:
    r"""Say which noise was calibrated on each axis, and where the axes differ.

    Empty for a simulation that was not calibrated on the record.

    Examples
    --------
    >>> def term(value, stderr, unit):
    ...     return {"value": value, "stderr": stderr, "unit": unit}
    >>> noise = {axis: {"N": term(0.05, 0.001, "deg/sqrt(h)"), "B": term(B, 0.02, "deg/h"),
    ...                 "K": term(0.4, 0.2, "deg/h^1.5")}
    ...          for axis, B in (("x", 0.7), ("y", 0.1), ("z", 0.09))}
    >>> hour = ["2026-03-01T00:00:00.000Z", "2026-03-01T01:00:00.000Z"]
    >>> print(*noise_texts({
    ...     "recording": {"start": hour[0], "end": "2026-03-01T02:00:00.000Z"},
    ...     "baseline": {"source": "calibrated", "noise": noise, "calibrated_on": [hour]}})[:-1],
    ...     sep="\n")
    noise calibrated on 50 % of the record:
      x: N 0.05 ± 0.001 deg/sqrt(h), B 0.7 ± 0.02 deg/h, K 0.4 ± 0.2 deg/h^1.5
      y: N 0.05 ± 0.001 deg/sqrt(h), B 0.1 ± 0.02 deg/h, K 0.4 ± 0.2 deg/h^1.5
      z: N 0.05 ± 0.001 deg/sqrt(h), B 0.09 ± 0.02 deg/h, K 0.4 ± 0.2 deg/h^1.5
    """
    baseline, recording = content["baseline"], content["recording"]
    if baseline["source"] != "calibrated" or not baseline["calibrated_on"]:
        return []
    record_s = span_seconds(recording["start"], recording["end"])
    quiet_s = sum(span_seconds(*span) for span in baseline["calibrated_on"])
    lines = [f"noise calibrated on {100 * min(quiet_s / record_s, 1.0):.0f} % of the record:"]
    for axis, terms in baseline["noise"].items():
        texts = [
            f"{symbol} {format_value(entry['value'], entry['stderr'])}"
            + (f" ± {entry['stderr']:.2g}" if entry["stderr"] else "")
            + f" {entry['unit']}"
            for symbol, entry in ((symbol, terms[symbol]) for symbol in "NBK" if symbol in terms)
        ]
        lines.append(f"  {axis}: {', '.join(texts)}")
    settings = stored_settings(content.get("settings", {}))
    return lines + [f"  {text}" for text in _unequal_noise_texts(baseline["noise"], settings)]


def span_seconds(start: str, end: str) -> float:
    """Return the length of a stretch between two ISO times [s]."""
    begin, stop = (np.datetime64(text.removesuffix("Z")) for text in (start, end))
    return float((stop - begin) / np.timedelta64(1, "s"))


def _unequal_noise_texts(noise: Mapping[str, Any], settings: Settings) -> list[str]:
    """Name the axes whose B or K exceeds that of every other, beyond the errors of both.

    The larger part of it is on no other axis.
    """
    texts = []
    for symbol, axis in product("BK", noise):
        entry = noise[axis].get(symbol)
        others = [noise[other].get(symbol) for other in noise if other != axis]
        if not others or not all(other and other["stderr"] for other in (entry, *others)):
            continue
        largest = max(other["value"] for other in others)
        if largest > settings.majority_share * entry["value"] or any(
            entry["value"] - other["value"]
            <= settings.clear_sigma * math.hypot(entry["stderr"], other["stderr"])
            for other in others
        ):
            continue
        names = join_words([other for other in noise if other != axis])
        texts.append(
            f"{symbol} of {axis} is at least {format_rounded(entry['value'] / largest)} times that "
            f"of {names}: a wandering bias on {axis} may have been calibrated as noise."
        )
    return texts


def _list_effects(named: Sequence[Mapping[str, Any]]) -> str:
    """List the effects, each once for the axes that it acts on, and each family once.

    Examples
    --------
    >>> _list_effects([{"name": "warm_up", "axes": [axis], "family": None} for axis in "xy"])
    'warm-up after power-on, on axes x and y'
    """
    axes_by_name: dict[tuple[str, str], list[Sequence[str]]] = {}
    for effect, *others in group_families(named):
        lines = f" ({effect['family']}, {len(others) + 1} lines)" if others else ""
        axes_by_name.setdefault((plain_name(effect["name"]), lines), []).append(effect["axes"])
    texts = []
    for (name, lines), axes in axes_by_name.items():
        together = [axis for effect_axes in axes for axis in effect_axes]
        if len(set(together)) == len(together):
            texts.append(f"{name}, on {axes_text(sorted(together))}{lines}")
            continue
        for where, count in Counter(map(axes_text, axes)).items():
            texts.append(f"{name}, on {where}{lines}" + f" ({count} times)" * (count > 1))
    return "; ".join(texts)
