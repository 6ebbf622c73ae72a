"""A bias of two levels in the block means: evidence, visits, look-alikes, diagnosis."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from scipy.signal import lfilter

from gyrostab.diagnose.core import diagnose
from gyrostab.diagnose.evidence.sample_counts import CountEvidence
from gyrostab.diagnose.evidence.telegraph import (
    compare_visits,
    telegraph_courses,
    telegraph_evidence,
    visit_columns,
)
from gyrostab.diagnose.identify.identifiability import keep_physical
from gyrostab.diagnose.identify.identifications import Identifications
from gyrostab.diagnose.identify.naming_order import SearchRound
from gyrostab.diagnose.predict.candidates import Candidate, Component, Variant
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.settings import DEFAULTS
from gyrostab.diagnose.statistics import find_statistic
from gyrostab.diagnose.statistics.base import SizeFit
from gyrostab.ingest.make_log import make_log
from gyrostab.simulate import simulate
from tests.support.named import name_effects, nulls

BLOCKS, STEP, WHITE = 100, 20.0, 0.01
WALKS, FLICKERS = np.array([0.0, 0.1, 0.3, 1.0, 3.0, 10.0]), np.array([0.0, 0.05, 0.2])
# heights of events, and their places [blocks]
EQUAL = (1.0, 1.0, 1.0, 1.0)
UNEQUAL = (1.0, 0.5, 0.8, 0.3)
BEGINS, LENGTH = (8, 30, 50, 75), 10


def frame(mean: np.ndarray) -> tuple[xr.Dataset, xr.Dataset]:
    """Return means (record, block) as block statistics of one axis, and a baseline of free K, B."""
    begin = np.arange(mean.shape[1]) * STEP
    data = xr.Dataset(
        {
            "mean": (("record", "axis", "block"), mean[:, None]),
            "begin": ("block", begin),
            "end": ("block", begin + STEP),
            "restart_end": ("restart", np.empty(0)),
        },
        {"axis": ["x"]},
        {"block_s": STEP},
    )
    K, B = (values.ravel() for values in np.meshgrid(WALKS, FLICKERS, indexing="ij"))
    baseline = xr.Dataset(
        {
            "known_mean": (("axis", "block"), np.zeros((1, mean.shape[1]))),
            "mean_variance": (("axis", "block"), np.full((1, mean.shape[1]), WHITE)),
            "angle_variance": (("axis",), np.zeros(1)),
            **{
                f"grid_{name}": (("axis", "grid"), values[None])
                for name, values in (("K", K), ("B", B), ("prior", 0.0 * K))
            },
        },
        {"axis": ["x"]},
    )
    return data, baseline


def telegraph_share(
    rng: np.random.Generator, low: float, high: float, block_count: int = BLOCKS
) -> np.ndarray:
    """Return the share of each block on the upper level; times in seconds."""
    fine, t, level = np.zeros(block_count * 20), 0.0, int(rng.integers(2))
    while t < fine.size:
        stay = rng.exponential((low, high)[level])
        fine[int(t) : int(t + stay) + 1] = level
        t, level = t + stay, 1 - level
    return fine.reshape(block_count, 20).mean(axis=1)


def white(rng: np.random.Generator, records: int) -> np.ndarray:
    return np.sqrt(WHITE) * rng.standard_normal((records, BLOCKS))


def test_finds_switches_and_their_parameters() -> None:
    rng = np.random.default_rng(1)
    course = np.stack([telegraph_share(rng, 120.0, 240.0) for _ in range(20)])
    evidence_nats, telegraph = telegraph_evidence(*frame(0.6 * course + white(rng, 20)), axis="x")
    assert np.median(evidence_nats) > 20.0
    assert (evidence_nats > 5.0).mean() >= 0.9
    assert np.median(telegraph.step) == pytest.approx(0.6, rel=0.05)
    np.testing.assert_allclose(np.median(telegraph.times, axis=0) * STEP, [120.0, 240.0], rtol=0.3)
    assert (
        np.sqrt(np.mean((telegraph.share[evidence_nats > 5.0] - course[evidence_nats > 5.0]) ** 2))
        < 0.12
    )


def test_finds_switches_in_a_random_walk() -> None:
    rng = np.random.default_rng(2)
    walk = np.cumsum(0.07 * rng.standard_normal((20, BLOCKS)), axis=1)
    course = np.stack([telegraph_share(rng, 150.0, 150.0) for _ in range(20)])
    evidence_nats, telegraph = telegraph_evidence(
        *frame(1.5 * course + walk + white(rng, 20)), axis="x"
    )
    assert np.median(evidence_nats) > 10.0
    assert np.median(telegraph.step[evidence_nats > 10.0]) == pytest.approx(1.5, rel=0.1)


def test_evidence_is_a_lower_bound_of_a_bayes_factor() -> None:
    """Over records of the baseline's noise, the mean Bayes factor is one."""
    rng = np.random.default_rng(3)
    K = rng.choice(WALKS, 300) * np.sqrt(STEP / 3600.0)
    mean = white(rng, 300) + np.cumsum(K[:, None] * rng.standard_normal((300, BLOCKS)), axis=1)
    evidence_nats, _ = telegraph_evidence(*frame(mean), axis="x")
    assert np.isfinite(evidence_nats).mean() > 0.3
    assert np.exp(evidence_nats).mean() < 1.0
    assert evidence_nats.max() < 4.0


