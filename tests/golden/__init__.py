"""Reference outputs of the whole program, compared before and after a change of structure."""
