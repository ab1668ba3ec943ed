"""Joint readings in another unit are refused at the door, with joint, values and cure; readings
that a real robot may show are not."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import virtual_arm as va
from arms import nominal, seen
from datasets import measured
from scipy.spatial.transform import Rotation

from parallel_cal.base.errors import FitError
from parallel_cal.base.rotation import matrix_to_quaternion
from parallel_cal.cli import main as cli
from parallel_cal.diagnosis.comparison import compare
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.identification.fit import fit
from parallel_cal.identification.given_model import GivenModel
from parallel_cal.identification.observations import observe
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.kinematics.solving import controlled_pose
from parallel_cal.mechanisms.delta54 import Delta54
from parallel_cal.mechanisms.linear_delta import LinearDelta
from parallel_cal.mechanisms.stewart42 import (
    BASE,
    PLATFORM,
    RETRACTED,
    Stewart42,
)
from parallel_cal.model.file.modelfile import write_model
from parallel_cal.model.mechanism import poses_in_workspace
from parallel_cal.model.model import Noise, new_model
from parallel_cal.model.shelf import list_plugins
from parallel_cal.recordings.csv_import import import_csv
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.session.goals import Request, examine, propose_model
from parallel_cal.session.steps import add, fitted
from parallel_cal.virtual import robot as vr

JUGGLEBOT = Path(__file__).parents[2] / "real" / "jugglebot" / "poses_108.csv"
NOISE = Noise(joint=1e-5, position=1e-5, orientation=1e-4)


def stewart(limits=(0.0, 0.2)):
    mechanism = Stewart42()
    mechanism.joint_limits = (limits,) * 6
    return replace(new_model(mechanism), noise=NOISE)


def legs(scale=1.0, offset=0.0, poses=40, places=None):
    """Samples of a nominal Stewart platform whose legs are read `scale` times, plus `offset`, by
    the distance of their balls; `places` scales the positions that the device shows."""
    rng = np.random.default_rng(0)
    r = np.array([0.0, 0.0, 0.3]) + rng.uniform(-0.05, 0.05, (poses, 3))
    R = vr.turn(rng.uniform(-0.15, 0.15, (poses, 3)))
    ends = r[:, None] + np.einsum("nij,kj->nki", R, PLATFORM) - BASE
    q = np.linalg.norm(ends, axis=2) - RETRACTED + 1e-5 * rng.standard_normal((poses, 6))
    return Dataset.from_arrays(
        stewart().joints, scale * q + offset, r * (places or 1.0), R, source="legs.csv"
    )


def delta(change=lambda q: q):
    """Samples of the thesis' mock-up whose joint readings are changed, and its model."""
    data = measured()
    return new_model(Delta54()), replace(data, q=change(data.q))


@pytest.mark.parametrize(
    ("scale", "words"),
    [
        (
            1e3,
            "By the measured poses the readings are in mm: state it in the column map (leg2: "
            "{column: ..., unit: mm}",
        ),
        (1e2, "the readings are in cm: state it in the column map (leg2: {column: ..., unit: cm}"),
        (1e6, "the readings are in um: "),
        (1 / 0.0254, "the readings are in in: "),
        (
            1 / 0.012,
            "(column map: leg2: {column: ..., unit: rev, per_rev: 12 mm}), its radians (unit: ra",
        ),
        (-4096 / 0.005, "encoder counts"),
    ],
)
def test_legs_in_another_unit_are_refused_with_joint_values_limits_and_cure(scale, words):
    data = legs(scale)
    with pytest.raises(FitError) as error:
        observe(stewart(), data)
    said = str(error.value)
    assert words in said
    worst = next(j for j in stewart().joints if f"joint {j} reads" in said)
    q = data.q[:, stewart().joints.index(worst)]
    assert said.startswith(
        f"legs.csv: joint {worst} reads {q.min():.4g} to {q.max():.4g} m, its limits are 0 to 0.2 m"
    )
    assert "model file (low, high)" in said


