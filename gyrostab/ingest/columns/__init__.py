"""Columns of any file to a raw log: names, units, stamps, and columns that may be larger than memory."""
