/* @robot@: direct and inverse problem of @what@.
 *
 * Written by parallel_cal @version@ from a model of sha256 @hash@.
 * Units: m, rad, s, kg, degC. C99, needs <math.h> alone; no allocation and no global state, so that
 * any number of threads may call. Rotations are row by row, R's columns {P}'s axes in {B}.
 *
@joint_table@
 */
#ifndef @ROBOT@_H
#define @ROBOT@_H

#ifdef __cplusplus
extern "C" {
#endif

#define @ROBOT@_JOINTS @n_joints@ /* @joints@ */

/* Status of an answer. */
enum {
    @ROBOT@_CONVERGED = 0,
    @ROBOT@_UNREACHABLE = 1,    /* nothing near; the answer is the nearest miss */
    @ROBOT@_SINGULAR = 2,       /* solved; errors are amplified more than 10^4 times */
    @ROBOT@_OUTSIDE_LIMITS = 3, /* solved; a joint is beyond its limits */
    @ROBOT@_NOT_CONVERGED = 4,
    @ROBOT@_INVALID_INPUT = 5,  /* NaN or infinity was given; the answer is NaN */
    @ROBOT@_EFFORT_EXCEEDED = 7, /* the allowed steps did not suffice; the answer is the last one */
    @ROBOT@_OTHER_BRANCH = 8 /* the answer closes, but is mirrored or turned over: no path without a
                              * singularity from home to it was found */
};

/* What the robot's errors depend on. NULL stands for the values named here. */
typedef struct {
@conditions@
} @robot@_conditions;
#define @ROBOT@_NEUTRAL {@neutral@}

/* Joints and pose that belong together: an answer, and the start of the next problem. */
typedef struct {
    double joints[@ROBOT@_JOINTS]; /* @units@: see above */
    double position[3];            /* m */
    double rotation[9];
@passive_member@} @robot@_configuration;

/* The model's numbers. A joint without a stated limit has an infinite one. */
extern const char @robot@_model_hash[65]; /* sha256 of the model file */
extern const char @robot@_joint_names[@ROBOT@_JOINTS][@name_size@];
extern const @robot@_configuration @robot@_home;
extern const double @robot@_joint_low[@ROBOT@_JOINTS], @robot@_joint_high[@ROBOT@_JOINTS];
extern const double @robot@_joint_velocity[@ROBOT@_JOINTS]; /* per s */
extern const double @robot@_joint_acceleration[@ROBOT@_JOINTS]; /* per s^2 */

/* Pose for joints; returns a status. `start` is an answer before or near this one and selects the
 * branch (NULL: the branch of home). Where it leads to nothing or by a long step to another branch, or
 * in the inverse problem to joints outside their limits, the answer is that of NULL if that one
 * converged inside the limits: joints may then jump to another branch. `residual` (may be NULL) is the norm of the
 * closure, m. */
int @robot@_direct(const double joints[@ROBOT@_JOINTS], const @robot@_conditions *at,
    const @robot@_configuration *start, @robot@_configuration *answer, double *residual);

/* Joints for a pose, of which @controls@ count and the rest is answered. NULL: home's. */
int @robot@_inverse(const double position[3], const double rotation[9],
    const @robot@_conditions *at, const @robot@_configuration *start,
    @robot@_configuration *answer, double *residual);

/* d (x y z, small turn about the base's axes) / d joints, 6 x JOINTS row by row, at an answer.
 * Returns 0, or @ROBOT@_SINGULAR where there is none. */
int @robot@_jacobian(const @robot@_configuration *answer, const @robot@_conditions *at,
    double jacobian[6 * @ROBOT@_JOINTS]);

/* d joints / d (x y z, small turn), JOINTS x 6; 0 for what the robot does not control. */
int @robot@_inverse_jacobian(const @robot@_configuration *answer, const @robot@_conditions *at,
    double jacobian[@ROBOT@_JOINTS * 6]);

/* As above, with at most `steps` steps of Levenberg and Marquardt's method and of paths from home,
 * for a bounded time: 0 allows Newton's method alone, which suffices from a start nearby. Where more
 * are needed, the status is @ROBOT@_EFFORT_EXCEEDED. The steps are those of one call, from `start`
 * and from NULL's together. The functions that are not capped allow @all_steps@. A step of a path
 * takes at most 4 iterations of Newton's method. Beside the steps, a call makes at most 8, and 4
 * where `start` is NULL (8 more for each of two paths from home). */
int @robot@_direct_capped(const double joints[@ROBOT@_JOINTS], const @robot@_conditions *at,
    const @robot@_configuration *start, int steps, @robot@_configuration *answer,
    double *residual);
int @robot@_inverse_capped(const double position[3], const double rotation[9],
    const @robot@_conditions *at, const @robot@_configuration *start, int steps,
    @robot@_configuration *answer, double *residual);

/* The Jacobian's rate of change while the joints move by `velocity`, 6 x JOINTS row by row: the
 * acceleration is jacobian * joint acceleration + rate * joint velocity. Conditions are constant.
 * Returns 0, or @ROBOT@_SINGULAR. */
int @robot@_jacobian_rate(const @robot@_configuration *answer, const @robot@_conditions *at,
    const double velocity[@ROBOT@_JOINTS], double rate[6 * @ROBOT@_JOINTS]);

/* Direction, travel and velocity of the joints, from their readings. */
typedef struct {
    double threshold[@ROBOT@_JOINTS]; /* a motion back by no more is noise, not a reversal */
    double direction[@ROBOT@_JOINTS]; /* sign of the last motion; 0 before the first */
    double travel[@ROBOT@_JOINTS];    /* signed, since the last reversal */
    double velocity[@ROBOT@_JOINTS];  /* per s */
    double reading[@ROBOT@_JOINTS], furthest[@ROBOT@_JOINTS], turned_at[@ROBOT@_JOINTS];
} @robot@_motion;
#define @ROBOT@_DIRECTION_THRESHOLD @threshold@ /* rad or m */

/* Begin at a reading, with the threshold above for all joints: no motion is known. Returns 0, or
 * @ROBOT@_INVALID_INPUT and changes nothing. */
int @robot@_motion_begin(@robot@_motion *motion, const double joints[@ROBOT@_JOINTS]);

/* Take the reading of every cycle, `period` s after the one before. Returns 0, or
 * @ROBOT@_INVALID_INPUT and changes nothing. */
int @robot@_motion_follow(@robot@_motion *motion, const double joints[@ROBOT@_JOINTS],
    double period);

/* Write those that the model needs into the conditions; the others stay. */
void @robot@_motion_conditions(const @robot@_motion *motion, @robot@_conditions *at);

#ifdef __cplusplus
}
#endif
#endif
