"""Group spectral lines into families: harmonics, side bands of a line, a shaped spectrum."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.special import bdtrc

from gyrostab.arrays import Floats

#: Probability that lines without relation form a family, below which they are one.
MAX_CHANCE = 0.05
#: More lines without a family are one shaped spectrum, not as many findings. Design choice.
MAX_UNRELATED_LINES = 3
#: Family of the lines of a shaped spectrum.
UNRELATED = "lines without a common spacing"
#: Largest multiple of the spacing that defines a family: of its lowest line, or between two lines.
#: Design choice: the chance of a family counts those that are tried.
_MAX_LOWEST_HARMONIC = 4
_MAX_APART = 3  # places between two lines that define a spacing; limits time
#: Distance allowed about a multiple, in spacings; with more, most unrelated lines are at one.
#: Design choice: the chance of a family accounts for what is allowed.
_MAX_DOUBT = 0.25


class _Spacing(NamedTuple):
    """Distance of the lines of a family, and its error [Hz]."""

    size: float
    error: float


def find_families(
    frequencies: Sequence[float], *, resolution: float | Sequence[float], bandwidth: float
) -> list[str | None]:
    """Label the family of each line; None for a line without one.

    Lines at multiples of a spacing, counted from zero or from another line, are a family if the
    probability is below 5 % that as many unrelated lines fall there, over all spacings and centres
    that are tried. The least probable family is taken first. More than three lines without a family
    are one too. The resolution, of all lines or of each, is the largest distance from such a
    multiple, and the bandwidth half the sampling rate [Hz].

    Examples
    --------
    >>> find_families([10.0, 31.7, 20.0, 40.0], resolution=0.05, bandwidth=50.0)
    ['harmonics of 10 Hz', None, 'harmonics of 10 Hz', 'harmonics of 10 Hz']
    >>> find_families([10.0, 10.7, 9.3], resolution=0.05, bandwidth=50.0)[0]
    'side bands of 10 Hz, 0.7 Hz apart'
    """
    lines, first, places = np.unique(
        np.asarray(frequencies, dtype=np.float64), return_index=True, return_inverse=True
    )
    distances = np.broadcast_to(np.asarray(resolution, dtype=np.float64), places.shape)[first]
    labels: dict[int, str] = {}
    remaining = np.arange(lines.size)
    while remaining.size > 1:
        chance, label, members = min(
            _try_families(lines[remaining], distances[remaining], bandwidth),
            key=lambda family: family[0],
        )
        if chance > MAX_CHANCE:
            break
        labels |= dict.fromkeys(remaining[members].tolist(), label)
        remaining = np.delete(remaining, members)
    families = [labels.get(int(place)) for place in places]
    is_shaped = families.count(None) > MAX_UNRELATED_LINES
    return [family or (UNRELATED if is_shaped else None) for family in families]


def _try_families(
    lines: Floats, resolution: Floats, bandwidth: float
) -> Iterator[tuple[float, str, list[int]]]:
    """Yield the probability by chance, the label and the members of each possible family."""
    for first, error in zip(lines, resolution, strict=True):  # a low multiple
        for order in range(1, _MAX_LOWEST_HARMONIC + 1):
            start = _Spacing(first / order, error / order)
            yield _judge_family(lines, resolution, start, tried=lines.size * order**2, defining=1)
    for apart in range(1, _MAX_APART + 1):  # two neighbouring multiples
        errors = np.hypot(resolution[apart:], resolution[:-apart])
        for difference, error in zip(lines[apart:] - lines[:-apart], errors, strict=True):
            for order in range(1, _MAX_LOWEST_HARMONIC + 1):
                start = _Spacing(difference / order, error / order)
                tried = math.comb(lines.size, 2) * order**2
                yield _judge_family(lines, resolution, start, tried=tried, defining=2)
    for place, centre in enumerate(lines):
        errors = np.maximum(resolution, resolution[place])
        for line in np.flatnonzero(lines != centre):
            start = _Spacing(abs(float(lines[line] - centre)), float(errors[line]))
            tried = math.comb(lines.size, 2)
            yield _judge_family(
                lines, errors, start, tried=tried, defining=2, centre=centre, bandwidth=bandwidth
            )


def _judge_family(
    lines: Floats,
    resolution: Floats,
    start: _Spacing,
    *,
    tried: int,
    defining: int,
    centre: float = 0.0,
    bandwidth: float = math.inf,
) -> tuple[float, str, list[int]]:
    """Return the probability by chance, the label and the members of a family from its spacing.

    It is one of so many that were `tried`, and `defining` lines determine it. The shares of the
    lines that unrelated ones fall on are replaced by their mean, which does not lower the
    probability of many (Hoeffding 1956, doi:10.1214/aoms/1177728178).
    """
    highest = 1.0 if centre else math.inf
    spacing, members, allowed = _collect_multiples(lines - centre, resolution, start, highest)
    place = min(1.0 / spacing, 2.0 * highest / bandwidth) if centre else 1.0 / spacing
    share = min(2.0 * float(np.mean(allowed)) * place, 1.0) if allowed else 1.0
    chance = bdtrc(len(members) - defining - 1, len(allowed) - defining, share)
    label = (
        f"side bands of {centre:.4g} Hz, {spacing:.4g} Hz apart"
        if centre
        else f"harmonics of {spacing:.4g} Hz"
    )
    return tried * float(chance), label, members


def _collect_multiples(
    distance: Floats, resolution: Floats, start: _Spacing, highest: float
) -> tuple[float, list[int], list[float]]:
    """Return a refined spacing, the lines at multiples of it, and what was allowed for each line.

    The nearest lines come first, and each one at a multiple makes the spacing of the next more
    exact. A line whose multiple is not certain, because it or the spacing is not known well enough,
    does not count. The distance allowed is that before the line itself changes the spacing.
    """
    members: list[int] = []
    allowances: list[float] = []
    spacing, error = start
    products, squares = spacing / error**2, 1.0 / error**2
    for line in np.argsort(np.abs(distance)).tolist():
        order = float(np.rint(distance[line] / spacing))
        # side bands next to a line are compared with each other, not with a refined spacing
        allowed = math.hypot(resolution[line], order * error if highest > 1.0 else 0.0)
        if allowed > _MAX_DOUBT * spacing:
            continue
        allowances.append(allowed)
        is_near = abs(distance[line] - order * spacing) <= allowed and abs(order) <= highest
        if is_near and (order or not distance[line]):
            members.append(line)
            products += order * distance[line] / resolution[line] ** 2
            squares += order**2 / resolution[line] ** 2
            spacing, error = float(products / squares), float(squares**-0.5)
    return spacing, members, allowances


def group_families(effects: Sequence[Mapping[str, Any]]) -> list[list[Mapping[str, Any]]]:
    """Group the tables of effects by family, in order; an effect without family is alone.

    Examples
    --------
    >>> groups = group_families([{"family": "a"}, {"family": None}, {"family": "a"}])
    >>> [len(group) for group in groups]
    [2, 1]
    """
    groups: dict[object, list[Mapping[str, Any]]] = {}
    for number, effect in enumerate(effects):
        groups.setdefault(effect.get("family") or number, []).append(effect)
    return list(groups.values())
