"""What the effects of the registry predict for a reduced record, and how well each does it."""