def test_angles_in_degrees_are_refused_though_whole_turns_change_nothing():
    with pytest.raises(
        FitError, match=r"joint\d reads .* rad, .*the readings are in deg: state it"
    ):
        observe(*delta(np.degrees))


def test_the_unit_is_guessed_from_the_limits_where_no_pose_tells():
    data = legs(1e3)
    unseen = replace(data, measured=np.zeros_like(data.measured))
    with pytest.raises(
        FitError,
        match=r"In mm the readings would be near the limits.*a motor's revolutions: leg.*rev",
    ):
        observe(stewart(), unseen)
    counts = replace(unseen, q=1e9 * data.q)
    with pytest.raises(FitError, match="Are the readings in mm or cm or um, a motor's revolutions"):
        observe(stewart(), counts)


def test_nothing_is_fitted_to_such_readings_through_any_door(tmp_path):
    model, data, file = stewart(), legs(1e3), str(tmp_path / "m.yaml")
    write_model(model, file)
    refused = "the readings are in mm"
    for identify in (fit, diagnose, lambda m, d: add(m, "thermal_expansion", d)):
        with pytest.raises(FitError, match=refused):
            identify(model, data)
    assert refused in propose_model(Request(file, file), data).message
    assert refused in examine(file, data, Request(file, file).options, lambda *_: None).message


@pytest.mark.wide
def test_a_comparison_shows_such_readings_and_warns():
    [said] = [
        w for w in compare(stewart(), legs(1e3)).dataset.warnings if "the readings are in mm" in w
    ]
    assert "leg" in said
    assert not any("limits" in w for w in compare(stewart(), legs()).dataset.warnings)


@pytest.mark.parametrize("offset", [0.0, 0.1])
@pytest.mark.parametrize(
    ("scale", "words"),
    [
        (
            1e-3,
            "factor 1e+03 .*the readings were in m already and were converted from mm: state it",
        ),
        (0.0254, "were in m already and were converted from in: state it in .* unit: m}; see"),
        (1 / 5.0, "revolutions .column map: leg6: {column: ..., unit: rev, per_rev: 5000 mm}"),
        (0.4, "by the measured poses the readings are wrong by the factor 2.5"),
        (2.8, "by the measured poses the readings are wrong by the factor 2.8"),
    ],
)
def test_readings_that_the_measured_poses_contradict_are_refused(scale, words, offset):
    data = legs(scale, offset)
    with pytest.raises(FitError, match=words.replace("+", r"\+")):
        observe(stewart(), data)
    assert len(observe(stewart(), data, insist=True)) == 40


@pytest.mark.parametrize("scale", [0.55, 0.94, 1.06, -0.6, 1.9])
def test_gains_and_signs_within_the_limits_are_accepted(scale):
    assert len(observe(stewart((-0.5, 0.5)), legs(scale))) == 40


def test_angles_in_revolutions_are_refused_and_a_wrong_gear_ratio_is_not():
    with pytest.raises(
        FitError, match=r"joint\d reads .* rad, .*the readings are in rev: state it"
    ):
        observe(*delta(lambda q: q / (2 * np.pi)))
    for ratio in (0.6, 0.94, 1.06):
        observe(*delta(lambda q, ratio=ratio: ratio * q))


def test_small_readings_are_accepted_unless_the_poses_prove_the_mismatch():
    data = legs(1e-3)
    observe(stewart(), replace(data, measured=np.zeros_like(data.measured)))
    observe(stewart(), data.select(np.arange(9)))
    noisy = data.q + 1e-4 * np.random.default_rng(0).standard_normal(data.q.shape)
    observe(stewart(), replace(data, q=noisy))
    # The poses span less than a twentieth of the joints' range.
    observe(stewart((0.0, 20.0)), data)


@pytest.mark.parametrize("scale", [1e3, 1e-3, 1 / 0.0712])
def test_the_poses_judge_the_readings_of_joints_without_limits(scale):
    unlimited = stewart((-np.inf, np.inf))
    with pytest.raises(
        FitError, match=r"joint leg\d reads .* m, it has no limits: by the measured"
    ):
        observe(unlimited, legs(scale))
    data = legs(scale)
    observe(unlimited, replace(data, measured=np.zeros_like(data.measured)))
    for own in (0.94, -1.0, 1.6):
        observe(unlimited, legs(own, offset=0.3))


