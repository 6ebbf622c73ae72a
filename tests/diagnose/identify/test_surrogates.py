"""Time-shifted surrogates of a channel, which an effect must exceed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter

from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.baseline.from_model import baseline_from_model
from gyrostab.diagnose.identify import identifiability
from gyrostab.diagnose.identify.identifiability import passes_time_shift_test
from gyrostab.diagnose.predict.candidates import Candidate, Component
from gyrostab.diagnose.predict.linear_model import initial_state
from gyrostab.diagnose.predict.search import compute_evidence
from gyrostab.diagnose.predict.windows import rebuild_variant
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.settings import DEFAULTS, Settings
from gyrostab.diagnose.statistics.build_candidates import effect_candidates
from gyrostab.ingest.make_log import make_log
from gyrostab.simulate import simulate
from tests.support.candidates import find_components, select_candidate
from tests.support.noise_records import flicker, mixture


def _run_time_shift_test(
    sensitivity: float, period: float, settings: Settings = DEFAULTS
) -> tuple[bool, float, float]:
    """Test a bias that follows a temperature with this period [s]."""
    swing = [
        [t, 40.0 + 20.0 * np.sin(2.0 * np.pi * t / period)]
        for t in np.arange(0.0, 1801.0, 15.0).tolist()
    ]
    model = {
        "log": {"axes": ["x"]},
        "noise": {"N": 0.003, "B": 0.004, "K": 0.02},
        "effect": [{"name": "temperature_bias", "sensitivity": sensitivity}],
        "environment": [
            {
                "profile": "ramps",
                "channel": "temperature",
                "unit": "degree_Celsius",
                "points": swing,
            }
        ],
    }
    blocks = reduce_log(simulate(model, duration="30min", rate=10.0, seed=5).compute())
    baseline = calibrate_noise(blocks)
    known, _ = effect_candidates(blocks, baseline["coefficient"])
    candidate = select_candidate(known, "temperature_bias", "mean")
    variant = next(variant for variant in candidate.variants if variant.columns == ("sensitivity",))
    return passes_time_shift_test(
        [Component(candidate, variant, ("x",), 50.0)],
        initial_state(blocks, baseline, settings=settings),
    )


def test_periodic_channel_is_not_rejected_for_its_mirror_image():
    """Half a period later it is the same channel with the other sign, which a negative size follows
    as well."""
    beats, p_value, _ = _run_time_shift_test(0.02, 600.0)
    assert beats
    assert p_value < 0.05  # one in 45: copies do not count


def test_unrelated_channel_fails():
    beats, p_value, _ = _run_time_shift_test(0.0, 1300.0)
    assert not beats
    assert p_value > 0.05


def test_a_channel_with_too_few_surrogates_is_not_tested():
    """A share of 0.5 % needs 200; the 90 blocks of the record give 89."""
    settings = Settings(surrogate_share=0.005)
    assert settings.min_surrogates == 200
    beats, p_value, _ = _run_time_shift_test(0.0, 1300.0, settings)
    assert beats
    assert np.isnan(p_value)


@pytest.mark.full
def test_an_unrelated_channel_is_no_better_than_its_surrogates(monkeypatch):
    """An unrelated channel explains as much as half of its surrogates, whatever time constants are
    tried."""
    monkeypatch.setattr(identifiability, "TIME_SHIFTS", 60)
    model = {"noise": {"N": 0.003, "B": 0.004, "K": 0.02}, "log": {"axes": ["x"]}}

    def p_value(seed: int) -> float:
        rng = np.random.default_rng(seed)

        def wander() -> np.ndarray:
            course = np.convolve(rng.standard_normal(9599), np.hanning(600), "valid")
            return (course - course.mean()) / course.std()

        rate = 0.4 * rng.standard_normal(9000) + 0.05 * wander()
        channels = {"temperature": (40.0 + 5.0 * wander(), "degC")}
        blocks = reduce_log(make_log(rate, rate=5.0, unit="deg/h", channels=channels, axis=["x"]))
        state = initial_state(blocks, baseline_from_model(blocks, model))
        known, _ = effect_candidates(blocks, state.baseline["coefficient"])
        shupe = select_candidate(known, "shupe", "mean")
        components = find_components([shupe], state)[shupe.key]
        return passes_time_shift_test(components, state)[1]

    assert np.mean([p_value(seed) for seed in range(4, 9)]) > 0.4


RATE, BLOCKS, SAMPLES = 5.0, 90, 100  # Hz, blocks of 20 s, samples of each
NOISE = {"N": 0.003, "B": 0.004, "K": 0.02}
FAST, FULL = 40, 300  # records


def draw_channel(kind: str, rng: np.random.Generator) -> np.ndarray:
    """Draw a course of unit scale for each sample: what a sensor unrelated to the rate shows."""
    n = BLOCKS * SAMPLES
    if kind == "vibration that is on and off":
        switches = np.sort(rng.uniform(0, n, rng.integers(3, 9)))
        return np.searchsorted(switches, np.arange(n)) % 2 - 0.5
    if kind == "random walk":
        course = np.cumsum(rng.standard_normal(n))
    elif kind == "first-order process":
        course = lfilter([1.0], [1.0, -np.exp(-1.0 / (RATE * 60.0))], rng.standard_normal(2 * n))
    else:
        course = gaussian_filter1d(rng.standard_normal(3 * n), RATE * 120.0)[n:-n]
    course = course[-n:]
    return (course - course.mean()) / course.std()


class Records:
    """Block statistics with one channel, drawn without reducing a log for each record."""

    def __init__(self, effect: str, statistic: str, noise: dict[str, float]) -> None:
        self.channel = "vibration" if effect.startswith("vibration") else "temperature"
        self.effect, self.statistic, self.noise = effect, statistic, noise
        unit, course = ("g", 1.0) if self.channel == "vibration" else ("degC", 20.0)
        course = course + 0.1 * np.arange(BLOCKS * SAMPLES) / RATE / 1800.0
        self.blocks = reduce_log(
            make_log(
                np.random.default_rng(1).standard_normal(BLOCKS * SAMPLES),
                rate=RATE, unit="deg/h", channels={self.channel: (course, unit)}, axis=["x"],
            ),
            block="20s",
        )  # fmt: skip
        model = {"noise": noise, "log": {"axes": ["x"]}}
        self.baseline = baseline_from_model(self.blocks, model)
        known, _ = effect_candidates(self.blocks, self.baseline["coefficient"])
        self.candidate = select_candidate(known, effect, statistic)

    def p_value(self, kind: str, seed: int, strength: float = 0.0) -> float:
        """Draw a channel and noise, with an effect of a strength in detection limits; test it."""
        rng = np.random.default_rng([seed, len(kind)])
        course = 1.5 + draw_channel(kind, rng) if self.channel == "vibration" else None
        course = 40.0 + 5.0 * draw_channel(kind, rng) if course is None else np.abs(course)
        blocks = self.blocks.copy()
        for name, parts in ((f"channel_{self.channel}", 1), (f"fine_{self.channel}", 4)):
            if name in blocks:
                shape = blocks[name].shape
                blocks[name] = blocks[name].copy(
                    data=course.reshape(BLOCKS, parts, -1).mean(axis=-1).reshape(shape)
                )
        rebuilt = (
            rebuild_variant(self.candidate, variant, initial_state(blocks, self.baseline))
            for variant in self.candidate.variants
        )
        candidate = replace(self.candidate, variants=tuple(filter(None, rebuilt)))
        blocks["mean"] = blocks["mean"].copy(data=self.draw_means(candidate, strength, rng))
        blocks["power"] = blocks["power"].copy(data=self.draw_powers(candidate, strength, rng))
        state = initial_state(blocks, self.baseline)
        (evidence,) = compute_evidence([candidate], blocks, state)
        component = Component(candidate, evidence.best[0], ("x",), 0.0)
        return passes_time_shift_test([component], state)[1]

    def draw_means(
        self, candidate: Candidate, strength: float, rng: np.random.Generator
    ) -> np.ndarray:
        """Draw block means; at one detection limit the likelihood with known noise is 5.7 nats."""
        noise = {name: size for name, size in self.noise.items() if name != "B"}
        means = mixture(rng, 1, BLOCKS, rate=0.05, **noise)
        means += flicker(rng, 1, BLOCKS, B=self.noise.get("B", 0.0))
        if not strength or self.statistic != "mean":
            return means
        course = candidate.variants[0].design[0, 0]
        white = self.noise["N"] ** 2 * 180.0  # blocks per hour; [deg2/h2]
        walk = self.noise.get("K", 0.0) ** 2 / 180.0
        place = np.arange(BLOCKS)
        covariance = white * np.eye(BLOCKS) + walk * np.minimum.outer(place, place) + 100.0
        information = course @ np.linalg.solve(covariance, course)
        return means + strength * np.sqrt(2.0 * 5.7 / information) * course

    def draw_powers(
        self, candidate: Candidate, strength: float, rng: np.random.Generator
    ) -> np.ndarray:
        """Draw band powers; at one detection limit the likelihood is 5.7 nats."""
        expected, shape = (self.baseline[name].values for name in ("spectrum", "shape_alone"))
        powers = expected * rng.gamma(shape) / shape
        if not strength or self.statistic != "power":
            return powers
        change = candidate.variants[0].design[0] / expected
        moved = change - change.mean(axis=1, keepdims=True)
        size = strength * np.sqrt(2.0 * 5.7 / (shape * moved**2).sum())
        return powers * (1.0 + size * change)


CASES = [
    ("temperature_bias", "mean", "smooth", NOISE),
    ("temperature_bias", "mean", "smooth", {"N": 0.003}),
    ("temperature_bias", "mean", "random walk", {"N": 0.003, "K": 0.04}),
    ("temperature_bias", "mean", "first-order process", {"N": 0.003, "B": 0.02}),
    ("vibration_rectification", "mean", "vibration that is on and off", NOISE),
    ("vibration_noise", "power", "vibration that is on and off", NOISE),
    ("vibration_noise", "power", "smooth", NOISE),
]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "count"),
    [(CASES[0], FAST), *(pytest.param(case, FULL, marks=pytest.mark.full) for case in CASES)],
)
def test_p_values_of_unrelated_channels_hold_their_level(
    case: tuple[str, str, str, dict[str, float]], count: int
) -> None:
    """At most five in a hundred are 0.05 or less, within three binomial errors."""
    effect, statistic, kind, noise = case
    records = Records(effect, statistic, noise)
    p_values = np.array([records.p_value(kind, seed) for seed in range(count)])
    assert np.isfinite(p_values).mean() > 0.9
    for level in (0.05, 0.2, 0.5):
        allowed = level + 3.0 * np.sqrt(level * (1.0 - level) / count)
        assert np.mean(p_values <= level) <= allowed


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effect", "statistic", "kind"),
    [
        ("temperature_bias", "mean", "smooth"),
        ("temperature_bias", "mean", "random walk"),
        ("vibration_noise", "power", "vibration that is on and off"),
    ],
)
def test_effects_of_five_detection_limits_pass(effect: str, statistic: str, kind: str) -> None:
    records = Records(effect, statistic, NOISE)
    p_values = [records.p_value(kind, seed, strength=5.0) for seed in range(4)]
    assert max(p_values) <= Settings().surrogate_share
