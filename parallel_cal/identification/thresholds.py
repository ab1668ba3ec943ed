"""Limits that decide in an identification, each with its meaning.

In brackets: in how many of 78 sessions a decision would have been another with half and with twice
the value (with the one session by name): ten tables of a foreign generator, the recordings of
`bags/`, the machines of `real/`, and 44 drawn by `bench.truth.probabilities`. A decision is one
comparison: where a search ends or a picture is thinned, no verdict follows from it. Of merged
limits all sessions count, at the values that they had. Without brackets no session compared
anything with the limit: tests and the sentence beside it do.
"""

# Warnings about a result
# tolerances: a parameter that moved further is named; the usual size of an effect of the device no
# longer separates it from the robot
MAX_MOVED_TOLERANCES = 5.0  # [30, 16]
# of the noise: above, a coordinate that the model holds does move
MAX_HELD_ERROR_RATIO = 3.0  # [0, 0]
MIN_TRUSTED_WEIGHT = 0.5  # a sample that a robust loss gives less weight than this is named
# degrees of freedom: with fewer, chi2/dof or replicates show the noise to 25 % at best
MIN_DOF = 8  # [0, 0]
MIN_SCALED_LENGTHS = 3  # not zero in the drawing: fewer share a factor by chance [0, 1: wam]
# of the squares of what moved lengths: the rest is one common factor
MAX_UNSCALED_SHARE = 0.05  # [0, 0]
MIN_NAMED_SHARE = 0.1  # of a direction's largest part: smaller ones are not named [8, 8]
# unidentifiable directions to name one by one; more are one sentence
MAX_NAMED_DIRECTIONS = 6  # [1, 1]
MAX_NAMED_WEAK_DIRECTIONS = 2  # weakest directions to name: a document has all of them
# of the validation error: the removal of an effect may cost so much
MAX_NEGLIGIBLE_ERROR_RISE = 0.01  # [6, 6]
# A factor that all lengths of a robot have in common, which a wrong size of a printed board causes
MIN_COMMON_SCALE = 2e-3  # nobody measures a printed board to less
UNKNOWN_TOLERANCES = 1e3  # sigma of a number of which nothing is known
# for a region, the noise, or where a law enters: more hardly change these
ENOUGH_SAMPLES = 3000  # [0, 0]
BLOCKS = 40  # stretches into which a continuous motion is cut, as if each were a pose [0, 0]

# Joint readings that no such robot shows
MOST_READINGS = 0.8  # of a joint's readings: a few outliers say nothing about their unit [0, 0]
MAX_SPAN = 3.0  # of a joint's range: wrong limits are not wrong by so much
MAX_DISTANCE = 10.0  # of a joint's range: no zero is so far off
MAX_ARC = 1.5  # of a joint's range: what readings span at most without whole turns
MIN_TURNS = 1.5  # whole turns: a crank that goes round once is no wrong unit
MIN_CORRELATION = 0.9  # of readings and inverse solutions, for their ratio to be a unit
SAME_UNIT = 0.05  # in the logarithm: by so much a ratio may differ from a unit's
# Joint readings whose scale the measured poses contradict
MIN_SCALE_SAMPLES, MAX_SCALE_SAMPLES = 10, 200  # more are not needed [1, 0: hangprinter_hp4]
MIN_SCALE_CORRELATION = 0.97  # of readings and inverse solutions; a wrong frame lowers it [0, 72]
MAX_SCALE_SPREAD = 0.25  # in the logarithm, between joints with the same mismatch [0, 0]
# no gain of a drive is wrong by such a factor; a wrong pitch may be, by 2
MAX_SCALE_MISMATCH = 1.9  # [73, 69]
MIN_POSE_SPAN = 0.05  # of a joint's range: less may be the geometry's error, not motion

# Of the motion (rms) of coordinates that the robot controls: what a fit leaves unexplained (median)
# It left up to 1.5 % in 45 sessions of 12 robots, with and without stated noise (most: a hexapod on
# strings, by motion capture), 4 to 7 % with the model of another robot, and 6 to 95 % where joints
# were coupled or poses were read by another convention.
MAX_UNEXPLAINED_SHARE = 0.03  # [2, 0]

# What the data determine
# of the largest singular value of exact columns: smaller ones are rounding errors; of chi2: so is
# a gain
ROUNDING = 1e-9
# of the largest singular value, columns in units of tolerance; of a parameter (squared share) in
# directions that are not determined
RELATIVE_RANK = 1e-6  # [4, 3]
# of a unit column: part of a frame's parameter that no parameter of the robot imitates. With 1e-6,
# the sigma of a Delta before a tracker two metres away was 28 times too large beyond its poses.
MIN_FRAME_COLUMN_REMAINDER = 1e-4
# sigmas that one tolerance moves the residuals by: below, the direction is weak
MIN_SIGMAS_PER_TOLERANCE = 1.0  # [8, 26]
# smallest singular value, as a share of the best sample's: samples nearer to a singularity are
# omitted by forward calibration, because two branches meet there (5.3.4)
MIN_DIRECT_SINGULAR_VALUE_RATIO = 0.2

