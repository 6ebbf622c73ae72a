"""Numerical kernels: arrays in, arrays out; no labels, no files, no NaN in an inner loop."""
