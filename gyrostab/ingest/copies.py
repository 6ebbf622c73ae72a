"""Whether values that were recorded at the same time are copies of each other."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["MIN_ALIKE_SHARE", "count_alike", "is_copy"]

#: Smallest share of equal samples in a copy, which may be damaged.
MIN_ALIKE_SHARE = 0.9


def count_alike(held: NDArray[np.float64], new: NDArray[np.float64]) -> tuple[Any, Any]:
    """Count the samples known in both arrays (axis, ..., sample), and the equal ones."""
    is_known = np.isfinite(held) & np.isfinite(new)
    has_values = is_known.any(axis=0)
    same = (np.isclose(held, new, rtol=1e-6, atol=0.0) | ~is_known).all(axis=0) & has_values
    return has_values.sum(axis=-1), same.sum(axis=-1)


def is_copy(common: int, same: int) -> bool:
    """Return whether so many equal samples among those in common show a copy."""
    return common >= 2 and same >= MIN_ALIKE_SHARE * common
