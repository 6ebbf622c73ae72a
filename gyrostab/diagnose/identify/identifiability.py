"""Compare an effect with other explanations: other forms, other effects, time-shifted channels."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import lsq_linear

from gyrostab.arrays import Floats
from gyrostab.diagnose.identify.components import sum_evidence
from gyrostab.diagnose.identify.examination import Examination
from gyrostab.diagnose.predict.candidates import Candidate, Component, Variant
from gyrostab.diagnose.predict.condition import mean_columns
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.predict.search import compute_evidence
from gyrostab.diagnose.predict.sizes import component_mixture, component_size
from gyrostab.diagnose.predict.windows import make_surrogates, max_correlation
from gyrostab.diagnose.reduce.zero_bin import possibly_truncated_axes
from gyrostab.diagnose.statistics.base import Competitor
from gyrostab.diagnose.statistics.build_candidates import largest_size
from gyrostab.physics.registry import effects

#: Number of time shifts at most, the recorded time among them: ten make the allowed share of 5 %.
TIME_SHIFTS = 200
_PPM = 1e6  # in one
_MIN_EIGENVALUE = 1e-12  # of a correlation; above rounding errors


def keep_physical(
    components: Sequence[Component], state: State, *, error: float = 0.0
) -> tuple[list[Component], tuple[str, float] | None]:
    """Return the components of an effect that no other form explains better, of possible sizes.

    Without an effect on an axis, chance may fit an impossible size. If no component is left, the
    second result is the form that excludes the effect, and by how much it explains more [nats], NaN
    for sizes that physics excludes. The state has all other effects in the model; `error` is what
    errors of their form may leave to this one [nats].
    """
    by_statistic = {
        statistic: [component for component in components if component.statistic is statistic]
        for statistic in dict.fromkeys(component.statistic for component in components)
    }
    other_course = _find_winner(
        competitor
        for statistic, own in by_statistic.items()
        for competitor in statistic.competitors(own, state, error)
    )
    if other_course:
        return [], other_course
    possible = [_with_possible_size(component, state) for component in components]
    forms = [
        _find_winner(component.statistic.axis_competitors(component, state))
        if component
        else ("an impossible size", math.nan)
        for component in possible
    ]
    remaining = [
        component for component, form in zip(possible, forms, strict=True) if component and not form
    ]
    return remaining, next(iter(forms), None) if not remaining else None


def _with_possible_size(component: Component, state: State) -> Component | None:
    """Return the component in the best form that gives a possible size; None without any.

    Where the record leaves a nuisance parameter open, the best form has any size: a toolface, for
    example, shows in the mean of one axis only by the cosine of an angle.
    """
    forms = (replace(component, variant=variant) for variant in component.close[1:])
    return next((form for form in (component, *forms) if _is_possible(form, state)), None)


def _find_winner(competitors: Iterable[Competitor]) -> tuple[str, float] | None:
    """Return the first form that explains more than it needs, and by how much [nats]."""
    return next(
        (
            (competitor.name, competitor.nats)
            for competitor in competitors
            if competitor.nats > competitor.needed
        ),
        None,
    )


def find_plainer_effect(components: Sequence[Component], state: State) -> str | None:
    """Return the simpler effect that explains the same, or None.

    An axis senses a real rotation by the cosine of its angle to it, which is rarely small; errors
    of the scale factor are, and physics excludes large ones.
    """
    effect = components[0].candidate.effect
    if effect == "real_motion" and all(
        _is_rotation(component)
        and _rotation_share(component, state) < state.settings.max_misalignment_share
        for component in components
    ):
        return "scale_factor"
    return next(iter(effects()[effect].look_alikes("limit")), None)


def _is_rotation(component: Component) -> bool:
    """Return whether a component belongs to an axis that senses the rotation of the tool."""
    return (
        component.candidate.effect == "real_motion"
        and component.statistic.is_linear_in_means
        and component.variant.columns == ("spin",)
    )


def _rotation_share(component: Component, state: State) -> float:
    """Return the share of the rotation of the tool that an axis senses, or that an error is."""
    if _is_rotation(component):
        return abs(component_size(component, state)[0])
    row = state.axes.index(component.row[0])
    error = component_mixture(component, state).moments()[0] @ mean_columns(component.variant, row)
    per_ppm = next(
        mean_columns(variant, row)[0]
        for variant in component.candidate.variants
        if variant.columns == ("linear",)
    )
    return float(np.nanstd(error) / (_PPM * np.nanstd(per_ppm)))


def _is_possible(component: Component, state: State) -> bool:
    """Return whether physics allows the size of a component."""
    effect, statistic, settings = component.candidate.effect, component.statistic, state.settings
    if _is_rotation(component) and _rotation_share(component, state) < settings.min_rotation_share:
        return False
    is_too_large = (
        effect == "scale_factor"
        and statistic.is_linear_in_means
        and _rotation_share(component, state) > settings.max_misalignment_share
    )
    # noise that is added, or the share of it that a filter stops
    is_positive = statistic.is_power and (component.variant.squared or component.is_filter)
    return (
        not is_too_large
        and _is_in_range(component, state)
        and not (is_positive and (component_mixture(component, state).mean <= 0.0).any())
    )


def _is_in_range(component: Component, state: State) -> bool:
    """Return whether the sizes can lie in the ranges of the registry and the settings."""
    columns = component.variant.columns
    low, high = (
        np.array([_allowed_range(component, name, state) for name in columns]).reshape(-1, 2).T
    )
    if not (np.isfinite(low) | np.isfinite(high)).any():
        return True
    sizes, covariance = component_mixture(component, state).moments()
    # the parts of a complex size have the range of its column
    low, high = (np.repeat(ends, sizes.size // len(columns)) for ends in (low, high))
    return distance_to_range(sizes, covariance, low, high) <= state.settings.clear_sigma


def distance_to_range(sizes: Floats, covariance: Floats, low: Floats, high: Floats) -> float:
    """Return how far sizes are from a range of all together, in standard errors.

    Sizes of columns that resemble each other have large errors, although their sum is well known.
    Sizes of infinite error may have any value.

    Examples
    --------
    >>> covariance = np.array([[1e4, -1e4], [-1e4, 1e4]]) + np.eye(2)
    >>> sizes, limit = np.array([300.0, 300.0]), np.full(2, 20.0)
    >>> round(distance_to_range(sizes, covariance, -limit, limit))
    396
    >>> round(distance_to_range(sizes, covariance, -20.0 * limit, 20.0 * limit), 6)
    0.0
    """
    is_known = np.isfinite(np.diagonal(covariance))
    if not is_known.any():
        return 0.0
    sizes, low, high = sizes[is_known], low[is_known], high[is_known]
    covariance = covariance[np.ix_(is_known, is_known)]
    scale = np.sqrt(np.maximum(np.diagonal(covariance), np.finfo(float).tiny))
    correlation = covariance / np.outer(scale, scale)
    values, vectors = np.linalg.eigh(correlation)
    whiten = (vectors / np.sqrt(np.maximum(values, _MIN_EIGENVALUE))).T
    nearest = lsq_linear(whiten, whiten @ (sizes / scale), (low / scale, high / scale)).x
    return float(np.linalg.norm(whiten @ (nearest - sizes / scale)))


def _allowed_range(component: Component, column: str, state: State) -> tuple[float, float]:
    """Return the range of the size of a column.

    A mean may have either sign. A single noise level may not be below the least: ageing, for
    example, does not improve a gyro.
    """
    effect, statistic, variant = component.candidate.effect, component.statistic, component.variant
    parameters = {item.name: item for item in effects()[effect].parameters()}
    if column not in parameters:
        return -math.inf, math.inf
    item = parameters[column]
    if statistic.is_power:
        has_least = not variant.squared and len(variant.columns) == 1
        return item.low if has_least else -math.inf, math.inf
    largest = largest_size(effect, state.settings)
    if statistic.is_linear_in_means:
        largest = min(largest, max(abs(item.low), abs(item.high)))
    return -largest, largest


def find_equivalent_effects(
    components: Sequence[Component], state: State, *, lines: int = 0
) -> list[str]:
    """Return effects that the data cannot separate from that of the components.

    `lines` counts all lines.
    """
    effect, blocks = components[0].candidate.effect, state.blocks
    out = list(effects()[effect].look_alikes("always"))
    if (
        effect == "spectral_line"
        and "profile" not in blocks
        and lines >= state.settings.min_comb_lines
    ):
        out.append("feedback_reset")
    if effect == "dead_zone" and len(state.axes) == 1:
        out.append("held_samples")  # no other axis shows whether the sample was lost
    if effect == "dead_zone" and any(
        possibly_truncated_axes(blocks)[state.axes.index(component.row[0])]
        for component in components
    ):
        out.append("rate_quantization")  # truncation towards zero makes the zero bin twice as wide
    if effect == "bias_jump" and any(
        component.is_step
        and np.abs(component_mixture(component, state).moments()[0]).max()
        >= state.settings.min_fringe_step
        for component in components
    ):
        out.append("fringe_hop")
    if effect == "telegraph" and not any(
        component.statistic.is_switching for component in components
    ):
        out.append("gauss_markov")  # two levels show only in the means
    if effect == "vibration_rectification":
        vibration = blocks[f"channel_{components[0].candidate.driver[0]}"].values
        good = np.isfinite(vibration)
        correlation = np.corrcoef(vibration[good], vibration[good] ** 2)[0, 1]
        # what a bias in proportion to g explains less than one in proportion to g^2
        lost_nats = (1.0 - correlation**2) * sum_evidence(components)
        if lost_nats < state.settings.ambiguous_nats:
            out.append("g_sensitivity")
    return out


def find_spectral_alternatives(
    components: Sequence[Component], state: State, examination: Examination
) -> list[str]:
    """Return effects of the same channel, if the spectrum does not tell them apart.

    Vibration through the resonance of a mount has a hump like an aliased band. The same holds for
    any spectrum that explains clearly more than the forms that were tried. `state` has all other
    effects in the model.
    """
    powers = [component for component in components if component.statistic.is_power]
    if not powers:
        return []
    others = list(effects()[powers[0].candidate.effect].look_alikes("any spectrum"))
    if not others:
        return []
    for part in powers:
        if all(variant.values.get("resonance") for variant in (part.variant, *part.close)):
            return others
    own_nats = sum(component.evidence_nats for component in powers)
    free = 0.0
    for component in powers:
        evidence = examination.compute_evidence([_any_spectrum(component, state)], state)[0]
        free += float(evidence.evidence_nats[0, evidence.rows.index(component.row)])
    return others if free - own_nats > state.settings.allow_form_error(own_nats) else []


def _any_spectrum(component: Component, state: State) -> Candidate:
    """Return a power of any spectrum with the course of a component over time."""
    design = component.variant.design
    row = state.axes.index(component.row[0]) if design.shape[1] > 1 else 0
    course = design[0, row].mean(axis=-1)
    bands = np.eye(design.shape[-1])
    variant = Variant(
        {}, tuple(map(str, range(len(bands)))), course[None, None, :, None] * bands[:, None, None]
    )
    return Candidate("~S(f)", component.statistic, component.candidate.driver, (variant,))


def passes_time_shift_test(
    components: Sequence[Component], state: State
) -> tuple[bool, float, float]:
    """Test whether an effect explains more than time-shifted surrogates of its channel.

    The state is that without the effect. It passes where no surrogate can be made. The other
    results are the share of the channel and its surrogates that explain as much as the channel, and
    by how much the best surrogate explains more [nats]; NaN where too few of them differ from it.

    All shifts round the record are equally likely for a channel that has nothing to do with the
    rate. Those near the recorded time therefore count, although they resemble the channel: without
    them, a smooth channel passes whenever it is near the best time. Copies from elsewhere do not
    count, since a periodic channel repeats itself.
    """
    following_components = [component for component in components if _follows_channel(component)]
    if not following_components:
        return True, np.nan, np.nan
    block_count = state.blocks.sizes["block"]
    shifts = np.unique(np.linspace(0, block_count, TIME_SHIFTS, endpoint=False).astype(int))[1:]
    real, shifted = 0.0, np.zeros(shifts.size)
    is_similar = np.zeros(shifts.size, np.bool_)
    for component in following_components:
        surrogates = make_surrogates(component, state, shifts)
        values = _compute_shifted_evidence(component, surrogates, state)
        real += float(values[0])
        shifted += values[1:]
        row, limit = state.axes.index(component.row[0]), state.settings.majority_share
        is_similar |= [
            surrogate is None or max_correlation(surrogate, component.variant, row) > limit
            for surrogate in surrogates
        ]
    different = np.flatnonzero(~is_similar)
    if different.size < state.settings.min_surrogates:
        return True, np.nan, np.nan
    first, stop = different[0], different[-1] + 1
    counted = np.concatenate([shifted[:first], shifted[different], shifted[stop:]])
    p_value = float((1 + np.sum(counted >= real)) / (1 + counted.size))
    return p_value <= state.settings.surrogate_share, p_value, float(counted.max() - real)


def _compute_shifted_evidence(
    component: Component, surrogates: Sequence[Variant | None], state: State
) -> Floats:
    """Return the evidence of the channel, then of each surrogate, on the axis of a component.

    The channel has all variants: it pays for the search of the best one, as no surrogate has to.
    """
    shifted = [
        replace(
            component.candidate,
            effect=f"shifted {number}",
            variants=(component.variant if surrogate is None else surrogate,),
        )
        for number, surrogate in enumerate(surrogates)
    ]
    all_evidence = compute_evidence([component.candidate, *shifted], state.blocks, state)
    row = state.axes.index(component.row[0])
    return np.array([evidence.evidence_nats[0, row] for evidence in all_evidence])


def _follows_channel(component: Component) -> bool:
    """Return whether a component follows a channel, or the means of other axes."""
    if not (component.statistic.is_linear_in_means or component.statistic.is_power):
        return False
    follows_axes = effects()[component.candidate.effect].follows_axes
    return any(component.candidate.driver) or (
        component.statistic.is_linear_in_means and follows_axes
    )
