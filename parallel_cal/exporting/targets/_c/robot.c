/* @robot@: see @robot@.h. Newton's method of third order with the model's own closure and effects;
 * where it does not arrive, Levenberg and Marquardt's. Every loop is bounded. */
#include "@robot@.h"

#include <math.h>
#include <string.h>

/* A status relies on NaN and infinity, which these options of a compiler declare impossible. */
#if (defined __FINITE_MATH_ONLY__ && __FINITE_MATH_ONLY__) || defined _M_FP_FAST
#error "@robot@ must know NaN: add -fno-finite-math-only behind -ffast-math or -Ofast, with MSVC /fp:precise"
#endif

#ifdef __TINYC__
#define MINUS_HUGE_VAL (-1.0 / 0.0) /* -HUGE_VAL is no constant for tcc */
#else
#define MINUS_HUGE_VAL (-HUGE_VAL)
#endif

#define NQ @n_joints@       /* joints */
#define NU @n_passive@       /* passive coordinates */
#define NX (NQ + 12 + NU)   /* a configuration: joints, position, rotation, passive coordinates */
#define NC (NQ + 6 + NU)    /* its changes: joints, position, small turn, passive coordinates */
#define ROWS @rows@         /* of the closure */
#define CONDITIONS @n_conditions@
#define MOST @most@         /* rows, or unknowns */
#define CONSTANTS @constants@ /* what depends on the given half alone */
#define EFFECTS @effects@
#define CLOSED @closed@     /* m: a closure below this is a solution */
#define SETTLED @settled@   /* m: a last step below this leaves no error */
#define LIMIT_ROUNDING @limit_rounding@ /* rad or m, that a solution may be wrong */
#define SMALL @singular@    /* smallest scaled singular value of a regular configuration */
#define SUSPECT @suspect@   /* a pivot below this asks for that value */
#define ITERATIONS 2 /* of third order; twice, where the first do not arrive */
#define DESCENTS @descents@
#define SLOW_STEPS @slow_steps@ /* a descent ends if so many leave more than this share */
#define SLOW_SHARE @slow_share@
#define PATH_STEPS @path_steps@
#define SAME_SOLUTION @same_solution@ /* m, rad */
#define FIRST_SHARE @first_share@ /* of a path, that shows its first direction */
#define MAX_BEND @max_bend@ /* change of the rate of motion from one step to the next, of this rate */
#define LEAST_STEP @least_step@ /* of a path; below it the branch has ended */

#define ALL_STEPS @all_steps@ /* descents from a start and home, then from three starts, all twice; four paths */

enum { DIRECT, INVERSE };

const char @robot@_model_hash[65] = "@hash@";
const char @robot@_joint_names[NQ][@name_size@] = {@joint_names@};
const @robot@_configuration @robot@_home = {{@home_joints@}, {@home_position@}, {@home_rotation@}@home_passive@};
const double @robot@_joint_low[NQ] = {@low@};
const double @robot@_joint_high[NQ] = {@high@};
const double @robot@_joint_velocity[NQ] = {@velocity@};
const double @robot@_joint_acceleration[NQ] = {@acceleration@};

static const double HOME[NX] = {@home@};
static const double PATH_HOME[2][NX] = {{@path_home_direct@}, {@path_home_inverse@}}; /* home, but next to a dead point of it */
static const double SCALE[NC] = {@scale@};     /* m that a unit moves things */
static const double TURN[NQ] = {@turn@};       /* by how much a joint may be off */
static const int UNKNOWN[2][MOST] = {{@unknown_direct@}, {@unknown_inverse@}};
static const int UNKNOWNS[2] = {@n_direct@, @n_inverse@};
static const int GIVEN[2][MOST] = {{@given_direct@}, {@given_inverse@}};
static const int GIVENS[2] = {@g_direct@, @g_inverse@};
static const int TURNS[2] = {@turns_direct@, @turns_inverse@}; /* the axis of unknown turns, 3 for any, -1 for none */
static const int MOTORS = @motors@; /* whether the direct problem has sides, to which the inverse one keeps */
static const int BLOCKS[2] = {@blocks_direct@, @blocks_inverse@}; /* of the slopes, 0 where home selects no side */
static const int BLOCK_SIZE[2][MOST] = {{@block_sizes_direct@}, {@block_sizes_inverse@}};
static const int BLOCK_SIGN[2][MOST] = {{@block_signs_direct@}, {@block_signs_inverse@}};
static const int BLOCK_ROW[2][MOST] = {{@block_rows_direct@}, {@block_rows_inverse@}};
static const int BLOCK_COLUMN[2][MOST] = {{@block_columns_direct@}, {@block_columns_inverse@}};
static const int BRANCHES[2] = {@branches_direct@, @branches_inverse@}; /* home selects one of several */
static const int AT_HOME[2] = {@at_home_direct@, @at_home_inverse@}; /* iterations begin there, or at its expansion */
static const double SHORT_STEP[NX] = {@short_step@}; /* a jump to another branch is longer */
static const double PASSIVE_TURN[NU + 1] = {@passive_turn@};
static const int TABLE[2] = {@constants_direct@, @constants_inverse@};

/* ------------------------------------------------ the model, generated from its expression */

static inline double square(double x) { return x * x; }
static inline double sign(double x) { return x < 0 ? -1 : x > 0 ? 1 : x; }