@pytest.mark.parametrize("size", [0.3, 1.0])
@pytest.mark.parametrize("time", [20.0, 60.0, 200.0])
def test_a_gauss_markov_bias_is_not_two_levels(time: float, size: float) -> None:
    rng = np.random.default_rng(4)
    keep = np.exp(-1.0 / time)
    fine = lfilter(
        [np.sqrt(1.0 - keep**2)], [1.0, -keep], rng.standard_normal((30, BLOCKS * 20 + 3000))
    )[:, -BLOCKS * 20 :]
    evidence_nats, _ = telegraph_evidence(
        *frame(size * fine.reshape(30, BLOCKS, 20).mean(axis=2) + white(rng, 30)), axis="x"
    )
    assert evidence_nats.max() < 3.0


def test_one_jump_and_its_return_are_not_two_levels() -> None:
    mean = np.zeros((1, BLOCKS)) + np.repeat([0.0, 2.0, 0.0], [30, 40, 30])
    evidence_nats, telegraph = telegraph_evidence(
        *frame(mean + white(np.random.default_rng(5), 1)), axis="x"
    )
    assert telegraph.switch_count[0] == pytest.approx(2.0, abs=0.2)
    assert telegraph.switch_count[0] < DEFAULTS.min_switches
    assert evidence_nats[0] == -np.inf


def test_given_columns_are_not_found_again_and_blocks_may_be_missing() -> None:
    rng = np.random.default_rng(6)
    course = telegraph_share(rng, 150.0, 150.0)
    ramp = np.linspace(0.0, 20.0, BLOCKS)
    data, baseline = frame((0.8 * course + ramp)[None] + white(rng, 1))
    data["mean"][:, :, 20:35] = np.nan
    with_ramp, telegraph = telegraph_evidence(data, baseline, axis="x", given=ramp[:, None])
    assert with_ramp[0] > 10.0
    assert telegraph.step[0] == pytest.approx(0.8, abs=0.1)
    with_course, _ = telegraph_evidence(
        data, baseline, axis="x", given=np.stack([ramp, course], axis=1)
    )
    assert with_course[0] < 1.0


def test_the_sign_of_the_bias_does_not_matter() -> None:
    rng = np.random.default_rng(7)
    values = (telegraph_share(rng, 100.0, 300.0) + white(rng, 1)[0])[:, None]
    variance, all_there, constant = (
        np.full(BLOCKS, WHITE),
        np.ones(BLOCKS, bool),
        np.ones((BLOCKS, 1)),
    )
    rising, falling = (
        telegraph_courses(sign * values, variance, all_there, constant) for sign in (1.0, -1.0)
    )
    np.testing.assert_allclose(rising.share, 1.0 - falling.share, atol=0.02)
    np.testing.assert_allclose(rising.times, falling.times[:, ::-1], rtol=0.02)
    np.testing.assert_allclose(rising.step, falling.step, rtol=0.01)


