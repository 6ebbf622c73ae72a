"""Predictions of the registered effects for a recording, and the evidence of each."""
