/* LinuxCNC kinematics around @robot@.c (user space): loadrt @robot@_kins
 *
 * Build: halcompile --install @robot@_kins.c, with @robot@.c and @robot@.h beside it.
 * Machine units mm and degrees. A, B, C turn about x, then y, then z of the machine where the robot
 * controls its orientation; letters that it does not use take the joints behind its own.
 * Conditions are neutral.
 * In the .ini file, HOME_OFFSET and SCALE must be those with which the robot was recorded: this
 * component corrects the zeros and the scales of the joints itself. The exported machine.ini is for
 * LinuxCNC's built-in kinematics; with this component it would correct the zeros twice.
@recorded@ */
#include "rtapi.h"
#include "rtapi_app.h"
#include "hal.h"
#include "kinematics.h"

#include "@robot@.c"

#define MM 0.001
#define DEGREE 0.017453292519943295
#define ALL 9

static const double factors[@ROBOT@_JOINTS] = {@factors@}; /* of a machine unit, in m or rad */

/* The letters behind x y z that no joint of the robot's moves. */
static int passed_on(EmcPose *world, double **letter)
{
    double *all[6] = {&world->a, &world->b, &world->c, &world->u, &world->v, &world->w};
    const int first = @turns@ ? 3 : 0;
    int k;
    for (k = first; k < 6 && @ROBOT@_JOINTS + k - first < ALL; ++k)
        letter[k - first] = all[k];
    return k - first;
}

static int failed(int status)
{
    return status == @ROBOT@_CONVERGED || status == @ROBOT@_OUTSIDE_LIMITS ? 0 : -1;
}

int kinematicsForward(const double *joint, EmcPose *world,
    const KINEMATICS_FORWARD_FLAGS *fflags, KINEMATICS_INVERSE_FLAGS *iflags)
{
    double q[@ROBOT@_JOINTS], *letter[6];
    @robot@_configuration found;
    const double *R = found.rotation;
    int k, n;
    (void)fflags;
    (void)iflags;
    for (k = 0; k < @ROBOT@_JOINTS; ++k)
        q[k] = joint[k] * factors[k];
    if (failed(@robot@_direct(q, NULL, NULL, &found, NULL)))
        return -1;
    world->tran.x = found.position[0] / MM;
    world->tran.y = found.position[1] / MM;
    world->tran.z = found.position[2] / MM;
    if (@turns@) {
        world->a = atan2(R[7], R[8]) / DEGREE;
        world->b = atan2(-R[6], sqrt(R[0] * R[0] + R[3] * R[3])) / DEGREE;
        world->c = atan2(R[3], R[0]) / DEGREE;
    }
    n = passed_on(world, letter);
    for (k = 0; k < n; ++k)
        *letter[k] = joint[@ROBOT@_JOINTS + k];
    return 0;
}

int kinematicsInverse(const EmcPose *world, double *joint,
    const KINEMATICS_INVERSE_FLAGS *iflags, KINEMATICS_FORWARD_FLAGS *fflags)
{
    const double r[3] = {world->tran.x * MM, world->tran.y * MM, world->tran.z * MM};
    const double a = world->a * DEGREE, b = world->b * DEGREE, c = world->c * DEGREE;
    const double R[9] = {
        cos(c) * cos(b), cos(c) * sin(b) * sin(a) - sin(c) * cos(a),
        cos(c) * sin(b) * cos(a) + sin(c) * sin(a),
        sin(c) * cos(b), sin(c) * sin(b) * sin(a) + cos(c) * cos(a),
        sin(c) * sin(b) * cos(a) - cos(c) * sin(a),
        -sin(b), cos(b) * sin(a), cos(b) * cos(a)};
    double *letter[6];
    @robot@_configuration found;
    EmcPose copy = *world;
    int k, n;
    (void)iflags;
    (void)fflags;
    if (failed(@robot@_inverse(r, @turns@ ? R : NULL, NULL, NULL, &found, NULL)))
        return -1;
    for (k = 0; k < @ROBOT@_JOINTS; ++k)
        joint[k] = found.joints[k] / factors[k];
    n = passed_on(&copy, letter);
    for (k = 0; k < n; ++k)
        joint[@ROBOT@_JOINTS + k] = *letter[k];
    return 0;
}

KINEMATICS_TYPE kinematicsType(void)
{
    return KINEMATICS_BOTH;
}

static int comp_id;

int rtapi_app_main(void)
{
    comp_id = hal_init("@robot@_kins");
    if (comp_id < 0)
        return comp_id;
    hal_ready(comp_id);
    return 0;
}

void rtapi_app_exit(void)
{
    hal_exit(comp_id);
}

KINS_NOT_SWITCHABLE
EXPORT_SYMBOL(kinematicsType);
EXPORT_SYMBOL(kinematicsForward);
EXPORT_SYMBOL(kinematicsInverse);
MODULE_LICENSE("GPL");
