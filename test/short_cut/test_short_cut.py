"""A Delta from loops of its own arms and rods: truth are arms and rods held together by numbers."""

import json
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import virtual_short_cut as vs
from bag_writing import Session, joint_states, text, write_bag
from tied import JOINTS, blind
from virtual_small import Rssr

from parallel_cal.base.errors import FitError
from parallel_cal.cli import main as cli
from parallel_cal.identification.fit_warnings import chi2_band
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.mechanisms.rssr import Circle, compute_parameters
from parallel_cal.model.file.modelfile import read_model, write_model
from parallel_cal.model.mechanism import Home
from parallel_cal.model.model import new_model
from parallel_cal.short_cut.identify import combine, identify, short_cut
from parallel_cal.short_cut.loop import Loop, loop_model, loop_numbers
from parallel_cal.virtual import robot as vr

SIGMA = vr.THESIS_NOISE.joint
RODS_1 = ("chain1.Lb", "chain1.dLb")


def recording(robot, loop, n=40, seed=0, sigma=SIGMA, noise=1.0):
    rng = np.random.default_rng([seed, *map(ord, loop)])
    q = vs.tied(robot, loop).places(n)
    return blind(q + noise * rng.normal(0, sigma, q.shape), sigma, {})


def recordings(robot, loops, **how):
    return [(Loop.parse(loop), recording(robot, loop, **how)) for loop in loops]


def measured_rods(robot):
    """The nominal model with the true lengths of chain 1's rods."""
    return new_model("delta54", {name: robot.parameters[name] for name in RODS_1})


def shape_error(model, robot):
    """Mean position error (m) over the workspace, with {B} where it fits best."""
    joints, where = vs.workspace(robot)
    r = Kinematics(model).direct(joints).position
    return np.linalg.norm(vs.moved_onto(r, where) - where, axis=1).mean()


def distances(robot):
    """Between all balls of the three arms at two places of each, and the rods' lengths."""
    balls = robot.joint_points(np.array([[0.0] * 3, [1.0] * 3])).reshape(-1, 3)
    return np.append(np.linalg.norm(balls[:, None] - balls, axis=-1), robot.rods)


# --------------------------------------------------------------------------- one loop


def test_a_loops_nine_numbers_are_read_from_its_balls_circles():
    numbers = {"a": 0.03, "alpha": -1.9, "input.r": 0.11, "input.s": 0.14, "input.q0": -1.4}
    numbers |= {"output.r": 0.12, "output.s": -0.16, "output.q0": 2.8, "L": 0.23}
    loop = Rssr(numbers)
    angles = np.array([[0.0], [np.pi / 2], [np.pi]])
    one, other = loop.balls(angles, vr.axis_rotation("z", angles[:, 0]))
    # Anywhere in space: what the loop is does not depend on where it stands.
    place = [points @ vr.turn([0.4, -1.0, 2.0]).T + [0.1, 0.5, -0.3] for points in (one, other)]
    found = np.array(compute_parameters(*[Circle(*map(ca.DM, points)) for points in place], 0.23))
    assert found.ravel() == pytest.approx(list(numbers.values()), abs=1e-14)


def test_the_nominal_deltas_loop_is_what_paper_and_pencil_say():
    """Table 5.12: axes 100 mm out, 120 degrees apart, so they meet 100 tan 60 mm from the arms'
    middles; the balls are 20 mm nearer, 3 mm beside arms of 119.963 mm."""
    model = loop_model(new_model("delta54"), Loop.parse("12:21:11"), Home((1.0,)))
    arm, along = np.hypot(0.119963, 0.003), 0.1 * np.sqrt(3) - 0.02
    lag = np.arctan2(3, 119.963)
    expected = [0, -np.radians(120), arm, along, -np.pi / 2 - lag, arm, -along, -np.pi / 2 - lag]
    assert model.values == pytest.approx([*expected, 0.24], abs=1e-12)
    assert [n for n, f in zip(model.table.names, model.fixed, strict=True) if f] == ["L"]


@pytest.mark.wide
@pytest.mark.parametrize("loop", vs.TWELVE)
def test_a_loop_closes_where_the_virtual_arms_hold_its_rod(loop):
    robot = vs.random_delta(1)
    truth = new_model("delta54", robot.parameters)
    q = vs.tied(robot, loop).places(60)
    one, other = Loop.parse(loop).arms
    x = np.zeros((60, 13))
    x[:, 0], x[:, 4:] = q[:, one], vr.axis_rotation("z", q[:, other]).reshape(-1, 9)
    model = loop_model(truth, Loop.parse(loop), Home((0.0,)))
    phi, _, _ = model.structure.closure_batch(x, np.zeros((60, 0)), model.values)
    assert np.abs(phi).max() < 1e-13


