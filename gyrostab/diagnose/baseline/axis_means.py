"""Block means of one axis: likelihood of their flicker, random walk and angle noise."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gyrostab.diagnose.evidence.products import marginalise, mean_products, scale_columns
from gyrostab.diagnose.evidence.wandering import RandomProcesses
from gyrostab.diagnose.settings import Settings

Array = NDArray[np.float64]
#: Every so many values of K and B are tried with angle noise; saves time.
_STRIDE = 2
#: Variances of angle noise are tried from three times that of all the scatter down to a sixtieth of
#: it. Half a step from the likeliest one, the likelihood of 500 means falls by 1 nat.
_ANGLE_RATIO, _ANGLE_STEPS = 1.2, np.arange(26)
_PRIOR_PRECISION = 1e-9  # of effects in the means, over that of one mean; nearly free


class AxisMeans(NamedTuple):
    """Block means of an axis, and what they are explained by next to flicker and random walk."""

    values: Array  # (block, 1): means [degree hour-1]; anything where not present
    effects: Array | None  # (block, column): designs of effects of any size
    variance: Array  # (block,): their white variance [degree2 hour-2]
    step: float  # length of a block [s]
    present: NDArray[np.bool_]  # (block,)
    wander: RandomProcesses

    def log_likelihood(self, K: Array, B: Array) -> Array:
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

    def with_angle_noise(self, K: Array, B: Array, settings: Settings) -> AxisMeans:
        """Return the means with the likeliest angle noise, if they show any.

        K and B are ascending values of which pairs are tried with it.
        """
        scatter = np.diff(self.values[self.present, 0]).var() if self.present.any() else 0.0
        K, B = (part.ravel() for part in np.meshgrid(K[::_STRIDE], B[::_STRIDE]))
        variances = np.append(0.0, self.step**2 * scatter / 2.0 / _ANGLE_RATIO**_ANGLE_STEPS)
        trials = [
            self._replace(wander=self.wander._replace(angle=np.array(variance)))
            for variance in variances
        ]
        likelihood = [trial.log_likelihood(K, B).max() for trial in trials]
        best = int(np.argmax(likelihood))
        has_angle_noise = likelihood[best] - likelihood[0] > settings.ambiguous_nats
        return trials[best] if has_angle_noise else self
