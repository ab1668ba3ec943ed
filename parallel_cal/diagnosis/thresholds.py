"""Limits that decide in a diagnosis, each with its meaning."""

from math import log

from parallel_cal.base.confidence import SIGNIFICANCE_LEVEL

# What is no chance
EFFECT_SIGNIFICANCE_LEVEL = (
    SIGNIFICANCE_LEVEL  # p-value: of an effect over the whole catalogue (Holm), of structure
)
REPLICATE_CONTRADICTION_LEVEL = (
    1e-4  # p-value of replicates, before they are believed instead of a stated noise
)
CERTAINTY_LEVEL = (
    1e-8  # p-value of what is there, though residuals are inside their noise without it
)
OUTLIER_SIGNIFICANCE_LEVEL = 1e-3  # p-value of an outlier, over the whole data set
MIN_INFLUENTIAL_COOKS_DISTANCE = (
    1.0  # Cook's distance: without the sample, estimates move by about their sigma
)
MAX_ERROR_TO_NOISE_RATIO = (
    1.2  # of the noise alone: an error at poses left out that is larger deserves a word
)
MAX_EXCESS_SIGMAS = 2.0  # sigmas of chi2/dof: within them an excess over the noise says nothing

# What the data can show at all
MIN_COLUMN_REMAINDER = 3e-3  # of a unit column: what projection leaves below is numerical rubbish
MIN_VISIBLE_SIGMAS = 0.1  # of all residuals, at typical size: ten times that is the most plausible
MIN_DOF = 10  # degrees of freedom: below, nothing can be said
MIN_REPLICATE_DOF = 8  # degrees of freedom: with fewer the noise is known to 25 % at best
MAX_HELD_COORDINATE_SIGMAS = 2.0  # sigmas rms of coordinates that a model holds: it lacks freedoms

# Which effects are looked at, and taken
MAX_EFFECTS = 4  # added in one diagnosis
MAX_REFITTED_CANDIDATES = (
    5  # best significant candidates that are identified and judged at poses left out
)
MAX_LOG_P_TO_REFINE = log(1e-3)  # log p: a scanned setting is refined between its neighbours
EQUAL_FIT_LOG_P = 4.5  # of log p, three sigmas: two settings of a scan that are closer fit alike
MAX_MISTRUSTED_SHARE = 0.25  # of the samples: so many at most does a robust loss set aside
SHUFFLES = 39  # copies with the condition shuffled between samples ...
EQUAL_SHUFFLES_TO_STOP = 5  # ... until so many score as well, which more copies would not undo ...
MAX_EQUAL_SHUFFLES = 1  # ... of which so many may score as well, by chance
STRETCHES = 12  # of the session that are shuffled whole: noise may wander from sample to sample
MIN_SLOW_CORRELATION = (
    0.5  # correlation of neighbours in time: a condition that changes so may be taken for noise
)
MIN_EXPLAINED_SHARE = 0.7  # of the variance beyond the noise

# Where a verdict holds
REGION_MARGIN = (
    0.1  # of the measured box: so far outside it the model is still the one that was judged
)
MIN_POSES_BEYOND_REGION = 15  # of POOL poses in the workspace: fewer are no region of their own

# Which effects cannot be told from each other
MIN_CONFUSED_CORRELATION = 0.9  # canonical correlation above which two effects are one entry
MAX_SWAP_ERROR_RATIO = 1.05  # of the held-out error: a swap within it tells as good a story ...
MIN_FAMILY_MEMBERS = 3  # members of one family in an "A or B or C": it has a name of its own
MIN_SEPARATION_SIGMAS = 5.0  # ... unless the data tell the two apart by as many sigmas

# How a smooth field of the device is made, to hold effects of the robot against
CENTRES = 40  # places at which it has values of its own
FIELD_LENGTHS = (0.25, 0.4, 0.7, 1.2, 2.5)  # over which it changes, in standard deviations of place
FIELD_SIZES = (0.3, 1.0, 3.0, 10.0, 30.0)  # of it, in sigmas of a sample
MIN_LOG_EVIDENCE_GAIN = (
    5.0  # log of how much likelier one of two explanations is (Kass & Raftery 1995: 2 ln B > 10)
)
EFFECT_SIZES = (0.3, 1.0, 3.0)  # of the effects beside it, in tolerances

# How tests and pictures of what is left are made
NEIGHBOURS = 7  # of a sample, in Moran's I
PERMUTATIONS = 999  # of the samples, for its p-value
RESAMPLES = 200  # of the poses, for who is picked first
MIN_SIGNS_PER_SIDE = 5  # on either side of the median, for a runs test
WINDOW = 15  # samples of a rolling mean
MIN_VARIATION_RATIO = (
    20.0  # times what readings scatter: a place that varies by less is no place to look along
)
LEVELS = 5  # a quantity with so few values has a mean for each, and nothing rolls
LENGTHS = (0.15, 0.25, 0.4, 0.7, 1.2)  # of the map's smoothness, in standard deviations of place
ROUGHNESS = (0.1, 0.3, 1.0, 3.0)  # of the map: noise over smooth part, in variances
MAX_MAP_POSES = 400  # poses that the map is drawn from: its cost goes with their cube
MAX_RIVAL_SETTINGS = 5  # of a rival's scan: a plan is made against the one that is hardest to tell
POOL = 300  # reachable poses to choose from, to tell two effects apart
PLAN_SIZES = (20, 40, 60)  # chosen of them: as few as settle it,
PLAN_REACHES = (1.0, 2.0)  # times the workspace: what it cannot tell, poses further out may
TARGET_SEPARATION_SIGMAS = 7.0  # sigmas: two more than what is APART, for luck
