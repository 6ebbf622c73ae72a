"""Compare ellipses of position from the terms of a log with those of simulated surveys.

    python benchmarks/survey_ellipses.py --output docs/how-to/survey-error-model.md \\
        --figure docs/figures/survey-ellipses.png

A gyro of known N, B and K is logged at rest, and `to_iscwsa` makes its terms from that log. welleng
propagates them along a well. The truth is the scatter of surveys with the noise of the same gyro:
each rate is simulated, each azimuth computed from the rates, and each position from the azimuths.
Needs welleng.
"""

from __future__ import annotations

import json
import math
import tempfile
import textwrap
import warnings
from pathlib import Path

import numpy as np
import welleng
from page import make_parser, renew, table

from gyrostab import davar, fit_noise, make_log, make_noise, to_iscwsa
from gyrostab.plot.style import COLOURS, INCH_MM, PAGE_MM, draws_figure, new_figure, save_png

NOISE = {"N": 0.003, "B": 0.006, "K": 0.004}
LATITUDE, EARTH_RATE = 60.0, 15.041
STATION_MIN, TRAVEL_MIN, CALIBRATION_MIN = 3, 2, 10
SPEED = 0.5  # m/s, of the continuous survey
LOG_HOURS, LOG_RATE = 96.0, 1 / 60


