"""Logs to dynamic Allan variance, and from there to the five noise coefficients."""
