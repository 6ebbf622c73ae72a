"""The cases of the blind test: what is drawn, injected or withheld, and the ground truth that is committed."""
