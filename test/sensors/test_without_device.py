"""Calibrations without a device: sockets, edges, inclinometers; the truth is numpy and scipy."""

from dataclasses import replace

import numpy as np
import pytest
from arms import AXES, ROWS
from chains import five_bar, make_chain
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from virtual_setups import random_delta, workspace

import parallel_cal as pc
from parallel_cal.base.errors import FitError, ModelError
from parallel_cal.identification.acceptance import acceptance
from parallel_cal.model.model import Noise, new_model
from parallel_cal.model.shelf import load_mechanism, load_sensor
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.sensors.straight_edge import StraightEdge
from parallel_cal.session.steps import fitted
from parallel_cal.virtual.stewart import Stewart

RING = tuple((0.05 * np.cos(a), 0.05 * np.sin(a), 0.0) for a in np.arange(8) * np.pi / 4)
TIP = (0.0, 0.0, -0.06)


def touched(model, q, sigma, contacts=None, **readings):
    """Samples of a session without a pose device."""
    n, columns = len(q), {}
    for name in sorted(set([] if contacts is None else contacts)):
        columns[f"reading.{name}"] = np.where(np.array(contacts) == name, 0.0, np.nan)
    return Dataset.from_arrays(
        model.joints,
        q,
        np.zeros((n, 3)),
        measured=np.zeros((n, 6), dtype=bool),
        joint_sigma=[sigma] * len(model.joints),
        conditions=columns | {f"reading.{k}": v for k, v in readings.items()},
        pose_id=np.arange(n),
        source="without a device",
    )


def left(found, truth):
    """Rms distance (m) of points from true ones, after the best rigid displacement."""
    a, b = truth - truth.mean(axis=0), found - found.mean(axis=0)
    turn, _ = Rotation.align_vectors(a, b)
    return np.sqrt(np.sum((a - turn.apply(b)) ** 2, axis=1).mean())


def hexapod(seed):
    """A hexapod of another hand, each dimension off by its tolerance."""
    table = new_model("stewart42").table
    rng = np.random.default_rng(seed)
    values = table.nominal + table.tolerance * rng.standard_normal(len(table))
    return Stewart(dict(zip(table.names, values, strict=True))), rng


def hexapod_poses(n, rng, model):
    w = model.mechanism.workspace
    low, high = np.array(w.low), np.array(w.high)
    x = rng.uniform(low, high, (n, 6))
    return x[:, :3], Rotation.from_rotvec(x[:, 3:]).as_matrix()


def hexapod_in_sockets(seed, centres, poses, seat=20e-6, **options):
    """(model, dataset, joints and tips at unseen poses) of a hexapod that visits sockets."""
    model = new_model("stewart42", sensors=[load_sensor("sockets", tip=TIP, sigma=seat, **options)])
    robot, rng = hexapod(seed)
    _, R = hexapod_poses(poses, rng, model)
    w, which = model.mechanism.workspace, np.arange(poses) % len(centres)
    middle = (np.array(w.low) + w.high)[:3] / 2 + TIP + [0.01, -0.02, 0.005]
    seats = middle + Rotation.from_euler("xyz", [2, -1, 3], degrees=True).apply(centres)
    r = seats[which] + rng.normal(0, seat, (poses, 3)) - R @ np.array(TIP)
    q = robot.inverse(r, R)[0] + rng.normal(0, 5e-6, (poses, 6))
    unseen, turned = hexapod_poses(100, rng, model)
    data = touched(model, q, 5e-6, [f"socket{k + 1}" for k in which])
    return model, data, robot.inverse(unseen, turned)[0], unseen + turned @ np.array(TIP)


def tips(model, q, tip=TIP):
    poses = pc.Kinematics(model).direct(q)
    return poses.position + poses.rotation @ np.array(tip)


def test_sockets_at_unknown_places_calibrate_a_hexapod_of_another_hand():
    centres = np.array([(-0.04, 0, 0), (0.05, 0.03, 0.01), (0, -0.05, 0.02)])
    model, data, q, seen = hexapod_in_sockets(1, centres, 90, n=3)
    result = pc.fit(model, data)
    assert left(tips(result.model, q), seen) < 0.6 * left(tips(model, q), seen)
    assert 0.7 < result.estimate.chi2_per_dof < 1.3


