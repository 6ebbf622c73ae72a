"""Held-out evidence of designs, for many records at once."""
