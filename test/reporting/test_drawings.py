"""Each mechanism draws itself: its lines are where its closure says, its parameters are named."""

import re
from importlib.util import module_from_spec, spec_from_file_location
from itertools import pairwise
from pathlib import Path

import chains
import numpy as np
import plotly.graph_objects as go
import pytest

from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.mechanism import poses_in_workspace
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import list_plugins, load_mechanism
from parallel_cal.reporting import drawings

DOCS = Path(__file__).parents[2] / "docs"
LINKS = [{"joint": "R", "axes": "parallel", "a": 0.3}, {"joint": "R", "a": 0.2}]
NAMES = list_plugins("mechanisms")


def model_of(name):
    options = {"serial": {"links": LINKS}, "chain": chains.ankle()}.get(name)
    return new_model(load_mechanism(name, **options) if options else name)


def off_nominal(model, seed=0):
    """A robot of its own, each parameter half a tolerance off."""
    way = np.random.default_rng(seed).choice([-0.5, 0.5], len(model.values))
    return model.with_values(model.values + np.where(model.fixed, 0, way) * model.table.tolerance)


def drawn_at_a_solved_pose(name):
    """(lines, values by name, joints by name, position) somewhere in the workspace."""
    model = off_nominal(model_of(name))
    k = Kinematics(model)
    q = k.inverse(*poses_in_workspace(model.mechanism, 5, np.random.default_rng(1))).joints
    found = k.direct(q)
    assert found.solved.any()
    x = found.configuration.rows[np.flatnonzero(found.solved)[0]]
    n = len(model.joints)
    return (
        drawings.lines(model, x),
        dict(zip(model.table.names, model.values, strict=True)),
        x[:n],
        x[n : n + 3],
    )


def lengths(lines, kind):
    ends = (line.points for line in lines if line.kind == kind)
    return np.array([np.linalg.norm(p[-1] - p[0]) for p in ends])


def rods_of_pairs(v):
    return [
        v[f"chain{i}.Lb"] + side * v.get(f"chain{i}.dLb", 0.0)
        for i in (1, 2, 3)
        for side in (1, -1)
    ]


@pytest.mark.parametrize(
    ("name", "kind", "expected"),
    [
        ("delta54", "rod", lambda v, q: rods_of_pairs(v)),
        ("linear_delta", "rod", lambda v, q: rods_of_pairs(v)),
        ("delta51", "rod", lambda v, q: [v[f"rod{i}{j}.l"] for i in (1, 2, 3) for j in (1, 2)]),
        ("delta24", "rod", lambda v, q: [v[f"chain{i}.Lb"] for i in (1, 2, 3)]),
        (
            "delta24",
            "driven",
            lambda v, q: [np.hypot(v[f"chain{i}.La_x"], v[f"chain{i}.La_y"]) for i in (1, 2, 3)],
        ),
        ("delta_nominal", "rod", lambda v, q: [v["Lb"]] * 3),
        ("delta_nominal", "driven", lambda v, q: [v["La"]] * 3),
        ("stewart42", "driven", lambda v, q: [q[i] + v[f"leg{i + 1}.L0"] for i in range(6)]),
        ("planar_stewart", "driven", lambda v, q: [q[i] + v[f"leg{i + 1}.L0"] for i in range(3)]),
        ("slider_crank", "driven", lambda v, q: [v["a"]]),
        ("slider_crank", "rod", lambda v, q: [v["b"]]),
        ("rssr", "rod", lambda v, q: [v["L"]]),
        ("rssr", "driven", lambda v, q: [v["input.r"]]),
        ("rssr", "platform", lambda v, q: [v["output.r"]]),
        ("parallelogram", "driven", lambda v, q: [v["l1"]]),
        ("parallelogram", "rod", lambda v, q: [v["l2"]]),
        ("parallelogram_simple", "driven", lambda v, q: [v["l"]]),
        ("argos27", "rod", lambda v, q: [v[f"chain{i}.R"] for i in (1, 2, 3)]),
        ("argos9", "rod", lambda v, q: [0.11] * 3),
        ("argos_nominal", "rod", lambda v, q: [0.11] * 3),
    ],
)
def test_a_rod_is_as_long_as_its_parameter_says_at_a_solved_pose(name, kind, expected):
    lines, values, q, _ = drawn_at_a_solved_pose(name)
    assert lengths(lines, kind) == pytest.approx(expected(values, q), abs=1e-8)


def test_lines_of_the_cable_robot_are_as_long_as_at_the_origin_plus_what_was_let_out():
    lines, v, q, r = drawn_at_a_solved_pose("cable")
    radius = [v["spool1.R"]] * 3 + [v["spool2.R"]]
    for i, line in enumerate(lines):
        anchor = np.array([v[f"line{i + 1}.A_{axis}"] for axis in "xyz"])
        np.testing.assert_allclose(line.points, [r, anchor], atol=1e-9)
    # More lines than freedoms: three that say where it is, the fourth that fits nearly.
    let_out = [
        q[i] * radius[i] / (v[f"line{i + 1}.gear"] * v[f"line{i + 1}.advantage"])
        + v[f"line{i + 1}.offset"]
        for i in range(4)
    ]
    at_origin = [np.linalg.norm(line.points[1]) for line in lines]
    assert lengths(lines, "rod") == pytest.approx(np.add(at_origin, let_out), abs=1e-2)


