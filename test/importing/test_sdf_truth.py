"""What an SDF says where readers differ, with the values of libsdformat in Drake 1.51.1.

All values can be worked out by hand: joints move by 0.5 (m or rad), links stand at round numbers.
"""

import linkage_files as own
import numpy as np
import pytest

from parallel_cal.base.errors import DatasetError
from parallel_cal.base.rotation import rotation_matrix
from parallel_cal.exporting.export import export_into
from parallel_cal.importing.closed_chain import chain
from parallel_cal.importing.sdf import read_sdf
from parallel_cal.kinematics.kinematics import Kinematics

QUARTER = "1.5707963267948966"
X, Z = ("<axis><xyz>1 0 0</xyz></axis>", "<axis><xyz>0 0 1</xyz></axis>")
FIXED = '<joint name="w" type="fixed"><parent>world</parent><child>a</child></joint>'
TURNED = f"<pose>0 0 1 0 0 {QUARTER}</pose>"
EIGHTH = f"<pose>0.1 0 0 0 0 {float(QUARTER) / 2!r}</pose>"
ROOT = float(np.sqrt(0.5))
HALF = repr(ROOT)


def model(body, version="1.9", attributes=""):
    return f'<sdf version="{version}"><model name="m"{attributes}>{body}{FIXED}</model></sdf>'


def link(name, pose=""):
    return f'<link name="{name}">{pose}</link>'


def joint(axis, kind="prismatic", pose="", parent="a", name="j", child="b"):
    return (
        f'<joint name="{name}" type="{kind}"><parent>{parent}</parent><child>{child}</child>'
        f"{pose}{axis}</joint>"
    )


AT_1 = link("a", "<pose>1 0 0 0 0 0</pose>")
PLACED = f"<pose>0 0 5 0 0 0</pose>{AT_1}{link('b')}{joint(X)}"
IN_MODEL = "<axis><xyz>1 0 0</xyz><use_parent_model_frame>1</use_parent_model_frame></axis>"
STATED = '<axis><xyz expressed_in="__model__">1 0 0</xyz></axis>'
ON_FRAME = (
    f'<frame name="f" attached_to="a"><pose>0 0 0.5 0 0 {QUARTER}</pose></frame>{AT_1}'
    + link("b", '<pose relative_to="f">1 0 0 0 0 0</pose>')
    + joint('<axis><xyz expressed_in="f">1 0 0</xyz></axis>', parent="f")
)
ON_JOINT = (
    AT_1
    + link("b", '<pose relative_to="j">0 0 1 0 0 0</pose>')
    + joint(X, pose=f'<pose relative_to="a">0 2 0 0 0 {QUARTER}</pose>')
)


def turned(axis, version, pose=EIGHTH):
    return model(link("a") + link("b", TURNED) + joint(axis, pose=pose), version)


CASES = {  # the file, the place of link b
    "an axis is in the frame of its joint, which is that of the child": (
        turned(X, "1.7", pose=""),
        (0, 0.5, 1),
    ),
    "the joint turns the axis": (turned(X, "1.7"), (-ROOT / 2, ROOT / 2, 1)),
    "since 1.5": (turned(X, "1.5"), (-ROOT / 2, ROOT / 2, 1)),
    "until 1.4 an axis is in the frame of the model": (turned(X, "1.4"), (0.5, 0, 1)),
    "use_parent_model_frame": (turned(IN_MODEL, "1.6"), (0.5, 0, 1)),
    "expressed_in": (turned(STATED, "1.11"), (0.5, 0, 1)),
    "the length of an axis": (
        model(link("a") + link("b") + joint("<axis><xyz>0 0 2</xyz></axis>")),
        (0, 0, 0.5),
    ),
    "degrees": (
        model(link("a") + link("b", '<pose degrees="true">0 0 1 0 0 90</pose>') + joint(X)),
        (0, 0.5, 1),
    ),
    "quaternion": (
        model(
            link("a")
            + link(
                "b",
                f'<pose rotation_format="quat_xyzw">0 0 1 0 0 {HALF} {HALF}</pose>',
            )
            + joint(X)
        ),
        (0, 0.5, 1),
    ),
    "relative to a joint": (model(ON_JOINT), (1, 2.5, 1)),
    "attached to a frame": (model(ON_FRAME), (1, 1.5, 0.5)),
    "the pose of the model": (model(PLACED), (0.5, 0, 5)),
    "placement_frame": (model(PLACED, attributes=' placement_frame="a"'), (-0.5, 0, 5)),
    "continuous": (
        model(
            link("a")
            + link("b", "<pose>1 0 0 0 0 0</pose>")
            + joint(Z, "continuous", "<pose>-1 0 0 0 0 0</pose>")
        ),
        (np.cos(0.5), np.sin(0.5), 0),
    ),
}


