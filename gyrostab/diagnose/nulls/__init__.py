"""Null records: block statistics of noise alone, and their scores."""
