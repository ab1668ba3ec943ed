"""Properties that hold for any input, tried on random ones by hypothesis.

Readers and parsers answer or raise a ParallelCalError, never another exception. What is written is
read back. Rotations and slopes agree with an independent computation.
"""

import contextlib
import json
import re

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.base.files import json_lines
from parallel_cal.base.rotation import (
    matrix_to_quaternion,
    quaternion_to_matrix,
    rotation_matrix,
    rotation_vector,
)
from parallel_cal.cli.models import parse_options
from parallel_cal.cli.recordings import data_options
from parallel_cal.kinematics.answers import parse_conditions
from parallel_cal.model.effect import parse_effects
from parallel_cal.model.file.modelfile import dump_model, parse_model
from parallel_cal.model.file.yamltext import flow, parse_yaml
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import list_plugins
from parallel_cal.recordings.csv_import import import_csv
from parallel_cal.recordings.loading import load_dataset
from parallel_cal.recordings.options import ReadOptions
from parallel_cal.recordings.table import UNITS, split_unit

# `make wide` runs this file again, with more examples.
pytestmark = [pytest.mark.wide] if settings.default.max_examples >= 100 else []

TABLE = "x [mm],y,z,q1,q2,t,k\n1,2,3,.1,.2,0,a\n2,3,4,.2,.3,1,b\n3,4,5,.2,.3,2,b\n"
COLUMN_MAP = """joints:
  joint1: {column: q1, unit: deg}
  joint2: {column: q2, factor: 0.5, unit: rev, per_rev: 71.2 mm, offset: 3 mm}
position: {columns: [x, y, z], unit: mm}
noise: {joint: 1.0e-5, position: 1.0e-5}
conditions: {time: t, temperature: 20}
group: k
"""
CRANK = new_model("slider_crank", effects=["thermal_expansion"])
NASTY = (
    *("", ".nan", "inf", "1e400", "-1", "9" * 5000, "0x10", "1:30", "2001-99-99", "null", "[]"),
    *("{a: 1}", "!!python/object:os", "*a", "&a x", "<<", "'", '"', "- a", "\x00", "\x7f", "²"),
    *("\ud800", "\u2028", "--5", "1_000", "..", "os.path", "deg", "x" * 300),
)
words = st.one_of(st.sampled_from(NASTY), st.text(max_size=8), st.floats().map(repr))
proper_text = st.text(st.characters(exclude_categories=["Cs"]))


@st.composite
def damaged(draw, text):
    """Return the text with one to three lines lost, doubled, or with a word replaced."""
    lines = text.split("\n")
    for _ in range(draw(st.integers(1, 3))):
        i = draw(st.integers(0, len(lines) - 1))
        places = [m.span() for m in re.finditer(r"[-+.\w]+", lines[i])]
        kind = draw(st.sampled_from(["lost", "doubled", "replaced"]))
        if kind == "lost" and len(lines) > 1:
            del lines[i]
        elif kind == "doubled" or not places:
            lines.insert(i, lines[i])
        else:
            begin, end = draw(st.sampled_from(places))
            lines[i] = lines[i][:begin] + draw(words) + lines[i][end:]
    return "\n".join(lines)


def answers_or_refuses(function, *given):
    """Any other exception fails the test."""
    with contextlib.suppress(ParallelCalError):
        function(*given)


# ------------------------------------------------------------------------------------ files


@given(damaged(dump_model(new_model("delta24", effects=["backlash"]))))
def test_any_model_file_is_read_or_refused(text):
    answers_or_refuses(parse_model, text)


@given(st.one_of(words, damaged("a: 1\nb: [1, {c: d}]\ne: 'x'\nf:\n- 1\n- g: h")))
@example("\ud800")  # an argument of the command line that was not UTF-8
def test_any_yaml_is_read_or_refused(text):
    answers_or_refuses(parse_yaml, text, "text")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("properties")


@given(table=damaged(TABLE), columns=damaged(COLUMN_MAP))
@example(table=TABLE, columns="\udcff")  # not UTF-8
def test_any_table_and_any_column_map_are_read_or_refused(folder, table, columns):
    paths = folder / "table.csv", folder / "map.yaml"
    for table_text, map_text in ((table, COLUMN_MAP), (TABLE, columns)):
        for path, text in zip(paths, (table_text, map_text), strict=True):
            path.write_bytes(text.encode(errors="surrogatepass"))
        answers_or_refuses(import_csv, *paths)


