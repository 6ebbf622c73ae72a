"""Uniform time axes, durations as users write them, and the clock for histories."""
