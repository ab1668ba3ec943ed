"""Every method finds the robot it was shown, and predicts poses that it was not shown."""

import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from datasets import measured as measured_delta
from datasets import quiet
from virtual_small import SliderCrank

from parallel_cal.model.model import new_model
from parallel_cal.virtual import robot as vr
from parallel_cal.virtual.stewart import Assembly

sys.path.insert(0, str(Path(__file__).parents[2]))

from bench.documents.tables import optimisers
from bench.documents.tables.parallelogram import base_parameters
from parallel_cal.base.errors import FitError
from parallel_cal.base.rotation import rotation_matrix
from parallel_cal.base.threads import single_threaded
from parallel_cal.identification.estimators import load_method
from parallel_cal.identification.methods import implicit
from parallel_cal.identification.observations import Observations, observe
from parallel_cal.identification.robust import estimate_robustly
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.mechanisms.delta24 import Delta24
from parallel_cal.thesis.methods import semiparametric
from parallel_cal.thesis.methods._factors import separate_factors
from parallel_cal.thesis.methods._separation import Separation

MM, DEGREE = 1e-3, np.pi / 180
CRANK = {"a": 80.2 * MM, "b": 50.1 * MM, "q0": 1 * DEGREE}
NOISE = {"slider_crank": (2 / 60 * DEGREE, 0.02 * MM, 1e-4), "stewart42": (1e-5, 2e-5, 1e-4)}
NO_NOISE = (1e-12, 1e-12, 1e-12)


def evidence_of(q, r, R, noise, seed=None):
    """What a device shows of true configurations, noise (joint, position, orientation) added."""
    rng, n = np.random.default_rng(seed), q.shape[1]
    sigma = np.repeat(noise, [n, 3, 3])
    e = sigma * rng.standard_normal((len(q), n + 6)) * (seed is not None)
    turned = rotation_matrix(e[:, n + 3 :]) @ R
    x = np.hstack([q + e[:, :n], r + e[:, n : n + 3], turned.reshape(-1, 9)])
    S = np.tile(np.diag(sigma**2), (len(q), 1, 1))
    return Observations(
        x,
        S,
        np.ones(S.shape[:2], bool),
        np.zeros((len(q), 0)),
        np.arange(len(q)),
        np.zeros((len(q), 0)),
        {},
    )


def crank_evidence(noise=NO_NOISE, seed=None, low=0.07, high=0.128, n=30):
    """A slider-crank from a crank's pin and a rod, away from its direct singularity."""
    r = np.column_stack([np.linspace(low, high, n), np.zeros((n, 2))])
    R = np.tile(np.eye(3), (n, 1, 1))
    q, r, R = SliderCrank(CRANK).inverse(r, R)
    return evidence_of(q, r, R, noise, seed)


class Legs(Assembly):
    """A Stewart platform from ball centres: a leg is as long as its balls are apart."""

    def __init__(self, p):
        super().__init__(p)
        self.B, self.C = (
            np.array([[p[f"leg{i}.{n}_{a}"] for a in "xyz"] for i in range(1, 7)]) for n in "BC"
        )
        self.L0 = np.array([p[f"leg{i}.L0"] for i in range(1, 7)])

    def lengths(self, r, R):
        ends = r[:, None] + np.einsum("nij,kj->nki", R, self.B)
        return np.linalg.norm(ends - self.C, axis=2) - self.L0


@cache
def stewart_truth():
    table = new_model("stewart42").table
    error = 0.5 * table.tolerance * np.random.default_rng(3).standard_normal(42)
    return table.nominal + error


def stewart_evidence(noise=NO_NOISE, seed=None, n=60, poses=0):
    model = new_model("stewart42")
    u = model.mechanism.sample(n, np.random.default_rng(poses))
    r, R = u[:, :3], rotation_matrix(u[:, 3:])
    robot = Legs(model.table.mapping(stewart_truth()))
    return evidence_of(robot.lengths(r, R), r, R, noise, seed)


