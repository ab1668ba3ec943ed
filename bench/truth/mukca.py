"""Calibrate Franka arms with the data of MUKCa: a ball in two printed sockets, 50 mm apart.

Data: github.com/platonics-delft/kinematics_calibration (MIT), Franzese et al., arXiv 2503.12584.
A folder of a robot has one folder for each placement of the tool, with the joint readings of the
visits to each socket (hole_0.csv, hole_1.csv; rad). Every placement is held out in turn. The error
is theirs: the mean distance of the ball from the mean ball of its socket, and how wrong the
distance of the two means is. Beside our fit: the same arm by scipy's least squares, written here
with matrices of its own. Usage: `python -m bench.truth.mukca FOLDER/data/panda_1`.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

import parallel_cal as pc
from parallel_cal.base.rotation import rotation_matrix, rotation_vector
from parallel_cal.base.threads import single_threaded
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import Model, new_model
from parallel_cal.model.shelf import load_mechanism
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.sensors.sockets import Sockets

Q = np.pi / 2
# a, d (m), alpha (rad) after each joint: the data sheet of the Franka arm; 0.107 is the flange.
ROWS = (
    (0.0, 0.333, -Q),
    (0.0, 0.0, Q),
    (0.0825, 0.316, Q),
    (-0.0825, 0.0, -Q),
    (0.0, 0.384, Q),
    (0.088, 0.0, Q),
    (0.0, 0.107, 0.0),
)
BALL = (0.0, 0.0, 0.1344)  # m, from the flange: gripper and printed ball
DISTANCE, SEAT, JOINT = 0.05, 0.2e-3, 1e-4
HOME = (0.0, 0.4, 0.0, -2.2, 0.0, 2.5, 0.7)
FAR_M = 0.05  # further from the other visits, by the data sheet: another socket was recorded

Placement = tuple[np.ndarray, np.ndarray]


def read(folder: Path) -> dict[str, Placement]:
    """Return the joint readings (n, 7) of both sockets, by the name of the placement."""
    found = {}
    for place in sorted(p for p in folder.iterdir() if (p / "hole_0.csv").exists()):
        both = [np.loadtxt(place / f"hole_{k}.csv", delimiter=",")[:, :7] for k in (0, 1)]
        found[place.name] = tuple(keep_near(q) for q in both)
    return found


def keep_near(q: np.ndarray) -> np.ndarray:
    """Leave out visits that are far from the median ball."""
    ball = forward(np.zeros(42), q)
    return q[np.linalg.norm(ball - np.median(ball, axis=0), axis=1) < FAR_M]


def forward(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Balls (n, 3) of the independent arm: p (42,) are errors of theta, d, a, alpha and of two
    small turns and shifts across each row."""
    errors = p.reshape(7, 6)
    T = np.tile(np.eye(4), (len(q), 1, 1))
    for (a, d, alpha), (dt, dd, da, dal, dy, db), turn in zip(ROWS, errors, q.T, strict=True):
        c, s, one = np.cos(turn + dt), np.sin(turn + dt), np.ones(len(q))
        ca, sa = np.cos(alpha + dal), np.sin(alpha + dal)
        step = np.zeros((len(q), 4, 4))
        step[:, 0] = np.stack([c, -s * ca, s * sa, (a + da) * c - db * s], -1)
        step[:, 1] = np.stack([s, c * ca, -c * sa, (a + da) * s + db * c], -1)
        step[:, 2] = np.stack([0 * one, sa * one, ca * one, (d + dd) * one], -1)
        step[:, 3, 3] = 1.0
        tilt = np.eye(4)
        tilt[0, 2], tilt[2, 0] = np.sin(dy), -np.sin(dy)
        tilt[0, 0] = tilt[2, 2] = np.cos(dy)
        T = T @ step @ tilt
    return T[:, :3, :3] @ np.array(BALL) + T[:, :3, 3]