def test_derivatives_of_a_loops_numbers_are_finite_differences():
    model, loop = new_model("delta54", vr.TABLE_5_18), Loop.parse("12:31:22")
    _, G = loop_numbers(model, loop, model.values, 0.24)
    for k, column in enumerate(1e-6 * np.eye(len(model.values))):
        ahead, behind = (
            loop_numbers(model, loop, model.values + s * column, 0.24)[0] for s in (1, -1)
        )
        assert np.abs((ahead - behind) / 2e-6 - G[:, k]).max() < 1e-8


def test_one_loop_is_found_as_far_as_its_angles_see_it():
    """Of nine numbers, the size is not seen, nor where nearly meeting axes pass each other."""
    robot = vs.random_delta(3)
    found = identify(new_model("delta54"), Loop.parse("12:21:11"), recording(robot, "12:21:11"))
    assert found.rank == 7
    low, high = chi2_band(found.fit.estimate.dof)
    assert low < found.fit.estimate.chi2_per_dof < high
    before, after = (e.document()["orientation_rms"] for e in (found.fit.before, found.fit.after))
    assert before > 20 * after
    assert after < 3 * SIGMA


# --------------------------------------------------------------------------- all loops


@pytest.mark.wide
def test_without_noise_the_loops_give_every_distance_in_arms_and_rods():
    robot = vs.random_delta(0)
    exact = recordings(robot, vs.SIX, sigma=1e-6 * SIGMA, noise=0)
    found = short_cut(measured_rods(robot), exact, fix=RODS_1)
    again = vr.Delta(found.model.table.mapping(found.model.values))
    assert np.abs(distances(again) - distances(robot)).max() < 1e-9
    assert np.abs(distances(vr.Delta(vr.TABLE_5_12)) - distances(robot)).max() > 1e-3


@pytest.mark.wide
def test_estimates_scatter_as_their_covariance_says():
    """Robots drawn from the tolerances, so that priors and data have their say."""
    check_covariance(range(3))


@pytest.mark.slow
def test_estimates_of_two_hundred_robots_scatter_as_their_covariance_says():
    check_covariance(range(200))


def check_covariance(seeds):
    """Of every parameter; and of distances in the robot, known far better than where it stands."""
    parameters, shape, chi2 = [], [], []
    for seed in seeds:
        robot = vs.random_delta(seed)
        data = recordings(robot, vs.SIX, seed=seed)
        found = short_cut(measured_rods(robot), data, fix=RODS_1)
        values, covariance, names = (
            found.model.values,
            found.model.covariance,
            found.model.table.names,
        )
        off = values - [robot.parameters[name] for name in names]
        parameters.append((off / np.sqrt(np.diag(covariance) + 1e-99))[~found.model.fixed])
        at_found = distances(vr.Delta(dict(zip(names, values, strict=True))))
        moved = [
            distances(vr.Delta(dict(zip(names, values + step, strict=True)))) - at_found
            for step in 1e-6 * np.eye(len(names))
        ]
        sigma = np.sqrt(np.einsum("ik,ij,jk->k", moved, covariance, moved)) / 1e-6
        seen = sigma > 1e-7
        shape.append((at_found - distances(robot))[seen] / sigma[seen])
        chi2.append(found.chi2_per_dof)
    n = len(seeds)
    assert rms(parameters) == pytest.approx(1, abs=0.7 / np.sqrt(n))
    assert rms(shape) == pytest.approx(1, abs=0.7 / np.sqrt(n))
    assert np.mean(chi2) == pytest.approx(1, abs=4 * np.sqrt(2 / found.dof / n))


def rms(rows):
    return float(np.sqrt(np.mean(np.square(np.concatenate(rows)))))


@pytest.mark.wide
def test_loops_put_together_from_their_covariances_agree_with_their_closures():
    robot = vs.random_delta(0)
    start, data = measured_rods(robot), recordings(robot, vs.TWELVE)
    anew = short_cut(start, data, fix=RODS_1)
    once = combine(replace(start, fixed=anew.model.fixed), anew.loops, relinearise=False)
    low, high = chi2_band(anew.dof)
    assert low < anew.chi2_per_dof < high
    assert anew.chi2_per_dof <= once.chi2_per_dof
    sigma = np.sqrt(np.diag(anew.model.covariance))[~anew.model.fixed]
    apart = (once.model.values - anew.model.values)[~anew.model.fixed]
    assert np.abs(apart / sigma).max() < 1
    assert shape_error(once.model, robot) < 2 * shape_error(anew.model, robot)


