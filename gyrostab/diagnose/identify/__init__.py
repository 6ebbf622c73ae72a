"""Which effects explain the difference, what cannot be told, and what is unknown."""
