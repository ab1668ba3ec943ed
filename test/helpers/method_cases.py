"""Virtual robots of every mechanism, strayed from nominal, as the methods see them."""

from functools import cache

import numpy as np
from test_mechanisms_against_virtual import CASES, Case, wanted
from virtual_serial import Serial

from parallel_cal.base.rotation import rotation_matrix
from parallel_cal.identification.observations import Observations
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_mechanism
from parallel_cal.virtual import robot as vr

SIGMA = {"joint": 5e-6, "position": 5e-6, "orientation": 2e-5}  # rad or m, m, rad


class Tables:
    """A virtual Delta whose smaller models' parameters are a table of the largest one."""

    def __init__(self, p):
        self._robot = vr.Delta({**vr.TABLE_5_12, **p})

    def inverse(self, r, R):
        q, turned = self._robot.inverse(r)
        return q, r, turned


def nominal_delta(p):
    """Three equal chains a third of a turn apart: radius R, arm La, rod Lb."""
    own = {"D_x": p["R"], "D_y": 0.0, "La_x": p["La"], "La_y": 0.0, "Lb": p["Lb"]}
    equal = {f"chain{i}.{name}": value for i in (1, 2, 3) for name, value in own.items()}
    return Tables(equal | {name: p[name] for name in p if name.endswith("theta")})


ROBOTS = {
    "delta54": Case("delta54", Tables),
    "delta24": Case("delta24", Tables),
    "delta_nominal": Case("delta_nominal", nominal_delta),
    **{str(case): case for case in CASES},
}


@cache
def strayed(name, seed=0, share=0.5):
    """A model at nominal values, the values of the robot that is shown, and that robot.

    Only what a fit may change is off: by `share` of its tolerance, 1 sigma.
    """
    case = ROBOTS[name]
    model = new_model(load_mechanism(case.name, **dict(case.options)))
    draw = np.random.default_rng(seed).standard_normal(len(model.values)) * ~model.fixed
    truth = model.values + share * model.table.tolerance * draw
    return model, truth, case.build(model.table.mapping(truth))


@cache
def true_poses(name, n, seed):
    """Joints and poses of the robot all over its workspace."""
    model, _, robot = strayed(name)
    r, R = wanted(model.mechanism, n, seed)
    return robot.inverse(r) if isinstance(robot, Serial) else robot.inverse(r, R)


def evidence_of(poses, seed=None, sigma=SIGMA):
    """What a device shows of true configurations; with a seed, noise of `sigma` added."""
    q, r, R = poses
    n = q.shape[1]
    scale = np.repeat([sigma["joint"], sigma["position"], sigma["orientation"]], [n, 3, 3])
    e = scale * np.random.default_rng(seed).standard_normal((len(q), n + 6)) * (seed is not None)
    x = np.hstack(
        [q + e[:, :n], r + e[:, n : n + 3], (rotation_matrix(e[:, n + 3 :]) @ R).reshape(-1, 9)]
    )
    return Observations(
        x,
        np.tile(np.diag(scale**2), (len(q), 1, 1)),
        np.ones((len(q), n + 6), bool),
        np.zeros((len(q), 0)),
        np.arange(len(q)),
        np.zeros((len(q), 0)),
        {},
    )