@generated@
/* ------------------------------------------------------------------ linear algebra */

/* A (n, n) x = b for m right sides, row by row, by elimination with pivots. Returns the sign of A's
 * determinant, 0 where singular. */
static int solved(int n, double *A, int m, double *b)
{
    int side = 1;
    for (int k = 0; k < n; ++k) {
        int best = k;
        for (int i = k + 1; i < n; ++i)
            if (fabs(A[i * n + k]) > fabs(A[best * n + k])) best = i;
        if (!(fabs(A[best * n + k]) > 0) || !isfinite(A[best * n + k])) return 0;
        if ((best != k) != (A[best * n + k] < 0)) side = -side;
        for (int j = 0; j < n && best != k; ++j) {
            double kept = A[k * n + j];
            A[k * n + j] = A[best * n + j], A[best * n + j] = kept;
        }
        for (int j = 0; j < m && best != k; ++j) {
            double kept = b[k * m + j];
            b[k * m + j] = b[best * m + j], b[best * m + j] = kept;
        }
        for (int i = k + 1; i < n; ++i) {
            double factor = A[i * n + k] / A[k * n + k];
            for (int j = k; j < n; ++j) A[i * n + j] -= factor * A[k * n + j];
            for (int j = 0; j < m; ++j) b[i * m + j] -= factor * b[k * m + j];
        }
    }
    for (int i = n - 1; i >= 0; --i)
        for (int j = 0; j < m; ++j) {
            for (int k = i + 1; k < n; ++k) b[i * m + j] -= A[i * n + k] * b[k * m + j];
            b[i * m + j] /= A[i * n + i];
        }
    return side;
}

/* J^T J, or J J^T where that is smaller; J (ROWS, n) row by row. Returns its size. */
static int gram(int n, const double *J, double *G)
{
    int size = n <= ROWS ? n : ROWS;
    for (int i = 0; i < size; ++i)
        for (int j = 0; j < size; ++j) {
            double sum = 0;
            for (int k = 0; k < (n <= ROWS ? ROWS : n); ++k)
                sum += n <= ROWS ? J[k * n + i] * J[k * n + j] : J[i * n + k] * J[j * n + k];
            G[i * size + j] = sum;
        }
    return size;
}

/* The smallest singular value of J (ROWS, n), by Jacobi's rotations of the smaller Gram matrix. */
static double smallest_singular_value(int n, const double *J)
{
    double G[MOST * MOST], least = HUGE_VAL;
    int size = gram(n, J, G);
    for (int sweep = 0; sweep < 12; ++sweep)
        for (int p = 0; p < size; ++p)
            for (int q = p + 1; q < size; ++q) {
                double angle = 0.5 * atan2(2 * G[p * size + q], G[q * size + q] - G[p * size + p]);
                double c = cos(angle), s = sin(angle);
                for (int k = 0; k < size; ++k) {
                    double a = G[k * size + p], b = G[k * size + q];
                    G[k * size + p] = c * a - s * b, G[k * size + q] = s * a + c * b;
                }
                for (int k = 0; k < size; ++k) {
                    double a = G[p * size + k], b = G[q * size + k];
                    G[p * size + k] = c * a - s * b, G[q * size + k] = s * a + c * b;
                }
            }
    for (int i = 0; i < size; ++i) least = fmin(least, G[i * size + i]);
    return sqrt(fmax(least, 0));
}

/* ------------------------------------------------------------------ configurations */

/* x turned about an axis of {B}, so that its rotation is nearest to that of `from`. */
static void turned_about(int axis, const double *from, double *x)
{
    int one = NQ + 3 + (axis + 1) % 3 * 3, other = NQ + 3 + (axis + 2) % 3 * 3;
    double c = 0, s = 0;
    for (int i = 0; i < 3; ++i) {
        c += from[one + i] * x[one + i] + from[other + i] * x[other + i];
        s += from[other + i] * x[one + i] - from[one + i] * x[other + i];
    }
    double size = sqrt(c * c + s * s);
    for (int i = 0; i < 3 && size > 0; ++i) {
        double u = x[one + i], v = x[other + i];
        x[one + i] = (c * u - s * v) / size, x[other + i] = (s * u + c * v) / size;
    }
}

/* The unknown coordinates of `from` into x. */
static void unknowns_of(int problem, const double *from, double *x)
{
    for (int j = 0; j < UNKNOWNS[problem]; ++j) {
        int column = UNKNOWN[problem][j];
        if (column < NQ + 3)
            x[column] = from[column];
        else if (NU && column >= NQ + 6)
            x[column + 6] = from[column + 6];
    }
    if (TURNS[problem] == 3)
        memcpy(x + NQ + 3, from + NQ + 3, 9 * sizeof *x);
    else if (TURNS[problem] >= 0)
        turned_about(TURNS[problem], from, x);
}

static int all_finite(int n, const double *x)
{
    for (int i = 0; i < n; ++i)
        if (!isfinite(x[i])) return 0;
    return 1;
}

/* The closure and its slopes by the unknowns, scaled to metres, (ROWS, n) row by row. */
static double closure_and_slopes(int problem, const double *x, const double *a, double *phi,
    double *J)
{
    double all[ROWS * NC], sum = 0;
    int n = UNKNOWNS[problem];
    closure(x, a, phi, all);
    for (int i = 0; i < ROWS; ++i) {
        sum += phi[i] * phi[i];
        for (int j = 0; j < n; ++j) {
            int column = UNKNOWN[problem][j];
            J[i * n + j] = all[column * ROWS + i] / SCALE[column];
        }
    }
    return sqrt(sum);
}