def shown(name, noisy, seed=0):
    """Model, truth (or None where the model is smaller than the robot) and observations."""
    model = new_model(name)
    if name == "slider_crank":
        found = crank_evidence(NOISE[name], seed) if noisy else crank_evidence()
        return model, model.table.vector(CRANK), found
    if name == "stewart42":
        found = stewart_evidence(NOISE[name], seed) if noisy else stewart_evidence()
        return model, stewart_truth(), found
    if name == "delta24":
        truth = {n: v for n, v in vr.TABLE_5_18.items() if n in model.table.names}
        robot = vr.Delta(_ideal(truth))
        data = measured_delta(seed, robot=robot, noise=vr.THESIS_NOISE if noisy else quiet(1e-9))
        return model, model.table.vector(truth), observe(model, data)
    data = measured_delta(seed, noise=vr.THESIS_NOISE if noisy else quiet(1e-9))
    return model, model.table.vector(vr.TABLE_5_18), observe(model, data)


def _ideal(truth):
    """A Delta with perfect parallelograms."""
    table = {**vr.TABLE_5_12, **truth}
    return table


def unseen(name, truth):
    """Joints and poses of the true robot that no fit has seen."""
    model = new_model(name).with_values(truth)
    targets = model.mechanism.sample(50, np.random.default_rng(99))
    if name == "slider_crank":
        targets = np.linspace(75, 120, 50)[:, None] * MM
    r = np.zeros((50, 3))
    r[:, : min(3, targets.shape[1])] = targets[:, :3]
    R = rotation_matrix(targets[:, 3:]) if targets.shape[1] == 6 else None
    return Kinematics(model).inverse(r, R)


def position_error(model, true):
    return np.linalg.norm(Kinematics(model).direct(true.joints).position - true.position, axis=1)


ITERATED = ("implicit", "forward", "inverse")
ROBOTS = ("slider_crank", "delta24", "delta54", "stewart42")
EXPANDED = [(m, r) for m in ("semiparametric", "cascaded") for r in ("slider_crank", "delta24")]


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("method", ITERATED)
def test_a_robot_without_noise_is_found_exactly(method, robot):
    model, truth, observations = shown(robot, noisy=False)
    found = load_method(method)(model, observations, ~model.fixed)
    assert np.abs(found.values - truth).max() < 1e-9


@pytest.mark.parametrize(("method", "robot"), EXPANDED)
def test_linear_factors_give_the_parameters_back_without_noise(method, robot):
    model, truth, observations = shown(robot, noisy=False)
    found = load_method(method)(model, observations, ~model.fixed)
    assert np.abs(found.values - truth).max() < 1e-9


@pytest.mark.parametrize("robot", ROBOTS)
def test_what_linear_calibration_leaves_is_of_second_order(robot):
    model, truth, observations = shown(robot, noisy=False)
    left = []
    for share in (1.0, 0.1):  # of the way from the truth to the nominal robot
        start = model.with_values(truth + share * (model.values - truth))
        step = load_method("linear")(start, observations, ~model.fixed).values - truth
        left.append(np.abs(step / model.table.tolerance)[~model.fixed].max())
    assert left[1] < 0.02 * left[0]


@pytest.mark.wide
@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("method", ITERATED)
def test_noisy_data_predict_unseen_poses(method, robot):
    model, truth, observations = shown(robot, noisy=True)
    true = unseen(robot, truth)
    found = load_method(method)(model, observations, ~model.fixed)
    before = position_error(model, true).mean()
    after = position_error(model.with_values(found.values), true).mean()
    assert after < before / 10
    assert 0.5 < found.chi2_per_dof < 1.6


@pytest.mark.parametrize(
    ("robot", "factors"), [("slider_crank", 3), ("delta24", 36), ("stewart42", 102)]
)
def test_semiparametric_models_have_as_many_factors_as_are_independent(robot, factors):
    """Section 5.3.8 counts 3, 36 and, for the Stewart platform, 174: see below."""
    assert sum(len(row) for row in separate_factors(new_model(robot))) == factors


