"""Physical effects in the log of a fiber-optic gyro; one module for a family of effects, found by `gyrostab.physics.registry`."""
