"""The closed-chain robots of the shelf: closures worked by hand, sizes by options, refusals."""

import numpy as np
import pytest

from parallel_cal.base.errors import ModelError
from parallel_cal.base.rotation import quaternion_to_matrix, rotation_matrix
from parallel_cal.exporting.export import export
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_mechanism

RIGHT = np.pi / 2
EYE = np.eye(3)
CYCLE = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])  # turns (x, y, z) into (z, x, y)
QUARTER = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # turns (x, y, z) into (-y, x, z)
POSITION = [4, 5, 14]  # with CYCLE, the point B = (1, 2, 3) of the platform is at (7, 6, 16)


def phi(model, q, r, R):
    configuration = np.concatenate([np.ravel(q), r, np.asarray(R).ravel()])
    return np.array(model.structure.closure(configuration, [], model.values)[0]).ravel()


def each(table):
    return pytest.mark.parametrize("changed", table, ids=lambda name: name or "nothing")


def numbers_with(numbers, changed, value, part):
    changes = {changed: value} if changed in numbers else {}
    return {f"{part}.{name}": v for name, v in {**numbers, **changes}.items()}


# The crank points along x: C = (3, 2, 4). The rod spans (4, 4, 12), 176 = 13.27^2, and is 10 long.
SERVO = {
    **{"D_x": 1, "D_y": 2, "D_z": 4, "theta": RIGHT, "alpha": RIGHT, "q0": RIGHT},
    **{"crank": 2, "rod": 10, "B_x": 1, "B_y": 2, "B_z": 3},
}
SERVO_BY_HAND = {
    "": (0, 3.8),
    "q": (RIGHT, 5.8),  # the crank points along -y: (6, 6, 12)
    "q0": (0, 4.2),  # along y: (6, 2, 12)
    "theta": (0, 5.8),
    "alpha": (0, 2.6),  # up: (6, 4, 10)
    "crank": (4, 3.2),
    "rod": (20, -5.6),
    "D_x": (2, 3.45),
    "D_y": (3, 3.45),
    "D_z": (5, 2.65),
    "B_x": (2, 4.25),
    "B_y": (3, 5.05),
    "B_z": (4, 4.25),
}


@each(SERVO_BY_HAND)
@pytest.mark.parametrize(
    ("name", "leg", "i"), [("stewart_rss", "leg1", 0), ("stewart_rss", "leg6", 5)]
    + [("ankle_2rsu", "left", 0), ("ankle_2rsu", "right", 1)],
)  # fmt: skip
def test_a_leg_with_a_servo_is_what_paper_and_pencil_say(changed, name, leg, i):
    value, expected = SERVO_BY_HAND[changed]
    model = new_model(name, numbers_with(SERVO, changed, value, leg))
    q = np.full(len(model.joints), value if changed == "q" else 0)
    assert phi(model, q, POSITION, CYCLE)[i] == pytest.approx(expected, abs=1e-12)
    assert {n for n in model.table.names if n.startswith(f"{leg}.")} == {
        f"{leg}.{n}" for n in SERVO
    }


# Axis a = -x in {B}; R turns b = x to y. Their normal is -z, and 2 along it is (0, 0, -2).
ANKLE = {
    **{"c_x": 1, "c_y": 2, "c_z": 4, "f_x": 1, "f_y": 2, "f_z": 3, "offset": 2, "angle": RIGHT},
    **{"a_z": RIGHT, "a_x": 0, "b_z": 0, "b_y": 0},
}
ANKLE_BY_HAND = {
    "": (0, [6, 4, 14, 0]),
    "c_x": (2, [5, 4, 14, 0]),
    "c_y": (3, [6, 3, 14, 0]),
    "c_z": (5, [6, 4, 13, 0]),
    "f_x": (2, [6, 5, 14, 0]),
    "f_y": (3, [6, 4, 15, 0]),
    "f_z": (4, [7, 4, 14, 0]),
    "offset": (3, [6, 4, 15, 0]),
    "angle": (np.pi / 6, [6, 4, 16, -np.sqrt(0.75)]),
    "a_z": (0, [6, 4, 12, 1]),  # both axes along y
    "a_x": (RIGHT, [8, 4, 12, 0]),  # a = z, normal -x
    "b_z": (RIGHT, [6, 2, 12, 0]),  # R b = z, normal y
    "b_y": (RIGHT, [6, 4, 12, 1]),  # R b = -x = a
}


