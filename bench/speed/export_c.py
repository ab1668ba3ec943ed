"""Exported C beside our Python call and a Newton written by hand in C, on the same poses.

The hand-written one knows the nominal Delta alone: three spheres, a 3x3 system by Cramer's rule.
Last, 10^7 cycles of a controller: the time of each, and the calls of the heap in all of them.
"""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path

import numpy as np

from bench.speed.timing import Row, seconds_each, show
from parallel_cal.exporting.export import export
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import Model, new_model

N = 20_000
EFFECTS = ("encoder_eccentricity", "backlash", "thermal_expansion")

BY_HAND = r"""
#include <math.h>
/* Position of the nominal Delta (R, La, Lb in m) for joints q, by Newton from a start. */
int by_hand(const double q[3], const double start[3], double r[3])
{
    static const double R = 0.076, La = 0.12, Lb = 0.24;
    static const double c3[3] = {1, -0.5, -0.5};
    static const double s3[3] = {0, 0.86602540378443864676, -0.86602540378443864676};
    double K[3][3];
    for (int i = 0; i < 3; ++i) {
        double out = R + La * cos(q[i]);
        K[i][0] = out * c3[i], K[i][1] = out * s3[i], K[i][2] = La * sin(q[i]);
        r[i] = start[i];
    }
    for (int round = 0; round < 20; ++round) {
        double J[3][3], f[3];
        for (int i = 0; i < 3; ++i) {
            f[i] = -Lb * Lb;
            for (int j = 0; j < 3; ++j) J[i][j] = r[j] - K[i][j], f[i] += J[i][j] * J[i][j];
            f[i] *= 0.5;
        }
        double a = J[1][1] * J[2][2] - J[1][2] * J[2][1], b = J[1][2] * J[2][0] - J[1][0] * J[2][2];
        double c = J[1][0] * J[2][1] - J[1][1] * J[2][0];
        double det = J[0][0] * a + J[0][1] * b + J[0][2] * c, step[3];
        step[0] = f[0] * a + J[0][1] * (J[1][2] * f[2] - f[1] * J[2][2])
                + J[0][2] * (f[1] * J[2][1] - J[1][1] * f[2]);
        step[1] = J[0][0] * (f[1] * J[2][2] - J[1][2] * f[2]) + f[0] * b
                + J[0][2] * (J[1][0] * f[2] - f[1] * J[2][0]);
        step[2] = J[0][0] * (J[1][1] * f[2] - f[1] * J[2][1])
                + J[0][1] * (f[1] * J[2][0] - J[1][0] * f[2]) + f[0] * c;
        double length = 0;
        for (int j = 0; j < 3; ++j) r[j] -= step[j] / det, length += step[j] * step[j] / det / det;
        if (length < 1e-20) return 0;
    }
    return 1;
}
"""

# Seconds a call, and where it ends, over the joints of a file; the median of five runs.
MAIN = r"""
#include "robot.h"
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
int by_hand(const double q[3], const double start[3], double r[3]);
static double q[COUNT][3], found[COUNT][3];
static int compare(const void *a, const void *b)
{
    return (*(double *)a > *(double *)b) - (*(double *)a < *(double *)b);
}
int main(int count, char **words)
{
    FILE *file = fopen(words[1], "rb");
    int kind = atoi(words[2]);
    double start[3] = {0, 0, 0.22078}, runs[5];
    robot_configuration answer, back;
    if (count < 3 || fread(q, sizeof q, 1, file) != 1) return 1;
    for (int run = 0; run < 5; ++run) {
        clock_t begin = clock();
        for (int i = 0; i < COUNT; ++i) {
            if (kind == 0) by_hand(q[i], start, found[i]);
            if (kind == 1) robot_direct(q[i], 0, 0, &answer, 0);
            if (kind == 2) robot_direct(q[i], 0, i ? &answer : 0, &answer, 0);
            if (kind == 3) robot_direct(q[i], 0, 0, &answer, 0), robot_inverse(answer.position, 0, 0, 0, &back, 0);
            if (kind) memcpy(found[i], answer.position, sizeof found[i]);
        }
        runs[run] = (double)(clock() - begin) / CLOCKS_PER_SEC / COUNT;
    }
    qsort(runs, 5, sizeof *runs, compare);
    fprintf(stderr, "%.12g\n", runs[2]);
    fwrite(found, sizeof found, 1, stdout);
    return 0;
}
"""  # noqa: E501

