#!/bin/sh
# Versions: casadi 3.8.2
# Question: An interpolant of casadi was made from a table over 0 to 4. What does it return at 4 + 1e-7, 4.5
#   and -0.5, with 'linear' and with 'bspline'?
# Guess: "Both extrapolate: linear goes on along its last line, bspline along the polynomial of its last
#   interval."
# True: linear goes on. bspline returns 0 everywhere outside, a jump behind the last point of the table.
# Matters: A map of measured errors is exact up to the border of the measured region, and one step behind it
#   the correction is gone. In an optimization, value and derivative are 0 there, so it does not come back.
cd "$(dirname "$0")" && ./with_packages casadi==3.8.2 numpy==2.4.6 <<'END'
import casadi as ca
import numpy as np

grid = np.linspace(0, 4, 9)
table = grid**3
x = ca.MX.sym("x")
for kind in ("linear", "bspline"):
    f = ca.interpolant("f", kind, [grid], table)
    slope = ca.Function("slope", [x], [ca.jacobian(f(x), x)])
    inside, outside = [float(f(v)) for v in (1.3, 3.999999, 4.0)], (4.0000001, 4.5, -0.5)
    print(kind, "inside", np.round(inside, 4), "outside", [round(float(f(v)), 4) for v in outside])
    print("  slope at 4.5:", float(slope(4.5)))
    assert abs(inside[2] - 64) < 1e-9
    values = np.array([float(f(v)) for v in outside])
    if kind == "linear":
        assert np.allclose(values, [64, 85.125, -0.125], atol=1e-5)
    else:
        assert (values == 0).all()
        assert float(slope(4.5)) == 0
END
# Seen:
#   linear inside [ 2.425 64.    64.   ] outside [64.0, 85.125, -0.125]
#     slope at 4.5: 42.25
#   bspline inside [ 2.197 64.    64.   ] outside [0.0, 0.0, 0.0]
#     slope at 4.5: 0.0