@each(ANKLE_BY_HAND)
def test_the_universal_joint_of_the_ankle_is_what_paper_and_pencil_say(changed):
    value, expected = ANKLE_BY_HAND[changed]
    model = new_model("ankle_2rsu", numbers_with(ANKLE, changed, value, "ankle"))
    assert phi(model, [0, 0], POSITION, CYCLE)[2:] == pytest.approx(expected, abs=1e-12)
    assert {n for n in model.table.names if "ankle" in n} == {f"ankle.{n}" for n in ANKLE}


# The carriage is at (3, 2, 4); the rod spans (4, 4, 12) and is 10 long.
RAIL = {
    **{"C_x": 1, "C_y": 2, "C_z": 4, "alpha": 0, "beta": 0},
    **{"rod": 10, "B_x": 1, "B_y": 2, "B_z": 3},
}
RAIL_BY_HAND = {
    "": (0, 3.8),
    "q": (3, 3.45),
    "alpha": (RIGHT, 5.8),  # the rail runs along -y: (6, 6, 12)
    "beta": (RIGHT, 7.4),  # along -z: (6, 4, 14)
    "rod": (20, -5.6),
    "C_x": (2, 3.45),
    "C_y": (3, 3.45),
    "C_z": (5, 2.65),
    "B_x": (2, 4.25),
    "B_y": (3, 5.05),
    "B_z": (4, 4.25),
}


@each(RAIL_BY_HAND)
@pytest.mark.parametrize("leg", [0, 3])
def test_a_leg_of_the_hexaglide_is_what_paper_and_pencil_say(changed, leg):
    value, expected = RAIL_BY_HAND[changed]
    model = new_model("hexaglide", numbers_with(RAIL, changed, value, f"leg{leg + 1}"))
    q = np.full(6, value if changed == "q" else 2)
    assert phi(model, q, POSITION, CYCLE)[leg] == pytest.approx(expected, abs=1e-12)
    assert {n[5:] for n in model.table.names if n.startswith("leg1")} == set(RAIL)


# C = (3, -3, 3) and B = (2, 6, 14), turned by QUARTER: the rod spans (-1, 9, 11), 203, 10 long.
ARM = {
    **{"D_x": 1, "D_y": 2, "D_z": 3, "theta": 0, "alpha": RIGHT},
    **{"La_x": 2, "La_y": 1, "Lb": 10},
}
BAR = {"x": 1, "y": 2}
ARM_BY_HAND = {
    "": (0, 5.15),
    "q": (RIGHT, 4.25),
    "D_x": (2, 5.3),
    "D_y": (3, 4.1),
    "D_z": (4, 6.1),
    "theta": (RIGHT, 1.55),
    "alpha": (0, 1.55),
    "La_x": (3, 5.3),
    "La_y": (2, 4.1),
    "Lb": (20, -4.925),
    "x": (2, 6.1),
    "y": (3, 5.3),
    "gear": (2, (91 + 23 * np.sqrt(2)) / 20),  # the bar turns by 45 degrees
}


@each(ARM_BY_HAND)
@pytest.mark.parametrize(("chain", "half"), [(1, "a"), (2, "a"), (3, "b"), (4, "b")])
def test_an_arm_of_the_quattro_is_what_paper_and_pencil_say(changed, chain, half):
    value, expected = ARM_BY_HAND[changed]
    numbers = numbers_with(ARM, changed, value, f"chain{chain}")
    bar = {**BAR, **({changed: value} if changed in BAR else {})}
    numbers |= {f"platform.{half}_{axis}": v for axis, v in bar.items()}
    numbers["platform.gear"] = value if changed == "gear" else 1
    q = np.full(4, value if changed == "q" else 0)
    rows = phi(new_model("quattro", numbers), q, POSITION, QUARTER)
    assert rows[chain - 1] == pytest.approx(expected, abs=1e-12)


def turned_with_the_chain(model, q, i):
    """(length error, distance from the plane) of chain i, with all turned about z as the chain."""
    around = rotation_matrix(np.array([0, 0, i * 2 * np.pi / 3]))
    rows = phi(model, np.full(3, q), around @ POSITION, around @ CYCLE @ around.T)
    return rows[[i, 3 + i]]