def make_well() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stations every 30 m: vertical to 600 m, built by 2 deg / 30 m to 60 deg, held to 3000 m."""
    depth = np.arange(0.0, 3001.0, 30.0)
    inclination = np.clip((depth - 600.0) / 30.0 * 2.0, 0.0, 60.0)
    return depth, inclination, np.full(depth.size, 60.0)


def simulate_rates(minutes: int, seed: int) -> np.ndarray:
    """Rates of three gyros, means of minutes [deg/h], relative to the calibration before them."""
    rates = np.stack(
        [
            make_noise(rate=1 / 60, size=minutes + CALIBRATION_MIN, seed=seed, axis=axis, **NOISE)
            for axis in "xyz"
        ]
    )
    bias = rates[:, :CALIBRATION_MIN].mean(axis=1, keepdims=True)
    return rates[:, CALIBRATION_MIN:] - bias


def compass(rates: np.ndarray, inclination: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    """Azimuth [rad] from rates x (high side), y, z that err by `rates` [deg/h]."""
    north = EARTH_RATE * math.cos(math.radians(LATITUDE))
    down = -EARTH_RATE * math.sin(math.radians(LATITUDE))
    sin, cos = np.sin(inclination), np.cos(inclination)
    x = north * cos * np.cos(azimuth) - down * sin + rates[0]
    y = -north * np.sin(azimuth) + rates[1]
    z = north * sin * np.cos(azimuth) + down * cos + rates[2]
    return np.arctan2(-y, x * cos + z * sin)


def survey_stations(seed: int) -> np.ndarray:
    """Azimuth errors of a stationary survey [rad]."""
    depth, inclination, azimuth = (np.array(part) for part in make_well())
    cycle = STATION_MIN + TRAVEL_MIN
    rates = simulate_rates(cycle * depth.size, seed).reshape(3, depth.size, cycle)
    angles = np.radians(inclination), np.radians(azimuth)
    return compass(rates[..., :STATION_MIN].mean(axis=-1), *angles) - angles[1]


def survey_continuously(seed: int) -> np.ndarray:
    """Azimuth errors of a continuous survey after its initialisation [rad]."""
    depth, inclination, _ = make_well()
    minutes = math.ceil(depth[-1] / SPEED / 60.0)
    rates = np.radians(simulate_rates(minutes, seed)) / 60.0  # rad in each minute
    angle = np.radians(np.interp((np.arange(minutes) + 0.5) * 60.0 * SPEED, depth, inclination))
    turned = np.cumsum(np.cos(angle) * rates[2] + np.sin(angle) * rates[0])
    return np.interp(depth / SPEED / 60.0, np.arange(minutes + 1), np.append(0.0, turned))


def find_positions(errors: np.ndarray) -> np.ndarray:
    """Shift north and east [m] at each station of wells whose azimuths err, to first order."""
    depth, inclination, azimuth = make_well()
    lateral = np.sin(np.radians(inclination)) * errors
    shift = np.zeros(errors.shape)
    shift[:, 1:] = np.cumsum((lateral[:, 1:] + lateral[:, :-1]) / 2.0 * np.diff(depth), axis=1)
    direction = np.radians(azimuth)
    return np.stack([-shift * np.sin(direction), shift * np.cos(direction)], axis=-1)


def read_owsg(name: str) -> dict:
    """Generic tool code of OWSG, as welleng ships it."""
    folder = Path(welleng.__file__).parent / "errors" / "iscwsa_json" / "owsg_a"
    return json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))


def is_gyro(code: str) -> bool:
    return code.startswith(("GXY", "GZ"))


def propagate(model: dict, endings: tuple[str, ...] = ()) -> np.ndarray:
    """Covariance of north and east [m2] at each station, of gyro terms with these endings."""
    depth, inclination, azimuth = make_well()
    header = welleng.survey.SurveyHeader(
        name="well", latitude=LATITUDE, longitude=2.0, b_total=50_000.0, dip=70.0, declination=0.0,
        convergence=0.0, G=9.80665, azi_reference="true",
    )  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        survey = welleng.survey.Survey(
            md=depth, inc=inclination, azi=azimuth, header=header, error_model=model
        )
    return sum(
        np.asarray(error.cov_NEV)[:, :2, :2]
        for code, error in survey.err.errors.errors.items()
        if not endings or (is_gyro(code) and code.endswith(endings))
    )


def export_model(seconds: tuple[float, float], **options: float) -> dict:
    """Terms for a section of `seconds` from a log of the gyro at rest."""
    size = round(LOG_HOURS * 3600 * LOG_RATE)
    rates = [make_noise(rate=LOG_RATE, size=size, seed=7, axis=axis, **NOISE) for axis in "xyz"]
    log = make_log(np.stack(rates), rate=LOG_RATE, unit="deg/h")
    product = fit_noise(davar(log, window=f"{LOG_HOURS}h", step=f"{LOG_HOURS}h"))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "tool.json")
        print(
            to_iscwsa(
                product,
                path,
                station_time=60.0 * STATION_MIN,
                calibration_time=60.0 * CALIBRATION_MIN,
                section_time=seconds,
                **options,
            )
        )
        return json.loads(path.read_text())


def lateral(covariance: np.ndarray) -> np.ndarray:
    """Standard deviation across the well [m]."""
    direction = math.radians(make_well()[2][0])
    across = np.array([-math.sin(direction), math.cos(direction)])
    return np.sqrt(np.einsum("i,kij,j->k", across, covariance, across))


def compare_mode(mode: str, surveys: int) -> tuple[dict, list[np.ndarray]]:
    """Model of the log, and deviations across the well of surveys, terms and generic terms [m]."""
    depth = make_well()[0]
    if mode == "stations":
        survey, rival, speed = survey_stations, "GYRO-NS", {}
        seconds = depth.size * (STATION_MIN + TRAVEL_MIN) * 60.0
        endings = ("RN", "B1", "B2", "ZB", "B1R", "B2R")
    else:
        survey, rival, speed = survey_continuously, "GYRO-NS-CT", {"running_speed": SPEED}
        seconds, endings = depth[-1] / SPEED, ("GD", "GRW")
    positions = find_positions(np.stack([survey(seed) for seed in range(surveys)]))
    truth = np.stack([np.cov(at, rowvar=False) for at in positions.transpose(1, 0, 2)])
    model = export_model(seconds, **speed)
    generic = propagate(read_owsg(rival), endings)
    return model, [lateral(part) for part in (truth, propagate(model, endings), generic)]


def draw_ellipse(ax, covariance: np.ndarray, centre: np.ndarray, scale: float, **style) -> None:  # type: ignore[no-untyped-def]
    """Ellipse of two standard deviations, enlarged."""
    values, vectors = np.linalg.eigh(covariance)
    turn = np.linspace(0.0, 2.0 * np.pi, 100)
    circle = np.stack([np.cos(turn), np.sin(turn)])
    north, east = 2.0 * scale * vectors @ (np.sqrt(np.maximum(values, 0.0))[:, None] * circle)
    ax.plot(east + centre[1], north + centre[0], **style)


@draws_figure
def draw(curves: dict[str, list[np.ndarray]], generic: np.ndarray, own: np.ndarray):  # type: ignore[no-untyped-def]
    """Plan of the well with ellipses, and the deviation across it over depth."""
    depth, inclination, azimuth = make_well()
    step = np.diff(depth, prepend=0.0) * np.sin(np.radians(inclination))
    path = np.cumsum(step)[:, None] * [
        np.cos(np.radians(azimuth[0])),
        np.sin(np.radians(azimuth[0])),
    ]
    figure = new_figure(PAGE_MM / INCH_MM, 78.0 / INCH_MM)
    plan, *panels = figure.subplots(1, 3, width_ratios=[1.5, 1.0, 1.0])
    plan.plot(path[:, 1], path[:, 0], color="0.4", lw=0.8)
    for k in (40, 60, 80, 100):
        last = k == 100
        draw_ellipse(plan, generic[k], path[k], 10.0, color=COLOURS[1], ls="--",
                     label="generic GYRO-NS" if last else None)  # fmt: skip
        draw_ellipse(plan, own[k], path[k], 10.0, color=COLOURS[0],
                     label="with the terms of this gyro" if last else None)  # fmt: skip
    plan.set(
        title="Ellipses (2σ, enlarged 10 times)",
        xlabel="east [m]",
        ylabel="north [m]",
        aspect="equal",
    )
    plan.set_ylim(-350.0, None)
    plan.legend(loc="lower right")
    for ax, (mode, (truth, terms, owsg)) in zip(panels, curves.items(), strict=True):
        ax.semilogy(depth[21:], owsg[21:], "--", color=COLOURS[1], label="generic OWSG")
        ax.semilogy(depth[21:], terms[21:], color=COLOURS[0], label="terms of the log")
        ax.semilogy(depth[24::6], truth[24::6], "o", ms=3, color="black", label="simulated surveys")
        ax.set(title=mode, xlabel="measured depth [m]")
        ax.set_ylabel("across the well, 1σ [m]" if ax is panels[0] else "")
        ax.legend(loc="lower right")
    return figure


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--surveys", type=int, default=1000)
    parser.add_argument("--figure", type=Path)
    options = parser.parse_args()
    depth, curves, models = make_well()[0], {}, {}
    for mode in ("stations", "continuous"):
        models[mode], curves[mode] = compare_mode(mode, options.surveys)
    tool = read_owsg("GYRO-NS")
    own, generic = (
        propagate({**tool, "terms": [*filter(is_kept, tool["terms"]), *terms]})
        for terms, is_kept in (
            (models["stations"]["terms"], lambda term: not is_gyro(term["name"])),
            ([], lambda term: not term["name"].startswith("GXY-G")),
        )
    )
    head = ["survey", "depth [m]", "simulated surveys", "terms of the log", "ratio", "generic OWSG"]
    rows = []
    for mode, values in curves.items():
        for k in (40, 60, 80, 100):
            truth, terms, owsg = (value[k] for value in values)
            ratio = f"{terms / truth:.2f}"
            rows.append(
                [mode, f"{depth[k]:.0f}", f"{truth:.3g}", f"{terms:.3g}", ratio, f"{owsg:.3g}"]
            )
    axes = [2.0 * np.sqrt(np.linalg.eigvalsh(part[-1])) for part in (own, generic)]
    (own_minor, own_major), (minor, major) = axes
    sentence = (
        "Semi-axes (2σ) of the horizontal ellipse of the tool code GYRO-NS at 3000 m, without its "
        f"g-dependent terms: {major:.0f} m and {minor:.0f} m as published, {own_major:.0f} m and "
        f"{own_minor:.0f} m with noise and bias of this gyro."
    )
    text = f"1σ across the well [m]:\n\n{table(head, rows)}\n\n{textwrap.fill(sentence, 120)}"
    print(text)
    renew(options.output, "ellipses", text)
    if options.figure:
        save_png(draw(curves, generic, own), options.figure)


if __name__ == "__main__":
    main()
