"""Periodograms of blocks with gaps, and their expectation."""