LOG_ROWS = "\n".join(
    f"{k / 10},{k // 20},{k / 50 % 0.4},{k // 20 / 100},{k // 30},3" for k in range(120)
)
LOG = f"t,q1,q2,x [mm],y,z\n{LOG_ROWS}\n"
LOG_MAP = COLUMN_MAP.split("conditions:")[0] + "log: {time: t, unit: s, offset: 0.0}\n"


@given(table=damaged(LOG), columns=damaged(LOG_MAP))
@example(table=LOG.replace("\n0.1,", "\n1e300,"), columns=LOG_MAP)
def test_any_table_that_logs_a_robot_is_read_or_refused(folder, table, columns):
    paths = folder / "log.csv", folder / "log.yaml"
    for table_text, map_text in ((table, LOG_MAP), (LOG, columns)):
        for path, text in zip(paths, (table_text, map_text), strict=True):
            path.write_bytes(text.encode(errors="surrogatepass"))
        answers_or_refuses(import_csv, *paths, ReadOptions(mode="continuous"))


def test_the_undamaged_log_is_read(folder):
    paths = folder / "log.csv", folder / "log.yaml"
    for path, text in zip(paths, (LOG, LOG_MAP), strict=True):
        path.write_text(text)
    assert len(import_csv(*paths, ReadOptions(mode="continuous"))) > 100


@given(st.binary(max_size=200), st.sampled_from(["", "joint1_deg,x_mm,y_mm,z_mm\n1,2,3,4\n"]))
def test_any_bytes_are_read_as_a_table_or_refused(folder, content, before):
    path = folder / "bytes.csv"
    path.write_bytes(before.encode() + content)
    answers_or_refuses(lambda: load_dataset(path, joints=["joint1"]))


def test_the_undamaged_table_is_read(folder):
    paths = folder / "table.csv", folder / "map.yaml"
    for path, text in zip(paths, (TABLE, COLUMN_MAP), strict=True):
        path.write_text(text)
    assert len(import_csv(*paths)) == 3


