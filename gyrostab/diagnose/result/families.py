"""Group spectral lines into families: harmonics, side bands of a line, a shaped spectrum."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtrc

Array = NDArray[np.float64]
#: Probability that lines without relation form a family, below which they are one.
MAX_CHANCE = 0.05
#: More lines without a family are one shaped spectrum, not as many findings. Design choice.
MAX_UNRELATED_LINES = 3
#: Family of the lines of a shaped spectrum.
UNRELATED = "lines without a common spacing"
_MAX_LOWEST_HARMONIC = 4  # the lowest line of a family may be this multiple of the fundamental


def find_families(
    frequencies: Sequence[float], *, resolution: float, bandwidth: float
) -> list[str | None]:
    """Label the family of each line; None for a line without one.

    Lines at multiples of a spacing, counted from zero or from another line, are a family if the
    probability is below 5 % that as many unrelated lines fall there, over all spacings and centres
    that are tried. The least probable family is taken first. More than three lines without a family
    are one too. The resolution is the distance of two lines of the spectrum, the bandwidth half the
    sampling rate [Hz].

    Examples
    --------
    >>> find_families([10.0, 31.7, 20.0, 40.0], resolution=0.05, bandwidth=50.0)
    ['harmonics of 10 Hz', None, 'harmonics of 10 Hz', 'harmonics of 10 Hz']
    >>> find_families([10.0, 10.7, 9.3], resolution=0.05, bandwidth=50.0)[0]
    'side bands of 10 Hz, 0.7 Hz apart'
    """
    lines, places = np.unique(np.asarray(frequencies, dtype=np.float64), return_inverse=True)
    labels: dict[int, str] = {}
    remaining = np.arange(lines.size)
    while remaining.size > 1:
        chance, label, members = min(
            _try_families(lines[remaining], resolution, bandwidth), key=lambda family: family[0]
        )
        if chance > MAX_CHANCE:
            break
        labels |= dict.fromkeys(remaining[members].tolist(), label)
        remaining = np.delete(remaining, members)
    families = [labels.get(int(place)) for place in places]
    is_shaped = families.count(None) > MAX_UNRELATED_LINES
    return [family or (UNRELATED if is_shaped else None) for family in families]


def _try_families(
    lines: Array, resolution: float, bandwidth: float
) -> Iterator[tuple[float, str, list[int]]]:
    """Yield the probability by chance, the label and the members of each possible family."""
    for centre in (0.0, *lines):
        lowest, highest = (1, 1.0) if centre else (_MAX_LOWEST_HARMONIC, np.inf)
        for line in lines[lines != centre]:
            for order in range(1, lowest + 1):
                spacing, members = _collect_multiples(
                    lines - centre, abs(line - centre) / order, highest, resolution
                )
                share = 2.0 * resolution * min(1.0 / spacing, 2.0 * highest / bandwidth)
                defining_count = 2 if centre else 1  # lines that define the family
                tried = math.comb(lines.size, defining_count) * order**2
                chance = bdtrc(
                    len(members) - defining_count - 1, lines.size - defining_count, min(share, 1.0)
                )
                label = (
                    f"side bands of {centre:.4g} Hz, {spacing:.4g} Hz apart"
                    if centre
                    else f"harmonics of {spacing:.4g} Hz"
                )
                yield tried * float(chance), label, members


def _collect_multiples(
    distance: Array, spacing: float, highest: float, resolution: float
) -> tuple[float, list[int]]:
    """Return a refined spacing, and the lines at multiples of it, the nearest ones first."""
    members: list[int] = []
    orders: list[float] = []
    for line in np.argsort(np.abs(distance)).tolist():
        order = float(np.rint(distance[line] / spacing))
        is_near = abs(distance[line] - order * spacing) <= resolution and abs(order) <= highest
        if is_near and (order or not distance[line]):
            members.append(line)
            orders.append(order)
            if any(orders):
                spacing = float(np.dot(orders, distance[members]) / np.dot(orders, orders))
    return spacing, members


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
