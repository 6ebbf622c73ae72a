"""gyrostab: gyro logs to dynamic Allan variance and time-varying noise coefficients."""
