"""Write examples/ankle_measured.csv: an ankle that is not as drawn, measured by a tracker.

The robot is made of points and hinges (`virtual_shelf`). A reflector on the toe is measured to
0.1 mm, and the motors have backlash behind their encoders.
"""

from pathlib import Path

import numpy as np
import virtual_shelf as vf

from parallel_cal.virtual.robot import turn

TABLE = Path(__file__).parents[2] / "examples" / "ankle_measured.csv"
TOE = np.array([0.14, 0.02, -0.035])
N, SEED, NOISE, READING = 160, 4, 1e-4, 5e-5  # samples, m, rad
BACKLASH = np.array([2.4e-3, 2.0e-3])  # rad
# How far the parts are from the drawing, m and rad; {P} is the toe.
ERRORS = {
    "ankle.c_x": 5e-4, "ankle.c_y": -3e-4, "ankle.c_z": 8e-4, "ankle.offset": 6e-4,
    "ankle.a_z": 6e-3, "ankle.a_x": -9e-3, "ankle.b_z": 7e-3, "ankle.b_y": 5e-3,
    "left.q0": 0.013, "left.crank": -1.8e-3, "left.D_x": 1e-3, "left.D_y": -8e-4, "left.B_z": 1e-3,
    "left.B_x": -1.5e-3, "left.theta": 7e-3, "left.alpha": 6e-3, "left.D_z": 2e-4,
    "right.q0": -0.009, "right.crank": 1.4e-3, "right.D_x": -7e-4, "right.B_x": 1.2e-3,
    "right.B_y": 1e-3, "right.B_z": -9e-4, "right.theta": -4e-3, "right.alpha": 6e-3,
}  # fmt: skip


def drawn():
    """The parameters of the drawing, with {P} at the toe."""
    p = dict.fromkeys((f"ankle.{n}" for n in "c_x c_y c_z a_z a_x b_z b_y offset".split()), 0.0)
    p |= {f"ankle.f_{axis}": -v for axis, v in zip("xyz", TOE, strict=True)}
    p["ankle.angle"] = np.pi / 2
    for leg, y, z in (("left", 0.035, 0.25), ("right", -0.035, 0.2)):
        numbers = {"D_x": -0.01, "D_y": y, "D_z": z, "theta": np.pi, "alpha": 0.0, "q0": 0.0}
        numbers |= {"crank": 0.04, "rod": z}
        ball = np.array([-0.05, y, 0.0]) - TOE
        numbers |= {f"B_{axis}": v for axis, v in zip("xyz", ball, strict=True)}
        p |= {f"{leg}.{name}": value for name, value in numbers.items()}
    return p


def table():
    """The lines of the table."""
    rng = np.random.default_rng(SEED)
    p = drawn()
    robot = vf.Ankle2Rsu({name: value + ERRORS.get(name, 0.0) for name, value in p.items()})
    robot.home = tuple(TOE)
    wanted = rng.uniform([-0.3, -0.5], [0.3, 0.5], (N, 2))
    tilt = turn(np.column_stack([wanted, 0 * wanted[:, 0]]))
    q = robot.inverse(tilt @ TOE, tilt)[0]
    way = np.sign(np.diff(q, axis=0, prepend=q[:1] - 0.1))
    r = robot.forward(q - BACKLASH / 2 * way, (tilt @ TOE, tilt))[0]
    q, r = q + READING * rng.standard_normal(q.shape), r + NOISE * rng.standard_normal(r.shape)
    rows = [
        f"{a:.5f},{b:.5f},{x:.3f},{y:.3f},{z:.3f}"
        for (a, b), (x, y, z) in zip(q, 1e3 * r, strict=True)
    ]
    return ["left_motor [rad],right_motor [rad],x [mm],y [mm],z [mm]", *rows]


if __name__ == "__main__":
    TABLE.write_text("\n".join(table()) + "\n", encoding="utf-8")