def test_a_stewart_leg_expands_into_45_monomials_of_which_17_combinations_matter():
    """r.RB 9, (RB)^2 18, C.RB 9, r.C 3, r^2 3, q, q^2, 1: R^T R = 1 and common coefficients
    leave 3 + 9 + 3 + q + 1 beside the leading one."""
    assert [len(row) for row in Separation(new_model("stewart42").structure).rows] == [45] * 6


def test_the_thesis_174_factors_are_products_of_euler_angles_without_offset_and_constant():
    """With R in three Euler angles and nothing merged, 13 products stand in C.RB, 13 in r.RB and
    3 in r.C: 29 a leg, 174 in all. The reading (2 L0 q) and the constant make it 31."""
    leg = new_model("stewart42").structure
    x, angles = stewart_configurations(400)
    columns = np.column_stack([*euler_products(x, angles).T, x[:, 0], np.ones(len(x))])
    assert columns.shape[1] - 2 == 174 / 6
    rod = leg.closure_batch(x, np.zeros((400, 0)), stewart_truth())[0][:, 0]  # its length - q - L0
    length = x[:, 0] + stewart_truth()[6]
    squares = (x[:, 6:9] ** 2).sum(axis=1) - x[:, 0] ** 2  # they hold no parameter
    target = (rod + length) ** 2 - length**2 - squares  # the rest of eq. 3.8
    for used, exact in ((columns, True), (columns[:, :-1], False), (columns[:, :-2], False)):
        left = target - used @ np.linalg.lstsq(used, target, rcond=None)[0]
        assert (np.abs(left).max() < 1e-12) == exact
    assert np.linalg.matrix_rank(columns) == 31


def stewart_configurations(n):
    """Any configurations (q, r, R) with the Euler angles x y x that make R."""
    rng = np.random.default_rng(0)
    q, r, angles = rng.uniform(0, 1, (n, 6)), rng.uniform(-1, 1, (n, 3)), rng.uniform(-3, 3, (n, 3))
    x, y = np.eye(3)[:2]
    R = rotation_matrix(angles[:, :1] * x) @ rotation_matrix(angles[:, 1:2] * y)
    R = R @ rotation_matrix(angles[:, 2:] * x)
    return np.hstack([q, r, R.reshape(-1, 9)]), angles


def euler_products(x, angles):
    """The 29 products of world coordinates: R's entries, r_i times those of row i, and r."""
    (c1, c2, c3), (s1, s2, s3) = np.cos(angles.T), np.sin(angles.T)
    rows = [
        [c2, s2 * s3, s2 * c3],
        [s1 * s2, c1 * c3, s1 * c2 * s3, c1 * s3, s1 * c2 * c3],
        [c1 * s2, s1 * c3, c1 * c2 * s3, s1 * s3, c1 * c2 * c3],
    ]
    r = x[:, 6:9].T
    alone = [product for row in rows for product in row]
    moved = [r_i * product for r_i, row in zip(r, rows, strict=True) for product in row]
    return np.column_stack([*alone, *moved, *r])


def test_an_expanded_closure_is_the_closure():
    for robot in ("slider_crank", "delta24", "stewart42"):
        model, truth, observations = shown(robot, noisy=True)
        factors = semiparametric.make_factor_model(model.with_values(truth))
        phi, _ = semiparametric.closure_rows(factors, observations)
        true, _ = semiparametric.closure_rows(model.with_values(truth), observations)
        assert np.abs(phi).max() < 1e-2  # (a Stewart leg's length is squared: another scale)
        assert np.corrcoef(phi, true)[0, 1] > 0.99


