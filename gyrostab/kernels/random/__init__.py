"""Random series: ideal gyro noise and coloured processes, as means over each sample."""
