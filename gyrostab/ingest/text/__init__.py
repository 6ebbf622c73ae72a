"""Text logs: layout, and conversion of cells to numbers."""
