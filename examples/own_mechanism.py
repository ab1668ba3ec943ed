"""How do I describe a robot that is not in the list of mechanisms?

One equation, the closure, is enough: kinematics both ways, their derivatives, the fit and the
diagnosis follow from it.
"""

import casadi as ca
import numpy as np

import parallel_cal as pc

MM, DEGREE = 1e-3, np.pi / 180


class FiveBar(pc.Mechanism):
    """Two cranks with axes on the x-axis, and two rods that meet in one point of the plane."""

    joints = ("left", "right")
    moves = controls = ("x", "y")
    parameters = pc.ParameterTable(
        pc.Parameter(f"{side}.{name}", unit, nominal, tolerance)
        for side, sign in (("left", -1), ("right", 1))
        for name, unit, nominal, tolerance in (
            ("x", "m", sign * 50 * MM, 0.2 * MM),
            ("crank", "m", 100 * MM, 0.2 * MM),
            ("rod", "m", 150 * MM, 0.2 * MM),
            ("q0", "rad", 0.0, 1 * DEGREE),
        )
    )
    home = pc.Home(joints=(120 * DEGREE, 60 * DEGREE), position=(0.0, 198.4 * MM, 0.0))
    workspace = pc.Workspace(low=(-40 * MM, 170 * MM), high=(40 * MM, 230 * MM))
    joint_limits = ((60 * DEGREE, 180 * DEGREE), (0.0, 120 * DEGREE))

    def closure(self, q, r, R, p):
        """Length error of each rod (m): (|P - elbow|^2 - rod^2) / (2 rod)."""
        rows = []
        for i, side in enumerate(self.joints):
            s = p[side]
            elbow = ca.vertcat(s.x + s.crank * ca.cos(q[i] + s.q0), s.crank * ca.sin(q[i] + s.q0))
            rows.append((ca.sumsqr(r[:2] - elbow) - s.rod**2) / (2 * s.rod))
        return ca.vertcat(*rows)


if __name__ == "__main__":
    model = pc.new_model("examples.own_mechanism")
    robot = pc.Kinematics(model)
    joints = robot.inverse((0.02, 0.2, 0.0)).joints
    print("cranks [deg]:", np.round(joints / DEGREE, 2))

    session = pc.simulate(model, 40, seed=1)
    print(pc.fit(model, session.dataset(), joint_sigma=1.2e-4))  # rad

# Prints:
# cranks [deg]: [110.85  53.13]
# FitResult(examples.own_mechanism, 40 samples, 8 of 8 free parameters identified, chi2/dof 1.11)