# Noise that nobody stated
GUESSED_NOISE_SHARE = 1e-5  # of the travel: of it only proportions may count, never the size
MIN_NOISE_FACTOR = 1e-6  # of the guess: exact data would make weights infinite [0, 0]
# of the residual variance: an estimate is not smaller, to keep weights sane
MIN_NOISE_SHARE = 0.01  # [0, 0]
# standard error of that share: above, the data cannot separate it
MAX_NOISE_SHARE_SIGMA = 0.2  # [1, 1: hangprinter_hp4]
MAX_SCORING_STEPS = 100  # of Fisher scoring for variances
CONVERGED_NOISE_RATIO = 1.01  # of standard deviations: smaller changes end their estimation
# estimations of the noise, each followed by a fit: with a robust loss, eight make it three times as
# large (`test_a_robust_loss_estimates_the_noise_of_the_good_samples`)
MAX_NOISE_ROUNDS = 3

# Convergence
CONVERGED_STEP = 1e-8  # tolerances: smaller steps change nothing a person can measure [35, 34]
# of chi2, or of a weight: a search ends if its next step is predicted to gain less, if
# MAX_REPETITIONS steps gained less, or if weights change less
UNSEEN_CHANGE = 1e-6  # [9, 10]
# steps that gain nothing, fits with looser priors or without outliers: more may alternate for ever
MAX_REPETITIONS = 8  # [7, 4]
MAX_DIRECTION_CHANGE = 1e-4  # rad: change of the weak directions below which the priors are final
MAX_DIRECTION_CHOICES = 4  # of these directions: more may lead along a curved valley for ever
NEWTON_STEP = 1e-12  # m: of the coordinates that the closure is solved for [37, 57]
REWEIGHTINGS = 20  # of samples by their residuals, or of weak directions by an unknown noise

# Joint readings from exchanged columns or of the other sign
MAX_GUESS_SAMPLES = 30
# every combination of signs, or order, that joints may have; of more, only the likely ones are
# tried: 64 are the signs of six joints and more than the orders of four [1, 0: delta_tilting]
MAX_GUESSES_OF_A_KIND = 64
MAX_GUESSES_REFINED = 8  # of which the frames of the device are found exactly
MIN_REACHED_SHARE = 0.9  # of the poses, which the robot must reach ... [0, 1: delta_tilting]
MIN_QUICK_SHARE = 0.3  # ... and which are found quickly where joints contradict each other
# of the ranges of joints and positions, which no session exceeds by much
MAX_USED_SHARE = 1.5
MAX_GUESS_SHARE = 0.25  # of the measured motion (rms) that the right readings leave unexplained
MIN_GUESS_ERROR_RATIO = 5.0  # of the errors with the given and with other readings [0, 0]
SAME_GUESS_ERROR_RATIO = 1.5  # of the errors of two guesses between which the poses do not decide

# Registration of a device
# times the pose error that tolerances explain, or that other options of a sensor leave; and times
# the error after registration
MIN_UNREGISTERED_ERROR_RATIO = 3.0  # [0, 2]
MIN_EXPLAINED_ERROR_RATIO = 10.0  # [62, 21]
# different poses that judge a frame and a target
MIN_REGISTRATION_POSES = 6  # [0, 1: hangprinter_hp4]
MAX_DISPLACEMENT_M = 4e-3  # of a frame or target that a workshop calls aligned [2, 1]
MAX_DISPLACEMENT_RAD = 0.07  # [1, 1]
# Rotation (rms) of a platform that no error of a robot explains, whatever its tolerances
MAX_UNCERTAIN_TILT_RAD = 0.1  # [1, 1]
# Share of the squared error that may remain after a registration: of any robot, and of an
# identified one
MAX_REMAINING_SHARE = 0.5  # [3, 2]
MAX_REMAINING_SHARE_IDENTIFIED = 0.25
# Rotation (rms) of the platform from which the start determines a target's position on it
MIN_PLACEMENT_TILT_RAD = 0.02
MIN_FRAME_POSES = 4  # that determine the frames of a device or of a sensor [0, 0]
# An error of the start, relative to the mechanism's length, from which other options are tried
MIN_DOUBTFUL_SHARE = 0.15
MIN_IMAGE_NOISE_DOF = 50  # residuals of images that measure their noise to a tenth
MIN_IMAGE_NOISE_SHARE = 1e-3  # of the guess: images without noise leave only rounding errors
IMAGE_POSE_STEPS = 2  # of Gauss-Newton from the predicted pose, which is near
MAX_IMAGE_POSE_SIGMA_RATIO = 3.0  # times the median: images that show their pose less precisely

# Usual sizes of effects as priors
CONTRADICTED_SIGMAS = 3.0  # of the prior: the data moved an effect further, so the prior yields
LOOSENING = 3.0  # times the usual size, at once; MAX_REPETITIONS of them are 6,561 times

# An effect of the device beyond MAX_MOVED_TOLERANCES is separated from the robot by the data
# alone. It is refused if it moves the robot further than so many times the error that it removes:
# refraction and leaning axes made the ratio 1.8 to 3, a scale that a yielding stand imitated 75.
# Axes eight times as large as usual made it 20 to 29. The covariance does not tell these from the
# stand, because it trusts the model: the robot moved by over 100 of its sigmas in both cases.
MAX_SHIFT_TO_SHOWN_RATIO = 10.0  # [0, 1]

# Samples that contradict all others
# of the typical rms residual, after such a sample drew the fit to itself: else none is searched
MIN_OUTSTANDING_RATIO = 4.0
MIN_OUTLIER_RATIO = 6.0  # of the typical rms residual, or of the typical distance of poses [61, 14]
# of the samples: where more are far away, it is the model that fails
MAX_OUTLIER_SHARE = 0.1  # [1, 0]
