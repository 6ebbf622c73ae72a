"""Compare samples that two files hold of the same time: raw files, rows of one file, or logs."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Samples that are compared at each end of an overlap.
COMPARED_SAMPLES = 2**13

#: Smallest share of equal samples in a copy, which may be damaged; below the second share at one
#: end, the other end is not compared.
_MIN_ALIKE_SHARE, _MIN_HOPEFUL_SHARE = 0.9, 0.5
#: Largest difference of equal samples, over the median difference of neighbours: files may be
#: rounded differently. Independent noise is that near in 5 % of the samples.
_MAX_ROUNDING = 0.1
_PROBED_SAMPLES = 64  # compared samples that are tried at every displacement
_MIN_COMMON_SAMPLES = 32  # common samples needed to find a displacement


@dataclass(frozen=True)
class Match:
    """Samples compared in two files, samples that are equal, and displacement of the later file."""

    common: int
    same: int
    shift: int = 0

    @property
    def alike(self) -> bool:
        """Whether so many equal samples among those in common show a copy."""
        return self.common >= 2 and self.same >= _MIN_ALIKE_SHARE * self.common


def count_alike(held: NDArray[np.float64], new: NDArray[np.float64]) -> tuple[Any, Any]:
    """Count samples known in both arrays (axis, ..., sample), and those equal but for rounding."""
    is_known = np.isfinite(held) & np.isfinite(new)
    has_values = is_known.any(axis=0)
    rounding = np.zeros((len(new), *[1] * (new.ndim - 1)))
    if new.shape[-1] > 1:
        steps = np.abs(np.diff(np.nan_to_num(new), axis=-1)).reshape(len(new), -1)
        rounding += _MAX_ROUNDING * np.median(steps, axis=1).reshape(rounding.shape)
    with np.errstate(invalid="ignore"):
        is_near = np.abs(held - new) <= np.maximum(rounding, 1e-6 * np.abs(new))
    same = (is_near | ~is_known).all(axis=0) & has_values
    return has_values.sum(axis=-1), same.sum(axis=-1)


def match_ends(ends: Iterable[tuple[NDArray[np.float64], NDArray[np.float64]]]) -> Match:
    """Compare two files at the ends of their overlap.

    `ends` yields the samples (axis, sample) of both files at each end; if those of the earlier file
    have a margin on both sides, the later ones are tried at every displacement in it.
    """
    matches: list[Match] = []
    for held, new in ends:
        match = _find_shift(held, new)
        matches.append(match)
        is_long = match.common >= COMPARED_SAMPLES // 2
        if is_long and match.same < _MIN_HOPEFUL_SHARE * match.common:
            break
    surest = max(matches, key=lambda match: (match.alike, match.same), default=Match(0, 0))
    return Match(
        sum(match.common for match in matches), sum(match.same for match in matches), surest.shift
    )


def _find_shift(held: NDArray[np.float64], new: NDArray[np.float64]) -> Match:
    """Compare `new` with `held` at the displacement at which they are alike, or without one."""
    size, margin = new.shape[1], (held.shape[1] - new.shape[1]) // 2
    unshifted = Match(*count_alike(held[:, margin : margin + size], new))
    if margin == 0 or unshifted.alike or unshifted.common < _MIN_COMMON_SAMPLES:
        return unshifted
    probe = np.flatnonzero(np.isfinite(new).any(axis=0))[:_PROBED_SAMPLES]
    shifts = np.array(sorted(range(-margin, margin + 1), key=abs))
    common, same = count_alike(held[:, margin + shifts[:, None] + probe], new[:, None, probe])
    for shift in shifts[
        (common >= _MIN_COMMON_SAMPLES) & (same >= _MIN_ALIKE_SHARE * common)
    ].tolist():
        begin = margin + shift
        shifted = Match(*count_alike(held[:, begin : begin + size], new), shift)
        if shifted.alike and shifted.common >= _MIN_COMMON_SAMPLES:
            return shifted
    return unshifted
