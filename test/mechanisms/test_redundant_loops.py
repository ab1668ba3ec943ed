"""Loops with more equations than unknowns: a wrist whose axes meet in a point, with few digits.

The wrist is written here a second time, from its axes and points alone, and closed by SciPy.
"""

from functools import cache

import numpy as np
import pytest
from chains import make_chain, revolute
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

import parallel_cal as pc
from parallel_cal.kinematics.all_solutions import direct_all

LEGS = (0, 1, 2)
DIGITS = 6


def direction(polar, azimuth):
    """A unit vector, by its angle from z and its azimuth in degrees."""
    theta, phi = np.radians([polar, azimuth])
    return np.array([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])


# The axes of a leg: of its motor, between its links, and on the platform. All meet in (0, 0, 0).
AXES = [
    (direction(140, 120 * k), direction(95, 120 * k + 55), direction(50, 120 * k + 20))
    for k in LEGS
]
DISTANCES = 0.06, 0.08, 0.07  # m from this point, of the joints on the three axes of a leg


def points(k):
    return [distance * axis for distance, axis in zip(DISTANCES, AXES[k], strict=True)]


@cache
def wrist(digits=DIGITS):
    """The wrist with numbers of a few digits; every frame is parallel to that of the base."""

    def numbers(vector):
        return np.round(vector, digits).tolist()

    joints, loops = [], []
    for k in LEGS:
        motor, elbow, ball = points(k)
        first, second, third = (numbers(axis) for axis in AXES[k])
        crank, link = f"crank{k}", f"link{k}"
        joints += [
            revolute(f"motor{k}", "base", crank, axis=first, origin=numbers(motor), driven=True),
            revolute(f"elbow{k}", crank, link, axis=second, origin=numbers(elbow - motor)),
        ]
        if k == 0:
            origin = numbers(ball - elbow)
            joints.append(revolute("hinge", link, "platform", axis=third, origin=origin))
        else:
            a = {"body": link, "point": numbers(ball - elbow)}
            b = {"body": "platform", "point": numbers(ball - points(0)[2])}
            loops.append({"name": f"ball{k}", "type": "point", "a": a, "b": b})
    target = {"platform": "platform", "target": [0.02, 0.03, 0.05]}
    return make_chain({"base": "base", **target, "joints": joints, "loops": loops})


