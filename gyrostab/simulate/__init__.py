"""Simulated logs: noise, environment and physical effects, from a model.

A simulation is a log like any other (see `gyrostab.schema`): every command and function takes it.
"""

from gyrostab.simulate.channels import combine
from gyrostab.simulate.core import simulate
from gyrostab.simulate.model import Model, read_model
from gyrostab.simulate.noise import make_noise

__all__ = ["Model", "combine", "make_noise", "read_model", "simulate"]
