"""The commands, one module per group; ``sort_key`` sets the place of a command in the help."""
