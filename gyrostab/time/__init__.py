"""Time: the computed uniform axis of a log, durations as users write them, and the clock for histories."""