def test_known_distances_between_the_sockets_show_more():
    model, data, q, seen = hexapod_in_sockets(1, RING, 96, holes=RING)
    result = pc.fit(model, data)
    assert left(tips(result.model, q), seen) < 0.15 * left(tips(model, q), seen)
    table = result.model.table
    found = [result.model.values[table.names.index(f"socket.plate.r{a}")] for a in "xyz"]
    # {B} of the fit is that of the drawing to within what its tolerances allow: 1 mm over 0.1 m
    assert np.degrees(found) == pytest.approx([2, -1, 3], abs=0.6)


def arm_in_sockets(seed, centres, n=80, seat=50e-6):
    """(model, dataset, joints and balls at unseen poses) of a UR5 by its own matrices."""
    rng = np.random.default_rng(seed)
    rows = np.array(ROWS["ur5"]) + rng.normal(0, [0.5e-3, 0.5e-3, 3e-3], (6, 3))
    zeros, ball = np.append(rng.normal(0, 3e-3, 5), 0.0), np.array([0.03, 0.0, 0.1])

    def forward(q):
        T = np.eye(4)
        for (a, d, alpha), angle in zip(rows, q + zeros, strict=True):
            step = np.eye(4)
            step[:3, :3] = Rotation.from_euler("ZX", [angle, alpha]).as_matrix()
            step[:3, 3] = a * np.cos(angle), a * np.sin(angle), d
            T = T @ step
        return T[:3, :3] @ ball + T[:3, 3]

    home, q = np.array([0.3, -1.2, 1.4, -0.8, -1.3, 0.4]), []
    middle = forward(home)
    for k in range(n):
        goal = middle + centres[k % len(centres)] + rng.normal(0, seat, 3)
        start = home + rng.uniform(-0.7, 0.7, 6)
        q.append(
            least_squares(
                lambda x, g=goal, s=start: np.append(1e3 * (forward(x) - g), 1e-6 * (x - s)), start
            ).x
        )
    links = [{"joint": None, "axes": "coincident"}]
    for (a, d, alpha), axes in zip(ROWS["ur5"], [*AXES["ur5"], None], strict=True):
        links.append(
            {"joint": "R", "a": a, "d": d, "alpha": alpha} | ({"axes": axes} if axes else {})
        )
    sensor = load_sensor("sockets", holes=tuple(centres), tip=tuple(ball), sigma=seat)
    model = new_model(load_mechanism("serial", links=links, home=tuple(home)), sensors=[sensor])
    q = np.array(q) + rng.normal(0, 2e-5, (n, 6))
    unseen = home + rng.uniform(-0.5, 0.5, (60, 6))
    data = touched(model, q, 2e-5, [f"socket{k % len(centres) + 1}" for k in range(n)])
    return model, data, unseen, np.array([forward(x) for x in unseen]), ball


@pytest.mark.wide
def test_two_sockets_at_a_known_distance_calibrate_an_arm_of_another_hand():
    model, data, q, seen, ball = arm_in_sockets(2, [(0.0, 0.0, 0.0), (0.05, 0.0, 0.0)])
    result = pc.fit(model, data)
    before, after = (left(tips(m, q, ball), seen) for m in (model, result.model))
    assert after < 0.5 * before
    assert 0.7 < result.estimate.chi2_per_dof < 1.3


def test_a_plate_calibrates_a_delta_that_unknown_sockets_tell_nothing():
    robot = random_delta(3)
    rng = np.random.default_rng(5)
    holes = [(x, y, z) for z in (0.0, 0.03) for x in (-0.05, 0, 0.05) for y in (-0.05, 0, 0.05)]
    seats = np.array(holes) + [0.004, -0.003, 0.19]
    q = robot.inverse(np.repeat(seats, 2, axis=0) + rng.normal(0, 10e-6, (36, 3)))[0]
    joints, where = workspace(robot)
    errors = {}
    for name, options in {"plate": {"holes": tuple(holes)}, "unknown": {"n": 18}}.items():
        model = new_model("delta24", sensors=[load_sensor("sockets", sigma=10e-6, **options)])
        data = touched(model, q, 2e-5, [f"socket{k // 2 + 1}" for k in range(36)])
        result = pc.fit(model, data, hold_out=0.0, insist=True)
        errors[name] = left(pc.Kinematics(result.model).direct(joints).position, where)
    nominal = left(pc.Kinematics(new_model("delta24")).direct(joints).position, where)
    assert errors["plate"] < 0.15 * nominal
    assert errors["unknown"] == pytest.approx(nominal, rel=0.05)


