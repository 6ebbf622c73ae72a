"""Reference outputs of the whole program, to compare before and after a change that must not alter results."""
