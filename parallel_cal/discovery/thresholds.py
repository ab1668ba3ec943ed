"""Limits that decide in a discovery, each with its meaning."""

# Screening: where an error enters and on what it depends, without a formula
SPLINES = 8  # columns of one driver: enough for a cubic law with a saturation
FINE_SPLINES = 24  # columns of a joint's own reading: enough for a dent of a twentieth of the range
MIN_SAMPLES_PER_FINE_SPLINE = 4  # with fewer samples, a local column describes single samples
MAX_DEGREE = 3  # of each of two drivers; together at most one more
MAX_LEVELS = 5  # a driver with so few values has polynomials through these values
MIN_VARIATION = 1e-9  # in SI: a driver that varies less is constant
MAX_SCREENED_SAMPLES = 3000  # evenly chosen of more; the proof uses all
MAX_CHUNK_NUMBERS = 1 << 23  # numbers in the largest array: 64 MB
WAVES = 240  # periods scanned of each joint's reading
MIN_SAMPLES_PER_LAG = 4  # steps between samples: a shorter time constant is not determined
LAGS_PER_OCTAVE = 4  # time constants that a law is refined with; one of them is screened
MIN_SAMPLES_PER_PERIOD = 2.5  # a shorter period is not determined by the samples

# Chance: sessions with the same noise and no law
NULL_SESSIONS = 200
MAX_FALSE_LAW_SHARE = 0.01  # of sessions without a law: a law is named beyond this quantile
MAX_CORRELATION_P = 0.05  # p-value: below it, drawn noise is correlated, or grows from the centre
MAX_OUTLIER_P = 1e-3  # p-value over all samples: below it, a sample is an outlier of drawn noise

# Which laws are reported
MAX_LAWS = 3
MAX_EQUAL_EVIDENCE = 5.0  # log of how much likelier one of two equally good laws may be
# log of how much likelier a law may be than one of the same quantities with fewer coefficients
MAX_SIMPLER_EVIDENCE = 2.0
MAX_EQUAL_MEMBERS_P = 0.01  # p-value below which the members of a law differ
# of the evidence for a law of the device: from it on, the robot may cause the error as well
MIN_RIVAL_EVIDENCE_SHARE = 0.8
MAX_FORMULAS = 20  # winners of the screening for which a formula is searched ...
MAX_FORMULA_LAG = 40.0  # ... if their evidence is at most so much smaller: a formula needs fewer
MAX_SPLITS = 4  # places from which a law of two drivers is split into laws of one driver
MAX_TERMS = 4  # of one formula
MIN_TERM_EVIDENCE = 4.0  # log of how much likelier a further term makes the data
REDRAWS = 40  # of the poses: a term that changes its sign in too many is removed
MIN_SIGN_SHARE = 0.95  # of the redraws in which a term has the same sign