def component(
    state: State, course: np.ndarray, axis: str = "x", evidence_nats: float = 50.0
) -> Component:
    variant = Variant(
        {"low": 100.0, "high": 200.0, "switches": 18.0}, ("step",), course[None, None]
    )
    return Component(
        Candidate("telegraph", find_statistic("telegraph"), (), (variant,)),
        variant,
        (axis,),
        evidence_nats,
    )


def state_of(mean: np.ndarray) -> State:
    data, baseline = frame(mean[None])
    return State(
        data.isel(record=0), baseline, np.ones((1, BLOCKS, 1)), np.zeros((1, BLOCKS), np.bool_)
    )


def test_a_telegraph_of_three_levels_is_not_physical() -> None:
    rng = np.random.default_rng(8)
    first, second = telegraph_share(rng, 150.0, 150.0), telegraph_share(rng, 200.0, 200.0)
    two = state_of(first + white(rng, 1)[0])
    assert keep_physical([component(two, first)], two)[0]
    more = state_of(first + 0.8 * second + white(rng, 1)[0])
    assert not keep_physical([component(more, first)], more)[0]


def test_sizes_match_those_of_the_course() -> None:
    rng = np.random.default_rng(9)
    course = telegraph_share(rng, 100.0, 200.0)
    state = state_of(0.5 * course + white(rng, 1)[0])
    shown = component(state, course)
    sizes = shown.statistic.estimate(SizeFit([shown], ("x",), state, CountEvidence({})))
    value, error = sizes["step"]
    assert abs(value - 0.5) < 4.0 * error
    assert 0.015 < error < 0.06  # twice the error of a mean over all blocks
    assert sizes["low"] == (100.0, pytest.approx(100.0 / 3.0))
    assert sizes["high"] == (200.0, pytest.approx(200.0 / 3.0))


def led(course: np.ndarray, evidence_nats: float, axis: str = "x") -> Component:
    """A mean that follows the temperature."""
    variant = Variant({}, ("sensitivity",), course[None, None])
    return Component(
        Candidate("temperature_bias", find_statistic("mean"), ("temperature",), (variant,)),
        variant,
        (axis,),
        evidence_nats,
    )


def jump(place: int, evidence_nats: float) -> Component:
    variant = Variant(
        {"at": place * STEP}, ("step",), (np.arange(BLOCKS) >= place).astype(float)[None, None]
    )
    return Component(
        Candidate("bias_jump", find_statistic("mean"), (), (variant,)),
        variant,
        ("x",),
        evidence_nats,
    )


FOLLOWS, HOPS_FIRST = (
    ["temperature_bias(temperature)"],
    ["telegraph", "temperature_bias(temperature)"],
)


@pytest.mark.parametrize(
    ("kind", "evidence_nats", "axis", "expected"),
    [
        ("the same", 20.0, "x", FOLLOWS),  # a channel that switches, one block early
        ("another", 20.0, "x", HOPS_FIRST),
        ("another", 60.0, "x", FOLLOWS),  # more evidence comes first
        ("the same", 60.0, "y", HOPS_FIRST),
    ],
)
def test_an_effect_of_a_switching_channel_comes_first(
    kind: str, evidence_nats: float, axis: str, expected: list[str]
) -> None:
    rng = np.random.default_rng(10)
    course = telegraph_share(rng, 120.0, 180.0)
    state = state_of(0.6 * course + white(rng, 1)[0])
    channel = np.roll(course, 1) if kind == "the same" else np.sin(np.arange(BLOCKS) / 9.0)
    components = {
        "telegraph": [component(state, course)],
        FOLLOWS[0]: [led(channel, evidence_nats, axis)],
        "bias_jump": [jump(50, 20.0)],
    }
    search = SearchRound(None, state, components, {})
    assert search.drop_switching_with_a_cause(HOPS_FIRST) == expected
    without_channel = ["telegraph", "bias_jump"]
    assert search.drop_switching_with_a_cause(without_channel) == without_channel


