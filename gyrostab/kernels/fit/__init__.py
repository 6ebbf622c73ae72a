"""Covariance of Allan variances, and least squares with coefficients that cannot be negative, for many windows."""
