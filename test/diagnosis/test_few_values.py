"""Columns of few values, robots that only turn or only shift, and few samples are judged or refused
in one sentence; no step ends with another exception than the package's own."""

import numpy as np
import pytest
from marks import keep

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.base.rotation import rotation_matrix
from parallel_cal.causes.unknown_laws import list_unknown_blocks
from parallel_cal.diagnosis.comparison import compare
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.diagnosis.noise_shape import noise_shape
from parallel_cal.discovery.discovery import discover
from parallel_cal.identification.fit import fit
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.mechanism import poses_in_workspace
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_mechanism
from parallel_cal.planning.plan import plan
from parallel_cal.posterior.scene import Scene
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.reporting import text
from parallel_cal.reporting.report import report
from parallel_cal.session.steps import add, fitted

SCARA = [
    {"joint": None, "axes": "coincident"},
    {"joint": "R", "axes": "parallel", "a": 0.4},
    {"joint": "R", "axes": "parallel", "a": 0.3},
    {"joint": "P", "low": -0.1, "high": 0.5},
]
ROBOTS = {
    "scara": lambda: load_mechanism("serial", links=SCARA, home=[0, 1, 0.2]),
    "hexapod": lambda: load_mechanism("stewart42"),
    **{
        name: lambda name=name: load_mechanism(name)
        for name in ("slider_crank", "five_bar", "delta24", "argos27", "planar_stewart")
    },
}
COLUMNS = ("free", "levels", "two", "constant", "quantised")
LEVELS = {"levels": 4, "two": 2, "constant": 1}


def stepped(values, kind, rng):
    """Readings (N,) moved to a few values over the range in which they lie."""
    low, high = values.min(), values.max()
    if kind == "free":
        return values
    if kind == "quantised":
        step = max((high - low) / 12, 1e-9)
        return np.round(values / step) * step
    return np.linspace(low, high, LEVELS[kind] + 2)[1:-1][
        rng.integers(0, LEVELS[kind], len(values))
    ]


def correlated(rng, shape, kept):
    """Noise of which a share stays from each sample to the next, of variance one."""
    e = rng.standard_normal(shape)
    for k in range(1, len(e)):
        e[k] = kept * e[k - 1] + np.sqrt(1 - kept**2) * e[k]
    return e


def drawn(robot, seed):
    """A small session of a nominal robot: columns of few values, errors of a kind, and conditions
    drawn by a seed."""
    rng = np.random.default_rng(seed)
    mechanism = ROBOTS[robot]()
    model = new_model(mechanism)
    solve = Kinematics(model)
    q = solve.inverse(*poses_in_workspace(mechanism, int(rng.choice([7, 12, 24, 40])), rng)).joints
    q = q[np.isfinite(q).all(axis=1)]
    q = np.column_stack([stepped(column, rng.choice(COLUMNS), rng) for column in q.T])
    pose = solve.direct(q)
    q, r, R = (values[pose.solved] for values in (q, pose.position, pose.rotation))
    n = len(q)
    if rng.random() < 0.5:  # a field of the device
        span = max(np.ptp(r, axis=0).max(initial=0.0), 1e-3)
        r = r + 3e-4 * np.sin(3 * r / span)[:, [1, 2, 0]]
    e = correlated(rng, (n, 6), rng.choice([0.0, 0.95]))
    r, R = r + 2e-5 * e[:, :3], np.array([rotation_matrix(1e-4 * w) for w in e[:, 3:]]) @ R
    shifts, turns = min(mechanism.moved) < 3, max(mechanism.moved) > 2
    what = rng.choice(
        ["position"] * shifts + ["orientation"] * turns + ["both"] * (shifts and turns)
    )
    measured = np.tile([what != "orientation"] * 3 + [what != "position"] * 3, (n, 1))
    conditions = {"time": 5.0 * np.arange(n)}
    for name, low, high in (("payload", 0.0, 2.0), ("temperature", 18.0, 30.0)):
        values = (np.full(n, high), rng.choice([low, high], n), rng.uniform(low, high, n))
        conditions |= {name: values[rng.integers(3)]} if rng.random() < 0.6 else {}
    if rng.random() < 0.5:
        sides = rng.choice([[1.0, -1.0], [1.0, 1.0]])
        conditions |= {f"direction.{joint}": rng.choice(sides, n) for joint in model.joints}
    stated = rng.random() < 0.6
    return model, Dataset.from_arrays(
        model.joints,
        q,
        np.where(measured[:, :3], r, 0.0),
        R if what != "position" else np.tile(np.eye(3), (n, 1, 1)),
        measured=measured,
        pose_cov=np.diag([4e-10] * 3 + [1e-8] * 3) if stated else None,
        joint_sigma=2e-5 if stated else None,
        conditions=conditions,
        source="drawn",
    )


def answer(step, *given, **options):
    """The result of a step; None if it is refused with an error of the package."""
    try:
        return step(*given, **options)
    except ParallelCalError:
        return None


