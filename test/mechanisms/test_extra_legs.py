"""Hexapods with more than six legs calibrate themselves by the lengths of their legs, without a
device. The true robots are points and distances between them."""

import json
from dataclasses import replace

import numpy as np
import pytest
from marks import as_slow
from scipy.optimize import least_squares

from parallel_cal.base.errors import ModelError, SolveError
from parallel_cal.cli.main import main
from parallel_cal.diagnosis.addition import see
from parallel_cal.diagnosis.field import Field
from parallel_cal.exporting.targets import linuxcnc
from parallel_cal.identification.fit import fit
from parallel_cal.identification.linearisation import Linearisation
from parallel_cal.identification.thresholds import MIN_SIGMAS_PER_TOLERANCE, RELATIVE_RANK
from parallel_cal.kinematics.all_solutions import direct_all
from parallel_cal.kinematics.answers import describe_disagreement
from parallel_cal.kinematics.kinematics import Kinematics, Solutions
from parallel_cal.kinematics.solvers import homotopy
from parallel_cal.model.file.modelfile import write_model
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_mechanism
from parallel_cal.posterior.scene import compute_orthonormal_basis
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.virtual.robot import turn

SIGMA, TOLERANCE = 5e-6, 1e-3  # m: of one reading, and of a part
HEIGHT = np.array([0.0, 0.0, 0.3])
FRAMES = ("leg1.?_?", "leg3.?_y", "leg3.?_z", "leg5.?_z")  # what defines {B} and {P}


def ring(radius, degrees):
    angles = np.radians(degrees)
    return radius * np.column_stack([np.cos(angles), np.sin(angles), 0 * angles])


# Two hexagons, with a seventh leg from a lower point of the base to the middle of the platform,
# and an eighth.
BASE = np.vstack(
    [ring(0.25, (-10, 10, 110, 130, 230, 250)), [[0.1, 0.05, -0.1], [-0.1, 0.15, 0.0]]]
)
PLATFORM = np.vstack(
    [ring(0.15, (-50, 50, 70, 170, 190, 290)), [[0.0, 0.0, 0.0], [0.05, -0.1, 0.05]]]
)


def drawn(legs):
    points = {"base": BASE[:legs].tolist(), "platform": PLATFORM[:legs].tolist()}
    return new_model(load_mechanism("stewart42", **points))


def distances(base, platform, r, R):
    """Lengths (n, legs) of the legs at the poses (n, 3), (n, 3, 3)."""
    heads = r[:, None] + np.einsum("nij,kj->nki", R, platform)
    return np.linalg.norm(heads - base, axis=2)


def built(legs, seed):
    """A robot whose parts are off by their tolerances, in the frames of the drawing: base and
    platform points, and readings of given lengths."""
    rng, model = np.random.default_rng([seed, 1]), drawn(legs)
    stray = rng.normal(0, TOLERANCE, (2, legs, 3))
    stray[:, 0] = 0
    stray[:, 2, 1:] = 0
    stray[:, 4, 2] = 0
    zero = np.array([model.value(f"leg{i + 1}.L0") for i in range(legs)])
    zero = zero + rng.normal(0, TOLERANCE, legs)
    return BASE[:legs] + stray[0], PLATFORM[:legs] + stray[1], zero


def poses(seed, n):
    rng = np.random.default_rng([seed, 2])
    return HEIGHT + rng.uniform(-0.05, 0.05, (n, 3)), turn(rng.uniform(-0.25, 0.25, (n, 3)))


def recording(legs, seed, n=150, sigma=SIGMA):
    base, platform, zero = built(legs, seed)
    q = distances(base, platform, *poses(seed, n)) - zero
    q = q + np.random.default_rng([seed, 3]).normal(0, sigma, q.shape)
    none = np.zeros((n, 6), bool)
    names = [f"leg{i + 1}" for i in range(legs)]
    return Dataset.from_arrays(names, q, np.zeros((n, 3)), measured=none, joint_sigma=sigma)


def identified(legs, seed):
    return fit(drawn(legs), recording(legs, seed), fix=FRAMES)


