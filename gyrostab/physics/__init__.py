"""Physical effects of a fiber-optic gyro, one module per family; see `registry`."""