def test_an_inclinometer_of_another_hand_shows_the_tilt_of_a_hexapod():
    model = new_model("stewart42", sensors=[load_sensor("inclinometer", sigma=0.1e-3)])
    robot, rng = hexapod(4)
    r, R = hexapod_poses(120, rng, model)
    mount = Rotation.from_rotvec([0.01, -0.015, 0.02]).as_matrix()
    up = np.einsum("nji,j->ni", R @ mount, [0.0, 0.0, 1.0]) + rng.normal(0, 0.1e-3, (120, 3))
    readings = {
        "inclinometer.roll": np.arctan2(up[:, 1], up[:, 2]),
        "inclinometer.pitch": -np.arctan2(up[:, 0], np.hypot(up[:, 1], up[:, 2])),
    }
    data = touched(model, robot.inverse(r, R)[0] + rng.normal(0, 5e-6, (120, 6)), 5e-6, **readings)
    result = pc.fit(model, data)
    r, R = hexapod_poses(100, rng, model)
    q = robot.inverse(r, R)[0]

    def tilt(m):  # what is left after the best mounting and levelling
        found = pc.Kinematics(m).direct(q).rotation[:, 2]
        turn, _ = Rotation.align_vectors(R[:, 2], found)
        return np.sqrt(np.mean(np.sum((turn.apply(found) - R[:, 2]) ** 2, axis=1)))

    assert tilt(result.model) < 0.35 * tilt(model)
    assert 0.7 < result.estimate.chi2_per_dof < 1.3


def test_points_on_a_straight_edge_and_a_plumb_line_lie_on_them():
    directions = {"edge": (1.0, 0.0, 0.0), "line": (0.0, 0.0, 1.0)}
    for name, direction in directions.items():
        sensor = StraightEdge(direction=direction, plumb=name == "line", name=name, sigma=10e-6)
        model = new_model("delta24", sensors=[sensor])
        robot, rng = random_delta(3), np.random.default_rng(6)
        tilt = np.array([0.0, 0.02, -0.03]) * (name == "edge")
        along = rng.uniform(-0.06, 0.06, 40)[:, None] * (np.array(direction) + tilt)
        points = along + [0.003, 0.01, 0.2] + rng.normal(0, 10e-6, (40, 3))
        q = robot.inverse(points)[0] + rng.normal(0, 2e-5, (40, 3))
        result = pc.fit(model, touched(model, q, 2e-5, [name] * 40), hold_out=0.0)
        assert 0.5 < result.estimate.chi2_per_dof < 1.5
        found = pc.Kinematics(result.model).direct(robot.inverse(along + [0.003, 0.01, 0.2])[0])
        spread = np.linalg.svd(found.position - found.position.mean(axis=0))[1]
        assert spread[1] / np.sqrt(40) < 30e-6  # straight again
        nominal = pc.Kinematics(model).direct(robot.inverse(along + [0.003, 0.01, 0.2])[0]).position
        assert np.linalg.svd(nominal - nominal.mean(axis=0))[1][1] > 1.5 * spread[1]


def blind(mechanism, sensor, n=30, **options):
    model = new_model(mechanism, sensors=[load_sensor(sensor, **options)])
    joint = 2e-5 if model.mechanism.joint_units[0] == "rad" else 1e-5
    return pc.plan(replace(model, noise=Noise(joint)), n, pool=150)


def test_a_plan_says_before_anybody_measures_what_stays_unknown():
    sockets = blind("delta24", "sockets")
    assert any("no reading contains a known length" in w for w in sockets.warnings)
    assert any("leaves a position error" in w for w in sockets.warnings)
    # A Delta has one configuration for each socket: nothing is better than the drawing.
    assert sockets.expected.undetermined_rms > 0.99 * sockets.expected.position_rms
    ring = blind("delta24", "sockets", holes=RING)
    assert not any("known length" in w for w in ring.warnings)
    assert ring.expected.position_rms < 0.7 * sockets.expected.position_rms


def test_planned_poses_satisfy_the_contact():
    found = blind("stewart42", "sockets", n=24, tip=TIP)
    where = found.poses.position + found.poses.rotation @ np.array(TIP)
    distances = np.linalg.norm(where[:, None] - where[None], axis=2)
    same = (distances < 1e-8).sum(axis=1)
    assert (same >= 2).all()  # several orientations over one socket
    turned = found.poses.rotation
    assert np.abs(turned - turned[0]).max() > 0.05


