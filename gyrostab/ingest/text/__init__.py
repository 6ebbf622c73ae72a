"""Text logs: their layout, and cells to numbers."""
