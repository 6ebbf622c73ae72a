"""Mixtures of normal distributions of sizes, over a grid of noise coefficients."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr, ndtri

from gyrostab.arrays import Floats
from gyrostab.diagnose.evidence.products import Products


@dataclass(frozen=True)
class Mixture:
    """A mixture of normal distributions of some sizes."""

    log_weight: Floats  # (point,): not normalised
    mean: Floats  # (point, size)
    covariance: Floats  # (point, size, size)

    @property
    def evidence(self) -> float:
        """Log likelihood over all points, up to a constant."""
        return float(np.logaddexp.reduce(self.log_weight))

    def weights(self) -> Floats:
        """Return the probabilities of the points."""
        return np.asarray(np.exp(self.log_weight - np.logaddexp.reduce(self.log_weight)))

    def quantiles(self, tail: float) -> Floats:
        """Return the quantiles of each size at `tail` and ``1 - tail``, shape (2, size).

        NaN for a size that is not determined.

        Examples
        --------
        >>> mixture = Mixture(np.zeros(2), np.array([[10.0], [40.0]]), np.ones((2, 1, 1)))
        >>> mixture.quantiles(0.025).round(1).tolist()
        [[8.4], [41.6]]
        """
        weight = self.weights()[:, None]
        sd = np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))
        sd = np.where(np.isfinite(sd).all(axis=0), sd, np.nan)
        ends = []
        for share in (tail, 1.0 - tail):
            of_points = self.mean + float(ndtri(share)) * sd
            below, above = of_points.min(axis=0), of_points.max(axis=0)
            with np.errstate(invalid="ignore"):  # errors of 0, or unknown
                for _ in range(80):
                    middle = 0.5 * (below + above)
                    is_low = (weight * ndtr((middle - self.mean) / sd)).sum(axis=0) < share
                    below, above = np.where(is_low, middle, below), np.where(is_low, above, middle)
            ends.append(0.5 * (below + above))
        return np.array(ends)

    def moments(self) -> tuple[Floats, Floats]:
        """Return mean and covariance of the mixture."""
        weight = self.weights()
        mean = weight @ self.mean
        deviation = self.mean - mean
        return mean, np.einsum("g,gij->ij", weight, self.covariance) + np.einsum(
            "g,gi,gj->ij", weight, deviation, deviation
        )


def products_mixture(products: Products, log_weight: Floats, *, ridge: float = 1e-9) -> Mixture:
    """Return the sizes of free columns at each point of a grid, from the products of one record.

    `log_weight` (point,) is the log prior of the grid, `ridge` the share of the trace of the Gram
    matrix on its diagonal, against singular columns.
    """
    cross = products.cross[:, :, 0]
    trace = np.trace(products.gram, axis1=1, axis2=2)[:, None, None]
    gram = products.gram + ridge * np.eye(cross.shape[1]) * (1.0 + trace)
    covariance = np.linalg.inv(gram)
    mean = np.einsum("gij,gj->gi", covariance, cross)
    misfit = products.square[:, 0] - (mean * cross).sum(axis=1)
    log = log_weight - 0.5 * (misfit + products.log_determinant + np.linalg.slogdet(gram)[1])
    return Mixture(log, mean, covariance)
