"""Sums of squared second differences: the dynamic Allan variance, its counts and equivalent degrees of freedom."""