@settings(max_examples=settings.default.max_examples // 2)
@given(st.data())
def test_any_sample_file_is_read_or_refused(folder, data):
    test_the_undamaged_table_is_read(folder)
    path = folder / "samples.json"
    import_csv(folder / "table.csv", folder / "map.yaml").to_json(path)
    text = data.draw(damaged(json.dumps(json.loads(path.read_text()), indent=0)))
    path.write_bytes(text.encode(errors="surrogatepass"))
    answers_or_refuses(load_dataset, path)


@given(words)
@example("[" * 100_000)
@example('{"a": ' + "9" * 5000 + "}")
def test_a_line_that_is_not_json_does_not_hide_the_next(folder, line):
    path = folder / "journal.jsonl"
    path.write_bytes(line.encode(errors="surrogatepass") + b'\n{"good": 1}\n')
    assert list(json_lines(path, 1 << 20))[-1] == {"good": 1}


# ------------------------------------------------------------------------------------ options

items = st.tuples(
    st.sampled_from(["backlash", "temperature", "mode", "exclude", "max_gap", "joint_states", ""]),
    st.sampled_from(["", ":", "=", ":a="]),
    words,
    st.sampled_from(["", ",b=1", ",", "+x:"]),
).map("".join)


@given(items)
@example("exclude=²")
def test_any_option_is_parsed_or_refused(text):
    answers_or_refuses(parse_effects, text)
    answers_or_refuses(data_options, [text])
    answers_or_refuses(parse_options, [text])
    answers_or_refuses(parse_conditions, CRANK, [text])


# ------------------------------------------------------------------------------------ round trips

scalars = st.one_of(
    st.none(),
    st.booleans(),
    st.floats(allow_nan=False, allow_infinity=False),
    st.integers(-(10**17) + 1, 10**17),
    proper_text,
)


@given(st.recursive(scalars, lambda inner: st.lists(inner, max_size=4), max_leaves=8))
@example("\x7f")
@example("a\u2028b")
def test_a_value_in_a_model_file_is_read_back(value):
    line = flow(value)
    assert "\n" not in line
    assert parse_yaml(f"key: {line}", "text").data == {"key": value}


@given(st.integers(-(10**18) + 1, 10**18 - 1))
@example(-(10**17))
def test_a_whole_number_has_18_digits_and_its_sign(number):
    assert parse_yaml(f"key: {number}", "text").data == {"key": number}


@given(proper_text)
@example("first\nsecond\u2028third")
def test_an_error_is_one_line_whatever_text_it_quotes(text):
    assert len(str(ParallelCalError(f"column {text} is missing")).splitlines()) == 1


def test_a_file_name_that_is_not_utf8_can_be_written():
    assert parse_yaml(f"key: {flow('a' + chr(0xDCFF))}", "text").data == {"key": "a\\udcff"}


@given(
    name=st.text(st.characters(categories=["Ll", "Lu", "Nd"]), min_size=1),
    unit=st.sampled_from(sorted(UNITS)),
    form=st.sampled_from(["{} [{}]", "{} ({})", "{}_{}", "{}/{}", "{} {}"]),
)
def test_a_unit_in_a_header_is_found(name, unit, form):
    assert split_unit(form.format(name, unit)) == (name, unit)


directions = arrays(float, 3, elements=st.floats(-1, 1)).filter(lambda v: np.linalg.norm(v) > 1e-3)
angles = st.one_of(
    st.floats(0, np.pi),
    st.floats(-17, 0).map(lambda k: 10**k),
    st.floats(-17, 0).map(lambda k: np.pi - 10**k),
)


@given(directions, angles)
def test_rotations_survive_vectors_and_quaternions_near_zero_and_near_pi(direction, angle):
    vector = angle * direction / np.linalg.norm(direction)
    R = rotation_matrix(vector)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(rotation_matrix(rotation_vector(R)), R, atol=1e-14)
    if angle < 3.14:  # at pi both directions are right
        np.testing.assert_allclose(
            rotation_vector(R), vector, rtol=1e-12, atol=1e-14 * angle + 1e-300
        )
    quaternion = matrix_to_quaternion(R)
    assert quaternion[3] >= 0
    np.testing.assert_allclose(matrix_to_quaternion(R[None])[0], quaternion, atol=1e-15)
    np.testing.assert_allclose(quaternion_to_matrix(quaternion), R, atol=1e-14)


@given(directions, st.floats(-300, 300))
@example(np.array([1.0, 2.0, 3.0]), -200.0)  # the squares of such numbers are zero
def test_a_quaternion_of_any_length_is_the_same_rotation(direction, power):
    quaternion = np.array([*direction, 1.0])
    R = quaternion_to_matrix(quaternion)
    np.testing.assert_allclose(quaternion_to_matrix(10.0**power * quaternion), R, atol=1e-14)


# ------------------------------------------------------------------------------------ slopes


@pytest.mark.parametrize(
    "name", [n for n in list_plugins("mechanisms") if n not in ("serial", "chain")]
)
@settings(max_examples=settings.default.max_examples // 8)
@given(st.integers(0, 2**32 - 1))
def test_slopes_of_a_closure_are_those_of_its_differences(name, seed):
    """Along a random direction, in units of the robot's size and of the tolerances."""
    model, rng = new_model(name), np.random.default_rng(seed)
    mechanism, home = model.mechanism, model.mechanism.home
    n, size = len(model.joints), mechanism.length
    turn = quaternion_to_matrix(home.quaternion)
    joint_size = size if mechanism.joint_unit == "m" else 1.0
    scale = np.r_[np.full(n, joint_size), np.full(3, size), np.ones(3)]
    begin, step = 0.1 * scale * rng.standard_normal((2, n + 6))
    values, change = model.table.tolerance * rng.standard_normal((2, len(model.values)))

    def closure(t):
        x = begin + t * step
        R = rotation_matrix(t * step[n + 3 :]) @ rotation_matrix(begin[n + 3 :]) @ turn
        pose = [np.add(home.joints, x[:n]), np.add(home.position, x[n : n + 3]), R.ravel()]
        given = np.concatenate(pose), np.zeros(0), model.values + values + t * change
        return [np.array(part) for part in model.structure.closure(*given)]

    def difference(t):
        return (closure(t)[0] - closure(-t)[0]).ravel() / (2 * t)

    rows, by_place, by_value = closure(0.0)
    slope = by_place @ step + by_value @ change
    numeric = (4 * difference(0.5e-2) - difference(1e-2)) / 3  # without the third derivative
    tolerance = 1e-6 * (np.abs(slope).max() + np.abs(rows).max())
    np.testing.assert_allclose(slope, numeric, atol=tolerance)