# The hinge is at (1, 2, 6) with its axis along y: the rod spans (6, 4, 10), 152, and is 10 long.
PRS = {
    **{"D_x": 1, "D_y": 2, "D_z": 4, "alpha": 0, "beta": 0, "gamma": 0, "delta": 0},
    **{"rod": 10, "B_x": 1, "B_y": 2, "B_z": 3},
}
PRS_BY_HAND = {
    "": (0, 2.6, 4),
    "q": (3, 1.65, 4),
    "D_x": (2, 2.05, 4),
    "D_y": (3, 2.25, 3),
    "D_z": (5, 1.65, 4),
    "alpha": (RIGHT, 5.8, 6),  # the rail runs along -y
    "beta": (RIGHT, 3.8, 4),  # along x
    "gamma": (RIGHT, 2.6, -6),  # the axis is along -x
    "delta": (RIGHT, 2.6, 10),  # along z
    "rod": (20, -6.2, 4),
    "B_x": (2, 3.05, 5),
    "B_y": (3, 3.65, 4),
    "B_z": (4, 3.25, 4),
}


@each(PRS_BY_HAND)
@pytest.mark.parametrize("chain", [0, 1, 2])
def test_a_chain_of_the_tripod_is_what_paper_and_pencil_say(changed, chain):
    value, *expected = PRS_BY_HAND[changed]
    model = new_model("tripod_prs", numbers_with(PRS, changed, value, f"chain{chain + 1}"))
    rows = turned_with_the_chain(model, value if changed == "q" else 2, chain)
    assert rows == pytest.approx(expected, abs=1e-12)
    assert {n[7:] for n in model.table.names if n.startswith("chain1")} == set(PRS)


# The crank points along x and its hinge along z: E = (3, 2, 4), the rod spans (4, 4, 12).
RRS = {
    **{"D_x": 1, "D_y": 2, "D_z": 4, "theta": RIGHT, "alpha": RIGHT, "crank": 2, "q0": RIGHT},
    **{"gamma": 0, "delta": 0, "rod": 10, "B_x": 1, "B_y": 2, "B_z": 3},
}
RRS_BY_HAND = {
    "": (0, 3.8, 12),
    "q": (RIGHT, 5.8, 12),
    "q0": (0, 4.2, 12),
    "D_x": (2, 3.45, 12),
    "D_y": (3, 3.45, 12),
    "D_z": (5, 2.65, 11),
    "theta": (0, 5.8, 12),
    "alpha": (0, 2.6, -6),
    "crank": (4, 3.2, 12),
    "gamma": (RIGHT, 3.8, -4),
    "delta": (RIGHT, 3.8, -4),
    "rod": (20, -5.6, 12),
    "B_x": (2, 4.25, 12),
    "B_y": (3, 5.05, 13),
    "B_z": (4, 4.25, 12),
}


@each(RRS_BY_HAND)
@pytest.mark.parametrize("chain", [0, 1, 2])
def test_a_chain_of_the_plate_is_what_paper_and_pencil_say(changed, chain):
    value, *expected = RRS_BY_HAND[changed]
    model = new_model("plate_rrs", numbers_with(RRS, changed, value, f"chain{chain + 1}"))
    rows = turned_with_the_chain(model, value if changed == "q" else 0, chain)
    assert rows == pytest.approx(expected, abs=1e-12)
    assert {n[7:] for n in model.table.names if n.startswith("chain1")} == set(RRS)