@pytest.mark.parametrize(
    ("evidence_nats", "axis", "expected"),
    [(20.0, "x", ["telegraph"]), (60.0, "x", []), (60.0, "y", ["telegraph"])],
)
def test_switching_within_blocks_waits_for_an_effect_that_explains_more(
    evidence_nats: float, axis: str, expected: list[str]
) -> None:
    rng = np.random.default_rng(10)
    course = telegraph_share(rng, 120.0, 180.0)
    state = state_of(0.6 * course + white(rng, 1)[0])
    whole = component(state, course)
    within = replace(whole, variant=replace(whole.variant, inside=np.ones((BLOCKS, 16))))
    components = {
        "telegraph": [within],
        "~levels": [within],
        "bias_jump": [replace(jump(50, evidence_nats), row=(axis,))],
    }
    search = SearchRound(None, state, components, {})
    assert search.identify_switching(list(components)) == expected
    search = SearchRound(None, state, {"telegraph": [whole]}, {})
    assert search.identify_switching(["telegraph"]) == []


def switched(stays: Sequence[int], seed: int, *, step: float, scatter: float) -> Identifications:
    """Diagnose a telegraph with these mean times [blocks] and a supply that switches like it."""
    course = np.repeat(np.arange(len(stays)) % 2, stays).astype(float)
    rng = np.random.default_rng(seed)
    supply, noise = (
        24.0 + course + scatter * rng.standard_normal(course.size),
        rng.standard_normal(200 * course.size),
    )
    log = make_log(
        np.repeat(step * course, 200) + noise,
        rate=10.0,
        unit="deg/h",
        channels={"supply_voltage": (np.repeat(supply, 200), "V")},
    )
    blocks = reduce_log(log, block="20s")
    return name_effects(blocks, *nulls(blocks, 40))


@pytest.mark.slow
def test_search_names_a_switching_channel_before_a_telegraph() -> None:
    """Two levels have more evidence than a noisy supply, but the supply is the cause."""
    identifications = switched([45, 14, 3, 12, 3, 10, 3, 5], 1, step=0.6, scatter=0.3)
    assert [identification.effect for identification in identifications.identified] == [
        "supply_bias"
    ]


