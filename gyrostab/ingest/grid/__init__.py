"""Convert raw rows to a regular log: sampling rate, sample of every row, gaps."""