# The upper arm (4) is upright, the forearm (3) level: elbow (0, 4), wrist (3, 4), crank end (-2, 0)
# and lever end (-2, 4) in the plane of the arm. The shoulder is at (1, 0, 2). It closes.
PALLETIZER = {
    **{"shoulder.x": 1, "shoulder.z": 2, "upper.length": 4, "crank.length": 2, "push.length": 4},
    **{"forearm.length": 3, "forearm.lever": 2, "level.base_x": -1, "level.rod1": 4},
    **{"level.arm": 1, "level.elbow_z": -1, "level.rod2": 3, "level.wrist_z": 1},
    **{"flange.x": 1, "tool.z": -1},
}
# Rows: wrist out of the plane, forearm, push rod, second level rod, and two tilts of the wrist.
INWARDS, LOWER = [0, -5 / 6, 1 / 18, -5 / 6, 0, 0], [0, 1 / 6, 13 / 18, 1 / 6, 0, 0]
ASIDE = [-1, 0, 0, 0, 0, 0]
PALLETIZER_BY_HAND = {
    "": (0, [0] * 6),
    "base.x": (1, INWARDS),  # the wrist at (2, 4)
    "base.y": (1, ASIDE),
    "base.alpha": (RIGHT, [6, 6, 6, 49 / 6, 0, 1]),  # the wrist at (3, -2)
    "base.beta": (
        RIGHT,
        [0, 44 / 6, 64 / 9, 64 / 6, 0, 0],
    ),  # at (-7, 2), and level rod 2 at (-8, 2)
    "waist.q0": (RIGHT, [-4, -8 / 6, 8 / 9, -8 / 6, -1, 0]),  # at (-1, 4)
    "shoulder.x": (2, INWARDS),
    "shoulder.y": (1, ASIDE),
    "shoulder.z": (3, LOWER),  # at (3, 3)
    "shoulder.tilt": (RIGHT, [4, 16 / 6, 32 / 9, 25 / 6, 0, 1]),  # at (3, 0)
    "crank.length": (1, [0, 0, 1 / 8, 0, 0, 0]),
    "crank.q0": (RIGHT, [0, 0, 3, 0, 0, 0]),  # the crank's end at (0, -2)
    "push.length": (2, [0, 0, 3, 0, 0, 0]),
    "forearm.length": (2, [0, 5 / 4, 1 / 8, 0, 0, 0]),
    "forearm.lever": (1, [0, 0, 1 / 8, 0, 0, 0]),
    "forearm.bend": (RIGHT, [0, 0, -1, 0, 0, 0]),  # the lever's end at (0, 2)
    "level.rod1": (26**0.5, [0, 0, 0, -4 / 6, 0, 0]),  # the lever points up, and its side to x
    "level.elbow_x": (1, [0, 0, 0, 7 / 6, 0, 0]),
    "level.elbow_z": (-2, [0, 0, 0, 1 / 6, 0, 0]),
    "level.rod2": (2, [0, 0, 0, 5 / 4, 0, 0]),
    "level.wrist_x": (1, [0, 0, 0, 7 / 6, 0, 0]),
    "level.wrist_z": (2, [0, 0, 0, 1 / 6, 0, 0]),
    "flange.alpha": (RIGHT, [0, 0, 0, 1 / 6, 0, 1]),
    "flange.beta": (RIGHT, [0, 8 / 6, 7 / 9, 4 / 6, 0, 0]),  # the wrist at (4, 3)
    "flange.q0": (RIGHT, [1, 7 / 6, 1 / 18, 7 / 6, -1, 0]),  # at (4, 4), 1 beside the plane
    "flange.x": (2, INWARDS),
    "tool.x": (1, INWARDS),
    "tool.y": (1, ASIDE),
    "tool.z": (0, LOWER),
}


@each(PALLETIZER_BY_HAND)
def test_the_linkage_of_the_palletizer_is_what_paper_and_pencil_say(changed):
    value, expected = PALLETIZER_BY_HAND[changed]
    numbers = {**PALLETIZER, **({changed: value} if changed else {})}
    model = new_model("palletizer", numbers)
    rows = phi(model, [0, RIGHT, 0, 0], [5, 0, 5], EYE)
    assert rows == pytest.approx(expected, abs=1e-12)


# ------------------------------------------------------------------------------ options