/* The norm of a closure, and of how far a configuration is out of reach although it is zero (m). */
static double residual_of(const double *x, const double *a, const double *phi)
{
    double beyond, sum = 0;
    overstretch(x, a, &beyond);
    for (int i = 0; i < ROWS; ++i) sum += square(phi[i] + beyond);
    return sqrt(sum);
}

/* x after a change: R <- exp(w) R. */
static void changed(const double *x, const double *change, double *to)
{
    const double *w = change + NQ + 3;
    double angle = sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2]);
    double s = angle > 1e-8 ? sin(angle) / angle : 1 - angle * angle / 6;
    double h = angle > 1e-8 ? 2 * square(sin(angle / 2) / angle) : 0.5;
    double W[9] = {0, -w[2], w[1], w[2], 0, -w[0], -w[1], w[0], 0};
    for (int i = 0; i < NQ + 3; ++i) to[i] = x[i] + change[i];
    for (int i = NQ + 6; i < NC; ++i) to[i + 6] = x[i + 6] + change[i];
    const double *R = x + NQ + 3;
    double turned[9];
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) {
            double sum = 0;
            for (int k = 0; k < 3; ++k) {
                double squared = 0;
                for (int l = 0; l < 3; ++l) squared += W[3 * i + l] * W[3 * l + k];
                sum += ((i == k) + s * W[3 * i + k] + h * squared) * R[3 * k + j];
            }
            turned[3 * i + j] = sum;
        }
    memcpy(to + NQ + 3, turned, sizeof turned);
}

/* x after a change of its unknowns (m). */
static void moved(int problem, const double *x, const double *step, double *to)
{
    double change[NC] = {0};
    for (int j = 0; j < UNKNOWNS[problem]; ++j) {
        int column = UNKNOWN[problem][j];
        change[column] = step[j] / SCALE[column];
    }
    changed(x, change, to);
}

/* The change from x to `to`; its turn is the largest row of the quaternion's products. */
static void change_between(const double *x, const double *to, double *change)
{
    double D[9], size = 0, angle;
    for (int i = 0; i < NQ + 3; ++i) change[i] = to[i] - x[i];
    for (int i = NQ + 6; i < NC; ++i) change[i] = to[i + 6] - x[i + 6];
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) {
            D[3 * i + j] = 0;
            for (int k = 0; k < 3; ++k)
                D[3 * i + j] += to[NQ + 3 + 3 * i + k] * x[NQ + 3 + 3 * j + k];
        }
    const double products[4][4] = {
        {1 + D[0] + D[4] + D[8], D[7] - D[5], D[2] - D[6], D[3] - D[1]},
        {D[7] - D[5], 1 + D[0] - D[4] - D[8], D[1] + D[3], D[2] + D[6]},
        {D[2] - D[6], D[1] + D[3], 1 - D[0] + D[4] - D[8], D[5] + D[7]},
        {D[3] - D[1], D[2] + D[6], D[5] + D[7], 1 - D[0] - D[4] + D[8]}};
    int best = 0;
    for (int k = 1; k < 4; ++k)
        if (products[k][k] > products[best][best]) best = k;
    const double *quaternion = products[best];
    for (int i = 1; i < 4; ++i) size += square(quaternion[i]);
    angle = 2 * atan2(sqrt(size), fabs(quaternion[0])) * (quaternion[0] < 0 ? -1 : 1);
    for (int i = 0; i < 3; ++i)
        change[NQ + 3 + i] = size > 0 ? angle / sqrt(size) * quaternion[i + 1] : 0;
}

/* Whether the determinant of each block of the slopes has the sign of home. */
static void sides_of_blocks(int problem, const double *x, const double *a, int *sides)
{
    double phi[ROWS], J[ROWS * MOST], A[MOST * MOST];
    closure_and_slopes(problem, x, a, phi, J);
    for (int block = 0, first = 0; block < BLOCKS[problem]; ++block) {
        int n = BLOCK_SIZE[problem][block];
        for (int i = 0; i < n; ++i)
            for (int j = 0; j < n; ++j)
                A[i * n + j] = J[BLOCK_ROW[problem][first + i] * UNKNOWNS[problem]
                    + BLOCK_COLUMN[problem][first + j]];
        sides[block] = BLOCK_SIGN[problem][block] * solved(n, A, 0, A) > 0;
        first += n;
    }
}

static int all_on_home_side(int problem, const double *x, const double *a)
{
    int sides[MOST];
    if (BLOCKS[problem]) sides_of_blocks(problem, x, a, sides);
    for (int i = 0; i < BLOCKS[problem]; ++i)
        if (!sides[i]) return 0;
    return 1;
}

/* Whether x is on home's side of the direct singularities, to which the inverse problem keeps. */
static int motors_on_home_side(int problem, const double *x, const double *a)
{
    return problem == DIRECT || !MOTORS || all_on_home_side(DIRECT, x, a);
}

static int on_home_side(int problem, const double *x, const double *a)
{
    return all_on_home_side(problem, x, a) && motors_on_home_side(problem, x, a);
}

