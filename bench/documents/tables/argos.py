"""Tables 5.22, 5.24, 5.25 and 5.27 on virtual Argos mock-ups, nine device parameters identified.

The robots are those of tables 5.22 and 5.25, built from lines, pantographs and balls; they are
measured at 47 orientations with the thesis' devices: encoders 25 arcsec, probes 1.9 um, a gimbal
in steps of 2.7 arcmin. Frames and gimbal stand as a person mounts them: some mrad and mm off.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import virtual_setups as vs

from bench.documents.tables.common import (
    ARCMIN,
    ARCSECOND,
    DEGREE,
    MM,
    UM,
    error_table,
    factor,
)
from parallel_cal.identification.methods import implicit
from parallel_cal.identification.observations import observe
from parallel_cal.identification.prediction_errors import errors
from parallel_cal.model.model import Model, new_model
from parallel_cal.model.shelf import load_sensor
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.virtual import argos as va
from parallel_cal.virtual import robot as vr

POSES, REACH = 47, 0.6  # rad about each axis: as far as the virtual pantographs' motors go
NOISE = vr.Noise(25 * ARCSECOND, 1.9 * UM, 2.7 * ARCMIN / np.sqrt(12))
HOME_QUATERNION = (3**-0.5, -(3**-0.5), 0.0, 3**-0.5)  # undoes home's turn: the device shows zero
DEVICE = vs.Device(
    shift=(1e-3, -2e-3, 1.5e-3),
    turn=(5e-3, -8e-3, 12e-3),
    target_shift=(1e-3, 2e-3, -1e-3),
    target_turn=va.Argos.home_turn.T @ vr.turn([-0.01, 0.02, 0.015]),
    zeros=(0.02, -0.03, 0.015),
)
LOST = [f"chain3.{name}" for name in ("alpha0", "Omega", "Phi", "omega", "phi")]  # in table 5.25
SHIFTS = tuple(f"{frame}.{axis}" for frame in ("frame", "target") for axis in "xyz")
ROBOTS = {"argos9": va.TABLE_5_22, "argos27": va.TABLE_5_25}
# Tables 5.24 and 5.27, arcmin and um, component by component and norm; None: not printed.
BEFORE = {
    "orientation": {"mean": (28, 22, 30, 99), "deviation": (81, 29, 44, 40)},
    "joint": {"mean": (28, -6.2, 28, 95), "deviation": (81, 28, 40, 37)},
}
AFTER_9 = {
    "orientation": {"mean": (-0.32, -0.17, 1.5, 18), "deviation": (12, 9.7, 13, 8.5)},
    "joint": {"mean": (-0.13, -0.03, 0.16, 18), "deviation": (12, 12, 12, 10)},
}
POSITION_BEFORE = {"mean": (None, None, None, 958), "deviation": (294, 251, 271, 338)}
AFTER_27 = {
    "orientation": {"mean": (-0.04, 0.91, 0.21, 19), "deviation": (11, 13, 11, 8.7)},
    "position": {"mean": (-3.0, -36, 26, 285), "deviation": (167, 179, 189, 130)},
    "joint": {"mean": (-0.14, 0.90, 1.1, 18), "deviation": (11, 14, 10, 10)},
}
FACTORS = {
    "argos9": {"orientation": 5.4, "joint": 5.2},
    "argos27": {"orientation": 5.3, "joint": 5.3, "position": 958 / 285},
}


def session(robot: va.Argos, seed: int, position: bool, device: vs.Device = DEVICE) -> Dataset:
    """What the devices show at 47 orientations about home; model 9 takes no positions."""
    around = np.random.default_rng(0).uniform(-REACH, REACH, (POSES, 3))
    q, *pose = robot.inverse(R=vr.turn(around) @ va.Argos.home_turn)
    r, R = device.shows(*pose)
    dq, dr, w = NOISE.draw(np.random.default_rng([seed, 5]), POSES)
    return Dataset.from_arrays(
        ("joint1", "joint2", "joint3"),
        q + dq,
        r + dr,
        vr.turn(w) @ R,
        measured=np.tile([position] * 3 + [True] * 3, (POSES, 1)),
        pose_cov=np.diag([NOISE.position**2] * 3 + [NOISE.orientation**2] * 3),
        joint_sigma=[NOISE.joint] * 3,
        pose_id=np.arange(POSES),
        source="virtual argos",
    )


def numbers(draws: int = 50) -> dict[str, Any]:
    """Both models over noise draws with the seeds 0, 1, ..."""
    return {
        "draws": draws,
        **{name: study(name, draws) for name in ROBOTS},
        "argos9 on the spatial robot": left_by_model_9(),
        "argos27 with nine": {f"{size:g}": left_with_nine(size) for size in (0.5, 1.0)},
    }


def study(name: str, draws: int) -> dict[str, Any]:
    """Parameters over all draws; errors of draw 0 before and after, where `before` has its device
    aligned with the nominal robot already (six frame and three gimbal numbers identified)."""
    model, robot = with_device(name), va.Argos(ROBOTS[name])
    own = np.array([n in ROBOTS[name] for n in model.table.names])
    evidences = [observe(model, session(robot, s, name == "argos27")) for s in range(draws)]
    found = [implicit.estimate(model, e, ~model.fixed) for e in evidences]
    aligned = model.with_values(implicit.estimate(model, evidences[0], ~own).values)
    before = errors(aligned, evidences[0])
    after = errors(model.with_values(found[0].values), evidences[0])
    return {
        "free": int((~model.fixed).sum()),
        "rank": found[0].spectrum.rank,
        "chi2_per_dof": found[0].chi2_per_dof,
        "parameters": parameters(model, own, np.array([f.values for f in found])),
        "before": error_table(before),
        "after": error_table(after),
        "factors": {k: factor(before, after, k) for k in FACTORS[name]},
    }


def with_device(name: str, fixed: tuple[str, ...] = ()) -> Model:
    sensor = load_sensor(
        "device_frame", target_quaternion=HOME_QUATERNION, gimbal=True, fixed=fixed
    )
    return new_model(name, sensors=[sensor])


def left_by_model_9() -> dict[str, Any]:
    """What model 9 leaves of the orientations of table 5.25's robot, which is not spherical."""
    return left(with_device("argos9"), session(va.Argos(va.TABLE_5_25), 0, position=False))


