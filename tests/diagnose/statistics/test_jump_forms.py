"""A jump is sudden, may come several times, and is not a gradual change."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.baseline.from_model import baseline_from_model
from gyrostab.diagnose.core import diagnose
from gyrostab.diagnose.estimate.joint_fit import fit_identifications
from gyrostab.diagnose.evidence.sample_counts import CountEvidence
from gyrostab.diagnose.identify.components import sum_evidence
from gyrostab.diagnose.identify.identifiability import find_equivalent_effects, keep_physical
from gyrostab.diagnose.predict.candidates import Candidate, Component
from gyrostab.diagnose.predict.linear_model import State, initial_state
from gyrostab.diagnose.predict.sizes import component_mixture, mean_mixture
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.result.tables import effect_tables
from gyrostab.diagnose.statistics.base import SizeFit
from gyrostab.diagnose.statistics.build_candidates import effect_candidates
from gyrostab.diagnose.statistics.jump_forms import is_free_jump, restart_competitors
from gyrostab.ingest.make_log import make_log
from gyrostab.simulate import simulate
from tests.support.candidates import find_components, winning_forms
from tests.support.named import name_effects, nulls
from tests.support.repetitions import first_of

MODEL = {"noise": {"N": 0.003, "B": 0.004, "K": 0.02}, "log": {"axes": ["x", "y"]}}
MIDDLE = 905.0  # inside a block
RATE = 2.0
RESTARTS = ((3000.0, 3090.0), (6200.0, 6500.0), (8500.0, 8560.0))
OTHER = "jumps at other instants"
SIZES = np.array([(1.6, -1.9, 1.1), (-1.1, 1.7, -2.0)])  # of the jumps at the restarts, x and y


def try_jumps(blocks: xr.Dataset, baseline: xr.Dataset) -> tuple[Candidate, State]:
    """Return the jumps that are tried in the means of a record, and its state without effects."""
    (jumps,) = (
        candidate
        for candidate in effect_candidates(blocks, baseline["coefficient"])[0]
        if (candidate.effect, candidate.statistic.name) == ("bias_jump", "mean")
    )
    return jumps, initial_state(blocks, baseline)


def test_time_of_a_jump_is_that_of_the_axis_that_shows_it_best():
    rng = np.random.default_rng(5)
    after = np.arange(6000) / 10.0 > 300.0
    rates = 0.57 * rng.standard_normal((2, 6000)) + np.outer([2.0, 0.16], after)
    blocks = reduce_log(make_log(rates, rate=10.0, unit="deg/h"))
    jumps, state = try_jumps(blocks, calibrate_noise(blocks, quiet=(0, 250)))
    (components,) = find_components([jumps], state).values()
    assert components[0].evidence_nats > components[1].evidence_nats + 100.0
    fit = SizeFit(components, ("x", "y"), state, CountEvidence({}))
    at, error, *_ = jumps.statistic.estimate(fit)["at"]
    assert at == pytest.approx(300.0, abs=5.0)
    assert error < 5.0


@pytest.mark.parametrize("unit", [0.01, 1.0, 100.0])
def test_evidence_over_error_does_not_depend_on_the_unit_of_a_course(unit):
    """A prior that is uniform in size over standard error has no unit."""
    blocks = reduce_log(simulate(MODEL, duration="10min", rate=10.0, seed=3))
    state = initial_state(blocks, calibrate_noise(blocks))
    course = np.sin(np.arange(blocks.sizes["block"]) / 5.0)
    in_unit = [mean_mixture(state, "x", [scale * course]) for scale in (1.0, unit)]
    plain, scaled = (
        mixture.evidence - 0.5 * np.log(mixture.moments()[1][0, 0]) for mixture in in_unit
    )
    assert scaled == pytest.approx(plain, abs=1e-6)


@pytest.mark.full
@pytest.mark.parametrize(
    ("way", "size", "jump"),
    [(0.0, 0.4, True), (100.0, 0.8, False), (0.0, 4.0, True), (160.0, 4.0, False)],
)
def test_gradual_change_is_not_a_jump(way: float, size: float, jump: bool) -> None:
    second = np.arange(18_000) / 10.0
    course = np.clip((second - MIDDLE) / max(way, 1e-3) + 0.5, 0.0, 1.0)
    noise = (
        0.003 * 60.0 * np.sqrt(10.0) * np.random.default_rng(4).standard_normal((2, second.size))
    )
    blocks = reduce_log(make_log(noise + size * course * [[1.0], [-0.8]], rate=10.0, unit="deg/h"))
    jumps, state = try_jumps(blocks, baseline_from_model(blocks, MODEL))
    components = find_components([jumps], state)[jumps.key]
    assert sum_evidence(components) > 10.0
    assert abs(float(components[0].variant.values["at"]) - MIDDLE) <= 30.0
    assert all(is_free_jump(component, state) for component in components)
    assert ("a gradual change" not in winning_forms(components, state)) == jump
    assert bool(keep_physical(components, state)[0]) == jump


@pytest.mark.full
def test_an_instant_that_axes_share_is_searched_once() -> None:
    """A jump that is weak on each of six axes is no scatter of their means."""
    axes = list("uvwxyz")
    second = np.arange(9_000) / 5.0
    noise = np.random.default_rng(0).standard_normal((len(axes), second.size))
    rate = 0.003 * 60.0 * np.sqrt(5.0) * noise + 0.07 * (second >= 800.0)
    blocks = reduce_log(make_log(rate, rate=5.0, unit="deg/h", axis=axes))
    jumps, state = try_jumps(blocks, baseline_from_model(blocks, MODEL | {"log": {"axes": axes}}))
    components = find_components([jumps], state)[jumps.key]
    assert len(components) == len(axes)
    assert sum_evidence(components) > 15.0
    assert not winning_forms(components, state)
    assert len(keep_physical(components, state)[0]) == len(axes)


def test_scatter_on_one_axis_is_no_jump_beside_that_of_another_axis() -> None:
    """Axis x has three noisy blocks, axis y a jump at another time."""
    second = np.arange(9_000) / 5.0
    rate = 0.003 * 60.0 * np.sqrt(5.0) * np.random.default_rng(1).standard_normal((2, second.size))
    for first, size in ((600.0, -1.0), (620.0, 1.5), (640.0, -0.6)):
        rate[0] += size * ((second >= first) & (second < first + 20.0))
    rate[1] += 0.3 * (second >= 1300.0)
    blocks = reduce_log(make_log(rate, rate=5.0, unit="deg/h"))
    jumps, state = try_jumps(blocks, baseline_from_model(blocks, MODEL))
    components = find_components([jumps], state)[jumps.key]
    assert {component.row for component in components} == {("x",), ("y",)}
    kept, _ = keep_physical(components, state)
    assert [(part.row, part.variant.values["at"]) for part in kept] == [(("y",), 1300.0)]


def test_jump_at_a_restart_may_settle() -> None:
    """Its cause is known there, and what follows a start is often slow."""
    second = np.arange(18_000) / 10.0
    course = np.clip((second - 960.0) / 100.0, 0.0, 1.0)
    rate = 0.6 * np.random.default_rng(4).standard_normal((2, second.size)) + 0.8 * course
    rate[:, (second >= 850.0) & (second < 960.0)] = np.nan
    blocks = reduce_log(make_log(rate, rate=10.0, unit="deg/h"))
    jumps, state = try_jumps(blocks, baseline_from_model(blocks, MODEL))
    at = np.array([variant.values["at"] for variant in jumps.variants])
    components = {
        instant: Component(jumps, jumps.variants[int(np.abs(at - instant).argmin())], ("x",), 20.0)
        for instant in (960.0, 1010.0)
    }
    assert [is_free_jump(component, state) for component in components.values()] == [False, True]
    assert [
        "a gradual change" in winning_forms([component], state) for component in components.values()
    ] == [
        False,
        True,
    ]


@pytest.mark.parametrize(("size", "others"), [(10.0, []), (4.8e6, ["fringe_hop"])])
def test_a_jump_of_a_fringe_may_be_a_fringe_hop(size: float, others: list[str]) -> None:
    second = np.arange(3_000) / 5.0
    noise = np.random.default_rng(4).standard_normal((2, second.size))
    rate = 0.4 * noise + size * (second >= 300.0) * [[1.0], [0.0]]
    blocks = reduce_log(make_log(rate, rate=5.0, unit="deg/h"))
    jumps, state = try_jumps(blocks, baseline_from_model(blocks, MODEL))
    components = find_components([jumps], state)[jumps.key]
    assert find_equivalent_effects(components, state) == others


def drifting_log(seed: int, steps: np.ndarray, gaps: tuple[tuple[float, float], ...]) -> xr.Dataset:
    """Make a log with N = 0.05, K = 0.4 and `steps` (axis, sample) [deg/h]."""
    rng = np.random.default_rng(seed)
    second = np.arange(steps.shape[1]) / RATE
    rate = 0.05 * 60.0 * np.sqrt(RATE) * rng.standard_normal(steps.shape) + steps
    rate += 0.4 * np.sqrt(1.0 / RATE / 3600.0) * rng.standard_normal(steps.shape).cumsum(axis=1)
    for begin, end in gaps:
        rate[:, (second >= begin) & (second < end)] = np.nan
    return make_log(rate, rate=RATE, unit="deg/h")


def levels(sizes: tuple[float, ...], times: tuple[float, ...], seconds: float) -> np.ndarray:
    """Sum steps of these sizes at these times."""
    second = np.arange(round(seconds * RATE)) / RATE
    return sum(size * (second >= at) for size, at in zip(sizes, times, strict=True))


@pytest.mark.parametrize("seed", first_of(1, 2, 3))
def test_jumps_at_every_restart_compete_as_one_design(seed: int) -> None:
    """One jump alone is no larger than the random walk that would explain the others."""
    times = tuple(end for _, end in RESTARTS)
    steps = np.stack([levels(tuple(row), times, 10_800.0) for row in SIZES])
    blocks = reduce_log(drifting_log(seed, steps, RESTARTS))
    jumps, state = try_jumps(blocks, calibrate_noise(blocks))
    components = find_components([jumps], state)[jumps.key]
    assert {component.row for component in components} == {("x",), ("y",)}
    assert all(len(component.variant.columns) == 3 for component in components)
    assert sum_evidence(components) > 15.0
    assert not winning_forms(components, state)
    for component in components:
        mean, covariance = component_mixture(component, state).moments()
        error = np.sqrt(np.diag(covariance))
        assert (np.abs(mean - SIZES["xy".index(component.row[0])]) < 4.0 * error).all()
        assert (error < 0.5).all()


def test_a_slow_course_is_not_a_jump_at_every_restart() -> None:
    """Of two axes with 34 gaps, x has a slow wave, which ends, and y a level after each gap."""
    gaps = tuple((begin, begin + 20.0) for begin in np.arange(300.0, 10_500.0, 300.0))
    wave = 300.0 * np.exp(-(((np.arange(21_600) / RATE - 5400.0) / 1200.0) ** 2))
    sizes = tuple(20.0 * np.random.default_rng(2).standard_normal(len(gaps)))
    steps = levels(sizes, tuple(end for _, end in gaps), 10_800.0)
    model = {"noise": {"N": 0.05, "K": 0.4}, "log": {"axes": ["x", "y"]}}
    blocks = reduce_log(drifting_log(1, np.stack([wave, steps]), gaps))
    jumps, state = try_jumps(blocks, baseline_from_model(blocks, model))
    components = find_components([jumps], state)[jumps.key]
    assert {len(component.variant.columns) for component in components} == {len(gaps)}
    assert {component.row for component in components} == {("x",), ("y",)}
    assert min(component.evidence_nats for component in components) > 50.0
    forms = {component.row: winning_forms([component], state) for component in components}
    assert forms == {("x",): {"a gradual change"}, ("y",): set()}
    assert [component.row for component in keep_physical(components, state)[0]] == [("y",)]


def test_levels_that_change_at_other_times_are_not_jumps_at_every_restart() -> None:
    """With 34 gaps, the levels of x change between two of them, those of y at them."""
    gaps = tuple((begin, begin + 20.0) for begin in np.arange(300.0, 10_500.0, 300.0))
    sizes = tuple(20.0 * np.random.default_rng(2).standard_normal(len(gaps)))
    ends = np.array([end for _, end in gaps])
    steps = np.stack([levels(sizes, tuple(ends + late), 10_800.0) for late in (140.0, 0.0)])
    model = {"noise": {"N": 0.05, "K": 0.4}, "log": {"axes": ["x", "y"]}}
    blocks = reduce_log(drifting_log(1, steps, gaps))
    jumps, state = try_jumps(blocks, baseline_from_model(blocks, model))
    (every,) = (variant for variant in jumps.variants if len(variant.columns) == len(gaps))
    forms = {axis: winning_forms([Component(jumps, every, (axis,), 50.0)], state) for axis in "xy"}
    assert OTHER in forms["x"]
    assert not forms["y"]


def test_steps_at_instants_without_meaning_seldom_beat_shifted_ones() -> None:
    """Steps at random instants are among the best 2 of their 41 places in 5 % of all draws."""
    gaps = tuple((begin, begin + 20.0) for begin in (500.0, 1300.0, 1700.0))
    model = {"noise": {"N": 0.05, "K": 0.4}, "log": {"axes": ["x"]}}
    blocks = reduce_log(drifting_log(3, np.zeros((1, 4_800)), gaps))
    jumps, state = try_jumps(blocks, baseline_from_model(blocks, model))
    (every,) = (variant for variant in jumps.variants if len(variant.columns) == len(gaps))
    rng, block = np.random.default_rng(6), np.arange(blocks.sizes["block"])
    leads = []
    for _ in range(24):
        instants = np.sort(rng.choice(block[2:-2], len(gaps), replace=False))
        steps = (block >= instants[:, None]).astype(float).reshape(every.design.shape)
        component = Component(jumps, replace(every, design=steps), ("x",), 50.0)
        leads += [form.nats for form in restart_competitors(component, state) if form.name == OTHER]
    assert len(leads) > 20
    assert sum(lead < 0.0 for lead in leads) <= 4


@pytest.mark.full
@pytest.mark.parametrize("seed", [1])
def test_jumps_at_all_restarts_are_sized(seed: int) -> None:
    times = tuple(end for _, end in RESTARTS)
    steps = np.stack([levels(tuple(row), times, 10_800.0) for row in SIZES])
    found = diagnose(drifting_log(seed, steps, RESTARTS), nulls=100)
    assert [effect["name"] for effect in found.effects] == ["bias_jump"] * 3
    assert [effect["at"] for effect in found.model["effect"]] == list(times)
    for effect, truth in zip(found.effects, SIZES.T, strict=True):
        for axis, size in zip(("x", "y"), truth, strict=True):
            estimate = effect["parameters"][f"step.{axis}"]
            assert abs(estimate["value"] - size) < 4.0 * estimate["stderr"]
            assert estimate["stderr"] < 0.5


@pytest.mark.full
@pytest.mark.parametrize("seed", first_of(2, 3))
def test_two_jumps_beat_a_course_of_levels(seed: int) -> None:
    steps = levels((2.6, -2.1), (9500.0, 11_800.0), 14_400.0)[None]
    blocks = reduce_log(drifting_log(seed, steps, ()))
    baseline, records = nulls(blocks, 10)
    fitted = fit_identifications(name_effects(blocks, baseline, records), baseline)
    sizes = {
        table["parameters"]["at"]["value"]: table["parameters"]["step"]
        for table in effect_tables(fitted, blocks)
        if table["name"] == "bias_jump"
    }
    assert len(sizes) == 2
    for (at, estimate), truth_at, truth in zip(
        sorted(sizes.items()), (9500.0, 11_800.0), (2.6, -2.1), strict=True
    ):
        assert at == pytest.approx(truth_at, abs=60.0)
        assert abs(estimate["value"] - truth) < 4.0 * estimate["stderr"] < 4.0