SIZED = {  # options, readings at home, position at home: all worked by hand
    "stewart_rss": (
        # Hubs on a circle of 0.1 m below the balls; the cranks, level, point 0.03 m aside.
        {
            "base": {"radius": 0.1, "angles": [0, 60, 120, 180, 240, 300]},
            "platform": {"radius": 0.1, "angles": [0, 60, 120, 180, 240, 300]},
            "crank": 0.03,
            "rod": 0.05,
        },
        [0.0] * 6,
        0.04,
    ),
    "hexaglide": (
        # Upright columns 0.03 m outside the balls: rods of 0.05 m rise 0.04 m from the carriages.
        {
            "base": {"radius": 0.13, "angles": [0, 60, 120, 180, 240, 300]},
            "platform": {"radius": 0.1, "angles": [0, 60, 120, 180, 240, 300]},
            "rails": [0, 0, 1],
            "rod": 0.05,
            "height": 0.3,
        },
        [0.26] * 6,
        0.3,
    ),
    "ankle_2rsu": ({"sole": 0.08, "motors": [0.3, 0.3]}, [0.0, 0.0], -0.08),
    "quattro": (
        # Level arms: the elbows are 0.3 + 0.4 - 0.1 = 0.6 m outside the rods' joints, 0.8 m above.
        {"base": 0.3, "arm": 0.4, "platform": 0.1, "rod": 1.0, "home": 0.0},
        [0.0] * 4,
        -0.8,
    ),
    "tripod_prs": ({"base": 0.16, "platform": 0.1, "rod": 0.1, "height": 0.2}, [0.28] * 3, 0.2),
    "plate_rrs": (
        # Upright cranks of 0.05 m, and rods that lean inwards by 0.06 m and rise 0.08 m.
        {"base": 0.16, "platform": 0.1, "crank": 0.05, "rod": 0.1, "home": RIGHT},
        [RIGHT] * 3,
        0.13,
    ),
    "palletizer": (
        # Upper arm upright, forearm level: 0.2 + 0.5 m, and the tool 0.1 m below the wrist.
        {
            **{"shoulder": 0.2, "height": 0.4, "upper": 0.4, "forearm": 0.5, "wrist": 0.0},
            **{"tool": 0.1, "home": [0.0, RIGHT, 0.0, 0.0]},
        },
        [0.0, RIGHT, 0.0, 0.0],
        0.7,
    ),
}


@pytest.mark.parametrize("name", SIZED)
def test_home_follows_from_the_size_that_the_options_state(name):
    options, joints, height = SIZED[name]
    model = new_model(load_mechanism(name, **options))
    home = model.mechanism.home
    assert home.joints == pytest.approx(joints, abs=1e-10)
    assert home.position[2] == pytest.approx(height, abs=1e-10)
    rows = phi(model, home.joints, home.position, quaternion_to_matrix(home.quaternion))
    assert rows == pytest.approx(0 * rows, abs=1e-10)


def test_the_tool_of_a_palletizer_follows_the_size_outwards():
    options = SIZED["palletizer"][0]
    home = load_mechanism("palletizer", **options).home
    assert home.position == pytest.approx((0.7, 0.0, 0.7), abs=1e-12)


def test_a_servo_stewart_with_rod_and_height_turns_its_cranks_to_home():
    options = {**SIZED["stewart_rss"][0], "height": 0.05}
    model = new_model(load_mechanism("stewart_rss", **options))
    # The ball is straight above the hub: 0.03^2 + 0.05^2 - 2 0.03 0.05 sin(q) = 0.05^2.
    assert model.mechanism.home.joints == pytest.approx([np.arcsin(0.3)] * 6, abs=1e-9)


def test_the_quattro_turns_its_tool_by_the_gear_times_the_bar():
    """Halves moved apart by equal arms turn the bar alike, whatever the gear."""
    turns = []
    for gear in (1.0, 2.0):
        model = new_model(load_mechanism("quattro", gear=gear))
        q = np.array(model.mechanism.home.joints) + [0.05, -0.05, 0.05, -0.05]
        R = Kinematics(model).direct(q).rotation
        turns.append(np.arctan2(R[1, 0], R[0, 0]))
    assert abs(turns[0]) > 0.05
    assert turns[1] == pytest.approx(2 * turns[0], rel=1e-9)