def test_wrong_set_ups_are_refused():
    with pytest.raises(ModelError, match="one hole has no distance"):
        load_sensor("sockets", holes=[(0.0, 0.0, 0.0)])
    with pytest.raises(ModelError, match="not along x"):
        load_sensor("sockets", holes=[(0.0, 0.0, 0.0), (0.0, 0.05, 0.0)])
    with pytest.raises(ModelError, match="2 places, expected 3"):
        load_sensor("sockets", n=3, places=[(0.0, 0.0, 0.0)] * 2)
    with pytest.raises(ModelError, match="direction"):
        load_sensor("straight_edge", direction=(0.0, 0.0, 0.0))
    with pytest.raises(ModelError, match="sigma is -1"):
        load_sensor("sockets", sigma=-1.0)


def test_a_simulated_session_can_be_written_and_read_again(tmp_path):
    model = new_model("delta24", sensors=[load_sensor("sockets", holes=RING)])
    session = pc.simulate(model, 16, seed=2)
    pc.write_bag(session, tmp_path / "bag")
    data = pc.load_dataset(tmp_path / "bag", joints=model.joints)
    assert not data.measured.any()
    held = np.array([np.isfinite(data.conditions[f"reading.socket{k}"]) for k in range(1, 9)])
    assert held.sum(axis=0).tolist() == [1] * 16
    assert held.sum(axis=1).tolist() == [2] * 8


def test_an_update_needs_a_calibration():
    model = new_model("delta24")
    with pytest.raises(FitError, match="no covariance"):
        pc.fit(model, pc.simulate(model, 10).dataset(), update=True)


def test_sockets_that_tell_a_delta_nothing_give_no_new_model():
    robot, rng = random_delta(3), np.random.default_rng(8)
    seats = np.array([(0.03, 0.0, 0.2), (-0.02, 0.03, 0.21), (0.0, -0.03, 0.19)])
    which = np.arange(45) % 3
    q = robot.inverse(seats[which] + rng.normal(0, 20e-6, (45, 3)))[0]
    model = new_model("delta24", sensors=[load_sensor("sockets", n=3, sigma=20e-6)])
    data = touched(model, q, 2e-5, [f"socket{k + 1}" for k in which])
    # Only the places of the sockets would explain the touches better.
    with pytest.raises(FitError, match="does not fall"):
        fitted(model, data)


def drifted_delta(seed):
    """Samples of a tracker before and after a Delta's zeros have drifted by 0.5 mrad."""
    robot, rng = random_delta(seed), np.random.default_rng([seed, 1])
    drift = rng.normal(0, 0.5e-3, 3)
    model = replace(new_model("delta24"), noise=Noise(2e-5, 30e-6))

    def session(n, drift):
        r = rng.uniform((-0.06, -0.06, 0.14), (0.06, 0.06, 0.26), (n, 3))
        q = robot.inverse(r)[0] + drift + rng.normal(0, 2e-5, (n, 3))
        seen = r + rng.normal(0, 30e-6, (n, 3))
        return Dataset.from_arrays(
            model.joints,
            q,
            seen,
            pose_cov=np.diag([30e-6**2] * 3 + [1e6] * 3),
            joint_sigma=[2e-5] * 3,
            pose_id=np.arange(n),
            source="virtual tracker",
        )

    joints, where = workspace(robot)
    return model, session(80, 0.0), session(10, drift), joints + drift, where


def test_ten_touches_update_a_calibration_better_than_they_make_one():
    rows = []
    for seed in range(3):
        model, before, today, joints, where = drifted_delta(seed)
        last = pc.fit(model, before, hold_out=0.0).model
        update = pc.fit(last, today, hold_out=0.0, update=True)
        models = last, update.model, pc.fit(model, today, hold_out=0.0).model
        found = [pc.Kinematics(m).direct(joints).position for m in models]
        rows.append([np.sqrt(np.mean(np.sum((r - where) ** 2, axis=1))) for r in found])
        assert update.document()["priors"] == "last calibration"
    unchanged, updated, scratch = np.sqrt(np.mean(np.square(rows), axis=0))
    assert updated < 0.5 * unchanged
    assert updated < 0.6 * scratch


