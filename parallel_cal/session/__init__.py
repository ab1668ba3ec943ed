"""A calibration as it goes on: its steps, each judged before it is taken."""
