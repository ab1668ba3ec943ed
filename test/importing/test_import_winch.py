"""Klipper's cable winches become a cable robot, which is written back; or one clear line."""

import numpy as np
import pytest

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.exporting.export import export, export_into
from parallel_cal.importing.controller_files import configured
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.drive import Drive
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_effect, load_mechanism

MM = 1e-3
# Anchors of Klipper's config/example-winch.cfg (84104bbbd), mm.
ANCHORS = ((0, -2000, -100), (2000, 1000, -100), (-2000, 1000, -100), (0, 0, 3000))
# Points in mm, and the lengths in mm that klippy/chelper/kin_winch.c computes there: by hand,
# sqrt(2000^2 + 100^2), and so on.
AT = ((0, 0, 0), (100, 50, 300))
LENGTHS = (
    (np.sqrt(4.01e6), np.sqrt(5.01e6), np.sqrt(5.01e6), 3000),
    (np.sqrt(4372500), np.sqrt(4672500), np.sqrt(5472500), np.sqrt(7302500)),
)


def printer(anchors=ANCHORS, more=""):
    sections = "".join(
        f"[stepper_{letter}]\nmicrosteps: 16\nrotation_distance: 40\n"
        + "".join(f"anchor_{a}: {v}\n" for a, v in zip("xyz", anchor, strict=True))
        for letter, anchor in zip("abcdefgh", anchors, strict=False)
    )
    return f"[printer]\nkinematics: winch\nmax_velocity: 300\n{sections}{more}"


def written(folder, text):
    (folder / "printer.cfg").write_text(text)
    return folder / "printer.cfg"


def test_lines_are_as_long_as_klipper_computes(tmp_path):
    found = configured([written(tmp_path, printer())])
    r, q = np.array(AT) * MM, np.array(LENGTHS) * MM
    kinematics = Kinematics(found.model)
    np.testing.assert_allclose(kinematics.inverse(r).joints, q, atol=1e-12)
    np.testing.assert_allclose(kinematics.direct(q).position, r, atol=1e-12)
    assert found.model.machine_class == "hobby"


def test_anchors_from_which_klipper_computes_the_mirror_image_are_named(tmp_path):
    """For its own example, trilateration (klippy/mathutil.py, run) returned (0, 0, -200) mm at the
    origin, and (100, 50, -500) at (100, 50, 300); with b and c exchanged, the points themselves."""
    assert any("200 mm away" in r for r in configured([written(tmp_path, printer())]).remarks)
    a, b, c, d = ANCHORS
    exchanged = configured([written(tmp_path, printer((a, c, b, d)))])
    assert not any("mirror" in remark for remark in exchanged.remarks)


def test_moved_anchors_and_offsets_go_back_into_the_file(tmp_path):
    """After it, a robot that starts at the origin moves as the model says."""
    path = written(tmp_path, printer())
    model = configured([path]).model
    rng = np.random.default_rng(2)
    values = model.values + 0.01 * rng.standard_normal(len(model.values)) * ~model.fixed
    moved = model.with_values(values)
    done = export_into(moved, "klipper", [path])
    assert done.loss["position_max"] < 1e-8
    assert done.before["position_max"] > 1e-3
    assert f"anchor_x: {moved.value('line2.A_x') / MM:.6f}".rstrip("0") in path.read_text()
    start = Kinematics(moved).inverse(np.zeros((1, 3))).joints[0] / MM
    assert any(f"the steppers are at {start[0]:.3f}, " in remark for remark in done.remarks)
    again = path.read_text()
    assert export_into(moved, "klipper", [path]).before["position_max"] < 1e-8
    assert path.read_text() == again


def test_a_new_file_has_one_section_a_line(tmp_path):
    anchors = [[1, 1, 2], [-1, 1, 2], [0, -1.4, 2.1], [1.1, -1, 0.1], [-1, -1, 0]]
    made = export(
        new_model(load_mechanism("cable", anchors=anchors, zero="anchors")), "klipper", tmp_path
    )
    text = made.paths[0].read_text()
    assert [line for line in text.splitlines() if line.startswith("[stepper")] == [
        f"[stepper_{letter}]" for letter in "abcde"
    ]
    assert "anchor_y = -1400" in text


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "anchor_y: -2000",
            "anchor_y: 2O00",
            r"cfg:8: \[stepper_a\] anchor_y is '2O00', expected mm",
        ),
        ("anchor_z: 3000\n", "", r"no \[stepper_d\] anchor_z, expected mm"),
        (
            "kinematics: winch",
            "kinematics: wench",
            r"is 'wench', expected delta, rotary_delta, del",
        ),
    ],
)
def test_a_broken_file_is_named_with_line_and_key(old, new, message, tmp_path):
    with pytest.raises(ParallelCalError, match=message):
        configured([written(tmp_path, printer().replace(old, new, 1))])


def test_anchors_that_hold_no_point_are_named(tmp_path):
    line = printer(((0, 0, 0), (1000, 0, 0), (2000, 0, 0)))
    with pytest.raises(ParallelCalError, match=r"anchor_x is '0', expected other anchors: cable: "):
        configured([written(tmp_path, line)])


def test_winches_that_klipper_does_not_have_are_refused(tmp_path):
    for options in ({}, {"anchors": [[-1, 2], [1, 2]], "zero": "anchors"}):
        model = new_model(load_mechanism("cable", **options))
        with pytest.raises(ParallelCalError, match=r"klipper: expected a cable robot in space who"):
            export(model, "klipper", tmp_path)


def test_a_winch_lets_out_its_rotation_distance_per_turn_of_the_spool(tmp_path):
    found = configured([written(tmp_path, printer(more="[stepper_a]\ngear_ratio: 5:1\n"))])
    first, *others = found.model.mechanism.drives
    assert first.spool.radius == pytest.approx(40 * MM / (2 * np.pi))
    assert first.spool.turn == pytest.approx(1 / first.spool.radius)  # out, as its line grows
    assert (first.kind, first.per_rev, first.gear) == ("spool", 8 * MM, 5.0)
    assert others == [Drive("spool", per_rev=40 * MM)] * 3
    assert not load_effect("spool_buildup").applies(found.model.mechanism)
