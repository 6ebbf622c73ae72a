"""Locate where recording and simulation differ, by thresholds from null records."""
