/* A controller's loop at 1 kHz around @robot@.c: Cartesian set points to joints, with speed and
 * acceleration feed-forward, and encoder readings to the pose. Nothing in it allocates memory.
 * Replace read_encoders, write_joints and set_point by your own. */
#include "@robot@.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

#define NQ @ROBOT@_JOINTS
#define PERIOD 1e-3     /* s */
#define STEPS 10        /* of the careful method in one call: bounds the time of a cycle */
#define AMPLITUDE @amplitude@ /* m */
#define MAX_MOVE 0.1    /* rad or m in a cycle: a joint that is further away jumped to a branch */

static double encoders[NQ]; /* this robot follows its commands at once */
static void read_encoders(double *joints) { memcpy(joints, encoders, sizeof encoders); }
static void write_joints(const double *joints) { memcpy(encoders, joints, sizeof encoders); }

/* A circle about home: position, its velocity and acceleration (x y z, rotation about x y z). */
static void set_point(double t, double *position, double *velocity, double *acceleration)
{
    double w = 6.283185307179586, s = sin(w * t), c = cos(w * t);
    memcpy(position, @robot@_home.position, 3 * sizeof *position);
    position[0] += AMPLITUDE * (1 - c), position[1] += AMPLITUDE * s;
    velocity[0] = AMPLITUDE * w * s, velocity[1] = AMPLITUDE * w * c;
    acceleration[0] = AMPLITUDE * w * w * c, acceleration[1] = -AMPLITUDE * w * w * s;
}

/* to (rows) = M (rows, columns) v */
static void product(int rows, int columns, const double *M, const double *v, double *to)
{
    for (int i = 0; i < rows; ++i) {
        to[i] = 0;
        for (int j = 0; j < columns; ++j) to[i] += M[i * columns + j] * v[j];
    }
}

int main(void)
{
    @robot@_configuration command = @robot@_home, pose = @robot@_home;
    @robot@_conditions now = @ROBOT@_NEUTRAL;
    @robot@_motion motion;
    double J[6 * NQ], rate[6 * NQ], inverse[NQ * 6], q[NQ], speed[NQ], feed[NQ];
    double r[3], v[6] = {0}, a[6] = {0}, bent[6], worst = 0, peak = 0;
    long failures = 0;
    memcpy(encoders, command.joints, sizeof encoders);
    @robot@_motion_begin(&motion, encoders);
    for (long cycle = 0; cycle < 2000; ++cycle) {
        read_encoders(q);
        if (@robot@_motion_follow(&motion, q, PERIOD)) return 1; /* a reading was not finite */
        @robot@_motion_conditions(&motion, &now);
        if (@robot@_direct_capped(q, &now, &pose, STEPS, &pose, 0)) ++failures;
        for (int i = 0; i < 3 && cycle; ++i)
            worst = fmax(worst, fabs(pose.position[i] - command.position[i]));
        set_point((double)cycle * PERIOD, r, v, a);
        int status = @robot@_inverse_capped(r, @robot@_home.rotation, &now, &command, STEPS,
            &command, 0);
        status |= @robot@_jacobian(&command, &now, J);
        status |= @robot@_inverse_jacobian(&command, &now, inverse);
        product(NQ, 6, inverse, v, speed);
        status |= @robot@_jacobian_rate(&command, &now, speed, rate);
        for (int i = 0; i < NQ && cycle; ++i) /* the first cycle moves to the start */
            status |= !(fabs(command.joints[i] - q[i]) < MAX_MOVE);
        if (status) { /* never command a jump, or what was not solved: stop here, and hold */
            ++failures;
            break;
        }
        product(6, NQ, rate, speed, bent);
        for (int i = 0; i < 6; ++i) bent[i] = a[i] - bent[i];
        product(NQ, 6, inverse, bent, feed); /* feed-forward: joint speeds and accelerations */
        for (int i = 0; i < NQ; ++i) peak = fmax(peak, fabs(feed[i]));
        write_joints(command.joints);
    }
    printf("failures %ld worst %.3g acceleration %.3g\n", failures, worst, peak);
    return failures > 0;
}