@pytest.mark.wide
@pytest.mark.parametrize("robot", ["slider_crank", "delta24", "stewart42"])
@pytest.mark.parametrize("weighted", [True, False])
def test_semiparametric_models_predict_unseen_poses(robot, weighted):
    model, truth, observations = shown(robot, noisy=False)
    true = unseen(robot, truth)
    found = semiparametric.identify(model, observations, weighted=weighted)
    assert position_error(found, true).max() < 1e-9
    model, truth, observations = shown(robot, noisy=True)
    found = semiparametric.identify(model, observations, weighted=weighted)
    assert position_error(found, true).mean() < position_error(model, true).mean() / 5
    if weighted:  # by the noise, which the linear solution does not know
        linear = semiparametric.identify(model, observations, weighted=False)
        assert position_error(found, true).mean() < position_error(linear, true).mean()
        assert found.covariance is not None
        assert linear.covariance is None


def test_sensitivity_matrix_finds_the_papers_six_base_parameters():
    model = new_model("parallelogram")
    q = np.radians(np.arange(-45, 46, 5.0))[:, None]
    pose = Kinematics(model).direct(q)
    observations = evidence_of(q, pose.position, pose.rotation, (1e-7, 3e-6, 5e-5))
    names = np.array(model.table.names)
    base = base_parameters(model, observations, names != "h")
    assert len(base.kept) == 6
    assert {"q0", "l1", "l2", "a2_y"} <= set(base.kept)
    assert set(base.dropped) == {"b1_x", "b2_x", "b2_y"}
    sums = dict(zip(base.dropped, base.grouping.T, strict=True))
    for dropped, partner in (("b1_x", "a1_x"), ("b2_x", "a2_x"), ("b2_y", "a2_y")):
        entry = dict(zip(base.kept, sums[dropped], strict=True))
        assert entry[partner] == pytest.approx(-1, abs=1e-3)  # eqs 70-72


def test_sensitivity_matrix_repeated_is_forward_calibration():
    model, truth, observations = shown("delta54", noisy=False)
    found = load_method("sensitivity")(model, observations, ~model.fixed, iterations=5)
    assert np.abs(found.values - truth).max() < 1e-9
    once = load_method("sensitivity")(model, observations, ~model.fixed)
    true = unseen("delta54", truth)
    error = position_error(model.with_values(once.values), true).mean()
    assert error < position_error(model, true).mean() / 10


@pytest.mark.slow
@pytest.mark.parametrize(
    "method", ["implicit", "forward", "inverse", "linear", "cascaded", "semiparametric"]
)
def test_predicted_sigma_is_the_spread_over_200_draws(method):
    model, free = new_model("slider_crank", CRANK), np.ones(3, dtype=bool)
    with single_threaded():
        found = [
            load_method(method)(model, crank_evidence(NOISE["slider_crank"], s), free)
            for s in range(200)
        ]
    spread = np.std([e.values for e in found], axis=0, ddof=1)
    predicted = np.sqrt(np.mean([e.sigma**2 for e in found], axis=0))
    assert np.abs(spread / predicted - 1).max() < 0.15
    bias = np.mean([e.values for e in found], axis=0) - model.values
    assert np.abs(bias / (predicted / np.sqrt(200))).max() < 3.5
    assert np.mean([e.chi2_per_dof for e in found]) == pytest.approx(1, abs=0.1)


def test_weighted_implicit_calibration_is_orthogonal_distance_regression():
    """One chain of model 24 against ODRPACK's implicit fit: the same estimates."""
    odr = pytest.importorskip("scipy.odr")
    model, _, observations = shown("delta24", noisy=True)
    free = model.table.matching(["chain1.*"])
    unit = model.table.tolerance[free]
    # One row of the closure is one chain: the others may not pass on its noise.
    alone = implicit.estimate(_first_chain(), observations, free)
    used = np.array([0, 3, 4, 5])  # its joint and x, y, z

    def rod(b, x):
        rows = np.tile(observations.x[:1], (x.shape[1], 1))
        rows[:, used] = x.T
        values = np.array(model.values)
        values[free] = b * unit
        return model.structure.closure_batch(rows, np.zeros((len(rows), 0)), values)[0][:, 0] * 1e3

    data = odr.Data(
        observations.x[:, used].T, y=1, we=1e14, wd=1 / np.diag(observations.S[0])[used]
    )
    fit = odr.ODR(
        data,
        odr.Model(rod, implicit=True),
        beta0=model.values[free] / unit,
        maxit=1000,
        sstol=1e-15,
        partol=1e-15,
    )
    fit.set_job(fit_type=1, deriv=1)
    best = fit.run().beta * unit
    large = np.abs(best) > 10 * MM
    assert np.abs(alone.values[free] / best - 1)[large].max() < 1e-6
    assert np.abs((alone.values[free] - best) / alone.sigma[free]).max() < 1e-2


