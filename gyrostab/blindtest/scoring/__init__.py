"""Scores of a diagnosis against the ground truth, beside those of two baseline detectors."""
