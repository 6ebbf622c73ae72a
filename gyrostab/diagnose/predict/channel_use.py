"""Channels of a recording that no effect can use, with reasons."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping

import numpy as np
import xarray as xr

from gyrostab.diagnose.predict.windows import channel_units
from gyrostab.diagnose.reduce.aligned_channels import ROTATION_WAVE_PREFIXES
from gyrostab.physics.registry import effects
from gyrostab.wording import join_words

#: Least share of the blocks in which a channel must have values. Design choice.
MIN_BLOCK_SHARE = 0.5
#: The angle whose rate of change is the channel ``rotation_rate``.
TOOLFACE = "toolface"
#: Prefixes of channels that select the quiescent intervals.
CALIBRATION_CHANNELS = ("vibration", "temperature", "rotation_rate")


def missing_channel_reason(channels: Collection[str], blocks: xr.Dataset) -> str:
    """Explain why an effect can use none of its channels."""
    unused: Mapping[str, str] = blocks.attrs.get("unused_channels", {})
    bases = {channel.rstrip("0123456789").rstrip("_") for channel in channels}
    similar = [
        name
        for name in (*channel_units(blocks), *unused)
        if name in bases or name.startswith(tuple(f"{base}_" for base in bases))
    ]
    for name in dict.fromkeys((*channels, *similar)):
        if name in unused:
            return f"the channel {name} is not used: {unused[name]}"
        if problem := _describe_problem(name, blocks):
            return f"the channel {name} is not used: {problem}"
    if len(similar) < len(channels) and similar:
        return (
            f"it needs {len(channels)} channels such as {join_words(list(channels))}, and the "
            f"recording has only {join_words(similar)}"
        )
    return f"the recording has no channel {' or '.join(channels)}"


def unused_channels(blocks: xr.Dataset, used: Iterable[str]) -> list[dict[str, str]]:
    """List the channels that no candidate used in a diagnosis, each with ``name`` and ``reason``.

    The attribute ``unused_channels`` of the blocks has those left out before.
    """
    reasons = dict(blocks.attrs.get("unused_channels", {}))
    used_channels = set(used)
    for name in channel_units(blocks):
        if name in used_channels:
            continue
        problem = _describe_problem(name, blocks)
        if problem or not name.startswith(CALIBRATION_CHANNELS):
            reasons[name] = problem or _describe_unused(name, blocks)
    return [{"name": name, "reason": reason} for name, reason in reasons.items()]


def _describe_problem(name: str, blocks: xr.Dataset) -> str:
    """Describe what is wrong with the values or the unit of a channel; empty if nothing is."""
    variable = f"channel_{name}"
    if variable not in blocks:
        return ""
    values = blocks[variable].values
    share = float(np.isfinite(values).mean())
    if share < MIN_BLOCK_SHARE:
        return (
            f"it has values in {100 * share:.0f} % of the blocks, and "
            f"{100 * MIN_BLOCK_SHARE:.0f} % are needed"
        )
    unit, usable_units = str(blocks[variable].attrs.get("units", "")), _wanted_units(name)
    if usable_units and unit not in usable_units:
        return (
            f"its unit is {unit!r}, and effects need {' or '.join(map(repr, usable_units))}; "
            f"give it with --unit {name}=UNIT, or in Python convert the channel and set its "
            "attribute units"
        )
    if np.nanmax(values) == np.nanmin(values) and not _is_compared(name, blocks):
        return "it does not change"
    return ""


def _wanted_units(name: str) -> list[str]:
    """Return the units in which effects use a channel with this name or prefix."""
    units: dict[str, None] = {}
    for kind in effects().values():
        for channel, unit in kind.channels.items():
            base = channel.rstrip("0123456789").rstrip("_")
            if name in (channel, base):
                units[unit] = None
    return list(units)


def _is_compared(name: str, blocks: xr.Dataset) -> bool:
    """Return whether a channel is on the time grid of the gyro, so that spectra are comparable."""
    return "reference" in blocks.dims and name in blocks["reference"].values


def _describe_unused(name: str, blocks: xr.Dataset) -> str:
    """Explain why no effect uses a channel."""
    if name == TOOLFACE:
        return (
            "effects that vary with the toolface, such as earth rate, take it from the channel "
            "rotation_rate"
        )
    if _is_compared(name, blocks) or _wanted_units(name):
        return "no effect that this record can show follows it"
    if name.startswith(ROTATION_WAVE_PREFIXES):
        return (
            "no effect follows a channel of this name; "
            "lines at the rotation are found with the channel rotation_rate"
        )
    rate = float(blocks.attrs["sampling_rate_hz"])
    return (
        "no effect follows a channel of this name, and it is too slow to be compared with the gyro "
        f"sample by sample ({rate:.4g} Hz)"
    )
