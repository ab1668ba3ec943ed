"""Measuring set-ups, one a file; the file's name is the set-up's name."""