# Nanoseconds of CYCLES cycles (motion, direct and inverse, both capped) by the thread's own clock,
# which other programs do not advance: median, the longest of 99.9 % and of 99.999 %, and the
# longest. Then the failures and the calls of the heap before and in the cycles.
CYCLE = r"""
#define _POSIX_C_SOURCE 199309L
#include "robot.h"
#include <stdio.h>
#include <stdlib.h>
#include <time.h>
enum { LONGEST = 200000 }; /* ns; the histogram's last class holds all that take longer */
static double q[COUNT][3];
static long heap_calls, histogram[LONGEST + 1];
void *__real_malloc(size_t), *__real_calloc(size_t, size_t), *__real_realloc(void *, size_t);
void *__wrap_malloc(size_t size) { ++heap_calls; return __real_malloc(size); }
void *__wrap_calloc(size_t n, size_t size) { ++heap_calls; return __real_calloc(n, size); }
void *__wrap_realloc(void *at, size_t size) { ++heap_calls; return __real_realloc(at, size); }
static long share(double part)
{
    long seen = 0, at = 0;
    while (at < LONGEST && seen + histogram[at] < part * CYCLES) seen += histogram[at++];
    return at;
}
int main(int count, char **words)
{
    robot_configuration pose = robot_home, command = robot_home;
    robot_conditions now = ROBOT_NEUTRAL;
    robot_motion motion;
    long failures = 0, longest = 0;
    FILE *file = fopen(words[1], "rb");
    if (count < 2 || !file || fread(q, sizeof q, 1, file) != 1) return 1;
    robot_motion_begin(&motion, q[0]);
    void *volatile proof = malloc(1); /* shows that calls are counted */
    free(proof);
    long before = heap_calls;
    for (long cycle = 0; cycle < CYCLES; ++cycle) {
        struct timespec begin, end;
        long along = cycle % (2 * COUNT - 2); /* to and fro, without a jump */
        const double *joints = q[along < COUNT ? along : 2 * COUNT - 2 - along];
        clock_gettime(CLOCK_THREAD_CPUTIME_ID, &begin);
        robot_motion_follow(&motion, joints, 1e-3);
        robot_motion_conditions(&motion, &now);
        failures += robot_direct_capped(joints, &now, &pose, 10, &pose, 0) != 0;
        failures += robot_inverse_capped(pose.position, pose.rotation, &now, &command, 10,
            &command, 0) != 0;
        clock_gettime(CLOCK_THREAD_CPUTIME_ID, &end);
        long spent = (end.tv_sec - begin.tv_sec) * 1000000000L + end.tv_nsec - begin.tv_nsec;
        longest = spent > longest ? spent : longest;
        ++histogram[spent < LONGEST ? spent : LONGEST];
    }
    printf("%ld %ld %ld %ld %ld %ld %ld\n", share(0.5), share(0.999), share(0.99999), longest,
        failures, before, heap_calls - before);
    return 0;
}
"""
CYCLES = 10_000_000
WRAPPED = "-Wl,--wrap=malloc,--wrap=calloc,--wrap=realloc"


def compiled_program(model: Model, folder: Path) -> Path:
    export(model, "c:name=robot,poses=10", folder)
    (folder / "by_hand.c").write_text(BY_HAND)
    (folder / "main.c").write_text(MAIN)
    words = ["gcc", "-std=c99", "-O2", f"-DCOUNT={N}", "robot.c", "by_hand.c", "main.c", "-lm"]
    subprocess.run([*words, "-o", "timed"], cwd=folder, check=True)
    return folder / "timed"


