"""File formats, one module each, found by the entry point group ``gyrostab.readers``."""
