"""Limits that decide in an identification, each with its meaning."""

# Warnings about a result
MAX_MOVED_TOLERANCES = 5.0  # tolerances: a warning names a parameter that moved further
MAX_HELD_ERROR_TO_NOISE_RATIO = (
    3.0  # of the noise: above, a coordinate that the model holds does move
)
MIN_TRUSTED_WEIGHT = 0.5  # a sample that a robust loss gives less weight than this is named
MIN_DOF_TO_JUDGE = 10  # degrees of freedom: with fewer, chi2/dof does not show what a fit leaves
MIN_SCALED_LENGTHS = 3  # not zero in the drawing: fewer share a factor by chance
MAX_UNSCALED_SHARE = 0.05  # of the squares of what moved lengths: the rest is one common factor
MIN_NAMED_SHARE = 0.1  # of a direction's largest part: smaller ones are not named
MAX_NAMED_DIRECTIONS = 6  # unidentifiable directions to name one by one; more are one sentence
MAX_NAMED_WEAK_DIRECTIONS = 2  # weakest directions to name: a document has all of them
MAX_NEGLIGIBLE_ERROR_RISE = (
    0.01  # of the validation error: the removal of an effect may cost so much
)
# A factor that all lengths of a robot have in common, which a wrong size of a printed board causes
MIN_COMMON_SCALE_SIGMAS = 4.0
MIN_COMMON_SCALE = 2e-3  # nobody measures a printed board to less
UNKNOWN_SCALE = 0.3  # prior sigma of a factor that is looked for
UNKNOWN_PLACE = 100.0  # factor of the tolerances of a camera's place, which grows with the robot
MAX_REGION_SAMPLES = 5000  # of which the positions are predicted, to state their region
BLOCKS = 40  # stretches into which a continuous motion is cut, as if each were a pose

# Joint readings that no such robot shows
MOST_READINGS = 0.8  # of a joint's readings: a few outliers say nothing about their unit
MAX_SPAN = 3.0  # of a joint's range: wrong limits are not wrong by so much
MAX_DISTANCE = 10.0  # of a joint's range: no zero is so far off
MAX_ARC = 1.5  # of a joint's range: what readings span at most without whole turns
MIN_TURNS = 1.5  # whole turns: a crank that goes round once is no wrong unit
MIN_CORRELATION = 0.9  # of readings and inverse solutions, for their ratio to be a unit
SAME_UNIT = 0.05  # in the logarithm: by so much a ratio may differ from a unit's
# Joint readings whose scale the measured poses contradict
MIN_SCALE_SAMPLES, MAX_SCALE_SAMPLES = 10, 200  # more are not needed
MIN_SCALE_CORRELATION = 0.97  # of readings and inverse solutions; a wrong frame lowers it
MAX_SCALE_SPREAD = 0.25  # in the logarithm, between joints with the same mismatch
MAX_SCALE_MISMATCH = 1.9  # no gain of a drive is wrong by such a factor; a wrong pitch may be, by 2
MIN_POSE_SPAN = 0.05  # of a joint's range: less may be the geometry's error, not motion

# Of the motion (rms) of coordinates that the robot controls: what a fit leaves unexplained (median)
# It left up to 1.5 % in 45 sessions of 12 robots, with and without stated noise (most: a hexapod on
# strings, by motion capture), 4 to 7 % with the model of another robot, and 6 to 95 % where joints
# were coupled or poses were read by another convention.
MAX_UNEXPLAINED_SHARE = 0.03

# What the data determine
RELATIVE_RANK = 1e-6  # of the largest singular value, columns in units of tolerance
MIN_LOST_SHARE = 1e-6  # squared share of a parameter in unidentifiable directions
MIN_SIGMAS_PER_TOLERANCE = (
    1.0  # sigmas that one tolerance moves the residuals by: below, the direction is weak
)
UNSEEN = 1e-13  # of the largest variance: that fit did not determine directions below it
# smallest singular value, as a share of the best sample's:
MIN_DIRECT_SINGULAR_VALUE_RATIO = 0.2
MIN_INVERSE_SINGULAR_VALUE_RATIO = 1e-4
# samples nearer to a singularity are omitted; at direct ones two branches meet (5.3.4)

# Noise that nobody stated
GUESSED_NOISE_SHARE = 1e-5  # of the travel: of it only proportions may count, never the size
MIN_NOISE_SHARE = 0.01  # of the residual variance: an estimate is not smaller, to keep weights sane
MIN_NOISE_FACTOR = 1e-6  # of the guess: exact data would make weights infinite
MAX_NOISE_SHARE_SIGMA = 0.2  # standard error of that share: above, the data cannot separate it
MAX_NOISE_SAMPLES = 2000  # samples that estimate the noise: more would hardly improve it
MAX_NOISE_STEPS = 50  # of its estimation with a linearised model
MAX_NOISE_ROUNDS = 3  # estimations of the noise, each followed by a fit
CONVERGED_NOISE_RATIO = 1.01  # of standard deviations: smaller changes end the estimation

# Convergence
CONVERGED_STEP = 1e-8  # tolerances: smaller steps change nothing a person can measure
CONVERGED_GAIN = (
    1e-9  # of chi2: a step that promises less ends the search, however long (weak directions)
)
UNSEEN_GAIN = 1e-6  # of chi2: predicted gain of the next step below which a search has converged
# of chi2: if so many steps gain less, the search ends
STALLED_GAIN = 1e-6
STALLED_ITERATIONS = 10
MAX_DIRECTION_CHANGE = 1e-4  # rad: change of the weak directions below which the priors are final
MAX_DIRECTION_CHOICES = 4  # of these directions: more may lead along a curved valley for ever
FACTOR_STEP = 1e-9  # tolerances: of parameters that follow from linear factors
NEWTON_STEP = 1e-12  # m: of the coordinates that the closure is solved for
VARIANCE_STEPS = 20  # iterations for an unknown noise and the weak directions together
WEIGHT_STEP = 1e-6  # of a sample's weight under a robust loss

