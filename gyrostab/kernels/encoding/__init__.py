"""Text rows to numbers, and numbers to fewer bytes and back."""
