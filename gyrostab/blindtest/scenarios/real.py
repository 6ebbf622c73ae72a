"""Plan the injections into real recordings, and read the recordings."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.blindtest.generator.scenario import stream
from gyrostab.blindtest.scenarios.injection import inject_effect
from gyrostab.errors import FormatError

#: The injected recording, and its controls.
COPIES = ("injected", "untouched", "flipped", "reversed")


@dataclass(frozen=True)
class _Recording:
    """How to read a recording, and the longest piece to take [s]."""

    file: str
    columns: dict[str, str]
    units: dict[str, str] = field(default_factory=dict)
    longest: float = 900.0
    rate: float | None = None  # given where the file has no times


RECORDINGS: dict[str, _Recording] = {
    "fog-blueseis": _Recording(
        "fog-blueseis-ramp/fog_ramp.csv.gz", {"rate_counts": "gyro_z"}, {"gyro": "1 nrad/s"}
    ),
    "laser-gyros": _Recording(
        "rlg-static-30min/lasergyro.csv.gz",
        {"gx_deg_per_h": "gyro_x", "gy_deg_per_h": "gyro_y", "gz_deg_per_h": "gyro_z"},
        {"gyro": "deg/h"},
    ),
    "mems-ch104": _Recording(
        "mems-static-53min/ch104.csv.gz",
        {"gx_dps": "gyro_x", "gy_dps": "gyro_y", "gz_dps": "gyro_z"},
        {"gyro": "deg/s"},
        1200.0,
        100.0,
    ),
    "ring-laser-g": _Recording(
        "ringlaser-g-3h/ringlaser_g_3h.nc",
        {"BJZ": "gyro_z"},
        {"gyro": "1.5825038e-13 rad/s"},
        2400.0,
    ),
}

#: Effects that can be added to existing noise on one axis, and on three.
_ONE_AXIS_EFFECTS = (
    "vibration_rectification",
    "shupe",
    "temperature_bias",
    "thermal_hysteresis",
    "vibration_noise",
    "aliased_vibration",
    "temperature_noise",
    "light_power_noise",
    "ageing_noise",
    "spectral_line",
    "supply_bias",
    "spikes",
)
_THREE_AXIS_EFFECTS = (*_ONE_AXIS_EFFECTS, "shared_source", "earth_rate", "scale_factor")

#: In fitted noise. There are few injections: half of them have the strength from which most should
#: be named.
_STRENGTHS = (3.0, 5.0, 5.0, 8.0)


def plan_injections(number: int, *, seed: int) -> list[dict[str, Any]]:
    """Plan `number` injections into real recordings, with four copies of each.

    Examples
    --------
    >>> [plan["copy"] for plan in plan_injections(1, seed=3)]
    ['injected', 'untouched', 'flipped', 'reversed']
    """
    out = []
    for index in range(number):
        rng = stream(seed, "injected", index)
        names = list(RECORDINGS)
        recording = names[(int(stream(seed, "injected").integers(len(names))) + index) % len(names)]
        effects = (
            _THREE_AXIS_EFFECTS
            if sum(name.startswith("gyro") for name in RECORDINGS[recording].columns.values()) == 3
            else _ONE_AXIS_EFFECTS
        )
        plan = {
            "index": index,
            "seed": seed,
            "recording": recording,
            "effect": str(rng.choice(effects)),
        }
        plan |= {"strength": float(rng.choice(_STRENGTHS)), "part": float(rng.random())}
        out += [
            plan | {"kind": "injected" if copy == "injected" else "control", "copy": copy}
            for copy in COPIES
        ]
    return out


def check_recordings(folder: Path) -> None:
    """Raise `FormatError` unless a folder has all real recordings."""
    for entry in RECORDINGS.values():
        if not (folder / entry.file).is_file():
            raise FormatError(
                f"{folder}: has no {entry.file}, which injections need; "
                "give the folder of the real recordings with --real DIR, or none"
            )


def _read_piece(recording: str, folder: Path, part: float) -> xr.Dataset:
    from gyrostab import read_log, regularise

    entry = RECORDINGS[recording]
    log = regularise(
        read_log(folder / entry.file, map=entry.columns, unit=entry.units, rate=entry.rate)
    )
    size = min(log.sizes["time"], round(entry.longest * float(log.attrs["sampling_rate_hz"])))
    first = round(part * (log.sizes["time"] - size))
    piece = log[["rate"]].isel(time=slice(first, first + size)).compute()
    # no attribute that identifies the recording
    piece.attrs = {name: log.attrs[name] for name in ("sampling_rate_hz", "kind")}
    return piece


def make_injection_case(plan: dict[str, Any], folder: Path) -> tuple[xr.Dataset, dict[str, Any]]:
    """Make one of the four logs of an injection into a recording of a folder, and its truth."""
    log = _read_piece(plan["recording"], folder, plan["part"])
    rng = np.random.default_rng(stream(plan["seed"], "injection", plan["index"]).integers(2**40))
    made, truth = inject_effect(log, plan["effect"], plan["strength"], rng)[plan["copy"]]
    return made, truth | {"plan": plan}
