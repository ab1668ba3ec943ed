"""Cable robots as their makers draw them: the origin at a motor, two lines from one pulley, a wall
drawn in x and y."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from parallel_cal.base.errors import ModelError
from parallel_cal.exporting.export import export
from parallel_cal.identification.fit import fit
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.file.modelfile import dump_model, parse_model
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_mechanism
from parallel_cal.recordings.dataset import Dataset

# Three lines of a wall 1.2 m wide and 1.9 m high. Each runs from a corner to a pulley on the
# platform and on to another corner, once or twice. Two start at the corner on the top left.
SHARED = {
    "anchors": [[0, 1.9], [0, 1.9], [1.2, 1.9]],
    "second_anchors": [[1.2, 1.9], [0, 0], [1.2, 0]],
    "second_strands": [1, 2, 2],
}


def size(*vector):
    return np.linalg.norm(vector)


def test_two_lines_from_one_pulley_have_the_lengths_of_paper_and_pencil():
    model = new_model(load_mechanism("cable", zero="anchors", **SHARED))
    x, y = 0.5, 0.7
    expected = [
        size(x, y - 1.9) + size(x - 1.2, y - 1.9),
        size(x, y - 1.9) + 2 * size(x, y),
        size(x - 1.2, y - 1.9) + 2 * size(x - 1.2, y),
    ]
    found = Kinematics(model).inverse(np.array([x, y, 0.0]))
    np.testing.assert_allclose(found.joints, expected, atol=1e-12)
    back = Kinematics(model).direct(np.array(expected))
    np.testing.assert_allclose(back.position, [x, y, 0.0], atol=1e-9)


def test_a_robot_with_two_lines_from_one_pulley_is_identified():
    """Corners 10 mm off, lengths and positions within 0.1 mm: the error returns to the noise."""
    rng = np.random.default_rng(3)
    model = new_model(load_mechanism("cable", zero="anchors", **SHARED))
    A, E = (np.array(SHARED[k], float) for k in ("anchors", "second_anchors"))
    A, E = A + rng.normal(0, 0.01, A.shape), E + rng.normal(0, 0.01, E.shape)
    P = rng.uniform((0.2, 0.3), (1.0, 1.6), (60, 2))

    def away(points):
        return np.linalg.norm(P[:, None] - points, axis=2)

    q = away(A) + away(E) * SHARED["second_strands"] + rng.normal(0, 1e-4, (60, 3))
    r = np.hstack([P + rng.normal(0, 1e-4, P.shape), np.zeros((60, 1))])
    found = fit(model, Dataset.from_arrays(model.joints, q, r))
    assert found.before.summary.position_rms > 3e-3
    assert found.held_out.summary.position_rms < 2.5e-4


@pytest.mark.parametrize(
    ("anchors", "home"),
    [
        ([[0, 0], [2.9, 0]], (1.45, -1.45, 0)),  # two motors on a bar, below it the pen
        ([[0, 0], [3, 0], [3, 2], [0, 2]], (1.5, 1.0, 0)),
        ([[0, 0, 0], [3, 0, 0], [3, 2, 0], [0, 0, 2]], (1.5, 0.5, 0.5)),
        ([[1, 1], [1, 1], [-1, 1]], (0, 0, 0)),  # a doubled line
    ],
)
def test_an_anchor_may_be_at_the_origin_or_at_the_place_of_another(anchors, home):
    """Readings are lengths from the anchors, or zero at home: both give the place that they had."""
    moved = len(anchors[0])
    place = np.array([0.15, -0.1, 0.05]) * ([1, 1, 1] if moved == 3 else [1, 1, 0]) + home
    lengths = np.array([size(*(place[:moved] - a)) for a in np.array(anchors, float)])
    at_home = np.array([size(*(np.array(home)[:moved] - a)) for a in np.array(anchors, float)])
    for zero, expected in (("anchors", lengths), ("origin", lengths - at_home)):
        mechanism = load_mechanism("cable", anchors=anchors, zero=zero)
        model = parse_model(dump_model(new_model(mechanism)))
        assert model.mechanism.home.position == pytest.approx(home)
        solver = Kinematics(model)
        np.testing.assert_allclose(solver.inverse(place).joints, expected, atol=1e-12)
        np.testing.assert_allclose(solver.direct(expected).position, place, atol=1e-9)
        assert bool(mechanism.remarks) == any(home)
        assert ("readings are taken as zero there" in str(mechanism.remarks)) == (
            any(home) and zero == "origin"
        )


def test_a_stated_home_is_where_readings_are_zero():
    model = new_model(load_mechanism("cable", anchors=[[0, 0], [2.9, 0]], home=[1.0, 1.0]))
    found = Kinematics(model).inverse(np.array([[1.0, 1.0, 0.0], [1.0, 2.0, 0.0]]))
    expected = [[0, 0], [size(1, 2) - size(1, 1), size(1.9, 2) - size(1.9, 1)]]
    np.testing.assert_allclose(found.joints, expected, atol=1e-12)
    assert not model.mechanism.remarks


def test_the_page_on_belts_states_the_sign_of_an_offset():
    """A line of 1.7651 m that reads 0.1391 m less, as on the page, has a positive offset."""
    page = (Path(__file__).parents[2] / "docs" / "belts.md").read_text(encoding="utf-8")
    stated = re.search(r"is (\S+) m long and reads\s+(\S+) m has the offset (\S+) m", page)
    length, reading, offset = map(float, stated.groups())
    anchors = np.array([[-1.4478, 1.0096], [1.4478, 1.0096]])
    model = new_model(load_mechanism("cable", anchors=anchors.tolist(), zero="anchors"))
    model = new_model(model.mechanism, {"line1.offset": offset, "line2.offset": offset})
    assert size(*anchors[0]) == pytest.approx(length, abs=5e-5)
    found = Kinematics(model).inverse(np.zeros(3))
    np.testing.assert_allclose(found.joints, [reading, reading], atol=1e-4)


def test_new_says_which_home_it_assumed(run_cli, tmp_path):
    at = ["--option", "anchors=[[0, 0], [2.9, 0]]", "-o", str(tmp_path / "m.yaml")]
    said = run_cli("new", "cable", *at, "--json")
    assert "home is [1.45, -1.45, 0.0] m" in json.loads(said)["remarks"][0]


@pytest.mark.parametrize(
    ("anchors", "gravity"),
    [
        ([[-1.4, 1.0], [1.4, 1.0]], (0.0, -9.81, 0.0)),
        ([[-1.4, -1.0], [1.4, -1.0]], (0.0, 9.81, 0.0)),  # y points down, as in an image
        ([[-1.4, 0, 1.0], [1.4, 0, 1.0]], (0.0, 0.0, -9.81)),
        ([[-1.4, 1.0], [1.4, 1.0], [1.4, -1.0]], (0.0, 0.0, -9.81)),  # it may lie on a table
    ],
)
def test_a_point_on_two_lines_hangs_in_the_plane_of_its_anchors(anchors, gravity):
    assert load_mechanism("cable", anchors=anchors).gravity == gravity


@pytest.mark.parametrize("effect", ["line_sag", "line_flex", "line_stretch"])
def test_lines_give_way_to_weight_alike_in_a_plane_drawn_in_x_y_and_in_x_z(effect):
    flat = [[-1.45, 1.0], [1.45, 1.1]]
    upright = [[x, 0, z] for x, z in flat]
    sizes = {"line_sag.sag": 7e-4, "line_flex.load": 1e-3, "line_stretch.mass.platform": 5.0}
    joints = []
    for anchors, axes in ((flat, (0, 1)), (upright, (0, 2))):
        model = new_model(load_mechanism("cable", anchors=anchors), effects=[effect])
        values = model.values.copy()
        for i, name in enumerate(model.table.names):
            if name.startswith(effect):
                values[i] = sizes.get(name, model.table.nominal[i] or model.table.tolerance[i])
        place = np.zeros((3, 3))
        place[:, axes] = [[0.3, 0.2], [-0.6, 0.4], [0.1, -0.5]]
        joints.append(Kinematics(model.with_values(values)).inverse(place).joints)
        straight = Kinematics(new_model(load_mechanism("cable", anchors=anchors))).inverse(place)
        assert np.abs(joints[-1] - straight.joints).max() > 1e-5
    np.testing.assert_allclose(*joints, atol=1e-12)


def test_a_firmware_that_counts_from_the_origin_is_not_written_for_another_home(tmp_path):
    anchors = [[0, 0, 0], [3, 0, 0], [3, 2, 0], [0, 0, 2]]
    model = new_model(load_mechanism("cable", anchors=anchors, spools=[1, 2, 3, 4]))
    with pytest.raises(ModelError, match="expected from the origin: state the anchors relative"):
        export(model, "rrf", tmp_path)