def left_with_nine(size: float) -> dict[str, Any]:
    """What model 27 leaves with the thesis' nine device parameters, when position device and
    target stand `size` times our shifts off: none of the nine is a shift."""
    shifts = (size * np.array(s) for s in (DEVICE.shift, DEVICE.target_shift))
    off = vs.Device(next(shifts), DEVICE.turn, next(shifts), DEVICE.target_turn, DEVICE.zeros)
    data = session(va.Argos(va.TABLE_5_25), 0, position=True, device=off)
    return left(with_device("argos27", SHIFTS), data)


def left(model: Model, data: Dataset) -> dict[str, Any]:
    """Errors after unweighted implicit calibration, as in the thesis."""
    observations = observe(model, data)
    found = implicit.estimate(model, observations, ~model.fixed, weighted=False)
    return error_table(errors(model.with_values(found.values), observations))


def parameters(model: Model, own: np.ndarray, found: np.ndarray) -> dict[str, Any]:
    """Printed value, mean and deviation of ours (degrees, mm) for the robot's own parameters."""
    rows = {}
    for i in np.flatnonzero(own):
        p = model.table[i]
        unit = DEGREE if p.unit == "rad" else MM
        sample = found[:, i] / unit
        printed = ROBOTS[model.mechanism.name][p.name] / unit
        rows[p.name] = {"printed": printed, "mean": sample.mean(), "deviation": sample.std(ddof=1)}
    return rows
