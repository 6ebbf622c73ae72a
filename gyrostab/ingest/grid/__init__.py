"""Raw rows to a regular log: sampling rate, place of every row, gaps."""
