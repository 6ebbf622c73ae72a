"""Cases of the blind test: plans, recordings, injections and committed ground truths."""
