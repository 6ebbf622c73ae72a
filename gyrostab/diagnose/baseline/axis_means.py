"""Block means of one axis: likelihood of their flicker, random walk and angle noise."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from scipy.optimize import Bounds, OptimizeResult, minimize

from gyrostab.arrays import Bools, Floats
from gyrostab.diagnose.evidence.products import marginalise, mean_products, scale_columns
from gyrostab.diagnose.evidence.wandering import RandomProcesses
from gyrostab.units import HOUR

#: K and B are tried up to this multiple of the scatter of neighbouring means. Design choice: far
#: above, because too low a limit makes a bias or angle noise of what is their noise.
MAX_SCATTER = 3.0
_MIN_MEANS = 4  # to tell K, B and angle noise apart
#: Variances of angle noise that are tried, as shares of one that makes all the scatter: less is not
#: visible next to white noise.
_ANGLE_RANGE = 0.03, 3.0
_SHORT_STEP = 1e-3  # of a logarithm, for gradients; far below any error, above rounding
_PRIOR_PRECISION = 1e-9  # of effects in the means, relative to one mean; nearly free


class AxisMeans(NamedTuple):
    """Block means of an axis, and what they are explained by next to flicker and random walk."""

    values: Floats  # (block, 1): means [degree hour-1]; anything where not present
    effects: Floats | None  # (block, column): designs of effects of any size
    variance: Floats  # (block,): their white variance [degree2 hour-2]
    step: float  # length of a block [s]
    present: Bools  # (block,)
    wander: RandomProcesses

    def log_likelihood(self, K: Floats, B: Floats) -> Floats:
        """Compute the log likelihood for every random walk [deg/h^1.5] and flicker [deg/h]."""
        columns = scale_columns(self.effects, len(self.values))
        products = mean_products(
            self.values,
            columns,
            variance=self.variance,
            step=self.step,
            K=K,
            B=B,
            present=self.present,
            wander=self.wander,
        )
        least_variance = np.maximum(self.variance[self.present].min(initial=1.0), 1e-300)
        precision = _PRIOR_PRECISION * np.eye(columns.shape[1]) / least_variance
        products = marginalise(products, columns.shape[1], precision)
        return np.asarray(-0.5 * (products.square[:, 0] + products.log_determinant))

    def noise_ranges(self, K: Floats, B: Floats) -> Floats:
        """Return the ends of the logarithms of K and B that are tried, (parameter, end).

        They are those of the given values, or larger ones as far as the means scatter.
        """
        scatter = MAX_SCATTER * np.diff(self.values[self.present, 0]).std()
        most = scatter * np.array([np.sqrt(HOUR / self.step), 1.0])
        return np.log([[K.min(), max(K.max(), most[0])], [B.min(), max(B.max(), most[1])]])

    def with_angle_noise(
        self, K: Floats, B: Floats, likelihood: Floats, least_nats: float
    ) -> AxisMeans:
        """Return the means with the likeliest angle noise, if it makes them more likely.

        Parameters
        ----------
        K, B, likelihood : ndarray, shape (point,)
            Random walk and flicker, and the log likelihood without angle noise. Larger ones are
            tried too, as far as the means scatter: they may explain what angle noise would.
        least_nats : float
            Log likelihood that angle noise must add [nats].
        """
        if self.present.sum() < _MIN_MEANS:
            return self
        scatter = float(np.diff(self.values[self.present, 0]).var())
        if scatter == 0.0:
            return self
        ends = self.noise_ranges(K, B)
        start = np.log([K[likelihood.argmax()], B[likelihood.argmax()]])
        without = maximise_likelihood(self._negative_likelihood, [start], ends)[0]
        # six of it are in the difference of two means
        angle = np.log(self.step**2 * scatter / 6.0)
        starts = [np.append(slow, angle) for slow in (without.x, ends.mean(axis=1))]
        ends = np.vstack([ends, angle + np.log(_ANGLE_RANGE)])
        with_angle = maximise_likelihood(self._negative_likelihood, starts, ends)[0]
        added_nats = without.fun - with_angle.fun
        return self._with_angle(with_angle.x[2]) if added_nats > least_nats else self

    def _with_angle(self, log_variance: float) -> AxisMeans:
        return self._replace(wander=self.wander._replace(angle=np.exp(np.array(log_variance))))

    def _negative_likelihood(self, points: Floats) -> Floats:
        """Return it for log K, log B and perhaps the log variance of the angle of every point."""
        K, B = np.exp(points[:, :2].T)
        if points.shape[1] == 2:
            return -self.log_likelihood(K, B)
        out = np.empty(len(points))
        for angle in np.unique(points[:, 2]):
            same = points[:, 2] == angle
            out[same] = -self._with_angle(angle).log_likelihood(K[same], B[same])
        return out


def maximise_likelihood(
    negative_likelihood: Callable[[Floats], Floats], starts: Iterable[Floats], ends: Floats
) -> list[OptimizeResult]:
    """Find the largest likelihood from several starts; the best first.

    Parameters
    ----------
    negative_likelihood : callable
        Its value (point,) for points (point, parameter).
    starts : iterable of ndarray, shape (parameter,)
    ends : ndarray, shape (parameter, 2)
        Ends of the ranges of the parameters, which are logarithms.
    """
    low, high = ends.T

    def add_gradient(point: Floats) -> tuple[float, Floats]:
        step = np.where(point + _SHORT_STEP <= high, _SHORT_STEP, -_SHORT_STEP)
        least, *shifted = negative_likelihood(np.vstack([point, point + np.diag(step)]))
        return float(least), (np.array(shifted) - least) / step

    peaks = [minimize(add_gradient, start, jac=True, bounds=Bounds(low, high)) for start in starts]
    return sorted(peaks, key=lambda peak: float(peak.fun))
