#!/bin/sh
# Versions: casadi 3.8.2
# Question: casadi.rootfinder solves a forward kinematics from its default start 0, where the Jacobian is
#   singular. What does it return?
# Guess: "An exception (error_on_fail is on), or success = False."
# True: NaN with success = True and return_status 'converged_abstol_step' (fast_newton) or 'success'
#   (newton). A step that is NaN passes the tests of convergence.
# Matters: A symmetrical home pose is singular for many parallel robots, and 0 is the default start. Check
#   the numbers; success does not say that they are any.
cd "$(dirname "$0")" && ./with_packages casadi==3.8.2 numpy==2.4.6 <<'END' 2> /dev/null
import casadi

height, strut = casadi.SX.sym("height"), casadi.SX.sym("strut")
problem = {"x": height, "p": strut, "g": strut**2 - 1 - height**2}  # a strut from (1, 0) to (0, height)
solve = casadi.rootfinder("solve", "fast_newton", problem)
found = {}
for start in (1.0, 0.0):
    found[start] = float(solve(x0=start, p=1.5)["x"])
    stats = solve.stats()
    print(f"start {start}: {found[start]:.5f}, success {stats['success']}, {stats['return_status']}")
    assert stats["success"]
assert abs(found[1.0] - 1.25**0.5) < 1e-9
assert found[0.0] != found[0.0]
END
# Seen:
#   start 1.0: 1.11803, success True, converged_abstol
#   start 0.0: nan, success True, converged_abstol_step