def position_error(model, legs, seed):
    """Rms position error (m) at other poses, with the frames of base and platform registered."""
    base, platform, zero = built(legs, seed)
    r, R = poses(seed + 1000, 60)
    found = Kinematics(model).direct(distances(base, platform, r, R) - zero)

    def gaps(u):
        W = turn(u[3:6])
        shown = u[:3] + r @ W.T + np.einsum("nij,j->ni", W @ R, u[6:9])
        turned = W @ R @ turn(u[9:12])
        return np.concatenate([(shown - found.position).ravel(), (turned - found.rotation).ravel()])

    off = least_squares(gaps, np.zeros(12)).fun[: 3 * len(r)].reshape(-1, 3)
    return np.sqrt(np.mean(np.sum(off**2, axis=1)))


def z_scores(legs, seed):
    """Errors of the identified parameters in their own sigmas."""
    base, platform, zero = built(legs, seed)
    found = identified(legs, seed)
    true = {f"leg{k + 1}.L0": zero[k] for k in range(legs)}
    for end, points in (("B", platform), ("C", base)):
        true |= {
            f"leg{k + 1}.{end}_{axis}": points[k][i]
            for k in range(legs)
            for i, axis in enumerate("xyz")
        }
    table = found.model.table
    off = found.model.values - table.vector(true)
    sigma = found.estimate.sigma
    return off[sigma > 0] / sigma[sigma > 0]


def test_every_leg_of_seven_spans_the_distance_of_its_points():
    """Home 0.3 m above the base: leg 7 spans from (100, 50, -100) mm to (0, 0, 300) mm."""
    model = drawn(7)
    assert len(model.table.names) == 49
    assert model.value("leg7.L0") == pytest.approx(np.sqrt(0.1**2 + 0.05**2 + 0.4**2), abs=1e-12)
    r, R = poses(3, 20)
    q = distances(BASE[:7], PLATFORM[:7], r, R) - distances(
        BASE[:7], PLATFORM[:7], HEIGHT[None], np.eye(3)[None]
    )
    found = Kinematics(model).direct(q)
    np.testing.assert_allclose(found.position, r, atol=1e-9)
    np.testing.assert_allclose(found.rotation, R, atol=1e-9)


def test_tests_for_structure_see_the_residual_of_each_leg():
    """Six of seven rows say nothing and are left out of a scene; what is tested along the samples
    are the rows of the legs, which mean alike at all samples."""
    found = identified(7, 0)
    scene = see(found)
    linearise = Linearisation(found.model, found.observations, found.free, True)
    every = linearise(found.model.values, scene.x)
    columns = every.columns * found.model.table.prior_sigma[found.free]
    basis = compute_orthonormal_basis(columns, RELATIVE_RANK, MIN_SIGMAS_PER_TOLERANCE)
    r = every.residual.ravel()
    left = (r - basis @ (basis.T @ r)).reshape(-1, 7)
    assert scene.rows == 1
    np.testing.assert_allclose(Field.of(scene).noise_units, left, atol=1e-6)
    # By the rows of the scene alone, the sign of a residual would be arbitrary.
    assert np.abs(scene.by_sample(scene.residual)).ravel() == pytest.approx(
        np.linalg.norm(left, axis=1), abs=1e-6
    )


def test_six_rods_are_no_complete_method_for_seven():
    model = drawn(7)
    with pytest.raises(SolveError, match="7 rods hold the platform, expected 6"):
        homotopy.direct_all(model, np.zeros(7))
    found = direct_all(model, np.zeros(7))
    np.testing.assert_allclose(found.position[0], HEIGHT, atol=1e-9)
    assert not found.complete


def test_linuxcnc_own_kinematics_hold_no_seventh_strut():
    with pytest.raises(ModelError, match="genhexkins has 6 struts, this robot 7: leave out the"):
        linuxcnc.project(drawn(7))


def test_base_and_platform_need_one_point_each_for_every_leg():
    with pytest.raises(ModelError, match="7 points of the platform for 8 points of the base"):
        load_mechanism("stewart42", base=BASE.tolist(), platform=PLATFORM[:7].tolist())
    with pytest.raises(ModelError, match=r"base has the shape \(5, 3\); expected six points"):
        load_mechanism("stewart42", base=BASE[:5].tolist())


@pytest.mark.parametrize(("legs", "share"), [(7, 1 / 2), (8, 1 / 3)])
def test_the_lengths_of_the_legs_calibrate_the_robot_without_a_device(legs, share):
    found = identified(legs, 0)
    assert found.held_out_before.summary.joint_rms > 20 * SIGMA
    assert found.held_out.summary.joint_rms < 1.4 * SIGMA * np.sqrt(legs - 6)
    before, after = (position_error(m, legs, 0) for m in (drawn(legs), found.model))
    assert after < share * before


