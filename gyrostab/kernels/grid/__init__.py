"""Rows to samples: which row belongs to which sample of a uniform grid."""
