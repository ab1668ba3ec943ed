/* @robot@: direct and inverse problem of @what@.
 *
 * Written by parallel_cal @version@ from a model of sha256 @hash@.
 * Units: m, rad, s, kg, degC. C99, needs <math.h> alone; no allocation and no global state, so that
 * any number of threads may call. Rotations are row by row, R's columns {P}'s axes in {B}.
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
    @ROBOT@_INVALID_INPUT = 5   /* NaN or infinity was given; the answer is NaN */
};

/* What the robot's errors depend on. NULL stands for the values named here. */
typedef struct {
@conditions@
} @robot@_conditions;
#define @ROBOT@_NEUTRAL {@neutral@}

/* Joints and pose that belong together: an answer, and the start of the next problem. */
typedef struct {
    double joints[@ROBOT@_JOINTS]; /* @units@ */
    double position[3];            /* m */
    double rotation[9];
} @robot@_configuration;

/* Pose for joints; returns a status. `start` is an answer before or near this one (NULL: the
 * start of the model's home branch), `residual` (may be NULL) the norm of the closure, m. */
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

#ifdef __cplusplus
}
#endif
#endif
