"""Salt for real recordings: an effect put into noise that no generator made, and three copies without it as controls."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.blindtest.generator.catalogue import CATALOGUE
from gyrostab.blindtest.generator.measured_noise import OwnNoise, own_noise
from gyrostab.blindtest.generator.record import channels_of, gap_columns, with_channels
from gyrostab.blindtest.generator.scenario import Effect, World, draw_world, to_samples
from gyrostab.blindtest.scenarios.case import truth_of
from gyrostab.blindtest.scoring.baseline_detectors import allan_variance, octaves
from gyrostab.errors import OptionError
from gyrostab.schema import check_log, signal_name
from gyrostab.time.grid import first_stamp

__all__ = ["counts_of", "inject_effect", "rough_noise"]

Array = NDArray[np.float64]

_TRIES = 60
_SAME, _WHOLE = 1e-9, 1e-3  # of the range, by which equal values may differ; of a step
_FEW = 0.2  # levels for each sample, beyond which there is no lattice


def rough_noise(record: Array, *, rate: float) -> dict[str, float]:
    """N and K of a real axis (time,) [deg/h], from its Allan variance near half a second and at the longest time: for sizes only.

    Examples
    --------
    >>> rough_noise(np.random.default_rng(0).normal(0, 1.8, 100_000), rate=100.0)["N"].__round__(4)
    0.003
    """
    factors = octaves(record.size)
    variance = allan_variance(record, factors)
    tau = np.array(factors) / rate
    white = float(np.nanmin((variance * tau)[tau <= max(1.0, tau[0])]))
    last = int(np.flatnonzero(np.isfinite(variance))[-1])
    left = max(0.0, float(variance[last]) - 1.5 * white / tau[last])
    return {
        "N": math.sqrt(white) / 60.0,
        "B": 0.0,
        "K": math.sqrt(3 * left / (tau[last] / 3600.0)),
        "Q": 0.0,
    }


def _world_of(log: xr.Dataset, record: Array, own: OwnNoise, rng: np.random.Generator) -> World:
    """The world of a real log: its own length, gaps, noise and temperature; what it does not tell is drawn."""
    rate = float(log.attrs["sampling_rate_hz"])
    world = draw_world(rng, rate=rate, seconds=record.shape[1] / rate, cuts=0)
    noise = [rough_noise(row, rate=rate) for row in record]
    noise += [noise[0]] * (3 - len(noise))
    gone = np.asarray(np.isnan(record).any(axis=0))
    world = replace(
        world,
        size=record.shape[1],
        start=first_stamp(log),
        noise=tuple(noise[:3]),
        missing=gone,
        own=own,
    )
    if "temperature" in log and np.isfinite(log["temperature"].values).mean() > 0.9:
        values = np.asarray(log["temperature"].values, dtype=float)
        at = np.linspace(0, values.size - 1, world.temperature.size)
        good = np.flatnonzero(np.isfinite(values))
        world = replace(world, temperature=np.interp(at, good, values[good]))
    return world


def _added(world: World, effect: Effect, rng: np.random.Generator) -> Array:
    """What an effect adds to noise that is there already (3, time): a share of noise cannot be taken out of a real record."""
    total = np.zeros((3, world.size))
    for part in (effect.mean, effect.extra):
        if part is not None:
            total += part
    sd = [60.0 * noise["N"] * math.sqrt(world.rate) for noise in world.noise]
    if effect.variance is not None:
        for i, ratio in enumerate(effect.variance):
            more = np.sqrt(to_samples(world, ratio / ratio.min()) - 1 + 1e-15)
            total[i] += more * sd[i] * rng.standard_normal(world.size) if np.ptp(ratio) else 0.0
    if effect.common is not None:
        total += effect.common * np.array(sd)[:, None]
    return total


def counts_of(values: Array) -> float:
    """Step of the lattice that values (time,) stand on, as a converter counts them; 0 where there is none.

    Examples
    --------
    >>> counts_of(np.random.default_rng(0).integers(-9, 9, 1000) * 0.25), counts_of(np.random.default_rng(0).normal(0, 1, 1000))
    (0.25, 0.0)
    """
    levels = np.unique(values[np.isfinite(values)])
    gaps = np.diff(levels)
    gaps = gaps[gaps > _SAME * max(float(np.ptp(levels)) if levels.size else 0.0, 1e-300)]
    if gaps.size == 0 or gaps.size > _FEW * values.size:
        return 0.0
    step = float(gaps.min())
    return step if np.abs(gaps / step - np.rint(gaps / step)).max() < _WHOLE else 0.0


def _as_counted(record: Array, added: Array, rng: np.random.Generator) -> Array:
    """Record and effect together (axis, time); counted as the record is, up or down by chance, so that the mean is that of the effect."""
    total = record + added
    for row, values in enumerate(record):
        step = counts_of(values)
        if step > 0.0:
            level = float(values[np.isfinite(values)][0])
            total[row] = level + step * np.floor(
                (total[row] - level) / step + rng.random(values.size)
            )
    return total


def inject_effect(
    log: xr.Dataset, effect: str, strength: float, rng: np.random.Generator
) -> dict[str, tuple[xr.Dataset, dict[str, Any]]]:
    """Put an effect into a real log, and make the controls.

    Parameters
    ----------
    log : xarray.Dataset
        A real log of rates.
    effect : str
        A name of the catalogue.
    strength : float
        Size in units of the closed-form limit, by the noise of the log itself as
        `gyrostab.blindtest.generator.measured_noise` measures it.
    rng : numpy.random.Generator

    Returns
    -------
    dict
        ``salted``, and without salt ``untouched``, ``flipped`` (the sign) and ``reversed`` (the
        time): log and truth each. All have the same channels.

    Raises
    ------
    OptionError
        When the effect is unknown, needs a restart that the log does not have, or axes that it does
        not have.

    Examples
    --------
    >>> from gyrostab.blindtest.scenarios.case import make_case
    >>> from gyrostab.blindtest.scenarios.plan import plan_case
    >>> null = {"names": [], "strengths": [], "kind": "null", "rate": 10.0, "seconds": 600, "severing": None}
    >>> log, _ = make_case(plan_case(0, seed=5) | null)
    >>> sorted(salt(log, "spectral_line", 4.0, np.random.default_rng(0)))
    ['flipped', 'reversed', 'salted', 'untouched']
    """
    check_log(log)
    if effect not in CATALOGUE:
        raise OptionError(f"no effect {effect!r} can be made; there are {', '.join(CATALOGUE)}")
    if signal_name(log) != "rate":
        raise OptionError("salt needs a log of rates; this one holds angles")
    record = np.asarray(log["rate"].values[:3], dtype=float)
    axes = [str(name) for name in log["axis"].values[:3]]
    world, made = _drawn(log, record, effect, strength, rng)
    salted = _as_counted(record, _added(world, made, rng)[: len(axes)], rng)
    if made.after is not None:
        padded = np.concatenate([salted, np.zeros((3 - len(axes), world.size))])
        salted = made.after(padded)[: len(axes)]
        salted[np.isnan(record)] = np.nan
    channels = {
        name: channel
        for name, channel in channels_of(world, [made], rng).items()
        if name not in log.variables
    }
    names = dict(zip("xyz", axes, strict=False))
    told = truth_of(world, [made], strengths=[strength])
    for one in told["effects"]:
        one["axes"] = [names[axis] for axis in one["axes"] if axis in names]
    bare = truth_of(world, [], strengths=[])
    copies = {
        "salted": salted,
        "untouched": record,
        "flipped": -record,
        "reversed": record[:, ::-1].copy(),
    }
    return {
        name: (
            _with(log, values, channels, world),
            (told if name == "salted" else bare)
            | {
                "plan": {"kind": "salted" if name == "salted" else "control", "copy": name},
                "buried": None,
            },
        )
        for name, values in copies.items()
    }


def _drawn(
    log: xr.Dataset, record: Array, effect: str, strength: float, rng: np.random.Generator
) -> tuple[World, Effect]:
    entry = CATALOGUE[effect]
    if entry.cuts:
        raise OptionError(
            f"{effect} follows restarts, and a real log has only its own; salt it with another effect"
        )
    present = set("xyz"[: record.shape[0]])
    own = own_noise(record, rate=float(log.attrs["sampling_rate_hz"]), axes=3)
    for _ in range(_TRIES):
        world = _world_of(log, record, own, rng)
        if entry.needs == "turning" and world.rotation.max() == 0:
            continue
        made = entry.make(world, rng, strength=strength)
        if set(made.axes) <= present or (len(made.axes) == 3 and made.after is not None):
            return world, made
    raise OptionError(
        f"{effect} needs more axes than the {record.shape[0]} of this log; salt it with another effect"
    )


def _with(
    log: xr.Dataset, record: Array, channels: dict[str, tuple[Array, float]], world: World
) -> xr.Dataset:
    gone = np.asarray(np.isnan(record).all(axis=0))
    out = log.isel(axis=slice(0, record.shape[0])).drop_dims("gap", errors="ignore")
    out = out.assign(
        rate=(("axis", "time"), record, dict(log["rate"].attrs)),
        **gap_columns(gone, start=world.start, rate=world.rate),
    )
    return with_channels(out, channels, start=world.start, rate=world.rate)
