"""Null records: block statistics as noise alone would have made them, and the scores that they reach."""