@pytest.mark.wide
@pytest.mark.parametrize("legs", [7, as_slow(8)])
def test_errors_of_the_points_are_as_large_as_stated_over_20_draws(legs):
    z = np.concatenate([z_scores(legs, seed) for seed in range(20)])
    assert 0.85 < np.sqrt(np.mean(z**2)) < 1.15


def disagreeing(n, seed, sigma):
    """Readings (n, 8) of robots with parts off by their tolerances, with noise `sigma`."""
    rng = np.random.default_rng(seed)
    r = HEIGHT + rng.uniform(-0.03, 0.03, (n, 3))
    readings = []
    for i in range(n):
        stray = rng.normal(0, TOLERANCE, (2, 8, 3))
        L0 = [drawn(8).value(f"leg{k + 1}.L0") for k in range(8)] + rng.normal(0, TOLERANCE, 8)
        lengths = distances(BASE + stray[0], PLATFORM + stray[1], r[i : i + 1], np.eye(3)[None])[0]
        readings.append(lengths - L0 + rng.normal(0, sigma, 8))
    return np.array(readings)


@pytest.mark.wide
def test_the_residual_of_more_legs_than_freedoms_is_as_large_as_noise_and_tolerances_explain():
    kinematics, sigma = Kinematics(drawn(8)), 2e-3
    found = kinematics.direct(disagreeing(200, 5, sigma))
    assert found.ok.all()
    expected = kinematics.direct_residual_sigma(found, joint_sigma=sigma)
    assert np.mean((found.residual / expected) ** 2) == pytest.approx(1, abs=0.2)
    # Without noise less is explained; six legs agree on a pose whatever their lengths are.
    assert (kinematics.direct_residual_sigma(found) < expected).all()
    six = Kinematics(drawn(6))
    agreed = six.direct(np.full(6, 1e-3))
    assert six.direct_residual_sigma(agreed, joint_sigma=sigma) < 1e-9


def test_direct_warns_of_leg_lengths_that_disagree(tmp_path, capsys):
    write_model(drawn(8), tmp_path / "eight.yaml")
    usual = disagreeing(1, 6, 0.0)[0]
    file = str(tmp_path / "eight.yaml")

    def run(*words):
        with pytest.raises(SystemExit) as ended:
            main(["direct", file, *words])
        assert not ended.value.code
        return capsys.readouterr()

    def direct(readings):
        out, err = run("--joints", " ".join(map(str, readings)), "--json")
        return json.loads(out)["solutions"][0], err

    solution, warning = direct(usual)
    assert "agree on no pose" not in warning
    assert 1e-4 < solution["residual"] < 3 * solution["explained_residual"]
    solution, warning = direct(usual + [0.02, 0, 0, 0, 0, 0, 0.03, 0])
    assert solution["status"] == "converged"
    assert solution["residual"] > 3 * solution["explained_residual"]
    assert "the joint readings agree on no pose: the residual is " in warning
    header = ",".join(f"leg{i + 1}" for i in range(8))
    rows = "\n".join(",".join(map(str, q)) for q in (usual, usual + 0.02 * np.eye(8)[0]))
    (tmp_path / "legs.csv").write_text(f"{header}\n{rows}\n")
    out, err = run("--input", str(tmp_path / "legs.csv"))
    assert out.splitlines()[0].endswith("explained_residual,residual,status")
    assert "the readings of 1 row agree on no pose: the residual in row 2 is " in err


def test_readings_that_close_are_no_disagreement_where_nothing_explains_a_residual():
    """Exact readings of an exact robot: what remains is rounding, and no error divides it."""
    found = Solutions(
        np.zeros((2, 4)),
        np.zeros((2, 3)),
        np.tile(np.eye(3), (2, 1, 1)),
        np.array([1e-18, 0.0]),
        np.zeros(2, dtype=np.int8),
    )
    with np.errstate(all="raise"):
        assert describe_disagreement(found, np.zeros(2)) == ""
        apart = replace(found, residual=np.array([1e-18, 2e-3]))
        words = describe_disagreement(apart, np.zeros(2))
    assert "the residual in row 2 is 2 mm" in words
