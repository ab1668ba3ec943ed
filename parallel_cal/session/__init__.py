"""A calibration session: its steps, each judged before it is committed."""
