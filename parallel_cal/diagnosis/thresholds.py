"""Limits that decide in a diagnosis, each with its meaning."""

from parallel_cal.base.confidence import SIGNIFICANCE_LEVEL

# Significance
EFFECT_SIGNIFICANCE_LEVEL = (
    SIGNIFICANCE_LEVEL  # p-value: of an effect that is worth a refit, of structure
)
REPLICATE_CONTRADICTION_LEVEL = 1e-4  # p-value below which replicates replace the stated noise
# p-value below which residuals depend on a recorded condition: it contradicts "this is noise"
CONDITION_SIGNIFICANCE_LEVEL = 1e-6
# of the variance of a slow mean, by correlated noise: less hardly changes a sigma
MIN_INFLATION = 1.5
CERTAINTY_LEVEL = (
    1e-8  # p-value below which an effect counts although residuals are within the noise
)
OUTLIER_SIGNIFICANCE_LEVEL = 1e-3  # p-value of an outlier, over the whole data set
MIN_INFLUENTIAL_COOKS_DISTANCE = (
    1.0  # Cook's distance: without the sample, estimates move by about their sigma
)
MAX_ERROR_TO_NOISE_RATIO = 1.2  # times the noise floor: a larger validation error is reported
MAX_EXCESS_SIGMAS = 2.0  # sigmas of chi2/dof: a smaller excess over the noise means nothing

# What the data can show
MIN_COLUMN_REMAINDER = (
    3e-3  # of a unit column: a smaller remainder of a projection is rounding error
)
MIN_VISIBLE_SIGMAS = 0.1  # of all residuals, at typical size: ten times that is the most plausible
MIN_DOF = 10  # degrees of freedom: with fewer there is no verdict
MIN_REPLICATE_DOF = 8  # degrees of freedom: with fewer the noise is known to 25 % at best
MAX_HELD_COORDINATE_SIGMAS = (
    2.0  # sigmas rms of coordinates that a model holds: above, it lacks freedoms
)


# Which effects are tested and added
MAX_REFITTED_CANDIDATES = (
    5  # best significant candidates that are refitted and judged at held-out poses
)
EQUAL_FIT_LOG_P = 4.5  # of log p, three sigmas: closer settings of a scan fit equally well
MAX_MISTRUSTED_SHARE = 0.25  # of the samples: a robust loss excludes at most so many
MIN_SLOW_CORRELATION = (
    0.5  # correlation of neighbours in time: noise may imitate such a slow condition
)
# of chi2: an effect that its prior holds, and that lowers chi2 by less, explains nothing
MIN_CHI2_FALL = 1e-3
MIN_EXPLAINED_SHARE = 0.7  # of the variance above the noise floor

# Where a verdict holds
MIN_POSES_BEYOND_REGION = 15  # of POOL poses in the workspace: fewer are no region of their own

# Which effects are lookalikes
MIN_CONFUSED_CORRELATION = 0.9  # canonical correlation above which two effects are one entry
MAX_SWAP_ERROR_RATIO = 1.05  # of the validation error: an exchange within it fits as well ...
MIN_FAMILY_MEMBERS = 3  # members of one family in an "A or B or C": above, the family is named
MIN_SEPARATION_SIGMAS = 5.0  # ... unless the data separate the two by as many sigmas

# Tests and plots of residuals
NEIGHBOURS = 7  # of a sample, in Moran's I
PERMUTATIONS = 999  # of the samples, for a p-value ...
ENOUGH_COPIES = 30  # ... until so many are as extreme: then it is known to a fifth
MIN_PERMUTATION_P = 1e-12  # the moments of permutations show no smaller one
MIN_SIGNS_PER_SIDE = 5  # on either side of the median, for a runs test
WINDOW = 15  # samples of a rolling mean, or more if this gives more than MAX_WINDOWS of them
MAX_WINDOWS = 200
MAX_PROFILE_POINTS = 500  # at which a rolling mean is given
MIN_VARIATION_RATIO = (
    20.0  # times the scatter of readings: a coordinate that varies less is not tested
)
LEVELS = 5  # a quantity with so few values has one mean for each, not a rolling mean
LENGTHS = (0.15, 0.25, 0.4, 0.7, 1.2)  # of the map's smoothness, in standard deviations of place
ROUGHNESS = (0.1, 0.3, 1.0, 3.0)  # of the map: noise over smooth part, in variances
MAX_MAP_POSES = 400  # poses of the map: its cost grows with their cube
POOL = 300  # reachable poses to select from, to decide between effects
MAX_PLANNED_POSES = 60  # of which the fewest are selected that are expected to decide
PLAN_REACHES = (1.0, 2.0)  # times the workspace: poses outside it may separate more

# Several stations: a device whose smooth error leaves more than this share of an effect is excluded
MIN_SHARE_BEYOND_DEVICE = 0.2
MAX_FIELD_DEGREE = 4  # of the polynomials of a device's error
MIN_ROWS_PER_FIELD_COLUMN = 4  # rows of the residual for each of their coefficients
