"""Statistics of samples: moments, counts and outliers."""
