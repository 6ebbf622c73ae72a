"""Dynamic Allan variance from sums of squared second differences, with degrees of freedom."""
