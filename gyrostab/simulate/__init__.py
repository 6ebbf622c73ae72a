"""Simulated logs: noise, environment and physical effects."""