def test_raised_cranks_push_the_toes_down():
    """Cranks behind the ankle that rise pull the heel up: the x axis of the foot points down."""
    pose = Kinematics(new_model("ankle_2rsu")).direct(np.array([0.2, 0.2]))
    assert pose.rotation[2, 0] < -0.1
    assert abs(pose.rotation[2, 1]) < 0.02


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("stewart_rss", {"rod": 0.02}, "rod is 0.02 m: too short to reach from the level cranks"),
        ("stewart_rss", {"rod": 0.05, "height": 0.3}, "the rod of leg1 does not reach"),
        ("stewart_rss", {"crank": -1}, "crank is -1: expected one number, above 0"),
        ("stewart_rss", {"directions": [0, 90]}, "directions is .*expected 6 numbers"),
        ("stewart_rss", {"base": [[0, 0, 0]]}, r"base has the shape \(1, 3\)"),
        ("hexaglide", {"rails": [0, 0, 0]}, r"rails is \[0, 0, 0\]: expected one direction"),
        ("hexaglide", {"rod": 0.1}, "rod is 0.1 m: the rod of leg2 does not reach from its rail"),
        ("ankle_2rsu", {"motors": [0.2]}, r"motors is \[0.2\]: expected 2 numbers"),
        ("ankle_2rsu", {"motors": [0.2, -0.2]}, "expected two heights above 0 m"),
        ("ankle_2rsu", {"first": "yaw"}, "first is 'yaw', expected pitch or roll"),
        ("quattro", {"rod": 0.3}, "rod is 0.3 m: too short for the elbows at home"),
        ("quattro", {"gear": 0}, "gear is 0: expected one number, above 0"),
        ("tripod_prs", {"base": 0.4}, "rod is 0.2 m: too short to reach from the rails"),
        ("plate_rrs", {"rod": 0.01}, "rod is 0.01 m: too short for hinges"),
        ("palletizer", {"flange": "yes"}, "flange is 'yes', expected true or false"),
        ("palletizer", {"upper": "long"}, "upper is 'long': expected one number, above 0"),
    ],
)
def test_a_size_that_cannot_be_is_refused_with_the_value_and_what_was_expected(
    name, options, words
):
    with pytest.raises(ModelError, match=words):
        load_mechanism(name, **options)


# ------------------------------------------------------------------ a five-bar with a tool


def test_two_arms_on_one_axis_reach_where_their_directions_add():
    """Morgan's SCARA: arms of 150 and 140 mm, each at the angle of its own motor.

    The left crank is parallel to the forearm, but points backwards: its angle is 180 degrees more.
    With both arms along x and along y, the end is at (150, 140) mm.
    """
    sizes = {"base": 0, "crank": [0.03, 0.15], "rod": [0.15, 0.03], "carrier": "right"}
    arms = load_mechanism(
        "five_bar", **sizes, tool=[-0.17, 0.0], home=[1.5 * np.pi, 0.0], below=True
    )
    assert arms.fixed == ("left.crank",)
    kinematics = Kinematics(new_model(arms))
    angles = np.array([[1.5 * np.pi, 0.0], [1.5 * np.pi + 0.3, 0.2]])
    expected = 0.15 * np.column_stack([np.cos(angles[:, 1]), np.sin(angles[:, 1])])
    forearm = angles[:, 0] - np.pi
    expected += 0.14 * np.column_stack([np.cos(forearm), np.sin(forearm)])
    assert expected[0] == pytest.approx([0.15, 0.14])
    found = kinematics.direct(angles)
    np.testing.assert_allclose(found.position[:, :2], expected, atol=1e-12)
    back = kinematics.inverse(found.position, found.rotation)
    np.testing.assert_allclose(back.joints, angles, atol=1e-12)


@pytest.mark.parametrize("carrier", ["left", "right"])
def test_a_tool_is_beyond_the_hinge_along_its_rod_and_to_its_left(carrier):
    """Cranks and rods of 3-4-5 triangles: hinge at (0, 0.8), the left rod leads up and right."""
    sizes = {"base": 1.2, "crank": 0.4, "rod": np.hypot(0.6, 0.4), "home": [np.pi / 2, np.pi / 2]}
    bars = load_mechanism("five_bar", **sizes, tool=[np.hypot(0.6, 0.4), 0.0], carrier=carrier)
    side = 1 if carrier == "left" else -1
    np.testing.assert_allclose(bars.home.position, [side * 0.6, 1.2, 0], atol=1e-12)
    turned = load_mechanism("five_bar", **sizes, tool=[0.0, np.hypot(0.6, 0.4)], carrier=carrier)
    aside = [-0.4, 1.4, 0] if carrier == "left" else [-0.4, 0.2, 0]
    np.testing.assert_allclose(turned.home.position, aside, atol=1e-12)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tool": [0.1]}, r"tool is \[0.1\]: expected 2 numbers"),
        ({"tool": [0.1, 0], "carrier": "middle"}, "carrier is 'middle': expected left or right"),
        ({"crank": [0.1, 0.1, 0.1]}, r"crank is .*: expected one number, or two: \[left, right\]"),
        ({"crank": [0.1, -0.1]}, "crank is -0.1: expected one number, above 0"),
        ({"rod": [0.01, 0.02]}, "rod is 0.01 and 0.02 m: the rods do not meet at home"),
    ],
)
def test_sizes_of_a_five_bar_that_cannot_be_are_named(options, message):
    with pytest.raises(ModelError, match=message):
        load_mechanism("five_bar", **options)


