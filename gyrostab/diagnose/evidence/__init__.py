"""What a design explains on time that was held out, for many records at once."""