@pytest.mark.wide
@pytest.mark.parametrize("seed", [0, 1])
def test_the_whole_robot_gets_better_though_its_platform_was_in_no_loop(seed):
    robot = vs.random_delta(seed)
    start = measured_rods(robot)
    found = short_cut(start, recordings(robot, vs.TWELVE, seed=seed), fix=RODS_1)
    before, after = shape_error(start, robot), shape_error(found.model, robot)
    assert after < 100e-6
    assert after < before / 4


@pytest.mark.wide
def test_model_24_comes_back_as_model_54():
    robot = vr.MOCK_UP
    found = short_cut(new_model("delta24"), recordings(robot, vs.SIX))
    assert found.model.mechanism.name == "delta54"
    assert shape_error(found.model, robot) < 0.6 * shape_error(new_model("delta24"), robot)


# --------------------------------------------------------------------------- what is not seen


FRAME = "where the robot stands in {B} (6 directions)"
PLATFORM = "the platform's bars, which are in no loop (6 directions)"
SIZE = "the robot's size, as no length is known (1 direction)"


@pytest.fixture(scope="module")
def robot():
    return vs.random_delta(2)


@pytest.mark.wide
def test_loops_see_three_arms_and_six_rods_but_no_size(robot):
    """4 numbers an axis, 3 a ball, 1 a rod, less 6 of the frame and the size: 29."""
    found = short_cut(new_model("delta54"), recordings(robot, vs.SIX))
    assert found.spectrum.rank == 3 * (4 + 2 * 3) + 6 - 6 - 1
    assert found.unseen == (PLATFORM, FRAME, SIZE)
    known = short_cut(measured_rods(robot), recordings(robot, vs.SIX), fix=RODS_1)
    assert known.unseen == (PLATFORM, FRAME)
    assert known.spectrum.rank == 28


def test_a_rod_and_balls_that_are_in_no_loop_are_named(robot):
    found = short_cut(new_model("delta54"), recordings(robot, ("12:21:11", "22:31:21", "32:12:21")))
    assert "rod 31, which is in no loop (1 direction)" in found.unseen
    assert "ball 11, which is in no loop (3 directions)" in found.unseen
    assert len(found.model.table) - 12 - found.spectrum.rank > 13
    assert found.warnings == tuple(f"the loops cannot tell {what}" for what in found.unseen)


@pytest.mark.wide
def test_what_no_loop_sees_keeps_its_tolerance(robot):
    found = short_cut(measured_rods(robot), recordings(robot, vs.TWELVE), fix=RODS_1)
    table = found.model.table
    sigma = np.sqrt(np.diag(found.model.covariance)) / table.tolerance
    assert sigma[table.index_of("chain2.dalpha")] > 0.5
    assert sigma[table.index_of("chain2.Lb")] < 0.1
    assert sigma[table.index_of("chain1.Lb")] == 0


# --------------------------------------------------------------------------- bad input


@pytest.mark.parametrize("text", ["12-21-11", "12:11:11", "12:21:13", "42:21:11", "12:21", ""])
def test_a_loop_named_wrongly_says_how(text):
    with pytest.raises(FitError, match="BALL:BALL:ROD"):
        Loop.parse(text)


def test_bad_input_is_a_clear_error(robot):
    model, one = new_model("delta54"), recordings(robot, ("12:21:11",))
    with pytest.raises(FitError, match="no loop holds arm 3"):
        short_cut(model, one)
    with pytest.raises(FitError, match="no loop holds arm 1, 2, 3"):
        short_cut(model, [])
    with pytest.raises(FitError, match="rssr with 0 effects"):
        short_cut(new_model("rssr"), one)
    with pytest.raises(FitError, match="delta54 with 1 effects"):
        short_cut(model.with_effect("encoder_eccentricity"), one)
    nameless = replace(one[0][1], joint_names=("a", "b", "c"))
    with pytest.raises(FitError, match=r"loop 12:21:11: .*joint joint1, joint2, joint3 is missing"):
        identify(model, one[0][0], nameless)