def frame_of_b(path, values):
    """The frame (4, 4) of link b in the world if joint j stands at these values."""
    linkage = read_sdf(path)
    by_name = {one.name: one for one in linkage.joints}
    one, moved, back, there = by_name["j"], np.eye(4), np.eye(4), np.eye(4)
    if one.kind == "prismatic":
        moved[:3, 3] = one.axes[0] * values[0]
    else:
        for axis, value in zip(one.axes, values, strict=True):
            moved[:3, :3] = moved[:3, :3] @ rotation_matrix(axis * value)
    there[:3, 3], back[:3, 3] = one.anchor, -one.anchor
    return by_name["w"].origin @ one.origin @ there @ moved @ back


@pytest.mark.parametrize("case", CASES)
def test_a_link_of_an_sdf_is_where_libsdformat_has_it(tmp_path, case):
    text, place = CASES[case]
    path = tmp_path / "m.sdf"
    path.write_text(text)
    np.testing.assert_allclose(frame_of_b(path, [0.5])[:3, 3], place, atol=1e-12)


@pytest.mark.parametrize("kind", ["universal", "revolute2"])
def test_the_first_axis_of_a_universal_joint_of_an_sdf_is_that_of_the_parent(tmp_path, kind):
    """Drake refuses revolute2; the rotation of universal is Rz(0.5) Ry(0.25)."""
    path = tmp_path / "m.sdf"
    second = Z.replace("axis>", "axis2>").replace("0 0 1", "0 1 0")
    path.write_text(model(link("a") + link("b") + joint(Z + second, kind)))
    expected = rotation_matrix(np.array([0, 0, 0.5])) @ rotation_matrix(np.array([0, 0.25, 0]))
    np.testing.assert_allclose(frame_of_b(path, [0.5, 0.25])[:3, :3], expected, atol=1e-12)


def test_a_joint_of_an_sdf_that_follows_another_one_or_a_screw_is_refused(tmp_path):
    """Drake takes <mimic> for a constraint: its kinematics does not follow it."""
    mimic = Z.replace("</axis>", '<mimic joint="k"><multiplier>2</multiplier></mimic></axis>')
    other = link("c") + joint(Z, name="k", child="c")
    path = tmp_path / "m.sdf"
    for text, why in (
        (model(link("a") + link("b") + other + joint(mimic), "1.11"), "follows another joint"),
        (model(link("a") + link("b") + joint(Z, "screw")), "type is 'screw'"),
    ):
        path.write_text(text)
        with pytest.raises(DatasetError, match=why):
            chain([path], "world", "b")


def placed_by(frame):
    """The five-bar, placed in the world by one of its links."""
    pose = f"<pose>{-own.HALF!r} 0 0 0 0 {own.LEFT!r}</pose>"
    before = '<model name="five_bar">'
    return own.five_bar_sdf().replace(
        before, f'<model name="five_bar" placement_frame="{frame}">{pose}'
    )


@pytest.mark.wide
def test_a_model_that_a_link_places_stays_there_when_the_link_moves(tmp_path):
    path = tmp_path / "m.sdf"
    path.write_text(placed_by("left_crank"))
    found = chain([path], "world", "tip", ["left", "right"]).model
    angles = np.array([[0.1, -0.2], [-0.3, 0.2]])
    tips = [own.five_bar_tip(own.LEFT + a, own.RIGHT + b) for a, b in angles]
    np.testing.assert_allclose(Kinematics(found).direct(angles).position[:, :2], tips, atol=1e-12)
    rng = np.random.default_rng(4)
    step = np.where(found.fixed, 0.0, rng.normal(size=len(found.values)) * found.table.tolerance)
    better = found.with_values(found.values + step)
    export_into(better, "sdf", [path])
    again = chain([path], "world", "tip", ["left", "right"]).model
    one, other = (Kinematics(m).direct(angles).position for m in (better, again))
    assert np.abs(one[:, :2] - tips).max() > 1e-4
    np.testing.assert_allclose(other, one, atol=1e-11)


def test_a_frame_that_does_not_exist_places_no_model(tmp_path):
    path = tmp_path / "m.sdf"
    path.write_text(placed_by("left_cranc"))
    with pytest.raises(DatasetError, match="there is no frame 'left_cranc', expected one of left"):
        read_sdf(path)
