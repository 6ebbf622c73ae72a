"""The commands, one module for each group. A new one is one more file here; ``sort_key`` is its place in the help."""
