"""Blind test of the diagnosis on generated recordings with a committed ground truth.

The generator implements its physics independently: it does not import `gyrostab.physics`,
`gyrostab.simulate`, `gyrostab.noise` or `gyrostab.diagnose`. A diagnosis that is right about these
recordings does not merely reproduce its own formulas.
"""
