"""Draw unusual but well-formed inputs with hypothesis: logs, stamps, options, models."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from typing import Any

from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import seed as seeded
from hypothesis import strategies as st

from tests.fuzz.seeds import MODELS

STRUCTURED = ("odd logs", "odd options", "odd models")

#: Files, main file, options, command.
Parts = tuple[dict[str, bytes], str, tuple[str, ...], str]

NUMBERS = st.one_of(
    st.sampled_from(
        [
            "0",
            "-0",
            "1e-300",
            "1e300",
            "nan",
            "inf",
            "-1",
            "0.1",
            "1e9",
            "9223372036854775807",
            "9" * 5000,
            "1e-5",
            "",
            "1,5",
            "x",
        ]
    ),
    st.integers(-(2**70), 2**70).map(str),
    st.floats().map(repr),
)
RATES = st.one_of(NUMBERS, st.sampled_from(["10", "100", "1000", "1e6", "1e10", "10.0001"]))
TIMES = st.one_of(
    st.sampled_from(
        [
            "2026-03-01",
            "2026-03-01T12:00:00Z",
            "1970-01-01",
            "1677-09-21",
            "1677-09-22",
            "2262-04-11T23:47:16",
            "2262-04-12",
            "1500-01-01",
            "9999-12-31",
            "10000-01-01",
            "now",
            "0",
            "-1",
            "2026-13-01",
            "2026-03-01T24:00:01",
            "",
            "2026-03-01T00:00:00+99:99",
            "9" * 400,
        ]
    ),
    st.datetimes().map(lambda stamp: stamp.isoformat()),
    st.datetimes().map(
        lambda stamp: f"{stamp.day}.{stamp.month}.{stamp.year:04d} {stamp:%H:%M:%S.%f}"
    ),
    st.datetimes().map(
        lambda stamp: f"{stamp.month}/{stamp.day}/{stamp.year:04d} {stamp:%I:%M:%S %p}"
    ),
    st.text(max_size=8),
)
DURATIONS = st.one_of(
    st.sampled_from(
        [
            "1s",
            "4s",
            "0s",
            "-1s",
            "1e300s",
            "10D",
            "nan s",
            "2samples",
            "1e9samples",
            "60",
            "1ns",
            "1h",
        ]
    ),
    NUMBERS,
)
UNITS = st.one_of(
    st.sampled_from(
        [
            "deg/h",
            "deg/s",
            "rad/s",
            "arcsec",
            "degC",
            "",
            "1",
            "0 deg/h",
            "1e400 deg/h",
            "nan deg/h",
            "1e-320 deg/s",
            "us",
            "ms",
        ]
    ),
    st.text(max_size=6),
)
NAMES = st.one_of(
    st.sampled_from(
        [
            "time",
            "gyro_x",
            "gyro_y",
            "gyro_z",
            "angle_x",
            "temperature",
            "vibration",
            "accel_x",
            "ramp",
            "a b",
            "x",
            "gyro",
            "rate",
        ]
    ),
    st.text(max_size=8),
)


@st.composite
def stamp_lists(draw: Any) -> list[int]:
    """Draw the stamps of a log, with bursts, repeats, clock steps, gaps and reversals."""
    stamps, now = [], draw(st.sampled_from([0, 0, 1_767_225_600_000, -(10**6), 2**62]))
    for _ in range(draw(st.integers(1, 6))):
        step = draw(st.sampled_from([1, 1, 7, 10, 10, 100, 0, -1, -10, 1000, 10**6, 10**12]))
        group = draw(st.sampled_from([1, 1, 1, 2, 4, 5]))
        for index in range(draw(st.integers(1, 60))):
            if index % group == 0:
                now += step * group
            stamps.append(now)
        now += draw(st.sampled_from([0, 0, 0, 1, -5, 10**4, 10**7, 86_400_000, -(10**9)]))
    return stamps


@st.composite
def unusual_logs(draw: Any) -> Parts:
    stamps = draw(stamp_lists())
    unit = draw(st.sampled_from(["s", "ms", "us", "ns", "min", "d"]))
    values = draw(
        st.lists(st.one_of(st.integers(-50, 50).map(str), NUMBERS), min_size=1, max_size=8)
    )
    separator = draw(st.sampled_from([",", ";", "\t", " "]))
    rows = [
        f"{stamp}{separator}{values[index % len(values)]}" for index, stamp in enumerate(stamps)
    ]
    if draw(st.booleans()):
        lines = [f"time [{unit}]{separator}gyro_x [deg/h]", *rows]
        options = ()
    else:
        lines, options = (
            rows,
            (
                "--map",
                "0=time",
                "--map",
                "1=gyro_x",
                "--unit",
                f"time={unit}",
                "--unit",
                "gyro=deg/h",
            ),
        )
    if draw(st.booleans()):
        options += draw(
            st.sampled_from(
                [
                    ("--rate", "100"),
                    ("--rate", "1000"),
                    ("--max-gap", "1h"),
                    ("--epoch", "2026-03-01"),
                ]
            )
        )
    return (
        {"log.csv": "\n".join(lines).encode(errors="replace")},
        "log.csv",
        options,
        draw(st.sampled_from(["scan", "ingest", "run"])),
    )


@st.composite
def unusual_options(draw: Any) -> Parts:
    kind = draw(st.sampled_from(["stamped", "bare", "words"]))
    names = [draw(NAMES) for _ in range(draw(st.integers(1, 4)))]
    header = (
        ",".join(f"{name} [{draw(UNITS)}]" for name in names)
        if kind == "words"
        else "gyro_x [deg/h],temperature [degC]"
    )
    rows = [f"{index % 7},{20 + index / 100}" for index in range(60)]
    if kind != "bare":
        header, rows = (
            f"time [s],{header}",
            [f"{index / 10},{row}" for index, row in enumerate(rows)],
        )
    options: list[str] = []
    for option, values in (
        ("rate", RATES),
        ("start", TIMES),
        ("epoch", TIMES),
        ("max-gap", DURATIONS),
    ):
        if draw(st.integers(0, 2)) == 0:
            options.append(f"--{option}={draw(values)}")
    if draw(st.integers(0, 3)) == 0:
        options.append(f"--unit={draw(NAMES)}={draw(UNITS)}")
    if draw(st.integers(0, 3)) == 0:
        options.append(f"--map={draw(NAMES)}={draw(NAMES)}")
    command = draw(st.sampled_from(["scan", "ingest", "run"]))
    if command == "run" and draw(st.integers(0, 2)) == 0:
        options += [
            f"--{name}={draw(DURATIONS)}"
            for name in draw(
                st.sets(st.sampled_from(["tau-max", "fit-from", "fit-to"]), max_size=2)
            )
        ]
    return (
        {"log.csv": "\n".join([header, *rows]).encode(errors="replace")},
        "log.csv",
        tuple(options),
        command,
    )


@st.composite
def unusual_models(draw: Any) -> Parts:
    from gyrostab.physics.registry import effects

    values = st.one_of(
        st.floats().map(repr),
        st.integers(-(2**65), 2**65).map(str),
        st.sampled_from(
            [
                '"1 degC"',
                '"x"',
                "[]",
                "[1.0, 2.0]",
                "true",
                "{}",
                '"0.1 deg/h"',
                "1e-300",
                "1e300",
                "0",
                "0.5",
                "2",
                '"10s"',
            ]
        ),
    )
    text = draw(st.sampled_from(["", *MODELS]))
    text += f'\n[[effect]]\nname = "{draw(st.sampled_from(sorted(effects())))}"\n'
    parameters = st.sampled_from(
        [
            "sensitivity",
            "lag",
            "amplitude",
            "frequency",
            "rate",
            "step",
            "driver",
            "axes",
            "period",
            "width",
            "tau",
            "level",
            "x",
        ]
    )
    for name in sorted(draw(st.sets(parameters, max_size=4))):
        text += f"{name} = {draw(values)}\n"
    return (
        {"model.toml": text.encode(errors="replace")},
        "model.toml",
        ("--duration", "4s", "--rate", "10"),
        "simulate",
    )


STRATEGIES = {
    "odd logs": unusual_logs(),
    "odd options": unusual_options(),
    "odd models": unusual_models(),
}


def draw_inputs(form: str, seed: str, count: int) -> Iterator[Parts]:
    """Draw inputs of a kind, determined by the seed."""
    inputs: list[Parts] = []

    @seeded(seed)
    @settings(
        max_examples=count,
        phases=[Phase.generate],
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(STRATEGIES[form])
    def collect(parts: Parts) -> None:
        inputs.append(parts)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        collect()
    return iter(inputs[:count])