def test_a_tool_beyond_the_rods_is_not_written_for_a_firmware_that_has_none(tmp_path):
    model = new_model(load_mechanism("five_bar", tool=[0.05, 0.0]))
    with pytest.raises(ModelError, match="beyond the point where the rods meet"):
        export(model, "rrf", tmp_path)


# ------------------------------------------------------------------ deltesian


def test_the_nozzle_of_a_deltesian_hangs_where_right_triangles_put_it():
    """Rails at -0.3 and 0.3 m and rods of 0.5 m: level carriages hold it 0.4 m below them.

    With the left carriage 0.1 m higher, each rod is the hypotenuse over half of sqrt(0.37) m.
    """
    model = new_model(load_mechanism("deltesian", width=0.3, rod=0.5))
    q = np.array([[0.6, 0.6, 0.07], [0.7, 0.6, -0.02]])
    middle, half = np.array([0.0, 0.65]), np.sqrt(0.37) / 2
    down = np.sqrt(0.25 - half**2) * np.array([-0.1, -0.6]) / np.sqrt(0.37)
    expected = [[0, 0.07, 0.2], [middle[0] + down[0], -0.02, middle[1] + down[1]]]
    found = Kinematics(model).direct(q)
    np.testing.assert_allclose(found.position, expected, atol=1e-12)
    back = Kinematics(model).inverse(found.position, found.rotation)
    np.testing.assert_allclose(back.joints, q, atol=1e-12)


def test_a_bed_whose_way_rises_lifts_the_plate_and_with_it_the_point():
    """A way that rises by 30 degrees: 0.1 m along it are 0.0866 m in y and 0.05 m in z."""
    model = new_model("deltesian", {"bed.lean": np.pi / 6, "bed.q0": 0.02})
    level = Kinematics(model).direct(np.array([0.25, 0.25, -0.02])).position
    moved = Kinematics(model).direct(np.array([0.25, 0.25, 0.08])).position
    np.testing.assert_allclose(moved - level, [0, 0.1 * np.sqrt(0.75), 0.05], atol=1e-12)


def test_rods_too_short_for_a_deltesian_are_refused():
    with pytest.raises(ModelError, match=r"rod is 0.1 m: too short for rails 0.15 m away"):
        load_mechanism("deltesian", rod=0.1)


# ------------------------------------------------------------------ struts to a point or to rings

# From (1, 2, 4) to the point (4, 5, 14) are (3, 3, 10), 118 = 10.86^2.
STRUT = {"C_x": 1, "C_y": 2, "C_z": 4, "L0": 10}
STRUT_BY_HAND = {
    "": (0, np.sqrt(118) - 10),
    "q": (3, np.sqrt(118) - 13),
    "L0": (12, np.sqrt(118) - 12),
    "C_x": (2, np.sqrt(113) - 10),
    "C_y": (3, np.sqrt(113) - 10),
    "C_z": (6, np.sqrt(82) - 10),
}
# Seen from a spindle turned by CYCLE at (4, 5, 14), its foot (-3, -3, -10) is at (-3, -10, -3):
# 10.44 from its axis. A ring of 2 at the height 1 is (8.44, 4) away.
OUT = np.sqrt(109)
RING = STRUT | {"B_r": 2, "B_z": 1}
RING_BY_HAND = {
    "": (0, np.hypot(OUT - 2, 4) - 10),
    "q": (3, np.hypot(OUT - 2, 4) - 13),
    "L0": (12, np.hypot(OUT - 2, 4) - 12),
    "B_r": (4, np.hypot(OUT - 4, 4) - 10),
    "B_z": (-3, OUT - 2 - 10),
    "C_x": (2, np.hypot(OUT - 2, 3) - 10),  # along z of the spindle
    "C_y": (3, np.hypot(np.hypot(2, 10) - 2, 4) - 10),
    "C_z": (6, np.hypot(np.hypot(3, 8) - 2, 4) - 10),
}


