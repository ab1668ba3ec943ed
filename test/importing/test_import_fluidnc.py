"""FluidNC's YAML becomes a model, which is written back into it; or one clear line."""

import numpy as np
import pytest
import virtual_firmware as vf
from test_export_firmware import moved

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.exporting.export import export, export_into
from parallel_cal.identification.fit import fit
from parallel_cal.importing.controller_files import configured, samples
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.mechanism import poses_in_workspace
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_mechanism

MM, DEGREE = 1e-3, np.pi / 180
DELTA = """\
board: 6 Pack
kinematics:
  parallel_delta:   # mine
    crank_mm: 70.0
    base_triangle_mm: 179.437 # by the drawing
    linkage_mm: 133.50
    end_effector_triangle_mm: 86.603
    up_degrees: -20.0
axes:
  x:
    steps_per_mm: 800
  z:
    homing:
      cycle: 1
      mpos_mm: 40
"""
PLOTTER = """\
kinematics:
  WallPlotter:
    left_axis: 0
    left_anchor_x: -267.0
    left_anchor_y: 250.0  # 250
    right_axis: 1
    right_anchor_x: 270.0
    right_anchor_y: 252.0
    segment_length: 10
"""
MASLOW = """\
board: Maslow
Maslow_vertical: false
# Top left corner of frame
Maslow_tlX: -27.6
Maslow_tlY: 2064.9
Maslow_trX: 2924.3
Maslow_trY: 2066.5
Maslow_blX: 0
Maslow_blY: 0
Maslow_brX: 2953.2
Maslow_brY: 0
Maslow_tlZ: 100
kinematics:
  MaslowKinematics:
"""


def written(folder, text, name="config.yaml"):
    (folder / name).write_text(text)
    return folder / name


def test_a_delta_moves_as_the_firmware_computes(tmp_path):
    model = configured([written(tmp_path, DELTA)]).model
    firmware = vf.FluidNcDelta(DELTA)
    r, _ = poses_in_workspace(model.mechanism, 200, np.random.default_rng(0))
    motors = firmware.motors(r / MM)
    np.testing.assert_allclose(Kinematics(model).inverse(r).joints, -motors * DEGREE, atol=1e-9)
    np.testing.assert_allclose(firmware.forward(motors) * MM, r, atol=1e-9)
    top = Kinematics(model).direct(np.full((1, 3), 20 * DEGREE)).position[0]
    np.testing.assert_allclose(top, [0, 0, 40 * MM], atol=1e-9)  # homed: mpos_mm


def test_a_plotters_lines_are_those_of_pythagoras(tmp_path):
    """At (-27, 10) mm the left line is 240 mm long both across and up; at the origin longer."""
    found = configured([written(tmp_path, PLOTTER)])
    point = np.array([[-27.0, 10.0, 0.0]]) * MM
    lengths = [np.hypot(240, 240) - np.hypot(267, 250), np.hypot(297, 242) - np.hypot(270, 252)]
    model = found.model
    q = Kinematics(model).inverse(point).joints
    np.testing.assert_allclose(q[0], np.array(lengths) * MM, atol=1e-12)
    # Where the two circles cross below the anchors is the pen.
    anchors = np.array([[-267.0, 250.0], [270.0, 252.0]])
    radii = q / MM + np.linalg.norm(anchors, axis=1)
    pen = vf.crossed_circles(anchors, radii)
    np.testing.assert_allclose(pen, point[:, :2] / MM, atol=1e-9)
    np.testing.assert_allclose(Kinematics(model).direct(q).position, point, atol=1e-9)
    assert any("factor: -1" in remark for remark in found.remarks)


def maslow_belts(text, points):
    """Lengths (N, 4) mm of belt in the plane, with the diagonals' crossing by similar triangles."""
    k = {key.lower(): float(v) for key, v in (line.split(": ") for line in numbers(text))}
    tl, tr, bl, br = ([k[f"maslow_{c}{a}"] for a in "xy"] for c in ("tl", "tr", "bl", "br"))
    tl, tr, bl, br = (np.array(corner) for corner in (tl, tr, bl, br))
    left, right = (np.cross([*(c - bl), 0], [*(tr - bl), 0])[2] for c in (tl, br))
    centre = tl + (br - tl) * left / (left - right)
    offset = k.get("maslow_beltendextension", 30.0) + k.get("maslow_armlength", 123.4)
    return np.column_stack(
        [np.hypot(*(points + centre - corner).T) - offset for corner in (tl, tr, bl, br)]
    )


