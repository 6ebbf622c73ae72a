"""Linear models of correlated series: likelihood, evidence, filters, smooth curves."""
