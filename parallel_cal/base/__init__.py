"""What everything stands on: errors, files, rotations, compiled functions."""
