"""All poses of a platform on six rods: complete, certified, and clustered as in annex A.2."""

import numpy as np
import pytest

from parallel_cal.base.errors import SolveError
from parallel_cal.base.rotation import rotation_matrix, rotation_vector
from parallel_cal.kinematics import solving
from parallel_cal.kinematics.all_solutions import direct_all
from parallel_cal.kinematics.kinematics import Kinematics, Status
from parallel_cal.kinematics.solvers import homotopy
from parallel_cal.kinematics.solvers._platform import all_poses, start_system
from parallel_cal.kinematics.solvers._quadrics import MAX_CERTIFIED_ALPHA, alpha
from parallel_cal.kinematics.solvers._study import quadrics
from parallel_cal.model.model import new_model
from parallel_cal.virtual import robot as vr


def platform(rng):
    """A random platform and one of its poses: C, B (6, 3), L (6,), r (3,), R (3, 3)."""
    C, B = rng.normal(size=(6, 3)), rng.uniform(0.2, 1) * rng.normal(size=(6, 3))
    r, R = rng.normal(size=3), rotation_matrix(2 * rng.normal(size=3))
    return C, B, np.linalg.norm(r + B @ R.T - C, axis=1), r, R


def gaps(C, B, L, r, R):
    return np.linalg.norm(r[..., None, :] + B @ np.swapaxes(R, -1, -2) - C, axis=-1) - L


def distance(r, R, others_r, others_R):
    return np.abs(r - others_r).max(axis=1) + np.abs(R - others_R).max(axis=(1, 2))


def check_platform(rng):
    C, B, L, r, R = platform(rng)
    found = all_poses(C, B, L)
    assert found.count_complex == 40
    assert found.certified.all()
    assert distance(r, R, found.real.position, found.real.rotation).min() < 1e-6
    assert np.abs(gaps(C, B, L, found.real.position, found.real.rotation)).max() < 1e-12
    return found


def multi_start(C, B, L, rng, starts=3000):
    """Distinct real poses that Newton's method finds from random starts, no homotopy in sight."""
    r, R = 3 * rng.normal(size=(starts, 3)), rotation_matrix(4 * rng.normal(size=(starts, 3)))
    for _ in range(60):
        arms = B @ np.swapaxes(R, 1, 2)
        rods = r[:, None] + arms - C
        J = np.concatenate([rods, np.cross(arms, rods)], axis=2)
        half_error = (np.sum(rods**2, axis=2) - L**2) / 2
        step = np.linalg.solve(J, half_error[:, :, None])[:, :, 0]
        step /= np.maximum(1, np.linalg.norm(step, axis=1, keepdims=True))
        r, R = r - step[:, :3], rotation_matrix(-step[:, 3:]) @ R
    found = []
    for k in np.flatnonzero(np.abs(gaps(C, B, L, r, R)).max(axis=1) < 1e-10):
        if not found or distance(r[k], R[k], *map(np.array, zip(*found, strict=True))).min() > 1e-5:
            found.append((r[k], R[k]))
    return found


def check_against_multi_start(rng):
    C, B, L, *_ = platform(rng)
    found = all_poses(C, B, L).real
    expected = multi_start(C, B, L, rng)
    assert len(expected) == len(found)
    for r, R in expected:
        assert distance(r, R, found.position, found.rotation).min() < 1e-6


def test_ten_random_platforms_have_forty_poses():
    rng = np.random.default_rng(1)
    for _ in range(10):
        check_platform(rng)


@pytest.mark.slow
def test_a_thousand_random_platforms_have_forty_poses_and_seldom_need_a_second_try():
    rng = np.random.default_rng(2)
    retries = [check_platform(rng).retries for _ in range(1000)]
    assert np.mean(np.array(retries) > 0) < 0.01


def test_the_real_poses_are_those_of_a_multi_start_newton():
    rng = np.random.default_rng(3)
    for _ in range(2):
        check_against_multi_start(rng)