@pytest.mark.wide
@pytest.mark.parametrize("ball", ["11:21:11", "12:22:11"])
def test_a_ball_named_wrongly_is_found_out(robot, ball):
    """By the loop itself, or by the others: alone, a plausible loop fits it to the noise."""
    data = recordings(robot, vs.SIX)
    wrong = [(Loop.parse(ball), data[0][1]), *data[1:]]
    with pytest.raises(FitError, match=r"plausible"):
        short_cut(new_model("delta54"), wrong)


@pytest.mark.wide
def test_an_encoder_set_to_zero_between_two_loops_is_a_warning(robot):
    data = recordings(robot, vs.TWELVE)
    data[3] = (data[3][0], replace(data[3][1], q=data[3][1].q + [5e-3, 0, 0]))
    assert "contradict each other" in short_cut(new_model("delta54"), data).warnings[-1]


def test_five_poses_of_a_loop_determine_five_numbers_and_hardly_a_chi2(robot):
    found = short_cut(new_model("delta54"), recordings(robot, vs.THREE, n=5))
    assert [loop.rank for loop in found.loops] == [5, 5, 5]
    assert found.spectrum.rank == 15
    # What the tolerances hold of 15 numbers is all that 15 residuals leave.
    assert found.spectrum.taken > 12
    assert found.dof == round(15 - found.spectrum.taken) < 3
    low, high = found.document()["chi2_band"]
    assert low <= found.document()["chi2_per_dof"] <= high


# --------------------------------------------------------------------------- command line


@pytest.fixture
def run(capsys):
    """run(*arguments) -> (exit code, stdout, stderr)."""

    def call(*arguments):
        with pytest.raises(SystemExit) as ended:
            cli.main([str(a) for a in arguments])
        return ended.value.code, *capsys.readouterr()

    return call


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """Three loops of a robot: joint_states, and on `constraint` the name of each loop."""
    messages = []
    for k, loop in enumerate(vs.THREE):
        q = recording(vs.random_delta(2), loop, n=16, seed=1).q
        messages += joint_states(Session(q, names=JOINTS, start=40.0 * k))
        messages.append(text(40.0 * k, loop, "constraint"))
    return write_bag(tmp_path_factory.mktemp("short_cut") / "bag", messages)


@pytest.mark.wide
def test_the_command_writes_a_model_from_recorded_loops(run, robot, bag, tmp_path):
    start, out = tmp_path / "m.yaml", tmp_path / "out.yaml"
    write_model(measured_rods(robot), start)
    options = ("--joint-sigma", SIGMA, "--fix", "chain1.Lb,chain1.dLb", "-o", out)
    code, answer, err = run("short-cut", start, bag, *options, "--json")
    assert code == 0, err
    assert f"warning: the loops cannot tell {FRAME}" in err
    document = json.loads(answer)
    assert [loop["loop"] for loop in document["loops"]] == list(vs.THREE)
    for loop in document["loops"]:
        assert loop["samples"] == 16
        assert loop["after"]["orientation_rms"] < loop["before"]["orientation_rms"] / 5
    low, high = document["chi2_band"]
    assert low < document["chi2_per_dof"] < high
    written = read_model(out)
    assert written.value("chain2.D_x") == document["parameters"]["chain2.D_x"]["value"]
    assert written.history[-1]["loops"] == list(vs.THREE)
    assert shape_error(written, robot) < shape_error(read_model(start), robot) / 2


def test_the_command_shows_people_what_it_found(run, bag, tmp_path):
    write_model(new_model("delta54"), tmp_path / "m.yaml")
    code, answer, err = run("short-cut", tmp_path / "m.yaml", bag, "--joint-sigma", SIGMA)
    assert code == 0, err
    assert "12:21:11" in answer
    assert "chain3.La_x" in answer


def test_the_command_refuses_what_it_cannot_use(run, robot, tmp_path):
    write_model(new_model("delta54"), tmp_path / "m.yaml")
    data, tied = recording(robot, "12:21:11"), np.zeros(40)
    for channels, words in (
        ({}, "'constraint'"),
        ({"reading.plane": tied}, "loop 'plane': expected BALL:BALL:ROD"),
        ({"reading.12:21:11": tied}, "no loop holds arm 3"),
    ):
        path = tmp_path / "samples.json"
        replace(data, conditions=channels).to_json(path)
        code, answer, err = run("short-cut", tmp_path / "m.yaml", path)
        assert (code, answer, err.count("\n")) == (1, "", 1)
        assert words in err