def test_a_plan_for_an_update_names_how_few_poses_show_a_drift():
    model, before, *_ = drifted_delta(0)
    last = pc.fit(model, before, hold_out=0.0).model
    found = pc.plan(last, 8, pool=100, update=True)
    assert found.update.enough <= 5
    assert found.update.invisible == ("temperature",)  # 60 ppm: 12 um of 0.2 m
    assert (np.diff(found.update.information) > 0).all()
    with pytest.raises(FitError, match="no covariance"):
        pc.plan(model, 8, pool=100, update=True)


def test_two_arms_that_hold_one_another_are_a_chain_with_more_drives_than_motions():
    """Two planar arms of two joints, pinned at their tips; the true arms are numpy."""
    rng = np.random.default_rng(3)

    def tip(base, links, first, second):
        angles = np.array([first, first + second])
        return np.array([base + links @ np.cos(angles), links @ np.sin(angles)])

    def held(start, links, zeros):
        """Joints (left, right, left_elbow, right_elbow) at which both tips meet at `start`'s."""

        def gap(x):
            a = tip(-0.05, links[0], *(x + zeros)[[0, 2]])
            b = tip(0.05, links[1], *(x + zeros)[[1, 3]])
            return np.concatenate([1e3 * (a - b), 1e-6 * (x - start)])

        return least_squares(gap, start, xtol=1e-15, ftol=1e-15, gtol=1e-15).x

    ideal = np.array([[0.1, 0.15], [0.1, 0.15]])
    home = held(np.array([2.2, 1.09, -1.35, 1.28]), ideal, 0.0)
    options = five_bar()
    order = ["left", "right", "left_elbow", "right_elbow"]
    for joint in options["joints"]:
        at = float(home[order.index(joint["name"])])
        joint.update(driven=True, home=at, limits=[at - 1.0, at + 1.0])
    model = make_chain(options)
    links, zeros = ideal + rng.normal(0, 0.3e-3, (2, 2)), rng.normal(0, 3e-3, 4)
    q = [held(home + rng.uniform(-0.4, 0.4, 4), links, zeros) for _ in range(80)]
    q = np.array(q)[:, [order.index(name) for name in model.joints]]
    result = pc.fit(model, touched(model, q + rng.normal(0, 2e-5, q.shape), 2e-5))
    assert 0.7 < result.estimate.chi2_per_dof < 1.3
    assert result.held_out.summary.joint_rms < 0.05 * result.before.summary.joint_rms
    assert result.estimate.spectrum.unidentifiable  # among them the size of both arms


def test_a_drift_is_accepted_by_its_evidence_and_the_set_up_is_placed_alike():
    """Ten touches hold too few poses out to prove a fall; sockets that nobody visited are no
    error."""
    model, before, today, *_ = drifted_delta(2)
    last = pc.fit(model, before, hold_out=0.0).model
    update = pc.fit(last, today, update=True)
    assert update.drift.is_shown
    assert not acceptance(update).against
    again = pc.fit(last, before.select(np.arange(10)), update=True)
    assert not again.drift.is_shown


def test_axes_along_which_a_robot_moves_nothing_are_refused():
    with pytest.raises(ModelError, match=r"axes is xyz, but five_bar moves points along x, y only"):
        new_model("five_bar", sensors=[load_sensor("sockets", n=2)])
    for wrong, words in (
        ({"holes": [(0.0, 0.0, 0.0)] * 2}, "two holes are at the same place"),
        ({"holes": [(0, 0, 0), (0.1, 0, 0), (0.1, 0.1, 0)], "n": 5}, "n is 5 beside 3 holes"),
        ({"rotation": (0.0, 0.0, 90.0)}, "expected a rotation vector in rad"),
    ):
        with pytest.raises(ModelError, match=words):
            load_sensor("sockets", **wrong)


def test_a_plan_says_which_socket_each_pose_touches():
    plate = load_sensor("sockets", holes=((0, 0, 0), (0.05, 0, 0), (0, 0.05, 0)), sigma=2e-5)
    model = replace(new_model("delta24", sensors=[plate]), noise=Noise(2e-5))
    found = pc.plan(model, 12, pool=60, prior=True)
    assert set(found.contacts) <= {"socket1", "socket2", "socket3"}
    header, *rows = [line for line in found.csv().splitlines() if not line.startswith("#")]
    assert header.endswith(",contact")
    assert [row.rpartition(",")[2] for row in rows] == found.contacts
