"""Evidence of effects in block means of three axes, and where it goes.

    python benchmarks/evidence_of_means.py

Half an hour of block means in angle and rate random walk, with an effect on one or three axes.
First the evidence of noise alone, then for each effect and strength: what the blind test expects in
fitted noise (`learned_nats`), the median evidence on held-out intervals with the search of each
axis alone, and as the diagnosis computes it, and the share above 8 nats.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import xarray as xr
from page import make_parser, table

from gyrostab.arrays import Floats
from gyrostab.blindtest.generator.detection_limits import NATS, learned_nats
from gyrostab.diagnose.baseline.assemble import grid_values
from gyrostab.diagnose.baseline.posterior import visible_coefficients
from gyrostab.diagnose.evidence.folds import FOLDS
from gyrostab.diagnose.evidence.held_out import mean_factors
from gyrostab.diagnose.predict.candidates import Candidate, Variant
from gyrostab.diagnose.predict.search import collect_evidence, combine_rows
from gyrostab.diagnose.statistics import find_statistic
from gyrostab.units import HOUR

BLOCKS, BLOCK_S, RATE = 90, 20.0, 10.0
N, B, K = 0.003, 0.004, 0.02
AXES = 3
WHITE = N**2 * HOUR / BLOCK_S
STEP = K**2 / HOUR * BLOCK_S
EDGES = np.arange(BLOCKS + 1) * BLOCK_S
T = EDGES[:-1] + BLOCK_S / 2.0
SPAN = EDGES[-1]
SLOW = np.sin(np.pi * 1.3 * T / SPAN)
#: Effect -> its variants: a jump at any instant, a lag behind a channel, a time constant.
SHAPES = {
    "jump": [(EDGES[:-1] >= at).astype(float) for at in EDGES[1:-1]],
    "lag": [np.interp(T - lag, T, SLOW) for lag in (0.0, 30.0, 60.0, 120.0, 240.0, 480.0, 900.0)],
    "warm-up": [np.exp(-T / time) for time in (60.0, 120.0, 240.0, 480.0, 900.0)],
    "half wave": [np.sin(np.pi * T / SPAN)],
    "ramp": [T / SPAN],
}
DESIGNS = [shape for shapes in SHAPES.values() for shape in shapes]
OWNER = np.repeat(np.arange(len(SHAPES)), [len(shapes) for shapes in SHAPES.values()])
CANDIDATES = [
    Candidate(
        name,
        find_statistic("mean"),
        (),
        tuple(Variant({}, ("0",), shape[None]) for shape in shapes),
    )
    for name, shapes in SHAPES.items()
]


def make_baseline() -> xr.Dataset:
    """Make the noise grid of one axis."""
    least = visible_coefficients(N**2 * HOUR, SPAN)
    walk, flicker = (
        values.ravel()
        for values in np.meshgrid(
            grid_values("K", K, least[0]), grid_values("B", B, least[1]), indexing="ij"
        )
    )
    flat = np.zeros((1, walk.size))
    return xr.Dataset(
        {
            "known_mean": (("axis", "block"), np.zeros((1, BLOCKS))),
            "mean_variance": (("axis", "block"), np.full((1, BLOCKS), WHITE)),
            "grid_K": (("axis", "grid"), walk[None]),
            "grid_B": (("axis", "grid"), flicker[None]),
            "grid_prior": (("axis", "grid"), flat),
            "grid_calibrated": (("axis", "grid"), flat),
        },
        coords={"axis": ["x"]},
    )


def draw_noise(rng: np.random.Generator, records: int) -> Floats:
    """Draw block means (record, block) [degree hour-1]."""
    white, steps = rng.standard_normal((2, records, BLOCKS))
    return np.asarray(np.sqrt(WHITE) * white + np.sqrt(STEP) * steps.cumsum(axis=1))


def compute_evidence(axes: list[Floats], baseline: xr.Dataset) -> tuple[Floats, Floats]:
    """Return the evidence (candidate, record) of each axis alone on intervals, and as it is now."""
    coordinates = {"begin": ("block", EDGES[:-1]), "end": ("block", EDGES[1:]), "axis": ["x"]}
    factors = [
        mean_factors(
            xr.Dataset({"mean": (("record", "axis", "block"), means[:, None])}, coordinates),
            baseline,
            DESIGNS,
            axis="x",
        )[:, 1:]
        for means in axes
    ]
    results = collect_evidence(CANDIDATES, [(str(row),) for row in range(len(axes))], factors)
    numbers = range(len(SHAPES))
    separate = np.stack(
        [[intervals_alone(row[:, number == OWNER]) for number in numbers] for row in factors],
        axis=-1,
    )
    return combine_rows(separate), combine_rows(
        np.array([result.evidence_nats for result in results])
    )


def intervals_alone(factors: Floats) -> Floats:
    """Return the evidence on held-out intervals, all variants equally probable."""
    mixed = np.logaddexp.reduce(factors, axis=1) - np.log(factors.shape[1])
    parts = (mixed[:1] - mixed[1:]).reshape(-1, FOLDS, mixed.shape[1]).sum(axis=1)
    return np.asarray(parts.max(axis=0))


def size_at(shape: Floats, strength: float) -> float:
    """Return the size of a shape at a strength in units of the limit, with all noise known."""
    place = np.arange(1, BLOCKS + 1)
    precision = np.linalg.inv(np.eye(BLOCKS) * WHITE + np.minimum.outer(place, place) * STEP)
    level = precision.sum(axis=1)
    square = shape @ precision @ shape - (level @ shape) ** 2 / level.sum()
    return float(strength * np.sqrt(2.0 * NATS / square))


def expected_nats(mean: Floats) -> float:
    """Return `learned_nats` of a mean on one axis."""
    samples = np.repeat(mean, round(BLOCK_S * RATE))
    scenario: Any = SimpleNamespace(
        size=samples.size,
        rate=RATE,
        missing=np.zeros(samples.size, bool),
        noise=[{"N": N, "B": 0.0, "K": K}],
        measured=None,
    )
    return learned_nats(scenario, samples[None])


def main() -> None:
    """Print the quantiles of noise, and a row for each effect, strength and number of axes."""
    parser = make_parser(__doc__, has_page=False)
    parser.add_argument("--records", type=int, default=100)
    records = parser.parse_args().records
    rng, baseline = np.random.default_rng(5), make_baseline()
    none = compute_evidence([draw_noise(rng, records) for _ in range(AXES)], baseline)
    for name, evidence in zip(("alone", "now"), none, strict=True):
        quantiles = np.quantile(evidence.max(axis=0), (0.5, 0.9, 0.99)).round(1)
        print(f"noise, {name}: best of all effects at 50, 90, 99 %: {quantiles} nats")
    rows = []
    for number, (name, shapes) in enumerate(SHAPES.items()):
        shape = shapes[len(shapes) * 2 // 5]
        for count in (1, AXES):
            for strength in (3.0, 4.0, 6.0, 8.0):
                mean = size_at(shape, strength) / np.sqrt(count) * shape
                axes = [draw_noise(rng, records) + mean * (row < count) for row in range(AXES)]
                evidences = [evidence[number] for evidence in compute_evidence(axes, baseline)]
                medians = [f"{np.median(evidence):.1f}" for evidence in evidences]
                shares = [f"{(evidence > 8).mean():.2f}" for evidence in evidences]
                expected = f"{count * expected_nats(mean):.0f}"
                rows.append([name, count, f"{strength:g}", expected, *medians, *shares])
    head = ["effect", "axes", "strength", "expected", "alone", "now", "above 8, alone", "now"]
    print(table(head, rows))


if __name__ == "__main__":
    main()