@pytest.mark.parametrize(
    ("name", "part", "changed"),
    [("tripod_struts", STRUT, c) for c in STRUT_BY_HAND]
    + [("pentapod", RING, c) for c in RING_BY_HAND],
)
@pytest.mark.parametrize("i", [0, 2])
def test_a_strut_is_what_paper_and_pencil_say(name, part, changed, i):
    value, expected = (STRUT_BY_HAND if part is STRUT else RING_BY_HAND)[changed]
    model = new_model(name, numbers_with(part, changed, value, f"leg{i + 1}"))
    q = np.full(len(model.joints), value if changed == "q" else 0)
    assert phi(model, q, POSITION, CYCLE)[i] == pytest.approx(expected, abs=1e-12)
    assert {n for n in model.table.names if n.startswith("leg1.")} == {f"leg1.{n}" for n in part}


def test_the_last_row_of_a_pentapod_says_how_far_its_spindle_turned_about_itself():
    """QUARTER turns x of the platform to y: by the whole characteristic length."""
    model = new_model("pentapod")
    q = np.zeros(5)
    assert phi(model, q, POSITION, QUARTER)[5] == pytest.approx(model.mechanism.length)
    assert phi(model, q, POSITION, EYE)[5] == 0


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("tripod_struts", {"base": [[0, 0, 0]]}, r"base is \[\[0, 0, 0\]\]: expected 3 points"),
        ("tripod_struts", {"home": [0.2, 0.12, 0.0]}, r"is in the plane of the base points"),
        ("tripod_struts", {"home": [0.2, 0.12]}, r"home is \[0.2, 0.12\]: expected a point"),
        ("tripod_struts", {"retracted": -1}, r"retracted is -1: expected one number, at least 0"),
        ("pentapod", {"radius": 0.6}, r"of leg5 is within the ring of 0.6 m at home"),
        (
            "pentapod",
            {"heights": [0.1]},
            r"heights is \[0.1\]: expected 5 numbers, one for each leg",
        ),
        ("pentapod", {"limits": [1, 0]}, r"limits is \[1, 0\]: expected two numbers in m"),
    ],
)
def test_struts_that_cannot_be_built_are_refused(name, options, message):
    with pytest.raises(ModelError, match=message):
        load_mechanism(name, **options)


def test_the_lever_of_a_palletizers_forearm_may_be_longer_than_its_crank():
    """The upper arm (0.4) is upright, the crank (0.3) points to (-0.3, 0). A push rod (0.4) from
    there to (-0.412, 0.384) turns the lever, which ends (0.412, 0.016) from the elbow (0, 0.4)."""
    lever = np.hypot(0.412, 0.016)
    arm = load_mechanism(
        "palletizer",
        **{"shoulder": 0, "height": 0, "upper": 0.4, "forearm": 0.5, "crank": [0.3, lever]},
        **{"wrist": 0, "tool": 0, "home": [0, RIGHT, 0, 0]},
    )
    wrist = np.array([0, 0.4]) + 0.5 * np.array([0.412, 0.016]) / lever
    np.testing.assert_allclose(arm.home.position, [wrist[0], 0, wrist[1]], atol=1e-12)
    found = Kinematics(new_model(arm)).direct([[0, RIGHT, 0, 0]])
    np.testing.assert_allclose(found.position, [[wrist[0], 0, wrist[1]]], atol=1e-9)


@pytest.mark.parametrize(
    ("crank", "words"),
    [
        ([0.1, 0.9], "crank is 0.1 and 0.9 m: the push rod of 0.45 m does not reach the"),
        ([0.1, -0.1], "forearm lever \\(crank\\) is -0.1: expected one number, above 0"),
        ([0.1, 0.1, 0.1], "crank is .*: expected one number, above 0"),
    ],
)
def test_a_crank_that_cannot_be_is_named(crank, words):
    with pytest.raises(ModelError, match=words):
        load_mechanism("palletizer", crank=crank)
