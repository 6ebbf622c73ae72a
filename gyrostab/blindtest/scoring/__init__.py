"""Score diagnoses against the ground truth, and compare them with other detectors."""