@pytest.mark.slow
def test_the_real_poses_of_three_dozen_platforms_are_those_of_a_multi_start_newton():
    rng = np.random.default_rng(4)
    for _ in range(36):
        check_against_multi_start(rng)


def test_a_rod_is_a_quadric_in_the_dual_quaternion():
    """Hand-worked: half a turn about z, moved by (1, 2, 3): e = k, g = t e with t = (1, 2, 3)."""
    C, B = np.zeros((6, 3)), np.tile([4.0, 5, 6], (6, 1))
    e, g = [0, 0, 0, 1], [-3, 2, -1, 0]  # (i + 2j + 3k) k = -j + 2i - 3
    # The platform's point is at (1, 2, 3) + (-4, -5, 6) = (-3, -3, 9), 99 from the origin, squared.
    X = np.array([*e, *g], dtype=float)
    assert X @ quadrics(C, B, np.full(6, 99.0))[:6] @ X == pytest.approx(np.zeros(6))
    assert X @ quadrics(C, B, np.full(6, 98.0))[:6] @ X == pytest.approx(np.ones(6))


def test_the_stored_start_system_has_forty_certified_zeros():
    M, zeros = start_system()
    size, _ = alpha(zeros, M)
    overlap = np.abs(zeros @ zeros.conj().T) - np.eye(40)
    assert zeros.shape == (40, 8)
    assert (size < MAX_CERTIFIED_ALPHA).all()
    assert overlap.max() < 1 - 1e-6


def test_the_mock_up_has_8_to_16_real_poses_in_two_clusters():
    """Annex A.2: they lie around both solutions of model 24, which are among them nearly."""
    model = new_model("delta54", vr.TABLE_5_18)
    narrow = new_model("delta24", {n: model.value(n) for n in new_model("delta24").table.names})
    for degrees in ([30.65, 30.65, 30.65], [20, 30, 40], [35, 20, 25], [10, 10, 60]):
        q = np.radians(degrees)
        found = homotopy.pose_set(model, q)
        upper, lower = direct_all(narrow, q).position
        assert found.count_complex == 40
        assert 8 <= len(found.real) <= 16
        assert (found.real.status == Status.CONVERGED).all()
        z = found.real.position[:, 2]
        assert np.sum(z > (upper + lower)[2] / 2) == len(z) / 2
        for near in (upper, lower):
            nearest = np.argmin(np.linalg.norm(found.real.position - near, axis=1))
            assert np.linalg.norm(found.real.position[nearest] - near) < 1e-3
            assert np.linalg.norm(rotation_vector(found.real.rotation[nearest])) < np.radians(1)


def test_the_first_pose_is_the_home_branch_and_all_close_on_the_virtual_robot():
    model, q = new_model("delta54", vr.TABLE_5_18), np.radians([25, 30, 35])
    found = homotopy.direct_all(model, q)
    home = Kinematics(model).direct(q)
    assert found.position[0] == pytest.approx(home.position, abs=1e-12)
    assert np.abs(vr.MOCK_UP.gaps(q, found.position, found.rotation)).max() < 1e-12
    assert homotopy.direct(model, np.stack([q, q])).position[1] == pytest.approx(home.position)


def test_effects_on_joints_are_seen():
    model = new_model("delta54", vr.TABLE_5_18, ["encoder_eccentricity"])
    values = {**vr.TABLE_5_18, "encoder_eccentricity.joint2.sin": 1e-2}
    model = model.with_values(model.table.vector(values))
    q = np.radians([25, 30, 35])
    turned = q + [0, 1e-2 * np.sin(q[1]), 0]
    plain = homotopy.direct_all(new_model("delta54", vr.TABLE_5_18), turned)
    assert homotopy.direct_all(model, q).position == pytest.approx(plain.position, abs=1e-9)