/* Whether iterations from x, whose motors have no side if it is no solution, stayed on its side. */
static int stayed(int problem, const double *x, const double *end, const double *a)
{
    int sides[MOST], others[MOST];
    if (BLOCKS[problem]) {
        sides_of_blocks(problem, x, a, sides);
        sides_of_blocks(problem, end, a, others);
    }
    for (int i = 0; i < BLOCKS[problem]; ++i)
        if (sides[i] != others[i]) return 0;
    return motors_on_home_side(problem, end, a);
}

/* Whether two configurations are too near for a jump to another branch. */
static int short_step(const double *here, const double *there)
{
    for (int i = 0; i < NX; ++i)
        if (!(fabs(there[i] - here[i]) < SHORT_STEP[i])) return 0;
    return 1;
}

/* A machine that was homed stands exactly at its limits: rounding must not put solved joints outside. */
static int within_limits(int problem, int joint, double q)
{
    double rounding = problem == INVERSE ? LIMIT_ROUNDING : 0;
    return @robot@_joint_low[joint] - rounding <= q && q <= @robot@_joint_high[joint] + rounding;
}

/* Solved angles within half a turn of home, or one further where only that is inside the limits;
 * whether any was moved. */
static int turned_towards_home(int problem, double *x)
{
    int any = 0;
    for (int i = 0; problem == INVERSE && i < NQ; ++i) {
        if (!(TURN[i] > 0)) continue;
        double q = x[i] - TURN[i] * rint((x[i] - HOME[i]) / TURN[i]);
        double other = q - TURN[i] * sign(q - HOME[i]);
        if (!within_limits(problem, i, q) && within_limits(problem, i, other)) q = other;
        any |= q != x[i];
        x[i] = q;
    }
    return any;
}

/* ------------------------------------------------------------------ solving */

static int redundant(int problem) { return ROWS > UNKNOWNS[problem]; }

/* Newton's iterations until the last step is small; that step (m). With more rows than unknowns all
 * iterations are made: if the rows disagree, a small second step, with the slopes of the first, does
 * not show that the minimum is reached. */
static double iterated(int problem, int most, const double *constants, double *x, double *pivot)
{
    double length = HUGE_VAL, next[NX];
    for (int i = 0; i < most && (length >= SETTLED || redundant(problem)); ++i) {
        if (problem == DIRECT)
            direct_step(x, constants, next, &length, pivot);
        else
            inverse_step(x, constants, next, &length, pivot);
        memcpy(x, next, sizeof next);
    }
    return length;
}

static double norm_of_closure(int problem, const double *x, const double *constants)
{
    double phi[ROWS], squares = 0;
    if (problem == DIRECT)
        direct_residual(x, constants, phi);
    else
        inverse_residual(x, constants, phi);
    for (int i = 0; i < ROWS; ++i) squares += phi[i] * phi[i];
    return sqrt(squares);
}

static int is_closed(int problem, double residual)
{
    return redundant(problem) ? isfinite(residual) : residual < CLOSED;
}

static void prepare(int problem, const double *given, const double *a, double *before)
{
    if (problem == DIRECT)
        direct_prepare(given, a, before);
    else
        inverse_prepare(given, a, before);
}

/* The solution, in place of x, for what x holds as given; whether Newton's method finds it near x, on
 * home's side of the problem's singularities. */
static int settled_on_home_side(int problem, const double *a, double *x)
{
    double before[CONSTANTS + NX], begin[NX], pivot = 0;
    memcpy(begin, x, sizeof begin);
    prepare(problem, x, a, before);
    return iterated(problem, 2 * ITERATIONS, before, x, &pivot) < SETTLED
        && is_closed(problem, norm_of_closure(problem, x, before)) && pivot > 0
        && short_step(begin, x) && motors_on_home_side(problem, x, a);
}

/* x after a share of a change. */
static void changed_by(const double *x, double share, const double *change, double *to)
{
    double part[NC];
    for (int k = 0; k < NC; ++k) part[k] = share * change[k];
    changed(x, part, to);
}

static void rate_between(const double *x, const double *to, double share, double *rate)
{
    change_between(x, to, rate);
    for (int k = 0; k < NC; ++k) rate[k] /= share;
}

/* Whether a path goes on in about one direction. */
static int is_straight(const double *before, const double *after)
{
    double off = 0, size = 0;
    for (int k = 0; k < NC; ++k) {
        off += square(SCALE[k] * (after[k] - before[k]));
        size += square(SCALE[k] * after[k]);
    }
    return off < square(MAX_BEND) * size;
}

/* What a problem is given moves in a straight line from home to x, and its solution follows on home's
 * side of the singularities, also of those of `judge`: x is replaced by the last solution. Each step
 * begins where the one before points, and ends near there: where two sets of solutions cross, the path
 * ends, and does not turn into the other set. Whether it does not end before x. */
