"""Limits that decide in a discovery, each with its meaning."""

# Screening: where an error enters and on what it depends, without a formula
SPLINES = 8  # columns of one driver: enough for a cubic law with a saturation
FINE_SPLINES = 24  # columns of a joint's own reading: enough for a dent of a twentieth of the range
MAX_CHUNK_NUMBERS = 1 << 23  # numbers in the largest array: 64 MB
WAVES = 240  # periods scanned of each joint's reading
LAGS_PER_OCTAVE = 4  # time constants that a law is refined with; one of them is screened
MIN_SAMPLES_PER_PERIOD = 2.5  # a shorter period is not determined by the samples

# Chance: sessions with the same noise and no law
NULL_SESSIONS = 200

# Which laws are reported
MAX_LAWS = 3
# log of how much likelier a law may be than one of the same quantities with fewer coefficients
MAX_SIMPLER_EVIDENCE = 2.0
MAX_FORMULAS = 20  # winners of the screening for which a formula is searched ...
MAX_FORMULA_LAG = 40.0  # ... if their evidence is at most so much smaller: a formula needs fewer
MAX_TERMS = 4  # of one formula; places from which a law of two drivers is split
REDRAWS = 40  # of the poses: a term whose sign is not CREDIBLE in them is removed
