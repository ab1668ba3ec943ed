"""Limits that decide in a diagnosis, each with its meaning.

In brackets: how many sessions depend on them, as in `identification/thresholds.py`.
"""

# Significance
# probability of what is named: a cause among those named for it, an effect whatever the noise is,
# the sign of a term; what has less than the rest of it does not count
CREDIBLE = 0.95
# of the variance of a slow mean, by correlated noise: less hardly changes a sigma
MIN_INFLATION = 1.5  # [1, 0: warmth]
# p-value below which replicates replace the stated noise
REPLICATE_CONTRADICTION_LEVEL = 1e-4  # [1, 0: delta_thermal]
# p-value below which residuals are no noise, since they depend on a condition
CERTAINTY_LEVEL = 1e-6  # [0, 0]
OUTLIER_SIGNIFICANCE_LEVEL = 1e-3  # p-value of an outlier, over the whole data set [2, 0]
# Cook's distance: without the sample, estimates move by about their sigma
MIN_INFLUENTIAL_COOKS_DISTANCE = 1.0  # [1, 0]
# times the noise floor: a larger validation error is reported
MAX_ERROR_TO_NOISE_RATIO = 1.2  # [5, 0]

# What the data can show
# of a unit column: a smaller remainder of a projection is rounding error
MIN_COLUMN_REMAINDER = 3e-3  # [11, 11]
# samples, rows or steps for each coefficient, spline or time constant: fewer do not determine it
SAMPLES_PER_NUMBER = 4
# of all residuals, at typical size: ten times that is the most plausible
MIN_VISIBLE_SIGMAS = 0.1  # [6, 8]

# samples that are diagnosed: a diagnosis of 10^5 takes a quarter of an hour. In 10^4 samples, a
# pattern with 5 % of the noise stands out by 0.05 * sqrt(10^4) = 5 sigmas. What only more samples
# could show changes the rms error by less than 0.2 %.
MAX_DIAGNOSED_SAMPLES = 10_000

# Which effects are tested and added
# best candidates that are refitted alone
MAX_REFITTED_CANDIDATES = 5  # [19, 4]
MAX_MISTRUSTED_SHARE = 0.25  # of the samples: a robust loss excludes at most so many
# correlation of neighbours in time: noise may imitate such a slow condition
MIN_SLOW_CORRELATION = 0.5  # [1, 8]

# Where a verdict holds
MIN_POSES_BEYOND_REGION = 15  # of POOL poses in the workspace: fewer are no region of their own

# Which effects are lookalikes
# canonical correlation above which two effects are one entry
MIN_CONFUSED_CORRELATION = 0.9  # [75, 75]
# of the validation error: an effect that lowers it by less is not proven by it
MAX_SWAP_ERROR_RATIO = 1.05  # [2, 56]
# members of one family in an "A or B or C": from here on, the family is named (delta_eccentricity)
MIN_FAMILY_MEMBERS = 3
# of an effect, beyond what a device's field explains: the robot has it, whatever the device
MIN_SEPARATION_SIGMAS = 5.0  # [1, 0]

# Tests and plots of residuals
NEIGHBOURS = 7  # of a sample, in Moran's I [0, 0]
PERMUTATIONS = 999  # of the samples, for a p-value ...
ENOUGH_COPIES = 30  # ... until so many are as extreme: then it is known to a fifth [73, 72]
MIN_PERMUTATION_P = 1e-12  # the moments of permutations show no smaller one
WINDOW = 15  # samples of a rolling mean, or more if this gives more than MAX_WINDOWS of them
MAX_WINDOWS = 200
MAX_PROFILE_POINTS = 500  # at which a rolling mean is given
MAX_MAP_POSES = 400  # poses of the map: its cost grows with their cube [1, 1]
# times the scatter of readings: a coordinate that varies less is not tested
MIN_VARIATION_RATIO = 20.0  # [0, 0]
LEVELS = 5  # a quantity with so few values has one mean for each: nothing rolls or bends [2, 0]
LENGTHS = (0.15, 0.25, 0.4, 0.7, 1.2)  # of the map's smoothness, in standard deviations of place
ROUGHNESS = (0.1, 0.3, 1.0, 3.0)  # of the map: noise over smooth part, in variances
POOL = 300  # reachable poses to select from, to decide between effects
MAX_PLANNED_POSES = 60  # of which the fewest are selected that are expected to decide
PLAN_REACHES = (1.0, 2.0)  # times the workspace: poses outside it may separate more

# Robot or device
# of an effect, or of the evidence for a law: if the other side explains as much, it may err
MIN_RIVAL_SHARE = 0.8
MAX_DEGREE = 3  # of a spline, and of a polynomial in one quantity; in several, one more altogether
