"""The named effects fitted together, and the noise once more with them in the model."""