@pytest.mark.wide
def test_a_stewart_platform_is_solved_from_its_lengths():
    model = new_model("stewart42")
    q = np.array(model.mechanism.home.joints) + 0.01 * np.arange(6)
    found = homotopy.direct_all(model, q)
    assert found.position[0] == pytest.approx(Kinematics(model).direct(q).position)
    assert found.residual.max() < 1e-12
    assert len(found) == 8  # two flat hexagons: each pose has its mirror image
    assert np.sort(found.position[:, 2])[:4] == pytest.approx(-np.sort(found.position[:, 2])[:3:-1])


def test_rods_too_short_to_meet_leave_no_real_pose():
    C, B, *_ = platform(np.random.default_rng(5))
    found = all_poses(C, B, np.full(6, 1e-3))
    assert len(found.real) == 0
    model = new_model("stewart42")
    assert homotopy.direct(model, np.full(6, -0.249)).status == Status.UNREACHABLE
    assert homotopy.direct(model, np.full((1, 6), np.nan)).status == [Status.INVALID_INPUT]


def test_what_is_no_platform_is_refused():
    C, B, L, *_ = platform(np.random.default_rng(6))
    with pytest.raises(SolveError, match="six base points"):
        all_poses(C[:5], B, L)
    with pytest.raises(SolveError, match="not a finite number"):
        all_poses(C, B, L * np.nan)
    with pytest.raises(SolveError, match="meet in one point"):
        all_poses(C, np.tile(B[0], (6, 1)), L)
    with pytest.raises(SolveError, match="rods"):
        homotopy.direct_all(new_model("delta24"), np.zeros(3))


def test_a_rod_that_is_there_twice_leaves_no_regular_pose():
    C, B, L, *_ = platform(np.random.default_rng(7))
    C[1], B[1], L[1] = C[0], B[0], L[0]
    assert all_poses(C, B, L).count_complex == 0


@pytest.mark.wide
@pytest.mark.parametrize("seed", [0, 2, 5])
def test_lost_paths_are_followed_anew(seed):
    """A platform so small that paths run close to each other: some jump, and poses are missed."""
    C, B, _, r, R = platform(np.random.default_rng(seed))
    B = 3e-5 * B
    L = np.linalg.norm(r + B @ R.T - C, axis=1)
    assert all_poses(C, B, L, retries=0).count_complex < 40
    found = all_poses(C, B, L)
    assert (found.count_complex, found.retries) == (40, 1)


@pytest.mark.parametrize("size", [1e-6, 1e6])
def test_size_does_not_matter(size):
    C, B, L, *_ = platform(np.random.default_rng(8))
    found, other = (all_poses(s * C, s * B, s * L) for s in (1, size))
    assert other.count_complex == 40
    assert other.real.position / size == pytest.approx(found.real.position)


@pytest.mark.wide
def test_flat_platforms_have_forty_poses_and_symmetric_ones_fewer():
    C, B, _, r, R = platform(np.random.default_rng(9))
    C[:, 2] = B[:, 2] = 0
    L = np.linalg.norm(r + B @ R.T - C, axis=1)
    assert all_poses(C, B, L).count_complex == 40
    C, B = (np.repeat(a[:3], 2, axis=0) for a in (C, B))
    found = all_poses(C, np.roll(B, 1, axis=0), np.full(6, 2.0))
    assert found.count_complex == 16  # the octahedron's, as is known


@pytest.mark.parametrize("name", ["delta51", "linear_delta"])
def test_other_robots_on_six_rods_are_solved_as_well(name):
    model = new_model(name)
    q = np.array(model.mechanism.home.joints) + [0.01, -0.02, 0.03]
    found = homotopy.direct_all(model, q)
    assert found.count_complex == 40
    assert found.position[0] == pytest.approx(Kinematics(model).direct(q).position)
    assert found.residual.max() < 1e-12
    with pytest.raises(SolveError, match="homotopy does not solve the inverse problem"):
        solving.inverse(new_model("delta54"), np.zeros(3), None, {}, solver="homotopy")