def bursts(heights: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return events of these heights by block, and whether there is one."""
    share, course = np.zeros((2, BLOCKS))
    for begin, height in zip(BEGINS, heights, strict=False):
        share[begin : begin + LENGTH] = 1.0
        course[begin : begin + LENGTH] = height
    return course, share


def nats(mean: np.ndarray, share: np.ndarray) -> float:
    _, baseline = frame(mean[None])
    return compare_visits(mean, baseline, share, axis="x", block_s=STEP).unequal_nats


def test_equal_and_unequal_visits_are_told_apart() -> None:
    rng = np.random.default_rng(1)
    for sign in (1.0, -1.0):
        equal, share = bursts(EQUAL)
        unequal, _ = bursts(UNEQUAL)
        noise = white(rng, 1)[0]
        assert nats(sign * equal + noise, share) < -3.0
        assert nats(sign * unequal + noise, share) > 10.0
        assert nats(sign * unequal + noise, 1.0 - share) > 10.0


def test_evidence_of_unequal_visits_is_a_bayes_factor() -> None:
    """Over records of equal visits, the mean Bayes factor of unequal ones is one at most."""
    rng = np.random.default_rng(2)
    course, share = bursts(EQUAL)
    gains = [nats(course + noise, share) for noise in white(rng, 200)]
    assert np.exp(gains).mean() < 1.2
    assert max(gains) < 5.0


def test_parts_of_blocks_belong_to_the_nearest_visit() -> None:
    share = np.array([0.0, 0.3, 1.0, 0.4, 0.4, 1.0, 0.2])
    columns = visit_columns(share)
    np.testing.assert_array_equal(columns.sum(axis=0), share)
    assert [np.flatnonzero(row).tolist() for row in columns] == [[1, 2, 3], [4, 5, 6]]
    assert visit_columns(np.full(5, 0.4)).shape == (0, 5)


def test_switches_within_blocks_are_counted_by_parts() -> None:
    share = np.tile([0.0, 0.0, 1.0, 1.0], (BLOCKS, 1))
    _, baseline = frame(np.zeros((1, BLOCKS)))
    comparison = compare_visits(np.zeros(BLOCKS), baseline, share, axis="x", block_s=STEP)
    assert comparison.switch_count == 2 * BLOCKS - 1
    assert np.isneginf(comparison.unequal_nats)


@pytest.mark.parametrize(
    ("heights", "named"), [(EQUAL, True), (UNEQUAL, False), (EQUAL[:2], False)]
)
def test_two_levels_are_named_only_if_the_bias_returns_to_them(
    heights: tuple[float, ...], named: bool
) -> None:
    """With four switches, or levels that differ, it may follow something not recorded."""
    course, share = bursts(heights)
    state = state_of(course + white(np.random.default_rng(3), 1)[0])
    shown = component(state, share)
    assert bool(keep_physical([shown], state)[0]) is named
    if not named:
        assert keep_physical([shown], state)[1][0] == "levels that differ"


def test_equal_visits_on_several_axes_count_once() -> None:
    """A single axis must show that the levels are equal; three weak ones do not add up to it."""
    rng = np.random.default_rng(4)
    share = bursts(EQUAL[:3])[1]
    state = state_of(0.18 * share + white(rng, 1)[0])
    shown = component(state, share)
    assert -3.0 < nats(state.blocks["mean"].values[0], share) < -1.0
    assert not keep_physical([shown] * 3, state)[0]


def test_the_course_of_a_telegraph_has_equal_visits() -> None:
    rng = np.random.default_rng(5)
    course = np.stack([telegraph_share(rng, 120.0, 160.0) for _ in range(20)])
    mean = 0.8 * course + white(rng, 20)
    _, telegraph = telegraph_evidence(*frame(mean), axis="x")
    assert (np.array([nats(*pair) for pair in zip(mean, telegraph.share, strict=True)]) < -3).all()


@pytest.fixture(scope="module")
def diagnosis():
    model = {
        "log": {"axes": ["x", "y"]},
        "noise": {"N": 0.003, "B": 0.002, "K": 0.01},
        "effect": [{"name": "telegraph", "axes": ["y"], "step": 0.4, "low": 120.0, "high": 90.0}],
    }
    return diagnose(simulate(model, duration="30min", rate=5.0, seed=11), nulls=100, seed=1)


@pytest.mark.slow
def test_diagnosis_names_the_telegraph_with_its_parameters(diagnosis) -> None:
    assert [(effect["name"], effect["axes"]) for effect in diagnosis.effects] == [
        ("telegraph", ["y"])
    ]
    numbers = diagnosis.effects[0]["parameters"]
    assert abs(numbers["step"]["value"] - 0.4) < 3.0 * numbers["step"]["stderr"]
    for name, true in (("low", 120.0), ("high", 90.0)):
        assert abs(numbers[name]["value"] - true) < 3.0 * numbers[name]["stderr"]
    assert diagnosis.effects[0]["alternatives"] == []
    assert diagnosis.content["held_out"]["log_likelihood_gain"] > 10.0


@pytest.mark.slow
def test_switching_is_in_the_model_but_not_in_its_noise(diagnosis) -> None:
    effect = next(effect for effect in diagnosis.model["effect"] if effect["name"] == "telegraph")
    assert float(np.atleast_1d(effect["step"])[0]) == pytest.approx(0.4, rel=0.15)
    assert diagnosis.model["noise"]["y"]["K"] < 0.3  # above 1 if the switches count as noise
    simulated = (
        simulate(diagnosis.model, duration="30min", rate=5.0, seed=12)["rate"]
        .coarsen(time=100)
        .mean()
        .std("time")
    )
    assert 0.1 < float(simulated.sel(axis="y")) < 0.3
    assert float(simulated.sel(axis="x")) < 0.08
