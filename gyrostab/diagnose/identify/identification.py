"""What naming gives: claims, what is unknown, and what both rest on."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.identify.components import LEAST, axes_of, sum_evidence
from gyrostab.diagnose.predict.condition import Component
from gyrostab.diagnose.predict.designs import Candidate
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.predict.search import CountEvidence

__all__ = [
    "Identification",
    "Identifications",
    "Unidentified",
    "add_identification",
    "find_unidentified",
    "form_error",
    "with_axes_of",
]

Array = NDArray[np.float64]
#: What an error of the spectrum of a driven noise leaves to a filter, as a share of its gain: 0.08
#: was seen in loud vibration.
_FILTER, _SPECTRUM = "logger_filter", 0.1


@dataclass(frozen=True)
class Identification:
    """An effect that is named.

    Attributes
    ----------
    effect : str
        Name in the registry.
    driver : tuple of str
        Channels of the log that it follows, in the order of the effect's channels.
    axes : tuple of str
    components : tuple of Part
        Where it shows.
    evidence_nats : float
        On held-out time, with all others in the model [nats].
    threshold : float
        That it had to pass [nats].
    alternatives : tuple of str
        Effects that these data cannot tell from it.
    surrogate_p : float
        Share of slid copies of its channel that explain as much; NaN where there is no channel.
    """

    effect: str
    driver: tuple[str, ...]
    axes: tuple[str, ...]
    components: tuple[Component, ...]
    evidence_nats: float
    threshold: float
    alternatives: tuple[str, ...] = ()
    surrogate_p: float = math.nan


@dataclass(frozen=True)
class Unidentified:
    """Something is there that no effect explains.

    Attributes
    ----------
    generic : str
        One of `GENERICS`.
    axes : tuple of str
    evidence_nats : float
        [nats]
    threshold : float
    candidates : tuple of str
        Effects that come nearest, or whose channel is missing.
    components : tuple of Part
    """

    generic: str
    axes: tuple[str, ...]
    evidence_nats: float
    threshold: float
    candidates: tuple[str, ...] = ()
    components: tuple[Component, ...] = ()


@dataclass(frozen=True)
class Identifications:
    """What naming found.

    Attributes
    ----------
    identified : tuple of Claim
        Effects named, the strongest first.
    unknown : tuple of Unknown
    threshold : float
        Gain that noise alone reaches in any effect, axis and grid point with the probability
        `level` [nats].
    null_best : ndarray
        Largest gain in each null record, sorted [nats].
    reasons : dict of str to str
        Effect -> why it cannot be seen in this record.
    candidates : tuple of Candidate
        All that was tried.
    state : State
        With all that was named.
    folds : xarray.DataArray
    count_evidence : Tallies
    expected : tuple of Claim
        Effects that the simulation has as well, with the size and course that the recording gives
        them; they are in `state` too.
    """

    identified: tuple[Identification, ...]
    unknown: tuple[Unidentified, ...]
    threshold: float
    null_best: Array
    reasons: dict[str, str]
    candidates: tuple[Candidate, ...]
    state: State
    folds: xr.DataArray
    count_evidence: CountEvidence = field(default_factory=lambda: CountEvidence({}))
    expected: tuple[Identification, ...] = ()

    @property
    def verdict(self) -> str:
        """What to call it: "no mismatch", "explained", "partly explained" or "unknown"."""
        if not self.identified:
            return "unknown" if self.unknown else "no mismatch"
        return "partly explained" if self.unknown else "explained"


def add_identification(
    chosen: Sequence[Identification | Unidentified], one: Identification | Unidentified
) -> list[Identification | Unidentified]:
    """The list with another claim; one of the same effect and channel becomes one with it, but for lines of other frequencies."""
    for place, other in enumerate(chosen):
        if (
            isinstance(one, Identification)
            and isinstance(other, Identification)
            and _same(one, other)
        ):
            axes = tuple(sorted({*other.axes, *one.axes}))
            alike = tuple(dict.fromkeys([*other.alternatives, *one.alternatives]))
            both = replace(
                other,
                axes=axes,
                components=(*other.components, *one.components),
                evidence_nats=other.evidence_nats + one.evidence_nats,
                alternatives=alike,
            )
            return [*chosen[:place], both, *chosen[place + 1 :]]
    return [*chosen, one]


def with_axes_of(
    identification: Identification, again: Mapping[str, Sequence[Component]]
) -> Identification:
    """A claim without the axes on which it no longer brings anything, by its parts that were found with the others in the model."""
    seen = {
        axis
        for component in again.get(identification.components[0].candidate.key, [])
        if component.evidence_nats > LEAST
        for axis in component.row
    }
    kept = tuple(component for component in identification.components if set(component.row) <= seen)
    return (
        replace(
            identification,
            components=kept,
            axes=tuple(axis for axis in identification.axes if axis in seen),
        )
        if kept
        else identification
    )


def _same(one: Identification, other: Identification) -> bool:
    lines = {
        component.place
        for identification in (one, other)
        for component in identification.components
        if component.candidate.statistic == "line"
    }
    return (one.effect, one.driver) == (other.effect, other.driver) and len(lines) < 2


def find_unidentified(
    key: str, components: Sequence[Component], threshold: float, near: Sequence[str]
) -> Unidentified:
    """What a generic found; `near` are the effects that come nearest."""
    return Unidentified(
        key,
        axes_of(components, ()),
        sum_evidence(components),
        threshold,
        tuple(dict.fromkeys(near)),
        tuple(components),
    )


def form_error(
    components: Sequence[Component],
    chosen: Sequence[Identification | Unidentified],
    *,
    share: float,
) -> float:
    """What errors of the form of what is named already may leave in the views and axes of these parts [nats].

    A steady line leaves nothing at other frequencies: what it leaks into is taken out with it. What
    follows a channel has a course in time that the record tells well, but its spectrum is that of a
    simple law, in place of mounts and decimators: what that leaves over frequency, a filter takes
    for its own.
    """
    statistics = [
        (_kind(component), set(component.row), component.candidate.effect)
        for component in components
        if component.candidate.statistic != "line"
    ]
    error = 0.0
    for one in chosen:
        for component in one.components:
            beside = [
                effect
                for statistic, axes, effect in statistics
                if statistic in _leaves(component) and axes & set(component.row)
            ]
            of_spectrum = (
                component.candidate.statistic == "power"
                and isinstance(one, Identification)
                and bool(one.driver)
                and _FILTER in beside
            )
            error += (
                max(_SPECTRUM if of_spectrum else 0.0, share) * component.evidence_nats
                if beside
                else 0.0
            )
    return error


def _leaves(component: Component) -> tuple[str, ...]:
    """Views in which an error of the form of a part shows: a harmonic that is not quite where it should be is power, and shared."""
    return (
        ("order", "power", "cross")
        if component.candidate.statistic == "order"
        else (_kind(component),)
    )


def _kind(component: Component) -> str:
    """View of a part, for what it leaves to others: two levels are seen in the means."""
    return "mean" if component.candidate.statistic == "levels" else component.candidate.statistic