def timed(program: Path, kind: int) -> tuple[float, np.ndarray]:
    """Seconds a call, and the positions (N, 3)."""
    words = [str(program), "joints", str(kind)]
    done = subprocess.run(words, cwd=program.parent, capture_output=True, check=True)
    return float(done.stderr), np.frombuffer(done.stdout).reshape(N, 3)


def path(model: Model) -> np.ndarray:
    """Positions (N, 3) along a smooth way through the workspace, 0.1 mm or so apart."""
    low, high = np.array(model.mechanism.workspace.low), np.array(model.mechanism.workspace.high)
    turned = np.sin(np.linspace(0.0, 60.0, N)[:, None] * [1.0, 1.3, 0.7] + [0.0, 1.0, 2.0])
    return np.asarray((low + high) / 2 + 0.48 * (high - low) * turned)


def rows(model: Model, name: str, hand: bool) -> list[Row]:
    kinematics = Kinematics(model, compile=True)
    r = path(model)
    q = np.ascontiguousarray(kinematics.inverse(r).joints)
    found: list[Row] = []
    with tempfile.TemporaryDirectory() as scratch:
        program = compiled_program(model, Path(scratch))
        (program.parent / "joints").write_bytes(q.tobytes())
        kinds = {"direct, from a start of its own": 1, "direct, warm": 2, "direct and inverse": 3}
        if hand:
            found.append(Row(f"{name}, by hand in C", timed(program, 0)[0]))
            assert np.abs(timed(program, 0)[1] - r).max() < 1e-9
        for text, kind in kinds.items():
            seconds, position = timed(program, kind)
            assert np.abs(position - r).max() < 1e-9
            found.append(Row(f"{name}, exported, {text}", seconds))
    batch = seconds_each(lambda: kinematics.direct(q), least=2) / N
    return [
        *found,
        Row(f"{name}, Python, direct, one call", seconds_each(lambda: kinematics.direct(q[0]))),
        Row(f"{name}, Python, direct, batch of {N}", batch),
    ]


def cycles(model: Model) -> list[Row]:
    """Time of a controller's cycle: median, rare and longest; no call of the heap, no failure."""
    q = np.ascontiguousarray(Kinematics(model).inverse(path(model)).joints)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        export(model, "c:name=robot,poses=10", folder)
        (folder / "cycle.c").write_text(CYCLE)
        (folder / "joints").write_bytes(q.tobytes())
        words = ["gcc", "-std=c99", "-O2", f"-DCOUNT={N}", f"-DCYCLES={CYCLES}L", WRAPPED]
        words += ["robot.c", "cycle.c", "-lm", "-o", "cycle"]
        subprocess.run(words, cwd=folder, check=True)
        run = subprocess.run(
            [str(folder / "cycle"), "joints"], cwd=folder, capture_output=True, check=True
        )
    *times, failures, counted, heap_calls = map(int, run.stdout.split())
    assert (failures, counted, heap_calls) == (0, 1, 0), (failures, counted, heap_calls)
    names = ("median", "longest of 99.9 %", "longest of 99.999 %", f"longest of {CYCLES:.0e}")
    return [Row(f"cycle, {name}", 1e-9 * time) for name, time in zip(names, times, strict=True)] + [
        Row("jitter: longest of 99.999 % less median", 1e-9 * (times[2] - times[0]))
    ]


def main() -> None:
    show("Nominal Delta", rows(new_model("delta_nominal"), "nominal", True))
    show("Model 54 with three effects", rows(new_model("delta54", effects=EFFECTS), "54", False))
    title = (
        "Model 54 with three effects: a controller's cycle (motion, direct, inverse); heap calls: 0"
    )
    show(title, cycles(new_model("delta54", effects=EFFECTS)))


if __name__ == "__main__":
    main()
