"""The run of the blind test: draw, commit, diagnose, score, publish."""
