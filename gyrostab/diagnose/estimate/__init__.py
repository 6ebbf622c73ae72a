"""Fit the identified effects and the noise together, and limit the sizes of all others."""