UNITS_OF = {"m": (1e-3, 1e-2, 0.0254, 0.005), "rad": (np.pi / 180, 2 * np.pi, 1e-3)}
# The arms of a user's own description have other joints each.
MECHANISMS = [name for name in list_plugins("mechanisms") if name not in ("serial", "chain")]


@pytest.mark.wide
@pytest.mark.parametrize("name", MECHANISMS)
def test_the_readings_of_every_mechanism_are_refused_in_a_unit_too_large_or_too_small(name):
    model = replace(new_model(name), noise=NOISE)
    r, R = poses_in_workspace(model.mechanism, 40, np.random.default_rng(0))
    r, R = controlled_pose(model, r, R)
    found = Kinematics(model).direct(Kinematics(model).inverse(r, R).joints)
    seen = found.solved
    data = Dataset.from_arrays(
        model.joints,
        found.joints[seen],
        found.position[seen],
        found.rotation[seen].reshape(-1, 3, 3),
    )
    assert len(observe(model, data)) == len(data) > 10
    for unit in UNITS_OF[model.mechanism.joint_units[0]]:
        for scale in (unit, 1 / unit):
            with pytest.raises(FitError, match=r"By the measured poses .*column map"):
                observe(model, replace(data, q=scale * data.q))


@pytest.mark.parametrize("axis", np.eye(3))
def test_an_unknown_frame_of_the_device_is_no_wrong_unit(axis):
    data, turn = legs(), vr.turn(1.5 * axis[None])[0]
    for shift in (0.0, 0.3, 2.0):
        moved = replace(data, r=data.r @ turn.T + shift, R=turn @ data.R)
        for limits in ((0.0, 0.2), (0.0, 0.1), (-0.5, 0.5), (-np.inf, np.inf)):
            observe(stewart(limits), moved)


@pytest.mark.parametrize("offset", [0.0, 0.3, -0.5, 1.5])
@pytest.mark.parametrize("scale", [1.0, 1.5, -1.0])
def test_wrong_zeros_gains_and_signs_are_a_robots_own(scale, offset):
    assert len(observe(stewart(), legs(scale, offset))) == 40


def test_whole_turns_of_a_joint_that_turns_are_legitimate():
    rng = np.random.default_rng(1)
    plain = observe(*delta(lambda q: q))
    for turned in (
        lambda q: q + 2 * np.pi * rng.integers(-20, 20, q.shape),
        lambda q: q + 1000 * np.pi,
    ):
        assert len(observe(*delta(turned))) == len(plain) > 0


def test_a_few_wild_readings_are_no_unit():
    data = legs()
    q = data.q.copy()
    q[::20] = 1e4
    assert len(observe(stewart(), replace(data, q=q))) == len(data)


def test_stated_limits_or_force_override_the_check():
    data = legs(1e3)
    observe(stewart((0.0, 200.0)), data)
    assert len(observe(stewart(), data, insist=True)) == 40
    narrow = stewart((0.0, 0.01))
    with pytest.raises(FitError, match=r"its limits are 0 to 0\.01 m"):
        fit(narrow, legs(), hold_out=0)
    found = fit(narrow, legs(), hold_out=0, insist=True)
    assert any("its limits are 0 to 0.01 m" in w for w in found.warnings)


def test_a_carriage_within_its_rail_is_not_changed():
    model = new_model(LinearDelta())
    q = np.random.default_rng(0).uniform(*model.mechanism.joint_limits[0], (30, 3))
    data = Dataset.from_arrays(model.joints, q, np.zeros((30, 3)), np.tile(np.eye(3), (30, 1, 1)))
    observe(replace(model, noise=NOISE), data)
    with pytest.raises(FitError, match=r"joint\d reads .* its limits are 0 to 0\.6 m"):
        observe(replace(model, noise=NOISE), replace(data, q=1e3 * q))


