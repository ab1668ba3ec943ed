"""Limits that decide in a diagnosis, each with its meaning."""

# Significance
# probability of what is named: a cause among those named for it, an effect whatever the noise is,
# the sign of a term; with less than the rest of it, something is left out of account
CREDIBLE = 0.95
# of the variance of a slow mean, by correlated noise: less hardly changes a sigma
MIN_INFLATION = 1.5
# p-value below which what was stated is contradicted: replicates replace the stated noise, "this is
# noise" is wrong if residuals depend on a condition, and an effect counts within the noise
CERTAINTY_LEVEL = 1e-6
OUTLIER_SIGNIFICANCE_LEVEL = 1e-3  # p-value of an outlier, over the whole data set
MIN_INFLUENTIAL_COOKS_DISTANCE = (
    1.0  # Cook's distance: without the sample, estimates move by about their sigma
)
MAX_ERROR_TO_NOISE_RATIO = 1.2  # times the noise floor: a larger validation error is reported

# What the data can show
MIN_COLUMN_REMAINDER = (
    3e-3  # of a unit column: a smaller remainder of a projection is rounding error
)
# samples, rows or steps for each coefficient, spline or time constant: fewer do not determine it
SAMPLES_PER_NUMBER = 4
MIN_VISIBLE_SIGMAS = 0.1  # of all residuals, at typical size: ten times that is the most plausible


# Which effects are tested and added
# best candidates that are refitted alone, and settings of a rival that a plan separates from
MAX_REFITTED_CANDIDATES = 5
MAX_MISTRUSTED_SHARE = 0.25  # of the samples: a robust loss excludes at most so many
MIN_SLOW_CORRELATION = (
    0.5  # correlation of neighbours in time: noise may imitate such a slow condition
)
MIN_EXPLAINED_SHARE = 0.7  # of the variance above the noise floor

# Which effects are lookalikes
MIN_CONFUSED_CORRELATION = 0.9  # canonical correlation above which two effects are one entry
MAX_SWAP_ERROR_RATIO = 1.05  # of the validation error: an exchange within it fits as well ...
MIN_SEPARATION_SIGMAS = 5.0  # ... unless the data separate the two by as many sigmas

# Tests and plots of residuals
NEIGHBOURS = 7  # of a sample, in Moran's I
PERMUTATIONS = 999  # of the samples, for a p-value ...
ENOUGH_COPIES = 30  # ... until so many are as extreme: then it is known to a fifth
MIN_PERMUTATION_P = 1e-12  # the moments of permutations show no smaller one
WINDOW = 15  # samples of a rolling mean
MAX_SHOWN_POINTS = 400  # of a rolling mean; poses of the map: its cost grows with their cube
MIN_VARIATION_RATIO = (
    20.0  # times the scatter of readings: a coordinate that varies less is not tested
)
LEVELS = 5  # a quantity with so few values has one mean for each: nothing rolls or bends
LENGTHS = (0.15, 0.25, 0.4, 0.7, 1.2)  # of the map's smoothness, in standard deviations of place
ROUGHNESS = (0.1, 0.3, 1.0, 3.0)  # of the map: noise over smooth part, in variances
POOL = 300  # reachable poses to select from, to separate two effects
PLAN_SIZES = (20, 40, 60)  # selected poses: as few as separate the effects
PLAN_REACHES = (1.0, 2.0)  # times the workspace: poses outside it may separate more

# Robot or device
# of an effect, or of the evidence for a law: if the other side explains as much, it may err
MIN_RIVAL_SHARE = 0.8
MAX_DEGREE = 3  # of a spline, and of a polynomial in one quantity; in several, one more altogether
