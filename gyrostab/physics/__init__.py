"""Physical effects of a fiber-optic gyro, one module per family; see `registry`.

How each effect looks in a recording, and what it is confused with: docs/physics/README.md.
"""