def check_every_step(robot, seed):
    model, data = drawn(robot, seed)
    step = answer(fitted, model, data, force=True)
    model = step.model if step else model
    if (found := answer(diagnose, model, data)) is not None:
        text.show(found), found.document()
        if found.additions:
            answer(add, model, "+".join(found.additions), data)
    if (law := answer(discover, model, data)) is not None:
        text.show(law)
    if (compared := answer(compare, model, data)) is not None:
        text.show(compared), compared.document()
    answer(report, model, data)
    answer(plan, model, 8)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("robot", "seed"),
    [("scara", 3), pytest.param("argos27", 1, marks=pytest.mark.wide), ("five_bar", 0)],
)
def test_every_step_answers_a_small_session_or_refuses_it_in_a_sentence(robot, seed):
    check_every_step(robot, seed)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "robot",
    keep(ROBOTS, "delta24", "slider_crank"),
)
@pytest.mark.parametrize(
    "seed",
    [pytest.param(k, marks=pytest.mark.slow if k else pytest.mark.wide) for k in range(4)],
)
def test_every_step_answers_many_small_sessions(robot, seed):
    check_every_step(robot, 100 + seed)


def scara_at_heights(heights):
    """A SCARA whose column stands at a few heights, before a device whose field is quadratic."""
    rng = np.random.default_rng(2)
    n = 120
    q = np.c_[rng.uniform(-1, 1, n), rng.uniform(0.4, 2.2, n), rng.choice(heights, n)]
    a, b = q[:, 0], q[:, 0] + q[:, 1]
    P = np.c_[0.4 * np.cos(a) + 0.3 * np.cos(b), 0.4 * np.sin(a) + 0.3 * np.sin(b), q[:, 2]]
    u = (P - P.mean(axis=0)) / 0.4
    field = np.c_[u[:, 1] * u[:, 2], u[:, 0] ** 2 - u[:, 2] ** 2, u[:, 0] * u[:, 1]]
    seen = P + 3e-4 * field + rng.normal(0, 2e-5, P.shape)
    return new_model(ROBOTS["scara"]()), Dataset.from_arrays(
        ("joint1", "joint2", "joint3"),
        q,
        seen,
        np.tile(np.eye(3), (n, 1, 1)),
        measured=np.tile([True] * 3 + [False] * 3, (n, 1)),
    )


@pytest.mark.wide
def test_a_column_that_stands_at_five_heights_is_diagnosed():
    model, data = scara_at_heights([0, 0.1, 0.2, 0.3, 0.4])
    found = diagnose(fitted(model, data).model, data)
    assert "device_field" in found.effects
    assert found.best.fitted.held_out.summary.position_rms < 40e-6  # of 119 um before


def test_a_smooth_error_of_each_joint_with_its_own_reading_lies_in_the_fields_of_the_joints():
    """Each joint errs with the square of its own reading; without the projection off the geometry,
    columns of such errors describe it, however few heights the column has."""
    model, data = scara_at_heights([0, 0.1, 0.2, 0.3, 0.4])
    base = fit(model, data, hold_out=0)
    nothing = np.zeros(len(base.free), bool)
    scene = Scene.of(base.model, base.dataset, base.observations, nothing)
    by_joint = scene.measured_jacobian[:, :, :3]
    error = np.einsum("nrj,nj->nr", by_joint, 1e-3 * data.q**2).ravel()
    laws = {block.name: block for block in list_unknown_blocks(scene)}
    own = laws["law of each joint's own reading"].columns[-1]  # of the smoothest
    left = error - own @ np.linalg.lstsq(own, error)[0]
    assert np.linalg.norm(left) < 1e-3 * np.linalg.norm(error)


@pytest.mark.parametrize("places", [np.zeros((60, 3)), np.tile([0.1, -0.2, 0.3], (60, 1))])
def test_noise_does_not_grow_from_the_centre_if_the_platform_stays_in_one_place(places):
    """The size of correlated noise wanders from sample to sample, which is no growth in space."""
    for seed in range(5):
        z = correlated(np.random.default_rng(seed), (60, 3), 0.95)
        shape = noise_shape(z, np.arange(60.0), places)
        assert (shape.growth, shape.growth_p) == (1.0, 1.0)


def argos_turned_by_correlated_noise(seed):
    rng = np.random.default_rng(seed)
    model = new_model("argos9")
    pose = Kinematics(model).direct(rng.uniform(-0.4, 0.4, (90, 3)))
    q = pose.joints[pose.solved]
    w = 1.2e-4 * correlated(rng, (len(q), 3), 0.95)
    return model, Dataset.from_arrays(
        model.joints,
        q,
        np.zeros((len(q), 3)),
        np.array([rotation_matrix(v) for v in w]) @ pose.rotation[pose.solved],
        measured=np.tile([False] * 3 + [True] * 3, (len(q), 1)),
        pose_cov=np.diag([1.0] * 3 + [1.2e-4**2] * 3),
        joint_sigma=5e-5,
        conditions={"time": 3.0 * np.arange(len(q))},
    )


@pytest.mark.parametrize("seed", [1, 5])
def test_correlated_noise_of_a_robot_that_only_turns_has_no_law(seed):
    model, data = argos_turned_by_correlated_noise(seed)
    assert discover(model, data).verdict == "nothing"


def test_noise_of_a_robot_that_only_turns_grows_with_the_turn_from_the_middle():
    """A third of the noise in the middle, and three times as much far out: of a robot that stays
    in place, where the noise is larger is a question of its orientation."""
    rng = np.random.default_rng(0)
    model, data = argos_turned_by_correlated_noise(0)
    base = fit(model, data, hold_out=0)
    scene = Scene.of(base.model, base.dataset, base.observations, base.free)
    away = np.linalg.norm(scene.places - scene.places.mean(axis=0), axis=1)
    assert 0.1 < away.max() < 1.5  # rad
    z = rng.standard_normal((len(away), 3)) * (0.3 + 3 * away / away.max())[:, None]
    assert noise_shape(z, data.time, scene.places).grows_from_centre
