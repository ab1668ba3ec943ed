/* Solves every row of a table of test vectors and reports the largest difference of those that
 * converge (beyond the limits there are several answers):
 * check vectors.csv [tolerance]. Exit 1 where a status differs or a number by more. */
#include "@robot@.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define NQ @ROBOT@_JOINTS
#define CONDITIONS @n_conditions@
#define COLUMNS (2 + CONDITIONS + NQ + 12)

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
    double tolerance = count > 2 ? strtod(words[2], 0) : 1e-12;
    double joints = 0, position = 0, rotation = 0;
    long rows = 0, other_status = 0;
    char line[4096];
    FILE *table = count > 1 ? fopen(words[1], "r") : 0;
    if (!table || !fgets(line, sizeof line, table)) {
        fprintf(stderr, "usage: %s vectors.csv [tolerance]\n", words[0]);
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
            joints = fmax(joints, apart(NQ, found.joints, q));
            position = fmax(position, apart(3, found.position, r));
            rotation = fmax(rotation, apart(9, found.rotation, R));
        }
    }
    fclose(table);
    printf("rows %ld other_status %ld joints %.3g position %.3g rotation %.3g\n", rows,
        other_status, joints, position, rotation);
    return !(rows && !other_status && fmax(joints, fmax(position, rotation)) <= tolerance);
}