def close_with_scipy(model, q, start=(0.0, 0.0, 0.0, 0.0)):
    """Return the position of {P} where the squares of both gaps are least, the gaps, and the angles
    of the passive hinges; these are sought from a start."""
    p = {
        name: dict.fromkeys("x y z rx ry rz a_x a_y a_z b_x b_y b_z zero".split(), 0.0)
        for name in [*model.joints, "elbow0", "elbow1", "elbow2", "hinge", "ball1", "ball2"]
    } | {"target": {}}
    for name, value in zip(model.table.names, model.values, strict=True):
        owner, _, key = name.rpartition(".")
        p[owner][key] = value

    def moved(frame, name, axis, value):
        own, (at, R) = p[name], frame
        small = Rotation.from_rotvec([own["rx"], own["ry"], own["rz"]])
        axis = np.round(axis, DIGITS)
        turn = Rotation.from_rotvec((value + own["zero"]) * axis / np.linalg.norm(axis))
        return at + R.apply([own["x"], own["y"], own["z"]]), R * small * turn

    def gaps(u):
        at, frames = {}, (np.zeros(3), Rotation.identity())
        for k in LEGS:
            crank = moved(frames, f"motor{k}", AXES[k][0], q[k])
            at[k] = moved(crank, f"elbow{k}", AXES[k][1], u[k])
        platform = moved(at[0], "hinge", AXES[0][2], u[3])
        found = []
        for k in (1, 2):
            own = p[f"ball{k}"]
            ends = [[own[f"{side}_{c}"] for c in "xyz"] for side in "ab"]
            (r, R), (s, S) = at[k], platform
            found.append(s + S.apply(ends[1]) - r - R.apply(ends[0]))
        target = platform[0] + platform[1].apply([p["target"][c] for c in "xyz"])
        return np.concatenate(found), target

    end = least_squares(lambda u: gaps(u)[0], start, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    return gaps(end.x)[1], np.linalg.norm(end.fun), end.x


READINGS = np.random.default_rng(3).uniform(-0.25, 0.25, (5, 3))


def strayed(model, share=1.0):
    """The wrist off its drawing: its axes miss their point by tenths of a millimetre."""
    step = np.random.default_rng(4).standard_normal(len(model.values)) * ~np.array(model.fixed)
    return model.with_values(model.values + share * model.table.tolerance * step)


@pytest.mark.wide
@pytest.mark.parametrize("share", [0.0, 0.3])
def test_redundant_loops_are_closed_where_the_squares_of_their_gaps_are_least(share):
    model = strayed(wrist(), share)
    found = pc.Kinematics(model).direct(READINGS)
    assert found.ok.all()
    expected, gaps, _ = zip(*(close_with_scipy(model, q) for q in READINGS), strict=True)
    assert found.position == pytest.approx(np.array(expected), abs=1e-9)
    # Of six digits, the loops stay open by less than a micrometre; of tilted axes, by far more.
    assert (min(gaps) > 1e-5) if share else (1e-9 < max(gaps) < 1e-6)


FAR = [[0.67, 1.44, 0.27], [1.36, 0.92, 0.7], [-0.12, 1.97, 0.65]]


@pytest.mark.parametrize("q", FAR)
def test_readings_far_from_home_have_the_pose_that_small_steps_lead_to(q):
    """It was out of reach: from where the expansion ends, the squares have other extrema."""
    model, u = wrist(), np.zeros(4)
    for share in np.linspace(0, 1, 41):
        expected, gaps, u = close_with_scipy(model, share * np.array(q), u)
        assert gaps < 1e-6
    found = pc.Kinematics(model).direct(q)
    assert found.ok
    assert found.position == pytest.approx(expected, abs=1e-8)


def test_a_chain_says_how_far_its_redundant_loops_stay_open():
    two, rounded = wrist().mechanism.remarks[:2]
    assert two.startswith("2 of 12 rows of the loops depend on the others at every pose")
    assert rounded.startswith("the loops stay up to 0.")
    assert "few digits" in rounded


def test_a_redundant_loop_with_all_digits_is_not_open():
    exact = wrist(digits=16)
    assert not any("few digits" in words for words in exact.mechanism.remarks)
    apart = pc.Kinematics(exact).direct(READINGS).position
    assert apart == pytest.approx(pc.Kinematics(wrist()).direct(READINGS).position, abs=1e-6)


def test_no_solution_is_a_wrist_whose_loops_are_open():
    """At antipodes of the sphere of the balls, the squares of the gaps have extrema, too."""
    model = wrist()
    found = direct_all(model, READINGS[0])
    assert 2 <= len(found) <= 8  # eight at most: Gosselin and Angeles, 1989
    for R in found.rotation[found.solved]:
        for k in LEGS:  # the angle between the elbow's axis and the platform's is that of the link
            motor, elbow, ball = AXES[k]
            crank = Rotation.from_rotvec(READINGS[0, k] * motor)
            cosine = crank.apply(elbow) @ (R @ ball)
            assert cosine == pytest.approx(elbow @ ball, abs=1e-5)


def test_readings_at_which_no_wrist_closes_have_no_solution():
    model, far = wrist(), [1.5, -1.5, 0.0]
    assert close_with_scipy(model, far)[1] > 0.01  # m
    found = pc.Kinematics(model).direct(far)
    assert not found.ok
    assert found.residual > 1e-3


def hinged_wrist(digits, **more):
    """The wrist with frames in its centre, and each hinge on the platform by two points of it."""

    def numbers(vector):
        return np.round(vector, digits).tolist()

    joints, loops = [], []
    for k in LEGS:
        first, second, third = AXES[k]
        joints += [
            revolute(f"motor{k}", "base", f"crank{k}", axis=numbers(first), driven=True),
            revolute(f"elbow{k}", f"crank{k}", f"link{k}", axis=numbers(second)),
        ]
        if k == 0:
            joints.append(revolute("hinge", "link0", "platform", axis=numbers(third)))
        for end, far in {"near": 0.1, "far": 0.15}.items() if k else ():
            at = numbers(far * third)
            a, b = ({"body": body, "point": at} for body in (f"link{k}", "platform"))
            loops.append({"name": f"{end}{k}", "type": "point", "a": a, "b": b})
    options = {"base": "base", "platform": "platform", "target": [0.0, 0.0, 0.1]}
    return make_chain(options | {"joints": joints, "loops": loops} | more)


def turn_by_scipy(q):
    """Return the rotation of the hinged wrist: each elbow keeps its angle with the hinge."""

    def gaps(w):
        return [
            Rotation.from_rotvec(angle * first).apply(second) @ Rotation.from_rotvec(w).apply(third)
            - second @ third
            for (first, second, third), angle in zip(AXES, q, strict=True)
        ]

    return Rotation.from_rotvec(least_squares(gaps, np.zeros(3), xtol=1e-15).x)


@pytest.mark.parametrize("digits", [16, 9, 7, 6])
def test_a_hinge_by_two_points_closes_whatever_the_digits(digits):
    """Its numbers may cancel at home, or close along one motion only: its coordinates stayed."""
    model = hinged_wrist(digits)
    assert model.mechanism.moves == ("x", "y", "z", "rx", "ry", "rz")
    found = pc.Kinematics(model).direct(READINGS)
    assert found.ok.all()
    expected = [turn_by_scipy(q).apply([0.0, 0.0, 0.1]) for q in READINGS]
    assert found.position == pytest.approx(np.array(expected), abs=max(1e-9, 10.0**-digits))


@pytest.mark.parametrize("tilt", [(0.0, 0.0, 0.0), (0.05, -0.03, 0.0)])
def test_a_controlled_turn_is_that_of_the_pose_whatever_the_uncontrolled_ones(tilt):
    """Small turns about x and y compose to one about z: it was up to 4e-4 rad, which depended on
    the path of the iterations. What is asked about x and y does not count."""
    kinematics = pc.Kinematics(hinged_wrist(16, controls=["x", "y", "rz"]))
    turns = [turn_by_scipy(q) for q in READINGS]
    at = np.array([R.apply([0.0, 0.0, 0.1]) for R in turns])
    asked = np.array([Rotation.from_rotvec(R.as_rotvec() + tilt).as_matrix() for R in turns])
    found = kinematics.inverse(at, asked)
    assert found.ok.all()
    np.testing.assert_allclose(found.joints, READINGS, atol=1e-7)
    for one, R, place in zip(asked, turns, at, strict=True):
        alone = kinematics.inverse(place, one)
        np.testing.assert_allclose(alone.rotation, R.as_matrix(), atol=1e-7)
        again = kinematics.direct(alone.joints)
        own = kinematics.model.mechanism.controlled_coordinates(
            again.position[None], again.rotation[None]
        )
        assert own[0, 2] == pytest.approx(R.as_rotvec()[2], abs=1e-7)


def test_a_turn_that_cannot_be_restored_is_not_called_solved(monkeypatch):
    monkeypatch.setattr("parallel_cal.kinematics.split_turns.MAX_CORRECTIONS", 1)
    found = pc.Kinematics(hinged_wrist(16, controls=["x", "y", "rz"])).inverse(
        [[0.03, -0.02, 0.09]], Rotation.from_rotvec([[0.2, 0.3, 0.2]]).as_matrix()
    )
    assert not found.solved.any()