def run(*arguments):
    with pytest.raises(SystemExit) as ended:
        cli.main([str(a) for a in arguments])
    return ended.value.code


def column_map(columns, **joint):
    legs = {name: {"column": column, **joint} for name, column in columns.items()}
    position = {"columns": ["position_x", "position_y", "position_z"], "unit": "mm"}
    turned = [f"orientation_{axis}" for axis in "xyzw"]
    # JSON is YAML
    return json.dumps({"joints": legs, "position": position, "orientation": turned})


@pytest.mark.wide
def test_a_fit_that_misses_a_joints_whole_range_is_never_written(tmp_path, capsys):
    """Positions in mm are taken for m, and tolerances allow any geometry. Not by force either."""
    data, file, better = legs(places=1e3, poses=12), tmp_path / "m.yaml", tmp_path / "better.yaml"
    write_model(stewart(), file)
    file.write_text(file.read_text().replace("tolerance: 0.001", "tolerance: 1000.0"))
    header = [f"leg{i}_m" for i in range(1, 7)] + ["position_x", "position_y", "position_z"]
    header += [f"orientation_{axis}" for axis in "xyzw"]
    rows = np.hstack([data.q, 1e3 * data.r, matrix_to_quaternion(data.R)])
    np.savetxt(tmp_path / "t.csv", rows, delimiter=",", header=",".join(header), comments="")
    map_file, samples = tmp_path / "map.yaml", tmp_path / "s.json"
    map_file.write_text(column_map({f"leg{i}": f"leg{i}" for i in range(1, 7)}))
    assert run("import-csv", tmp_path / "t.csv", "--columns", map_file, "-o", samples) == 0
    capsys.readouterr()
    assert run("fit", file, samples, "-o", better, "--force", "--hold-out", 0) == 1
    said = capsys.readouterr().err.replace("\n", " ")
    assert "misses the readings of joint leg" in said
    assert "more than its whole range (0 to 0.2)" in said
    assert not better.exists()


def jugglebot():
    """A model of the machine as its builders state it (README beside the data)."""
    turns, pairs = np.arange(6) // 2, (np.arange(6) + 1) // 2
    mechanism = Stewart42(
        base={"radius": 0.41, "angles": 200 + 100 * turns + 20 * pairs},
        platform={
            "radius": 0.219075,
            "angles": 154.3012223 + 8.6024446 * turns + 111.3975554 * pairs,
        },
        height=0.565,
        limits=(0.0, 0.3),
        tolerance=0.02,
    )
    return replace(new_model(mechanism), noise=Noise(1e-3, 1e-3, 1e-3, assumed=True))


def test_motor_revolutions_of_a_real_hexapod_are_refused_and_what_the_message_says_cures_it(
    tmp_path,
):
    columns = {f"leg{i}": f"leg_length_{i}" for i in range(1, 7)}
    file = tmp_path / "map.yaml"
    file.write_text(column_map(columns, unit="m"))
    with pytest.raises(FitError) as error:
        fit(jugglebot(), import_csv(JUGGLEBOT, file))
    assert "leg5 reads 0.2299 to 3.966 m, its limits are 0 to 0.3 m" in str(error.value)
    per_rev = re.search(r"unit: rev, per_rev: ([0-9.]+ mm)\}\)", str(error.value))[1]
    assert float(per_rev.split()[0]) == pytest.approx(71.03, rel=0.05)
    file.write_text(column_map(columns, unit="rev", per_rev=per_rev))
    found = fit(jugglebot(), import_csv(JUGGLEBOT, file))
    assert found.held_out.summary.position_rms < 3e-3  # 55 mm before


# ------------------------------------------------------------- other columns, signs, conventions


def exchanged(q):
    return q[:, [0, 1, 3, 2, 4, 5]]


def turned_around(data):
    return replace(data, R=data.R.transpose(0, 2, 1))


def about_rotated_axes(data):
    """Three angles about fixed axes, taken for angles about rotated axes."""
    angles = Rotation.from_matrix(data.R).as_euler("xyz")
    return replace(data, R=Rotation.from_euler("XYZ", angles).as_matrix())


