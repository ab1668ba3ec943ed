"""How do I get poses from three reflectors on the platform?

A laser tracker measures positions. Three reflectors that are not in a line give the pose of the
platform: the rotation that turns their places on the platform into the measured ones.
"""

import tempfile
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import parallel_cal as pc

ON_PLATFORM = np.array([[80, 0, 15], [-40, 70, 15], [-40, -70, 15]]) * 1e-3  # m, in {P}
NOISE = 15e-6  # m, of each coordinate of a reflector
HEADER = "leg1 [m],leg2 [m],leg3 [m],leg4 [m],leg5 [m],leg6 [m],x [m],y [m],z [m],qx,qy,qz,qw"
MAP = """\
joints: {%s}
position: {columns: [x, y, z]}
orientation: [qx, qy, qz, qw]
noise: {joint: 1.0e-6, position: %.2e, orientation: %.2e}
"""


def pose_of(measured):
    """Position (3,) of {P}, its rotation, and the sigma of a rotation about an axis (rad)."""
    places, points = (p - p.mean(axis=0) for p in (ON_PLATFORM, measured))
    turn, _, sensitivity = Rotation.align_vectors(points, places, return_sensitivity=True)
    sigma = NOISE * np.sqrt(np.trace(sensitivity) / 3)
    return measured.mean(axis=0) - turn.apply(ON_PLATFORM.mean(axis=0)), turn, sigma


if __name__ == "__main__":
    rng = np.random.default_rng(1)
    robot = pc.new_model("stewart42")
    # In place of a real hexapod: what its encoders read, and where its reflectors are.
    true = pc.simulate(robot, 40, seed=1, quiet=True).dataset()
    rows, sigmas = [HEADER], []
    for q, r, turn in zip(true.q, true.r, true.R, strict=True):
        seen = r + ON_PLATFORM @ turn.T + NOISE * rng.standard_normal((3, 3))
        position, rotation, sigma = pose_of(seen)
        rows.append(",".join(f"{v:.9g}" for v in (*q, *position, *rotation.as_quat())))
        sigmas.append(sigma)
    position_sigma = NOISE / np.sqrt(3)
    print(f"position {1e6 * position_sigma:.0f} um, orientation {1e6 * sigmas[0]:.0f} urad (sigma)")
    joints = ", ".join(f"{name}: {{column: {name}}}" for name in robot.joints)
    with tempfile.TemporaryDirectory() as folder:
        table, columns = Path(folder) / "poses.csv", Path(folder) / "map.yaml"
        table.write_text("\n".join(rows) + "\n", encoding="utf-8")
        columns.write_text(MAP % (joints, position_sigma, sigmas[0]), encoding="utf-8")
        data = pc.load_dataset(table, mechanism=robot.mechanism, columns=columns)
    print(pc.fit(robot, data))

# Prints:
# position 9 um, orientation 139 urad (sigma)
# FitResult(stewart42, 40 samples, 42 of 42 free parameters identified, chi2/dof 0.826)