def numbers(text):
    pairs = (line.split(": ") for line in text.splitlines() if ": " in line)
    return [f"{key}: {v}" for key, v in pairs if v.strip("-").replace(".", "").isdigit()]


def test_a_maslow_measures_belts_to_the_crossing_of_its_diagonals(tmp_path):
    model = configured([written(tmp_path, MASLOW)]).model
    points = np.random.default_rng(0).uniform(-400, 400, (50, 2))
    belts = maslow_belts(MASLOW, points)
    r = np.column_stack([points, 0 * points[:, 0]]) * MM
    np.testing.assert_allclose(Kinematics(model).inverse(r).joints, belts * MM, atol=1e-9)
    np.testing.assert_allclose(Kinematics(model).direct(belts * MM).position, r, atol=1e-9)


def turned_out(model):
    """The machine as it turns out; all arms of a Delta are alike, as the firmware takes them."""
    if model.mechanism.name != "delta24":
        return moved(model)
    change = {"D_x": 0.2 * MM, "La_x": 0.5 * MM, "Lb": -0.7 * MM}
    values = model.values.copy()
    for name, by in change.items():
        for i in (1, 2, 3):
            values[model.table.index_of(f"chain{i}.{name}")] += by
    return model.with_values(values)


@pytest.mark.parametrize("text", [DELTA, PLOTTER, MASLOW])
def test_a_users_file_gets_the_numbers_and_keeps_the_rest(text, tmp_path):
    path = written(tmp_path, text)
    model = configured([path]).model
    same = export_into(model, "fluidnc", [path])
    assert same.loss["position_max"] < 0.3e-6
    changed = [line for line in text.splitlines() if line not in path.read_text().splitlines()]
    assert changed == []
    done = export_into(turned_out(model), "fluidnc", [path])
    assert done.loss["position_mean"] < 0.5 * done.before["position_mean"]
    kept = [line for line in text.splitlines() if line in path.read_text().splitlines()]
    assert "end_effector_triangle_mm: 86.603" in path.read_text() or text is not DELTA
    assert len(text.splitlines()) - len(kept) >= 3
    for comment in ("# mine", "# by the drawing", "# 250", "# Top left"):
        assert (comment in text) == (comment in path.read_text())
    again = configured([path]).model
    assert export_into(again, "fluidnc", [path]).before["position_max"] < 0.3e-6


def test_a_maslow_keeps_its_lower_edge_and_moves_as_its_model(tmp_path):
    path = written(tmp_path, MASLOW.replace("Maslow_tlZ: 100\n", "Maslow_armLength: 123\n"))
    model = moved(configured([path]).model)
    done = export_into(model, "fluidnc", [path])
    text = path.read_text()
    assert text.splitlines()[7:9] == ["Maslow_blX: 0", "Maslow_blY: 0"]
    assert "Maslow_brY: 0\n" in text or "Maslow_brY: 0.0000" in text
    # The frame of the firmware in {B}, as the remark tells it.
    line = next(each for each in done.remarks if each.startswith("frame of the firmware"))
    words = line.replace(",", "").split()
    origin = np.array([float(words[words.index("origin") + k]) for k in (2, 4)])
    axis = np.array([float(word) for word in words[words.index("x-axis") + 1 :][:2]])
    points = np.random.default_rng(1).uniform(-300, 300, (20, 2))
    inside = (points - origin) @ np.array([[axis[0], -axis[1]], [axis[1], axis[0]]])
    r = np.column_stack([points, 0 * points[:, 0]]) * MM
    found = Kinematics(model).direct(maslow_belts(text, inside) * MM).position
    assert np.abs(found - r).max() < done.loss["position_max"] + 5e-6