SPOILT = {
    "exchanged": (
        lambda d: replace(d, q=exchanged(d.q)),
        "leg3, leg4 are in the columns of leg4, leg3: the errors are",
    ),
    "reversed": (lambda d: replace(d, q=d.q[:, ::-1]), "are in the columns of leg"),
    "sign": (
        lambda d: replace(d, q=d.q * [1, 1, -1, 1, 1, 1]),
        "leg3 has the other sign (column map: leg3: {column: ..., factor: -1})",
    ),
    "turned": (turned_around, "the rotations are those of the device seen by the target"),
    "unit": (
        lambda d: replace(d, r=10 * d.r),
        "the positions are in mm, not cm (column map: unit)",
    ),
}


def seen_from(elsewhere):
    """Sound samples of a device at the robot's base, or of one that stands anywhere."""
    data = legs(offset=0.01)
    F, f = vr.turn(np.array([0.3, -0.2, 1.9])), np.array([0.8, -0.4, 0.2])
    return replace(data, r=data.r @ F.T + f, R=F @ data.R, frame="tracker") if elsewhere else data


@pytest.mark.parametrize("elsewhere", [False, True])
def test_sound_samples_are_fitted_wherever_the_device_stands(elsewhere):
    fit(replace(stewart((-0.4, 0.4)), noise=NOISE), seen_from(elsewhere), hold_out=0)


FIRST = {"sign": (), "exchanged": pytest.mark.wide, "unit": pytest.mark.wide}


@pytest.mark.parametrize(
    "what", [pytest.param(one, marks=FIRST.get(one, pytest.mark.slow)) for one in SPOILT]
)
@pytest.mark.parametrize("elsewhere", [pytest.param(False, marks=pytest.mark.slow), True])
def test_what_was_meant_is_named_if_it_fits_the_poses(what, elsewhere):
    spoil, words = SPOILT[what]
    with pytest.raises(FitError, match=re.escape(words)) as refused:
        fit(replace(stewart((-0.4, 0.4)), noise=NOISE), spoil(seen_from(elsewhere)))
    assert str(refused.value).startswith("legs.csv: the joint readings do not fit")


def test_a_comparison_warns_in_the_words_with_which_a_fit_refuses():
    data = legs(offset=0.01)
    doubtful, wrong = stewart((-0.4, 0.4)), replace(data, q=data.q * [1, 1, -1, 1, 1, 1])
    with pytest.raises(FitError) as refused:
        fit(doubtful, wrong)
    [said] = [w for w in compare(doubtful, wrong).dataset.warnings if "leg3 has the" in w]
    assert said == str(refused.value)


@pytest.mark.wide
def test_a_convention_that_tolerances_would_excuse_is_named_where_no_geometry_fits():
    with pytest.raises(FitError, match=r"the angles are ZYX, not zyx .* As they are, the"):
        fitted(stewart(), about_rotated_axes(legs()))


@pytest.mark.slow
def test_two_mistakes_at_once_are_refused_and_the_command_tries_no_effect():
    data = seen(va.session(va.arm("ur5", 4), 60, 5, va.Tracker()))
    wrong = replace(data, q=data.q[:, [0, 2, 1, 3, 4, 5]] * [1, 1, 1, -1, 1, 1])
    with pytest.raises(FitError, match=r"No single exchange of columns.* two of them may be wrong"):
        fitted(nominal("ur5"), wrong)


@pytest.mark.wide
def test_a_zero_a_quarter_turn_away_is_named_and_robots_with_errors_are_let_in():
    model, data = delta(lambda q: q + [0.0, np.pi / 2, 0.0])
    with pytest.raises(FitError, match=r"-90 deg are added to joint2 \(column map: joint2: {col"):
        fit(model, data)
    for seed in range(3):
        off = 3 * model.table.tolerance * np.random.default_rng(seed).standard_normal(54)
        poor = model.with_values(model.values + np.where(model.fixed, 0.0, off))
        given = GivenModel.of(poor, measured())
        assert given.doubted_columns == ""