def independent(placements: dict[str, Placement]) -> np.ndarray:
    """Errors (42,) of the arm by scipy: balls of a socket agree, distances are right."""
    tolerance = np.tile([8e-3, 1e-3, 1e-3, 8e-3, 8e-3, 1e-3], 7)

    def residuals(p: np.ndarray) -> np.ndarray:
        rows = [p]
        for both in placements.values():
            balls = [forward(p * tolerance, q) for q in both]
            means = [b.mean(axis=0) for b in balls]
            rows += [((b - m) / SEAT).ravel() for b, m in zip(balls, means, strict=True)]
            wrong = np.linalg.norm(means[0] - means[1]) - DISTANCE
            rows.append(np.array([wrong / SEAT * len(both[0]) ** 0.5]))
        return np.concatenate(rows)

    return np.asarray(least_squares(residuals, np.zeros(42)).x * tolerance)


def set_up(name: str, both: Placement) -> Sockets:
    """The tool at one placement: roughly where the data sheet's arm reaches its sockets."""
    first, second = (forward(np.zeros(42), q).mean(axis=0) for q in both)
    x = (second - first) / np.linalg.norm(second - first)
    yaw, pitch = np.arctan2(x[1], x[0]), -np.arcsin(x[2])
    turn = rotation_matrix([0.0, 0.0, yaw]) @ rotation_matrix([0.0, pitch, 0.0])
    return Sockets(
        holes=((0.0, 0.0, 0.0), (DISTANCE, 0.0, 0.0)),
        places=(tuple(first.tolist()),),
        rotation=tuple(rotation_vector(turn).tolist()),
        tip=BALL,
        sigma=SEAT,
        name=name.replace("-", "_"),
    )


def fit(placements: dict[str, Placement]) -> Model:
    """Our calibration with the visits of some placements."""
    links: list[dict[str, object]] = [{"joint": None, "axes": "coincident"}]
    for a, d, alpha in ROWS:
        links.append({"joint": "R", "axes": "perpendicular", "a": a, "d": d, "alpha": alpha})
    del links[-1]["axes"]
    sensors = [set_up(name, both) for name, both in placements.items()]
    mechanism = load_mechanism("serial", links=links, home=HOME)
    model = new_model(mechanism, sensors=sensors)
    visits = [
        (f"{sensor.name}{k + 1}", q)
        for sensor, both in zip(sensors, placements.values(), strict=True)
        for k, q in enumerate(both)
    ]
    names = np.concatenate([[name] * len(q) for name, q in visits])
    joints = np.concatenate([q for _, q in visits])
    n = len(joints)
    data = Dataset.from_arrays(
        model.joints,
        joints,
        np.zeros((n, 3)),
        measured=np.zeros((n, 6), dtype=bool),
        joint_sigma=[JOINT] * 7,
        conditions={f"reading.{c}": np.where(names == c, 0.0, np.nan) for c, _ in visits},
        pose_id=np.arange(n),
        source="MUKCa",
    )
    return pc.fit(model, data, hold_out=0.0, prior=True, insist=True).model


def balls(model: Model, q: np.ndarray) -> np.ndarray:
    poses = Kinematics(model).direct(q)
    return np.asarray(poses.position + poses.rotation @ np.array(BALL))


def judge(both: list[np.ndarray]) -> tuple[float, float]:
    """Their mean absolute error, and the error of the distance of the sockets (m)."""
    away = np.concatenate([np.linalg.norm(b - b.mean(axis=0), axis=1) for b in both])
    distance = np.linalg.norm(both[0].mean(axis=0) - both[1].mean(axis=0))
    return float(away.mean()), float(abs(distance - DISTANCE))


def main() -> None:
    for folder in map(Path, sys.argv[1:]):
        placements = read(folder)
        print(f"{folder.name}: {len(placements)} placements; mm: consistency, distance")
        print("| held out | visits | data sheet | parallel_cal | scipy |")
        rows = []
        for held, both in placements.items():
            rest = {name: q for name, q in placements.items() if name != held}
            model, other = fit(rest), independent(rest)
            found = [
                judge([forward(np.zeros(42), q) for q in both]),
                judge([balls(model, q) for q in both]),
                judge([forward(other, q) for q in both]),
            ]
            rows.append(found)
            cells = " | ".join(f"{1e3 * a:.2f}, {1e3 * b:.2f}" for a, b in found)
            print(f"| {held} | {sum(map(len, both))} | {cells} |", flush=True)
        mean = np.mean(rows, axis=0) * 1e3
        print("| mean | | " + " | ".join(f"{a:.2f}, {b:.2f}" for a, b in mean) + " |")


if __name__ == "__main__":
    with single_threaded():
        main()
