"""Where recording and simulation differ, against records of noise alone."""
