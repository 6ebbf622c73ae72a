"""Identify the effects that explain the differences, and what no effect explains."""
