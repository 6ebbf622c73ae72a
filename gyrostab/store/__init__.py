"""The working store: how long variables of a log are written in chunks and read lazily.

One chunk holds about 20 minutes of one axis. What a source delivered as integers is kept as
integers with their factor, if that gives back the same doubles. A chunk that is missing or damaged
becomes a gap, and a warning says where.
"""
