"""The baseline: the stationary noise that a recording is compared with."""
