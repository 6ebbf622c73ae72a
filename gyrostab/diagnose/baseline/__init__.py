"""The stationary noise that a record is compared with."""
