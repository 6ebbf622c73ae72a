"""Lines: steady, above both sides, each a separate identification with the simplest name."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.evidence.spectral_lines import line_evidence, line_skirt
from gyrostab.diagnose.evidence.wandering import with_process
from gyrostab.diagnose.identify import forward_search
from gyrostab.diagnose.identify.components import merge_lines
from gyrostab.diagnose.identify.examination import nuisance_alternatives
from gyrostab.diagnose.identify.selections import Selection, add_selection, form_error
from gyrostab.diagnose.predict.candidates import Candidate, Component, Variant
from gyrostab.diagnose.predict.condition import condition_on
from gyrostab.diagnose.predict.filter_response import undo_filter
from gyrostab.diagnose.predict.linear_model import initial_state
from gyrostab.diagnose.predict.search import compute_evidence
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.settings import DEFAULTS
from gyrostab.diagnose.statistics import find_statistic
from gyrostab.diagnose.statistics.build_candidates import effect_candidates
from gyrostab.diagnose.statistics.spectral_line import estimate_line
from gyrostab.ingest.make_log import make_log
from gyrostab.kernels.spectra.line_levels import local_level
from tests.support.candidates import find_components
from tests.support.named import name_effects, nulls

WEIGHT = np.full((1, 8), 22.0)

pytestmark = pytest.mark.usefixtures("one_thread")


def spectra(density: np.ndarray, *, records: int = 20, seed: int = 1) -> np.ndarray:
    """Return mean periodograms with a density (part or 1, line), as (record, 1, part, line)."""
    shape = (records, 1, 8, density.shape[-1])
    return np.random.default_rng(seed).gamma(22.0, 1.0 / 22.0, shape) * density


def test_slopes_and_humps_are_not_lines() -> None:
    place = np.arange(1.0, 601.0)
    for density in (place**-2.0, place**2.0, 1.0 + 50.0 * np.exp(-(((place - 90.0) / 15.0) ** 2))):
        evidence_nats = line_evidence(spectra(density[None]), WEIGHT)
        assert evidence_nats.max(axis=-1).max() < 8.0  # of 12 000 lines


def test_many_records_have_the_evidence_of_each_alone_in_little_memory() -> None:
    power = spectra(np.ones((1, 400)), records=300)
    alone = np.concatenate([line_evidence(record[None], WEIGHT) for record in power])
    tracemalloc.start()
    together = line_evidence(power, WEIGHT)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    np.testing.assert_allclose(together, alone, rtol=1e-12)
    assert peak < 1.5 * power.nbytes  # all records at once need several times as much


@pytest.mark.parametrize("lines", [7, 8])
def test_levels_are_medians_of_intervals(lines: int) -> None:
    power = np.random.default_rng(4).exponential(size=(2, 3, lines))
    power[0, 1, 2] = np.nan
    expected = np.median(power, axis=-1)
    np.testing.assert_array_equal(local_level(power, lines)[..., 0], expected)


def test_an_intermittent_line_is_not_steady() -> None:
    once = np.ones((8, 400))
    once[3, 200] = 40.0
    assert line_evidence(spectra(once), WEIGHT)[..., 200].max() < 0.0


def test_a_steady_line_is_found_under_a_changing_noise_level() -> None:
    level = np.array([1, 1, 1, 50, 50, 1, 1, 1.0])[:, None] * np.ones(400)
    level[:, 200] += 2.0
    gains = line_evidence(spectra(level), WEIGHT)[:, 0]
    assert (gains.argmax(axis=-1) == 200).all()
    assert gains.max(axis=-1).min() > 20.0


def sines(
    amplitudes: dict[float, float],
    *,
    wander: float = 0.0,
    size: int = 18_000,
    axes: int = 2,
    jump: float = 0.0,
    lost: float = 0.0,
) -> xr.Dataset:
    """White noise of 0.57 deg/h with sines of wandering phase [rad] on the first axis.

    The last axis may have a jump [deg/h] in the middle. The share `lost` of the samples is missing.
    """
    rng = np.random.default_rng(2)
    t = np.arange(size) / 10.0
    rates = 0.57 * rng.standard_normal((axes, size))
    for frequency, amplitude in amplitudes.items():
        phase = np.cumsum(rng.normal(0.0, wander / np.sqrt(size), size))
        rates[0] += amplitude * np.sin(2.0 * np.pi * frequency * t + phase)
    rates[-1, size // 2 :] += jump
    rates[:, rng.random(size) < lost] = np.nan
    return reduce_log(make_log(rates, rate=10.0, unit="deg/h"))


@pytest.mark.parametrize(("wander", "lost"), [(0.0, 0.0), (30.0, 0.0), (30.0, 0.4)])
def test_the_skirt_contains_only_its_line(wander: float, lost: float) -> None:
    blocks = sines({1.0: 3.0, 3.1: 1.0}, wander=wander, lost=lost)
    lines = blocks["line_frequency"].values
    place = int(np.abs(lines - 1.0).argmin())
    skirt = line_skirt(blocks, "x", place)
    assert skirt[place]
    assert (np.abs(lines[skirt] - 1.0) < 1.5).all()
    (amplitude, error), (frequency, _) = estimate_line(blocks, "x", place)
    # the level between the lines, raised by the losses, hides the ends of the skirt
    assert amplitude == pytest.approx(3.0, abs=max(4.0 * error, 0.25 if lost else 0.15))
    assert frequency == pytest.approx(1.0, abs=0.03)


@pytest.fixture(scope="module")
def lines() -> tuple[Selection, ...]:
    blocks = sines({0.7: 0.25, 2.03: 0.15, 4.06: 0.2}, size=12_000)
    baseline, records = nulls(blocks, 40)
    return name_effects(blocks, baseline, records).identified


@pytest.mark.slow
def test_each_line_is_a_separate_identification(lines: tuple[Selection, ...]) -> None:
    assert [identification.effect for identification in lines] == ["spectral_line"] * 3
    assert all(identification.axes == ("x",) for identification in lines)
    assert all(
        len({component.line_index for component in identification.components}) == 1
        for identification in lines
    )
    assert len({identification.components[0].line_index for identification in lines}) == 3
    assert all(
        {"real_motion", "supply_bias", "feedback_reset"} <= set(identification.alternatives)
        for identification in lines
    )  # three lines may be a comb


@pytest.mark.full
def test_evidence_is_recalled_only_where_nothing_has_changed() -> None:
    blocks = sines({3.4: 0.4}, size=6_000, axes=2)
    start = initial_state(blocks, calibrate_noise(blocks))
    effects, _ = effect_candidates(blocks, start.baseline["coefficient"])
    every = [*effects, *nuisance_alternatives(blocks)]
    one_of_each = {one.statistic.name: one for one in every}
    candidates = list(one_of_each.values())
    candidates += [one for one in every if one.effect == "bias_jump" and one not in candidates]
    quick = [one for one in candidates if one.statistic.name not in ("telegraph", "wandering_bias")]
    components = find_components(candidates, start)
    line = components["spectral_line"][0]
    with_line = condition_on(start, [line])
    with_jump = condition_on(start, components["bias_jump"][:1])
    lost = blocks.assign(mean=blocks["mean"].where(blocks["begin"] > 0.0))
    states = {
        "line": with_line,
        "another line in its band": condition_on(
            with_line, [replace(line, line_index=line.line_index + 1)]
        ),
        "jump": with_jump,
        "lost block": replace(start, blocks=lost),
        "other weights": replace(start, expected_power=1.1 * start.expected_power),
        "masked": replace(start, masked=start.masked | (np.arange(start.masked.shape[1]) < 2)),
        "random walk": replace(
            start, baseline=with_process(start.baseline, "x", np.full(start.masked.shape[1], 1e-3))
        ),
    }
    compute_evidence(candidates, blocks, start)
    added = {}
    for name, state in states.items():
        tried = candidates if name in ("line", "jump", "random walk") else quick
        before = len(start.memory)
        recalled = compute_evidence(tried, state.blocks, state)
        added[name] = len(start.memory) - before
        fresh = compute_evidence(tried, state.blocks, replace(state, memory={}))
        for one, other in zip(recalled, fresh, strict=True):
            assert one.candidate is other.candidate
            np.testing.assert_array_equal(one.evidence_nats, other.evidence_nats)
    first = len(start.memory) - sum(added.values())
    assert added["another line in its band"] == 0
    assert all(0 < added[name] < first for name in states if name != "another line in its band")


@pytest.mark.full
def test_more_lines_than_are_named_do_not_end_the_search(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(forward_search, "MAX_LINES", 1)
    blocks = sines({0.7: 0.3, 2.03: 0.25}, size=6_000, axes=1, jump=0.25)
    baseline, records = nulls(blocks, 20)
    identified = name_effects(blocks, baseline, records).identified
    assert sorted(identification.effect for identification in identified) == [
        "bias_jump",
        "spectral_line",
    ]
    line = next(
        identification for identification in identified if identification.effect == "spectral_line"
    )
    jump = next(
        identification for identification in identified if identification.effect == "bias_jump"
    )
    assert line.evidence_nats > jump.evidence_nats


# --------------------------------------------------------------------------------
# merging of identifications


def component(effect: str, statistic: str, evidence_nats: float, place: int = -1) -> Component:
    variant = Variant({}, ("size",), np.empty(0))
    return Component(
        Candidate(effect, find_statistic(statistic), (), (variant,)),
        variant,
        ("x",),
        evidence_nats,
        place,
    )


def identification(component: Component) -> Selection:
    return Selection(
        component.candidate.effect, (), component.row, (component,), component.evidence_nats, 7.0
    )


def test_a_line_counts_only_for_the_simplest_effect() -> None:
    groups = {
        "spectral_line": [component("spectral_line", "spectral_line", 50.0)],
        "supply_bias(supply)": [
            component("supply_bias", "spectral_line", 50.0),
            component("supply_bias", "mean", 9.0),
        ],
        "real_motion": [component("real_motion", "spectral_line", 50.0)],
    }
    merged = merge_lines(groups)
    assert merged["spectral_line"] == groups["spectral_line"]
    assert [component.statistic.name for component in merged["supply_bias(supply)"]] == ["mean"]
    assert "real_motion" not in merged


def test_identifications_of_one_effect_merge_except_lines_of_other_frequencies() -> None:
    first = identification(component("spectral_line", "spectral_line", 50.0, 3))
    assert (
        len(
            add_selection(
                [first], identification(component("spectral_line", "spectral_line", 20.0, 9))
            )
        )
        == 2
    )
    (merged,) = add_selection(
        [first],
        replace(identification(component("spectral_line", "spectral_line", 20.0, 3)), axes=("y",)),
    )
    assert (merged.axes, merged.evidence_nats) == (("x", "y"), 70.0)
    assert (
        len(
            add_selection(
                [identification(component("shupe", "mean", 9.0))],
                identification(component("shupe", "mean", 8.0)),
            )
        )
        == 1
    )


def test_a_steady_line_has_no_model_error() -> None:
    chosen = [
        identification(component("spectral_line", "spectral_line", 900.0, 3)),
        identification(component("shupe", "mean", 400.0)),
    ]
    assert (
        form_error([component("spectral_line", "spectral_line", 20.0, 9)], chosen, DEFAULTS) == 0.0
    )
    assert form_error([component("warm_up", "mean", 20.0)], chosen, DEFAULTS) == pytest.approx(4.0)


def test_driven_noise_may_leave_a_filter_or_noise_of_its_channel_but_no_other_noise() -> None:
    driven = replace(
        identification(component("vibration_noise", "power", 200.0)), driver=("vibration",)
    )
    steady = identification(component("relative_intensity_noise", "power", 200.0))
    for chosen, effect, error in (
        (driven, "logger_filter", 20.0),
        (driven, "temperature_noise", 2.0),
        (steady, "logger_filter", 2.0),
    ):
        assert form_error([component(effect, "power", 17.0)], [chosen], DEFAULTS) == pytest.approx(
            error
        )
    left = component("aliased_vibration", "power", 17.0)
    left = replace(left, candidate=replace(left.candidate, driver=driven.driver))
    assert form_error([left], [driven], DEFAULTS) == pytest.approx(20.0)


@pytest.mark.parametrize("weight", [0.1, 0.25, 0.5])
def test_a_filter_is_undone_at_its_estimated_size(weight: float) -> None:
    """Weights of 1 - a and a remove 4 a (1 - a) of what a mean of two removes; a line remains."""
    rng = np.random.default_rng(8)
    raw = rng.standard_normal(60_001) + 0.15 * np.sin(2.0 * np.pi * 4.0 * np.arange(60_001) / 10.0)
    record = reduce_log(
        make_log(((1.0 - weight) * raw[1:] + weight * raw[:-1])[None], rate=10.0, unit="deg/h")
    )
    lines = record["line_frequency"].values
    mean_of_two = {"cutoff": 0.0, "order": 2.0, "length": 0.2, "pick": 0.0, "instrument": 1.0}
    undone, stopped = undo_filter(record, "x", "logger_filter", mean_of_two, np.ones(lines.size))
    power = undone["line_power"].mean("part").values[0] * 10.0
    is_near_line = np.abs(lines - 4.0) < 0.2
    is_fitted = ~is_near_line & ~stopped
    slope, level = np.polyfit(lines[is_fitted], power[is_fitted], 1)
    assert level == pytest.approx(1.0, abs=0.05)
    assert slope * 5.0 == pytest.approx(0.0, abs=0.13)
    assert stopped.any() == (weight == 0.5)
    gains = line_evidence(undone["line_power"].values[None], undone["line_weight"].values)[0, 0]
    assert lines[gains.argmax()] == pytest.approx(4.0, abs=0.1)
    assert gains.max() > 20.0
    assert np.where(is_near_line | stopped, -np.inf, gains).max() < 5.0
    second_pass, _ = undo_filter(undone, "x", "logger_filter", mean_of_two, np.ones(lines.size))
    xr.testing.assert_identical(second_pass, undone)
