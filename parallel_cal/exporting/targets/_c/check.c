/* Solves every row of a table of test vectors and reports the largest difference of those that
 * converge (beyond the joint limits there are several answers):
 * check vectors.csv [limit]. Exit 1 where a status differs or a number differs by more than the
 * limit (m, rad). Without the argument each row states its own limit, in its last column: what
 * rounding in the closure may do there. */
#include "@robot@.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define NQ @ROBOT@_JOINTS
#define CONDITIONS @n_conditions@
#define COLUMNS (2 + CONDITIONS + NQ + 12 + 1)

static double apart(int n, const double *a, const double *b)
{
    double most = 0;
    for (int i = 0; i < n; ++i) {
        double d = fabs(a[i] - b[i]);
        if (!(d <= most)) most = d;
    }
    return most;
}

int main(int count, char **words)
{
    double least = HUGE_VAL, largest = 0; /* limits of the rows */
    double joints = 0, position = 0, rotation = 0;
    long rows = 0, other_status = 0, beyond = 0;
    char line[4096];
    FILE *table = count > 1 ? fopen(words[1], "r") : 0;
    if (!table || !fgets(line, sizeof line, table)) {
        fprintf(stderr, "usage: %s vectors.csv [limit]\n", words[0]);
        return 2;
    }
    while (fgets(line, sizeof line, table)) {
        double row[COLUMNS], *q = row + 2 + CONDITIONS, *r = q + NQ, *R = r + 3;
        char *at = line;
        for (int i = 0; i < COLUMNS; ++i) {
            row[i] = strtod(at, &at);
            at += *at == ',';
        }
        @robot@_conditions now = @ROBOT@_NEUTRAL;
@read@
        @robot@_configuration found;
        int inverse = row[0] > 0;
        int status = inverse ? @robot@_inverse(r, R, &now, 0, &found, 0)
                             : @robot@_direct(q, &now, 0, &found, 0);
        ++rows;
        if (status != (int)row[1]) {
            if (++other_status < 10)
                printf("row %ld: status %d, expected %d\n", rows, status, (int)row[1]);
            continue;
        }
        if (status == @ROBOT@_CONVERGED) {
            double limit = count > 2 ? strtod(words[2], 0) : R[9];
            double q_apart = apart(NQ, found.joints, q), r_apart = apart(3, found.position, r);
            double R_apart = apart(9, found.rotation, R);
            least = fmin(least, limit), largest = fmax(largest, limit);
            beyond += !(fmax(q_apart, fmax(r_apart, R_apart)) <= limit);
            joints = fmax(joints, q_apart);
            position = fmax(position, r_apart);
            rotation = fmax(rotation, R_apart);
        }
    }
    fclose(table);
    printf("rows %ld other_status %ld joints %.3g position %.3g rotation %.3g least_limit %.3g "
           "largest_limit %.3g beyond_limit %ld\n", rows, other_status, joints, position, rotation,
        least, largest, beyond);
    return !(rows && !other_status && !beyond);
}