def test_what_was_exported_is_read_again(tmp_path):
    lines = load_mechanism("cable", anchors=[[0.3, 0.25], [-0.3, 0.2]])  # right and left
    robots = {"delta": new_model("delta_nominal"), "lines": new_model(lines)}
    for name, model in robots.items():
        done = export(model, "fluidnc", tmp_path / name)
        again = export(configured(done.paths).model, "fluidnc", tmp_path / f"{name}2")
        assert again.paths[0].read_text() == done.paths[0].read_text()
    assert any("right, but moves" in r or "reported positions are wrong" in r for r in done.remarks)


@pytest.mark.parametrize(
    ("text", "old", "new", "message"),
    [
        (DELTA, "crank_mm: 70.0", "", "no kinematics/parallel_delta/crank_mm, expected a length"),
        (DELTA, "133.50", "30", r":6: kinematics/.*/linkage_mm is '30', expected mm that reach"),
        (DELTA, "-20.0", "20", r":8: kinematics/.*/up_degrees is '20', expected degrees from -90"),
        (DELTA, "crank_mm: 70", "crank_mm: 49", "crank_mm is '49.0', .* in mm from 50 to 500"),
        (DELTA, "179.437", "600", "base_triangle_mm is '600', expected a length in mm from 20 to"),
        (DELTA, "up_degrees: -20", "homing_mpos_radians: 0", "radians is '0.0', .* FluidNC 4.0"),
        (DELTA, "board", "  \tboard", r"config.yaml:1: the indentation is '  \\tboard: 6 Pack'"),
        (PLOTTER, "-267", "300", "left_anchor_x is '300.0', expected mm, left of the right"),
        (DELTA, "parallel_delta", "ParallelDelta", "expected the section parallel_delta: the firm"),
        (PLOTTER, "WallPlotter", "CoreXY", "no /maslow_tlx, expected parallel_delta, WallPlotter"),
        (DELTA, "kinematics", "kin", "config.yaml: not a configuration that can be read"),
    ],
)
def test_settings_that_cannot_be_are_named(text, old, new, message, tmp_path):
    with pytest.raises(ParallelCalError, match=message):
        configured([written(tmp_path, text.replace(old, new))])


def delta_of(crank, across=40.0, effector=86.603):
    """A Delta in mm; the sides of its triangles differ by 2 sqrt(3) times `across`."""
    text = DELTA.replace("70.0", f"{crank}").replace("133.50", f"{2 * crank}")
    text = text.replace("86.603", f"{effector}")
    return text.replace("179.437", f"{effector + 2 * np.sqrt(3) * across:.4f}")


def test_a_crank_outside_of_the_firmwares_range_is_refused(tmp_path):
    path = written(tmp_path, delta_of(50.2))
    model = configured([path]).model
    values = model.values.copy()
    for i in (1, 2, 3):
        values[model.table.index_of(f"chain{i}.La_x")] -= 0.6 * MM
    before = path.read_text()
    expected = r"crank_mm would be 49.6\d*, expected 50 to 500.*; grblhal can"
    with pytest.raises(ParallelCalError, match=expected):
        export_into(model.with_values(values), "fluidnc", [path])
    assert path.read_text() == before


def test_a_base_outside_of_its_range_becomes_smaller_with_the_effector(tmp_path):
    """Both sides smaller by the same is the same machine: 480 = 500 - 20."""
    across = 480 / 2 / np.sqrt(3)
    model = configured([written(tmp_path, delta_of(150, across, 20))]).model
    done = export(model, "fluidnc", tmp_path / "new")
    assert done.loss["position_max"] < 0.3e-6
    text = done.paths[0].read_text()
    assert "base_triangle_mm: 500.0000" in text
    assert "end_effector_triangle_mm: 20.0000" in text


def test_an_unchanged_model_changes_nothing(tmp_path):
    """Also where the file leaves up_degrees to its default."""
    for text in (DELTA.replace("    up_degrees: -20.0\n", ""), PLOTTER, MASLOW):
        path = written(tmp_path, text)
        export_into(configured([path]).model, "fluidnc", [path])
        assert path.read_text() == text


