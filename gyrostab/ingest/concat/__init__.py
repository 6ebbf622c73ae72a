"""Concatenate regular logs lazily: their samples on one grid, with one table of gaps."""
