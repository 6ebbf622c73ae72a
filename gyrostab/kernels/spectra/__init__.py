"""Periodograms of blocks with gaps, their expectation, and outliers."""
