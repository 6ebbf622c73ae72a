"""Where a recording and its simulation differ, and which physics is missing. See docs/method.md."""
