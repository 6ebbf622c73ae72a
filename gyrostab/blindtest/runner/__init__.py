"""Run of the blind test: draw, commit, diagnose, score and publish."""
