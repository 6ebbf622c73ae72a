"""Where a recording and its simulation differ, and which physics is missing. See docs/method.md.

`core.diagnose` goes one way through the rooms: *reduction* reads the log once, *calibration* finds
the noise, *locating* compares the *views* with records of noise alone, *naming* selects *effects*
by their *gains* on held-out time, *modelling* fits them together, and *conclusion* says what was
found and how well it holds.
"""