class FirstChain(Delta24):
    """Model 24 with the rod of chain 1 alone: one row, every coordinate measured."""

    moves = controls = ("x",)

    def closure(self, q, r, R, p):
        return self.rod(q[0], r, p["chain1"])


def _first_chain():
    return new_model(FirstChain())


OPTIMISERS = (
    "newton",
    "gauss_newton_normal",
    "gauss_newton_svd",
    "levenberg_marquardt",
    "steepest_descent",
)


def test_all_optimisers_of_annex_c_end_in_one_minimum():
    model, observations = new_model("slider_crank"), crank_evidence(NOISE["slider_crank"], 0, 0.033)
    unit = np.array([80 * MM, 80 * MM, 1.0])
    problem = optimisers.closure_problem(model, observations, unit, 2 * model.structure.v[1])
    ends = {n: getattr(optimisers, n)(problem, model.values / unit, 1e-12) for n in OPTIMISERS}
    best = ends["gauss_newton_svd"]
    for end in ends.values():
        assert np.abs(end.p - best.p).max() < 1e-6
    rough = {n: getattr(optimisers, n)(problem, model.values / unit, 1e-4) for n in OPTIMISERS}
    assert [rough[n].iterations for n in OPTIMISERS[:4]] == [4, 3, 3, 3]  # table 5.7
    assert rough["steepest_descent"].iterations > 20


def test_the_exact_hessian_is_the_slope_of_the_gradient():
    model, observations = new_model("slider_crank"), crank_evidence(NOISE["slider_crank"], 0)
    problem = optimisers.closure_problem(model, observations, np.array([0.08, 0.08, 1.0]))
    p, h = model.values / [0.08, 0.08, 1.0], 1e-6
    slope = [(problem.gradient(p + e) - problem.gradient(p - e)) / (2 * h) for e in h * np.eye(3)]
    assert np.array(slope) == pytest.approx(problem.hessian(p), rel=1e-6)


@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_a_robust_loss_is_not_pulled_by_a_few_bad_samples(loss):
    model, truth, observations = shown("delta54", noisy=True)
    true = unseen("delta54", truth)
    clean = implicit.estimate(model, observations, ~model.fixed)
    observations.x[[3, 30, 60], 3:6] += 0.5 * MM
    pulled = implicit.estimate(model, observations, ~model.fixed)
    held = estimate_robustly(implicit.estimate, model, observations, ~model.fixed, loss)
    errors = [
        position_error(model.with_values(e.values), true).mean() for e in (clean, held, pulled)
    ]
    assert errors[1] < 1.5 * errors[0] < errors[2]


def test_what_a_method_cannot_do_is_a_clear_error():
    model, _, observations = shown("delta24", noisy=True)
    observations.measured[:, 3] = False
    for method in ("inverse", "semiparametric", "cascaded"):
        with pytest.raises(FitError, match=r"needs x at every sample.*implicit"):
            load_method(method)(model, observations, ~model.fixed)
    crank = new_model("slider_crank")
    for method in ("semiparametric", "cascaded"):
        with pytest.raises(FitError, match="takes no prior"):
            load_method(method)(crank, crank_evidence(), ~crank.fixed, prior=True)
    bent = new_model("delta24").with_effect("encoder_eccentricity")
    with pytest.raises(FitError, match="cannot be separated"):
        separate_factors(bent)
