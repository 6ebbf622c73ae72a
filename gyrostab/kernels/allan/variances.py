"""The variances of a surface: which differences of the angle they square and average.

=========  ==========================================  ==========  ==========
name       difference at m                             divisor     samples
=========  ==========================================  ==========  ==========
avar       second difference of the angle              ``2 k^2``   ``2 k``
hadamard   third difference of the angle               ``6 k^2``   ``3 k``
modified   sum of k consecutive second differences     ``2 k^4``   ``3 k - 1``
=========  ==========================================  ==========  ==========

The sum of k second differences is the third difference of the running sum of the angle, so only two
patterns occur.

References
----------
NIST SP 1065, sections 5.2.4 (modified Allan) and 5.2.10 (overlapping Hadamard variance).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gyrostab.arrays import Floats, Ints


class Variance(NamedTuple):
    """One variance: its name in texts, order of its differences, and whether angles are summed."""

    text: str
    order: int
    summed: bool

    def spans(self, ks: Ints) -> Ints:
        """Samples that a term uses; a window has ``window - span + 1`` terms."""
        return self.order * ks - self.summed

    def divisors(self, ks: Ints) -> Floats:
        """Divisor of a mean squared difference, for a sampling interval of 1."""
        squares = ks.astype(np.float64) ** 2
        return 2.0 * squares**2 if self.summed else (6.0 if self.order == 3 else 2.0) * squares


#: The variances by the names that `gyrostab.davar` takes.
VARIANCES = {
    "avar": Variance("Allan", 2, summed=False),
    "hadamard": Variance("Hadamard", 3, summed=False),
    "modified": Variance("modified Allan", 3, summed=True),
}