@pytest.mark.parametrize("name", ["scara16", "serial"])
def test_a_serial_arm_is_drawn_from_its_base_to_its_tool(name):
    lines, _, _, r = drawn_at_a_solved_pose(name)
    links = [line.points for line in lines if line.kind != "axis"]
    np.testing.assert_allclose(links[0][0], 0.0)
    np.testing.assert_allclose(links[-1][-1], r, atol=1e-9)
    for one, after in pairwise(links):
        np.testing.assert_allclose(one[-1], after[0])


@pytest.mark.parametrize("name", NAMES)
def test_every_mechanism_draws_itself_and_shows_parameters(name):
    model = model_of(name)
    drawn = drawings.drawing(model)
    go.Figure(drawn)
    parts = drawings.lines(model)
    assert {part.kind for part in parts} <= set(drawings.COLOURS)
    shown = {name for part in parts for name in part.parameters}
    free = {n for n, fixed in zip(model.table.names, model.fixed, strict=True) if not fixed}
    # What a line cannot show: nothing but radii of spools and places along a circle's axis.
    hidden = {n for n in free - shown if not n.startswith("spool")}
    assert hidden <= {n for n in free if n.rpartition(".")[2] in {"dA", "dC", "beta"}}
    labels = next(t["text"] for t in drawn["data"] if t["name"] == "parameters")
    assert labels
    assert len(labels) == len(set(labels))


def label_boxes(drawn, width=700, height=460):
    """The boxes (n, 4) [px] of the labels as Plotly's camera shows them at first."""
    words = next(t for t in drawn["data"] if t["name"] == "parameters")
    scene = drawn["layout"]["scene"]
    low, high = np.array([scene[f"{axis}axis"]["range"] for axis in "xyz"]).T
    at = (np.array([words[axis] for axis in "xyz"]).T - (low + high) / 2) / (high - low)
    given = {"center": (0, 0, 0), "up": (0, 0, 1)} | {
        name: tuple(value.values()) for name, value in scene["camera"].items()
    }
    eye = np.array(given["eye"])
    back = eye - given["center"]
    back /= np.linalg.norm(back)
    right = np.cross(given["up"], back)
    right /= np.linalg.norm(right)
    up = np.cross(back, right)
    boxes = []
    for point, text, place in zip(at - eye, words["text"], words["textposition"], strict=True):
        scale = height / 2 / np.tan(np.radians(22.5)) / -(point @ back)
        x, y = width / 2 + scale * (point @ right), height / 2 - scale * (point @ up)
        long, high = 6 * len(text), 13  # of text of 11 px
        vertical, horizontal = place.split()
        x -= {"left": long, "center": long / 2, "right": 0}[horizontal]
        y -= {"top": high, "middle": high / 2, "bottom": 0}[vertical]
        boxes.append((x, y, x + long, y + high))
    return np.array(boxes)


@pytest.mark.parametrize("name", NAMES)
def test_no_label_of_a_drawing_covers_another(name):
    boxes = label_boxes(drawings.drawing(model_of(name)))
    for i, a in enumerate(boxes):
        for b in boxes[:i]:
            shared = np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2])
            assert shared.min() <= 0


def test_a_mechanism_without_lines_has_no_drawing(monkeypatch):
    model = new_model("slider_crank")
    monkeypatch.setattr(type(model.mechanism), "drawing", lambda *_: [])
    assert drawings.drawing(model) is None


def test_a_row_whose_parameters_moved_far_is_marked_and_explained_under_the_pointer():
    from parallel_cal.reporting.contents import DescribedParameter

    model = new_model("delta24")
    moved = DescribedParameter(
        value=0.246,
        sigma=2e-5,
        nominal=0.24,
        moved_tolerances=12.0,
        unit="m",
        fixed=False,
        shown_name="chain1.Lb",
        words="rod length of chain 1",
        sigma_tolerances=0.04,
    )
    drawn = drawings.drawing(model, None, {"chain1.Lb": moved})
    far = [t for t in drawn["data"] if "moved over 5 tolerances" in t["name"]]
    assert [t["name"] for t in far] == ["rod, moved over 5 tolerances"]
    assert far[0]["text"][0].startswith("rod length of chain 1: 246.000 ± 0.020 mm")


def docs_tool(name):
    spec = spec_from_file_location(f"docs_{name}", DOCS / f"{name}.py")
    tool = module_from_spec(spec)
    spec.loader.exec_module(tool)
    return tool


def test_the_page_of_mechanisms_shows_every_one_as_it_draws_itself_today():
    tool = docs_tool("mechanisms")
    assert (DOCS / "mechanisms.md").read_text(encoding="utf-8") == tool.page()
    for name in NAMES:
        kept = (DOCS / "mechanisms" / f"{name}.svg").read_text(encoding="utf-8")
        drawn = tool.picture(new_model(load_mechanism(name, **tool.OPTIONS.get(name, {}))))
        assert re.findall(r">([^<]+)</text>", kept) == re.findall(r">([^<]+)</text>", drawn)
        numbers = [
            np.array(
                re.findall(r"[\d.]+", " ".join(re.findall(r'points="([^"]+)"', svg))), dtype=float
            )
            for svg in (kept, drawn)
        ]
        np.testing.assert_allclose(*numbers, atol=0.3)
