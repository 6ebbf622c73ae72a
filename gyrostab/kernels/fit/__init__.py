"""Covariance of Allan variances, and non-negative least squares for many windows at a time."""