static int followed(int problem, int judge, const double *a, int *steps, double *x)
{
    double change[NC], rate[NC], last[NC], there[NX], ahead[NX], t = 0, step = 1;
    change_between(PATH_HOME[problem], x, change);
    memcpy(x, PATH_HOME[problem], NX * sizeof *x);
    if (!settled_on_home_side(problem, a, x)) return 0;
    changed_by(PATH_HOME[problem], FIRST_SHARE, change, there);
    unknowns_of(problem, x, there);
    settled_on_home_side(problem, a, there);
    rate_between(x, there, FIRST_SHARE, rate);
    for (int i = 0; i < PATH_STEPS && t < 1 && step >= LEAST_STEP; ++i) {
        double target = fmin(t + step, 1);
        if (--*steps < 0) return 0;
        changed_by(x, target - t, rate, ahead);
        changed_by(PATH_HOME[problem], target, change, there);
        unknowns_of(problem, ahead, there);
        int kept = settled_on_home_side(problem, a, there) && short_step(x, there)
            && (judge == problem || on_home_side(judge, there, a));
        if (kept) rate_between(x, there, target - t, last);
        if (kept && is_straight(rate, last)) {
            memcpy(x, there, sizeof there);
            for (int k = 0; k < NC; ++k) rate[k] = last[k] + (last[k] - rate[k]) / 2;
            t = target, step *= @path_growth@;
        } else {
            step /= 2;
        }
    }
    return t >= 1;
}

/* Levenberg-Marquardt from x, in place, with at most DESCENTS and `steps` steps; a status. */
static int descended(int problem, double *x, const double *a, int *steps, double *residual)
{
    double phi[ROWS], J[ROWS * MOST], trial_phi[ROWS], trial_J[ROWS * MOST], trial[NX];
    double gradient[MOST], A[MOST * MOST], step[MOST], damping = 1e-3, slope = 0, sizes[DESCENTS];
    int n = UNKNOWNS[problem];
    double size = closure_and_slopes(problem, x, a, phi, J);
    for (int round = 0; round < DESCENTS; ++round) {
        double length = 0;
        sizes[round] = *residual = size;
        if (round >= SLOW_STEPS && size > SLOW_SHARE * sizes[round - SLOW_STEPS]
            && !redundant(problem))
            break;
        for (int i = 0; i < n; ++i) {
            step[i] = 0;
            for (int k = 0; k < ROWS; ++k) step[i] -= J[k * n + i] * phi[k];
            for (int j = 0; j < n; ++j) {
                A[i * n + j] = i == j ? damping : 0;
                for (int k = 0; k < ROWS; ++k) A[i * n + j] += J[k * n + i] * J[k * n + j];
            }
        }
        if (--*steps < 0) return @ROBOT@_EFFORT_EXCEEDED;
        if (!solved(n, A, 1, step)) return @ROBOT@_NOT_CONVERGED;
        for (int i = 0; i < n; ++i) length += step[i] * step[i];
        if (sqrt(length) < 1e-15) break;
        moved(problem, x, step, trial);
        double found = closure_and_slopes(problem, trial, a, trial_phi, trial_J);
        if (found < size) {
            int improved = size - found > 1e-14;
            memcpy(x, trial, sizeof trial);
            memcpy(phi, trial_phi, sizeof phi);
            memcpy(J, trial_J, sizeof J);
            size = found, damping /= 10;
            if (!improved) break;
        } else {
            damping = fmax(damping * 10, 1e-12);
            if (damping > 1e12) break;
        }
    }
    for (int i = 0; i < n; ++i) {
        gradient[i] = 0;
        for (int k = 0; k < ROWS; ++k) gradient[i] += J[k * n + i] * phi[k];
        slope += gradient[i] * gradient[i];
    }
    int flat = sqrt(slope) < 1e-6 * size;
    *residual = size = residual_of(x, a, phi);
    if (size < CLOSED || (flat && redundant(problem))) return @ROBOT@_CONVERGED;
    return flat || size > 1e-6 ? @ROBOT@_UNREACHABLE : @ROBOT@_NOT_CONVERGED;
}

/* Undoes whole turns of the joints; an effect need not repeat after them. */
static int turned_back(int problem, double *x, const double *a, int status, int *steps,
    double *residual)
{
    double phi[ROWS], J[ROWS * MOST];
    if (turned_towards_home(problem, x) && EFFECTS != 0)
        return descended(problem, x, a, steps, residual);
    closure_and_slopes(problem, x, a, phi, J);
    *residual = residual_of(x, a, phi);
    return status;
}

/* Whether a path of the other coordinates joins a solution with home. */
static int joined(int problem, const double *x, const double *a, int *steps)
{
    double end[NX];
    if (!on_home_side(problem, x, a)) return 0;
    memcpy(end, x, sizeof end);
    if (!followed(!problem, problem, a, steps, end)) return 0;
    for (int i = 0; i < NX; ++i) {
        double off = end[i] - x[i], turn = i < NQ + 12 ? 0 : PASSIVE_TURN[i - NQ - 12];
        if (turn > 0) off -= turn * rint(off / turn);
        if (!(fabs(off) < SAME_SOLUTION)) return 0;
    }
    return 1;
}

static int singular_at(int problem, const double *x, const double *a)
{
    double phi[ROWS], J[ROWS * MOST];
    closure_and_slopes(problem, x, a, phi, J);
    return smallest_singular_value(UNKNOWNS[problem], J) < SMALL;
}

/* Levenberg-Marquardt from each of `count` starts, whose ends replace them. x is the first end that
 * is joined with home (of a start, where `warm`: the first solution), else the best one; a status. */
