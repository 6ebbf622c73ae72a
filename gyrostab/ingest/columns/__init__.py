"""Convert the columns of any file to a raw log: names, units, stamps, columns beyond memory."""
