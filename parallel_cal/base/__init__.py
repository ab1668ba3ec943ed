"""The base of all rooms: errors, files, rotations, compiled functions."""