static int searched(int problem, int warm, int count, double starts[][NX], const double *a,
    int *steps, double *x, double *residual)
{
    int best = @ROBOT@_NOT_CONVERGED, any = warm || !BRANCHES[problem];
    *residual = HUGE_VAL;
    for (int i = 0; i < count; ++i) {
        double size = 0;
        if (!all_finite(NX, starts[i])) continue;
        int status = descended(problem, starts[i], a, steps, &size);
        if (status != @ROBOT@_EFFORT_EXCEEDED)
            status = turned_back(problem, starts[i], a, status, steps, &size);
        int closed = status == @ROBOT@_CONVERGED;
        if (closed && !any && singular_at(problem, starts[i], a)) status = @ROBOT@_SINGULAR;
        int found = closed && (any || status == @ROBOT@_SINGULAR || joined(problem, starts[i], a, steps));
        if (found || (best != @ROBOT@_OTHER_BRANCH && (closed || size < *residual))) {
            memcpy(x, starts[i], sizeof starts[i]);
            *residual = size;
            best = closed && !found ? (int)@ROBOT@_OTHER_BRANCH : status;
        }
        if (*steps < 0) return @ROBOT@_EFFORT_EXCEEDED;
        if (found) break;
    }
    return best;
}

/* The solution on the branch of home, if x is not known to be on it, or no solution: a path from home
 * leads to it, or a search from x, from where this path ends, and from home. */
static int on_home_branch(int problem, const double *given, const double *a, int *steps, double *x,
    double *residual)
{
    double ends[3][NX];
    memcpy(ends[0], x, sizeof ends[0]);
    memcpy(ends[2], given, sizeof ends[0]);
    memcpy(x, given, sizeof ends[0]);
    if (followed(problem, problem, a, steps, x))
        return turned_back(problem, x, a, @ROBOT@_CONVERGED, steps, residual);
    memcpy(ends[1], given, sizeof ends[0]);
    unknowns_of(problem, x, ends[1]);
    return searched(problem, 0, 3, ends, a, steps, x, residual);
}

/* x (in: the start, where `warm`) for what is given; a status. */
static int solve_once(int problem, const double *given, const double *a, int warm, int *steps,
    double *x, double *residual)
{
    double before[CONSTANTS + NX], begin[NX], pivot = 0, starts[2][NX];
    int status = @ROBOT@_CONVERGED, inside = 1;
    if (!all_finite(NX, given) || !all_finite(CONDITIONS, a)) {
        for (int i = 0; i < NX; ++i) x[i] = NAN;
        *residual = NAN;
        return @ROBOT@_INVALID_INPUT;
    }
    prepare(problem, given, a, before);
    if (!warm) memcpy(x, before + TABLE[problem], NX * sizeof *x);
    memcpy(begin, x, sizeof begin);
    double length = iterated(problem, ITERATIONS, before, x, &pivot);
    int near = short_step(begin, x) && pivot > 0;
    if ((turned_towards_home(problem, x) && EFFECTS != 0) || (isfinite(length) && length >= SETTLED)) {
        memcpy(starts[0], x, sizeof starts[0]);
        length = iterated(problem, ITERATIONS, before, x, &pivot);
        near = near && short_step(starts[0], x);
    }
    *residual = norm_of_closure(problem, x, before);
    int settled = length < SETTLED && is_closed(problem, *residual);
    int trusted = settled && pivot > 0 && (near || !(warm || AT_HOME[problem]))
        && motors_on_home_side(problem, x, a);
    int sure = trusted && pivot > SUSPECT;
    if (settled && !sure && singular_at(problem, x, a)) {
        status = @ROBOT@_SINGULAR;
    } else if (!sure && !warm) {
        if (!settled || (BRANCHES[problem] && !trusted))
            status = on_home_branch(problem, given, a, steps, x, residual);
    } else if (!settled) {
        memcpy(starts[0], x, sizeof starts[0]);
        memcpy(starts[1], given, sizeof starts[1]);
        status = searched(problem, 1, 2, starts, a, steps, x, residual);
    } else if (!sure && !stayed(problem, begin, x, a) && !short_step(begin, x)) {
        status = @ROBOT@_OTHER_BRANCH;
    }
    if (status == @ROBOT@_CONVERGED && !settled && singular_at(problem, x, a))
        status = @ROBOT@_SINGULAR;
    for (int i = 0; i < NQ; ++i) inside &= within_limits(problem, i, x[i]);
    return status == @ROBOT@_CONVERGED && !inside ? (int)@ROBOT@_OUTSIDE_LIMITS : status;
}

/* The same. Where a start leads to nothing, to another branch than its own, or to unknown joints outside their limits, once more
 * without it, with the steps that are left; the end from the start stays where that fails, too. */
static int answered(int problem, const double *given, const double *a, int warm, int steps,
    double *x, double *residual)
{
    double other[NX], left;
    int status = solve_once(problem, given, a, warm, &steps, x, residual);
    int outside = status == @ROBOT@_OUTSIDE_LIMITS;
    int lost = outside ? problem == INVERSE
        : status != @ROBOT@_CONVERGED && status != @ROBOT@_SINGULAR;
    if (!warm || !lost || status == @ROBOT@_INVALID_INPUT) return status;
    if (solve_once(problem, given, a, 0, &steps, other, &left) != @ROBOT@_CONVERGED) return status;
    memcpy(x, other, sizeof other);
    *residual = left;
    return @ROBOT@_CONVERGED;
}

static void row_of(const @robot@_configuration *from, double *x)
{
    memcpy(x, from->joints, NQ * sizeof *x);
    memcpy(x + NQ, from->position, 3 * sizeof *x);
    memcpy(x + NQ + 3, from->rotation, 9 * sizeof *x);
@from_passive@}