def test_a_cable_robot_that_fluidnc_cannot_move_is_refused(tmp_path):
    with pytest.raises(ParallelCalError, match="expected a cable robot in x and y"):
        export(new_model("cable"), "fluidnc", tmp_path)
    three = load_mechanism("cable", anchors=[[0, 1], [1, -1], [-1, -1]])
    with pytest.raises(ParallelCalError, match=r"3 lines that count from .*expected two lines"):
        export(new_model(three), "fluidnc", tmp_path)


# ------------------------------------------------------------ the log of a Maslow's calibration

# Lengths of bl, br, tr and tl in mm that a page of Maslow's documents states as an example.
CLBM = (
    "[MSG:INFO: Measured waypoint 0]\n"
    "CLBM:[{bl:2960.58,   br:3150.08,   tr:3067.72,   tl:3049.85},]\n"
    "CLBM:[{bl:2960.58,   br:3150.08,   tr:3067.72,   tl:3049.85},"
    "{bl:3066.96,   br:3042.59,   tr:2957.53,   tl:3158.38},]\n"
)
ANCHORS = np.array([(-27.6, 2064.9), (2924.3, 2066.5), (0, 0), (2953.2, 0)])  # mm, of MASLOW


def maslow_files(folder, log=CLBM, setup=MASLOW):
    (folder / "serial.log").write_text(log)
    (folder / "maslow.yaml").write_text(setup)
    return [folder / "serial.log", folder / "maslow.yaml"]


def test_waypoints_are_lengths_of_belt_that_count_once(tmp_path):
    """A belt is measured 30 + 123.4 mm from the middle of the sled, to which the log's lengths
    lead."""
    data = samples("fluidnc", maslow_files(tmp_path))
    expected = np.array(
        [[3049.85, 3067.72, 2960.58, 3150.08], [3158.38, 2957.53, 3066.96, 3042.59]]
    )
    np.testing.assert_allclose(data.q, (expected - 153.4) * MM, atol=1e-12)
    assert data.joint_names == configured([tmp_path / "maslow.yaml"]).model.joints
    assert not data.measured.any()
    longer = MASLOW.replace("Maslow_tlZ: 100", "Maslow_beltEndExtension: 40")
    other = samples("fluidnc", maslow_files(tmp_path, setup=longer))
    np.testing.assert_allclose(other.q - data.q, -10 * MM, atol=1e-12)


def test_the_belts_alone_tell_how_far_the_anchors_are_apart(tmp_path):
    """Anchors up to 13 mm from the file, lengths from right triangles, rounded as in a log."""
    true = ANCHORS + [[6, -9], [-11, 7], [0, 0], [4, 0]]
    at = np.array([[x, y] for x in np.linspace(600, 2300, 5) for y in np.linspace(400, 1700, 5)])
    belts = np.hypot(*(at[:, None] - true).transpose(2, 0, 1))
    rows = "".join(f"{{bl:{c:.2f}, br:{d:.2f}, tr:{b:.2f}, tl:{a:.2f}}}," for a, b, c, d in belts)
    files = maslow_files(tmp_path, f"CLBM:[{rows}]\n")
    model = fit(configured(files[1:]).model, samples("fluidnc", files)).model
    found = np.array([[model.value(f"line{i}.A_{axis}") for axis in "xy"] for i in range(1, 5)])

    def compute_distances(points):
        return np.array([np.hypot(*(points[i] - points[j])) for i in range(4) for j in range(i)])

    assert np.abs(compute_distances(ANCHORS) - compute_distances(true)).max() > 15
    np.testing.assert_allclose(compute_distances(found / MM), compute_distances(true), atol=0.2)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("bl:2960.58", "bl:2960.5B", r"serial.log:2: bl is '2960.5B', expected a length in mm"),
        (
            "bl:2960.58",
            "b:2960.58",
            r"serial.log:2: a waypoint is 'b:2960.58, .* expected the four",
        ),
        ("CLBM", "CLB", r"serial.log: no waypoints, expected lines 'CLBM:\[\{bl:2960.58, br"),
    ],
)
def test_a_broken_log_is_named_with_line_and_belt(old, new, message, tmp_path):
    with pytest.raises(ParallelCalError, match=message):
        samples("fluidnc", maslow_files(tmp_path, CLBM.replace(old, new)))
