"""Robots of the shelf calibrated from simulated measurements of their independent twins.

The twin strays from the drawing by its tolerances. A tracker of 0.1 mm measures the platform. The
fit must end at the noise floor, at poses that it has not seen. Backlash and compliance that are
hidden in the twin must be named.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import virtual_shelf as vf
from marks import as_slow

from parallel_cal.diagnosis.comparison import compare
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.identification.fit import fit
from parallel_cal.identification.fit_warnings import chi2_band
from parallel_cal.model.mechanism import poses_in_workspace
from parallel_cal.model.model import new_model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.virtual.load_effects import ShaftTwist
from parallel_cal.virtual.robot import Backlash, SampleConditions, solve_true_pose, turn

MM, ARCSEC = 1e-3, np.pi / 180 / 3600
POSITION, READING = 0.1 * MM, {"rad": 30 * ARCSEC, "m": 5e-6}
TWINS = {
    "stewart_rss": vf.StewartRss,
    "hexaglide": vf.Hexaglide,
    "ankle_2rsu": vf.Ankle2Rsu,
    "quattro": vf.Quattro,
    "tripod_prs": vf.TripodPrs,
    "plate_rrs": vf.PlateRrs,
    "palletizer": vf.Palletizer,
    "tripod_struts": vf.TripodStruts,
    "pentapod": vf.Pentapod,
    "hanging_sled": vf.HangingSled,
}


@dataclass
class Session:
    """A nominal model, the recorded samples, and others with true poses that nobody recorded."""

    model: Any
    data: Any
    unseen: Any


def build(name, seed):
    """The nominal model, and a twin that strays from it by half its tolerances."""
    model = new_model(name)
    free = ~np.array(model.fixed)
    draw = np.random.default_rng([seed, 1]).standard_normal(len(model.values)) * free
    values = model.values + 0.5 * model.table.tolerance * draw
    return model, TWINS[name](model.table.mapping(values))


def record(name, seed=0, n=80, effects=(), payload=0.0):
    """Visit n poses twice, from both sides if there is a backlash, and 100 more without noise."""
    model, twin = build(name, seed)
    rng = np.random.default_rng([seed, 2])
    r, R = poses_in_workspace(model.mechanism, n + 100, rng)
    visits, new = np.repeat(np.arange(n), 2), np.arange(n, n + 100)
    q, r, R = twin.inverse(r, R)
    unit = model.mechanism.joint_units[0]
    sigma = POSITION / model.mechanism.length / 2  # of the orientation: a tracker with its target

    def true(which):
        """The conditions of visits, and the readings and poses of the robot there."""
        reading = q[which]
        side = np.where(rng.random(reading.shape) < 0.5, -1.0, 1.0) if effects else 0 * reading
        loads = payload * rng.random(len(which))
        at = SampleConditions(1.0 * which, 20 + 0 * loads, loads, side)
        start = r[which], R[which]
        return at, reading, *solve_true_pose(twin, effects, reading, at, start)[1:]

    def dataset(which, share):
        """Samples with a share of the noise."""
        at, reading, position, rotation = true(which)
        conditions = {"payload": at.payload} if payload else {}
        sides = zip(model.joints, at.direction.T, strict=True)
        conditions |= {f"direction.{joint}": side for joint, side in sides if side.any()}
        noise = [share * rng.standard_normal(part.shape) for part in (reading, position, position)]
        return Dataset.from_arrays(
            model.joints,
            reading + READING[unit] * noise[0],
            position + POSITION * noise[1],
            turn(sigma * noise[2]) @ rotation,
            pose_id=which,
            frame="base",
            conditions=conditions,
            joint_sigma=READING[unit],
            pose_cov=np.diag([POSITION**2] * 3 + [sigma**2] * 3),
        )

    return Session(model, dataset(visits, 1.0), dataset(new, 0.0))


def misses(model, truth):
    """Rms errors of the prediction at readings that were not recorded: m, rad."""
    errors = compare(model, truth).errors
    return [float(np.sqrt(np.nanmean(errors.norms(k) ** 2))) for k in ("position", "orientation")]


QUICK = ("ankle_2rsu", "tripod_prs")  # the others take longer
EACH = [n if n in QUICK else pytest.param(n, marks=pytest.mark.wide) for n in TWINS]


@pytest.mark.parametrize("name", EACH)
def test_a_fit_to_the_twins_measurements_ends_at_the_noise_floor_at_poses_not_seen(name):
    session = record(name)
    result = fit(session.model, session.data)
    low, high = chi2_band(result.estimate.dof)
    assert 0.9 * low < result.estimate.chi2_per_dof < 1.1 * high
    for kind in ("position_rms", "orientation_rms"):
        held, floor = (getattr(e, kind) for e in (result.held_out.summary, result.noise_floor))
        assert held < 1.2 * floor
    before, after = misses(session.model, session.unseen), misses(result.model, session.unseen)
    # The truth has no noise: the model predicts better than one measurement of 0.1 mm.
    assert after[0] < min(POSITION, before[0])
    assert after[1] <= before[1] / 3  # both are 0 of a point


HIDDEN = [  # robot, effect in the twin, payload up to (kg), its name in the catalogue
    ("ankle_2rsu", Backlash((0.0028, 0.0025)), 0.0, "backlash"),
    as_slow(("stewart_rss", Backlash((0.0028,) * 6), 0.0, "backlash")),
    ("hexaglide", Backlash((0.19 * MM,) * 6), 0.0, "backlash"),
    as_slow(("hexaglide", ShaftTwist((8e-6, 0.0, 2e-6, 0.0, 8e-6, 0.0)), 10.0, "joint_compliance")),
    pytest.param(
        *("palletizer", ShaftTwist((0.0, 5e-5, 5e-5, 0.0)), 10.0, "joint_compliance"),
        marks=pytest.mark.slow,
    ),
]


@pytest.mark.wide
@pytest.mark.parametrize(("name", "effect", "payload", "expected"), HIDDEN, ids=str)
def test_an_effect_that_is_hidden_in_the_twin_is_named(name, effect, payload, expected):
    session = record(name, effects=(effect,), payload=payload)
    found = diagnose(session.model, session.data).document()
    assert found["verdict"] == "explained"
    assert found["effects"] == [expected]