static void configuration_of(const double *x, @robot@_configuration *to)
{
    memcpy(to->joints, x, NQ * sizeof *x);
    memcpy(to->position, x + NQ, 3 * sizeof *x);
    memcpy(to->rotation, x + NQ + 3, 9 * sizeof *x);
@to_passive@}

static void conditions_of(const @robot@_conditions *at, double a[CONDITIONS + 1])
{
    static const @robot@_conditions neutral = @ROBOT@_NEUTRAL;
    if (!at) at = &neutral;
@copied@
}

int @robot@_direct_capped(const double joints[NQ], const @robot@_conditions *at,
    const @robot@_configuration *start, int steps, @robot@_configuration *answer,
    double *residual)
{
    double given[NX], x[NX], a[CONDITIONS + 1], left;
    memcpy(given, HOME, sizeof given);
    memcpy(given, joints, NQ * sizeof *given);
    conditions_of(at, a);
    if (start) row_of(start, x);
    memcpy(x, joints, NQ * sizeof *x);
    int status = answered(DIRECT, given, a, start != 0, steps, x, &left);
    configuration_of(x, answer);
    if (residual) *residual = left;
    return status;
}

int @robot@_inverse_capped(const double position[3], const double rotation[9],
    const @robot@_conditions *at, const @robot@_configuration *start, int steps,
    @robot@_configuration *answer, double *residual)
{
    double given[NX], begin[NX], x[NX], a[CONDITIONS + 1], left;
    memcpy(given, HOME, sizeof given);
    if (!position) position = HOME + NQ;
    if (!rotation) rotation = HOME + NQ + 3;
@given@
    conditions_of(at, a);
    memcpy(x, given, sizeof x);
    if (start) {
        row_of(start, begin);
        unknowns_of(INVERSE, begin, x);
    }
    int status = answered(INVERSE, given, a, start != 0, steps, x, &left);
    configuration_of(x, answer);
    if (residual) *residual = left;
    return status;
}

int @robot@_direct(const double joints[NQ], const @robot@_conditions *at,
    const @robot@_configuration *start, @robot@_configuration *answer, double *residual)
{
    return @robot@_direct_capped(joints, at, start, ALL_STEPS, answer, residual);
}

int @robot@_inverse(const double position[3], const double rotation[9],
    const @robot@_conditions *at, const @robot@_configuration *start,
    @robot@_configuration *answer, double *residual)
{
    return @robot@_inverse_capped(position, rotation, at, start, ALL_STEPS, answer, residual);
}

/* d unknowns / d given, (n, m) row by row, along the closure; 0 where singular. */
static int slopes(int problem, const @robot@_configuration *at_answer,
    const @robot@_conditions *at, double *D)
{
    double x[NX], a[CONDITIONS + 1], phi[ROWS], all[ROWS * NC], J[ROWS * MOST];
    double B[MOST * MOST], A[MOST * MOST], b[MOST * MOST];
    int n = UNKNOWNS[problem], m = GIVENS[problem];
    row_of(at_answer, x);
    conditions_of(at, a);
    closure_and_slopes(problem, x, a, phi, J);
    closure(x, a, phi, all);
    for (int i = 0; i < ROWS; ++i)
        for (int j = 0; j < m; ++j) B[i * m + j] = -all[GIVEN[problem][j] * ROWS + i];
    int size = n == ROWS ? n : gram(n, J, A);
    for (int i = 0; n == ROWS && i < n * n; ++i) A[i] = J[i];
    for (int i = 0; i < size; ++i)
        for (int j = 0; j < m; ++j) {
            b[i * m + j] = n < ROWS ? 0 : B[i * m + j];
            for (int k = 0; n < ROWS && k < ROWS; ++k) b[i * m + j] += J[k * n + i] * B[k * m + j];
        }
    if (!solved(size, A, m, b)) return 0;
    for (int i = 0; i < n; ++i)
        for (int j = 0; j < m; ++j) {
            double sum = n <= ROWS ? b[i * m + j] : 0;
            for (int k = 0; n > ROWS && k < ROWS; ++k) sum += J[k * n + i] * b[k * m + j];
            D[i * m + j] = sum / SCALE[UNKNOWN[problem][i]];
        }
    return all_finite(n * m, D);
}

int @robot@_jacobian(const @robot@_configuration *answer, const @robot@_conditions *at,
    double jacobian[6 * NQ])
{
    double D[MOST * MOST];
    memset(jacobian, 0, 6 * NQ * sizeof *jacobian);
    if (!slopes(DIRECT, answer, at, D)) return @ROBOT@_SINGULAR;
    for (int i = 0; i < UNKNOWNS[DIRECT]; ++i)
        if (UNKNOWN[DIRECT][i] < NQ + 6)
            memcpy(jacobian + NQ * (UNKNOWN[DIRECT][i] - NQ), D + NQ * i, NQ * sizeof *D);
    return 0;
}

int @robot@_inverse_jacobian(const @robot@_configuration *answer, const @robot@_conditions *at,
    double jacobian[NQ * 6])
{
    double D[MOST * MOST];
    memset(jacobian, 0, NQ * 6 * sizeof *jacobian);
    if (!slopes(INVERSE, answer, at, D)) return @ROBOT@_SINGULAR;
    for (int i = 0; i < NQ; ++i)
        for (int j = 0; j < GIVENS[INVERSE]; ++j)
            jacobian[6 * i + GIVEN[INVERSE][j] - NQ] = D[i * GIVENS[INVERSE] + j];
    return 0;
}

