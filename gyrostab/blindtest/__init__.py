"""The blind test of the diagnosis: recordings with hidden effects, their ground truth committed before the diagnosis sees them.

The generator has physics of its own: it imports neither `gyrostab.physics` nor `gyrostab.simulate`,
`gyrostab.noise` or `gyrostab.diagnose`. A diagnosis that is right about these recordings is right
about more than its own formulas.
"""