# What is counted with exact numbers: factors of a closure, parameters of a complete model
DRAWS = 400  # random configurations and parameters that distinguish factors
MIN_COLUMN_REMAINDER = 1e-9  # of a unit column: remainder after the factors before it
MIN_INDEPENDENT_SINGULAR_VALUE = (
    1e-11  # of the largest singular value, every column brought to length 1
)
MAX_CLOSED_RESIDUAL_M = 1e-11  # m: residual of a pose that counts as consistent
PART_OF_TRAVEL = 0.15  # of each joint's range, to both sides of home
FRAME_UNIT = 1e-3  # m, and rad at the mechanism's length: what a frame's error is counted in

# Joint readings from exchanged columns or of the other sign
MAX_GUESS_SAMPLES = 30
MAX_JOINTS_OF_ANY_SIGN = 6  # every combination of signs is tried
MAX_JOINTS_IN_ANY_ORDER = 4  # every order is tried
MAX_GUESSES_REFINED = 8  # of which the frames of the device are found exactly
MIN_REACHED_SHARE = 0.9  # of the poses, which the robot must reach ...
MIN_QUICK_SHARE = 0.3  # ... and which are found quickly where joints contradict each other
MAX_GUESS_SHARE = 0.25  # of the measured motion (rms) that the right readings leave unexplained
MIN_GUESS_ERROR_RATIO = 5.0  # of the errors with the given and with other readings
SAME_GUESS_ERROR_RATIO = 1.5  # of the errors of two guesses between which the poses do not decide

# Registration of a device
# times the pose error that tolerances explain, and times the error after registration
MIN_UNREGISTERED_ERROR_RATIO = 3.0
MIN_EXPLAINED_ERROR_RATIO = 10.0
# Rotation (rms) of a platform that no error of a robot explains, whatever its tolerances
MAX_UNCERTAIN_TILT_RAD = 0.1
MIN_REGISTRATION_POSES = 6  # different poses that judge a frame and a target
MAX_DISPLACEMENT_M = 4e-3  # of a frame or target that a workshop calls aligned
MAX_DISPLACEMENT_RAD = 0.07
# Share of the squared error that may remain after a registration: of any robot, and of an
# identified one
MAX_REMAINING_SHARE = 0.5
MAX_REMAINING_SHARE_IDENTIFIED = 0.25
OUTLIER_DISTANCE_RATIO = 6.0  # times the usual distance: such poses are ignored
MIN_PLACEMENT_POSES = 4  # that start a sensor which shows poses
# An error of the start, relative to the mechanism's length, from which other options are tried
MIN_DOUBTFUL_SHARE = 0.15
MIN_VARIANT_RATIO = 3.0  # by which other options must fit better to be believed
# Rotation (rms) of the platform from which the start determines a target's position on it
MIN_PLACEMENT_TILT_RAD = 0.02
IMAGE_POSE_STEPS = 2  # of Gauss-Newton from the predicted pose, which is near
MAX_IMAGE_POSE_SIGMA_RATIO = 3.0  # times the median: images that show their pose less precisely
MIN_IMAGE_NOISE_DOF = 50  # residuals of images that measure their noise to a tenth
MIN_IMAGE_NOISE_SHARE = 1e-3  # of the guess: images without noise leave only rounding errors
MAX_ROBOT_ERROR_STEPS = 100  # of Fisher scoring for one variance
MIN_CLEAR_BIC_GAIN = 10.0  # of what moved: a smaller difference does not decide
LSTSQ_RANK_TOLERANCE = (
    1e-9  # of the largest singular value: below, no pose determines the direction
)
MIN_FRAME_COLUMN_REMAINDER = (
    1e-4  # of a unit column: part of a frame's parameter that is independent of the robot's
)

# Usual sizes of effects as priors
CONTRADICTED_SIGMAS = 3.0  # of the prior: the data moved an effect further, so the prior yields
LOOSENING = 3.0  # times the usual size, at once
MAX_LOOSENINGS = 8  # of a prior that the data contradict: up to 6,561 times the usual size
# An effect of the device beyond so many of its tolerances is separated from the robot by the data
# alone. It is refused if it moves the robot further than so many times the error that it removes:
# refraction and leaning axes made the ratio 1.8 to 3, a scale that a yielding stand imitated 75.
# Axes eight times as large as usual made it 20 to 29. The covariance does not tell these from the
# stand, because it trusts the model: the robot moved by over 100 of its sigmas in both cases.
MAX_DEVICE_TOLERANCES = 5.0
MAX_SHIFT_TO_SHOWN_RATIO = 10.0

# Samples that contradict all others
MIN_OUTSTANDING_RATIO = 4.0  # of the typical rms residual: without such a sample, none is searched
MIN_OUTLIER_RATIO = 6.0  # of the typical rms residual, after a robust fit
MIN_OUTLIER_WEIGHT = 1e-4  # of a sample in the robust fit
MAX_OUTLIER_SHARE = 0.1  # of the samples: where more are far away, it is the model that fails
MAX_OUTLIER_FITS = 6  # without them, until the same samples are far away
OUTLIER_ROUNDS = 20  # of reweighting