/* From A D = B for the slopes D (n, NQ) follows A D' = B' - A' D; with more rows than unknowns, from
 * A^T (A D - B) = 0, A^T A D' = A^T (B' - A' D) + A'^T (B - A D). */
int @robot@_jacobian_rate(const @robot@_configuration *answer, const @robot@_conditions *at,
    const double velocity[NQ], double rate[6 * NQ])
{
    double x[NX], change[NX], a[CONDITIONS + 1], phi[ROWS], all[ROWS * NC], faster[ROWS * NC];
    double D[MOST * MOST], J[ROWS * MOST], A[MOST * MOST], b[MOST * MOST], speed[NC] = {0};
    const double *pose = speed + NQ;
    int n = UNKNOWNS[DIRECT];
    memset(rate, 0, 6 * NQ * sizeof *rate);
    if (!slopes(DIRECT, answer, at, D)) return @ROBOT@_SINGULAR;
    for (int i = 0; i < n; ++i)
        for (int j = 0; j < NQ; ++j)
            speed[UNKNOWN[DIRECT][i]] += D[i * NQ + j] * velocity[j];
    row_of(answer, x);
    conditions_of(at, a);
    memcpy(change, velocity, NQ * sizeof *change);
    memcpy(change + NQ, pose, 3 * sizeof *change);
    for (int i = NQ + 6; i < NC; ++i) change[i + 6] = speed[i];
    for (int i = 0; i < 3; ++i) /* R' = w x R */
        for (int j = 0; j < 3; ++j)
            change[NQ + 3 + 3 * i + j] = pose[3 + (i + 1) % 3] * x[NQ + 3 + 3 * ((i + 2) % 3) + j]
                - pose[3 + (i + 2) % 3] * x[NQ + 3 + 3 * ((i + 1) % 3) + j];
    closure(x, a, phi, all);
    closure_rate(x, a, change, faster);
    closure_and_slopes(DIRECT, x, a, phi, J);
    if (n == ROWS)
        for (int i = 0; i < n * n; ++i) A[i] = J[i];
    else
        gram(n, J, A);
    for (int j = 0; j < NQ; ++j) {
        double turning[ROWS], missing[ROWS]; /* B' - A' D and B - A D */
        for (int k = 0; k < ROWS; ++k) {
            turning[k] = -faster[j * ROWS + k], missing[k] = -all[j * ROWS + k];
            for (int i = 0; i < n; ++i) {
                int column = UNKNOWN[DIRECT][i];
                turning[k] -= faster[column * ROWS + k] * D[i * NQ + j];
                missing[k] -= all[column * ROWS + k] * D[i * NQ + j];
            }
        }
        for (int i = 0; i < n; ++i) {
            int column = UNKNOWN[DIRECT][i];
            b[i * NQ + j] = n == ROWS ? turning[i] : 0;
            for (int k = 0; n < ROWS && k < ROWS; ++k)
                b[i * NQ + j] += J[k * n + i] * turning[k]
                    + faster[column * ROWS + k] / SCALE[column] * missing[k];
        }
    }
    if (!solved(n, A, NQ, b)) return @ROBOT@_SINGULAR;
    for (int i = 0; i < n; ++i)
        for (int j = 0; j < NQ; ++j) {
            int column = UNKNOWN[DIRECT][i];
            if (column < NQ + 6) rate[NQ * (column - NQ) + j] = b[i * NQ + j] / SCALE[column];
        }
    return all_finite(6 * NQ, rate) ? 0 : (int)@ROBOT@_SINGULAR;
}

/* ------------------------------------------------------------------ motion */

int @robot@_motion_begin(@robot@_motion *motion, const double joints[NQ])
{
    if (!all_finite(NQ, joints)) return @ROBOT@_INVALID_INPUT;
    memset(motion, 0, sizeof *motion);
    for (int i = 0; i < NQ; ++i) {
        motion->threshold[i] = @ROBOT@_DIRECTION_THRESHOLD;
        motion->reading[i] = motion->furthest[i] = motion->turned_at[i] = joints[i];
    }
    return 0;
}

int @robot@_motion_follow(@robot@_motion *motion, const double joints[NQ], double period)
{
    if (!all_finite(NQ, joints) || !(period > 0)) return @ROBOT@_INVALID_INPUT;
    for (int i = 0; i < NQ; ++i) {
        double moved_by = joints[i] - motion->furthest[i], going = motion->direction[i];
        motion->velocity[i] = (joints[i] - motion->reading[i]) / period;
        motion->reading[i] = joints[i];
        if (fabs(moved_by) > motion->threshold[i] && !(moved_by * going > 0)) {
            motion->turned_at[i] = motion->furthest[i];
            motion->direction[i] = going = sign(moved_by);
        }
        if (moved_by * going > 0) motion->furthest[i] = joints[i];
        motion->travel[i] = fabs(going) > 0 ? joints[i] - motion->turned_at[i] : 0;
    }
    return 0;
}

void @robot@_motion_conditions(const @robot@_motion *motion, @robot@_conditions *at)
{
    (void)motion;
    (void)at;
@followed@
}
