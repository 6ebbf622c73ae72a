"""A log becomes block statistics: it is read once, and all later steps ask these."""
