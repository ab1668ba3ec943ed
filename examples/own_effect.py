"""How do I describe an effect that the catalogue does not have?

An effect says which readings an ideal robot would have shown. Everything else (derivatives, the
fit, the diagnosis, compiled code) follows from it.
"""

import casadi as ca

import parallel_cal as pc


class ThirdHarmonic(pc.Effect):
    """An encoder's disc that three screws bend: q_ideal = q + sin * sin 3q + cos * cos 3q."""

    physics = "A disc clamped by three screws bends: its error has three periods per turn."
    source = "a robot in our workshop"

    def parameters(self, mechanism):
        names = [f"{joint}.{term}" for joint in mechanism.joints for term in ("sin", "cos")]
        return [pc.Parameter(name, "rad", 0.0, 1e-3) for name in names]

    def ideal(self, seen, e, at, mechanism):
        q = [
            seen.q[i] + e[joint].sin * ca.sin(3 * seen.q[i]) + e[joint].cos * ca.cos(3 * seen.q[i])
            for i, joint in enumerate(mechanism.joints)
        ]
        return seen.with_q(ca.vertcat(*q))


if __name__ == "__main__":
    robot = pc.new_model("delta24")
    session = pc.simulate(robot, 60, effects=["examples.own_effect:sin=0.002"], seed=1)
    data = session.dataset()
    fitted = pc.fit(robot, data, joint_sigma=1.2e-4)  # rad
    better = pc.add(fitted.model, "examples.own_effect", data)
    print(fitted)
    print(better.model)

# Prints:
# FitResult(delta24, 60 samples, 24 of 24 free parameters identified, chi2/dof 10.7)
# Model(delta24 + examples.own_effect, 30 parameters)
