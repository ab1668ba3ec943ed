"""The model file: what is written comes back, and every mistake in a file is named."""

import os
import re
import stat
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from parallel_cal.base.errors import ModelFileError
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.file import modelfile
from parallel_cal.model.file.modelfile import (
    dump_model,
    model_hash,
    parse_model,
    read_model,
    replace_model,
    write_model,
)
from parallel_cal.model.model import Noise, new_model
from parallel_cal.model.shelf import load_mechanism

ROOT = Path(__file__).parents[2]
LINK = "chain1.D_x: {value: 0.0761, unit: m, nominal: 0.076, tolerance: 0.001}"


@pytest.fixture(scope="module")
def text():
    """A file with one changed value and one effect, as the package writes it."""
    model = new_model("delta24", {"chain1.D_x": 0.0761}, ["backlash"])
    written = dump_model(replace(model, noise=Noise(1e-4, 1e-5, None)))
    assert LINK in written
    return written


def refused(text, *words):
    """The error of a text, which must hold all the words."""
    with pytest.raises(ModelFileError) as caught:
        parse_model(text, "robot.yaml")
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert word in message, message
    return message


def line_of(text, part):
    return next(i for i, line in enumerate(text.split("\n"), start=1) if part in line)


def with_covariance(model, seed=0):
    n = len(model.table)
    root = np.random.default_rng(seed).standard_normal((n, n)) * 1e-5
    covariance = np.tril(root @ root.T)
    covariance = covariance + np.tril(covariance, -1).T
    covariance[3] = covariance[:, 3] = 0
    return replace(model, covariance=covariance)


# ------------------------------------------------------------------- what is written comes back


def test_a_model_comes_back_to_the_last_bit(text):
    model = parse_model(text)
    assert dump_model(model) == text
    assert model.value("chain1.D_x") == 0.0761
    assert [effect.name for effect in model.effects] == ["backlash"]
    assert model.noise == Noise(1e-4, 1e-5, None)


def test_awkward_numbers_come_back_to_the_last_bit():
    rng = np.random.default_rng(1)
    start = new_model("delta54")
    model = start.with_values(start.values + 1e-5 * rng.standard_normal(len(start.values)))
    assert (parse_model(dump_model(model)).values == model.values).all()


def test_the_covariance_comes_back_to_the_last_bit():
    model = with_covariance(new_model("delta54"))
    again = parse_model(dump_model(model))
    assert (again.covariance == model.covariance).all()
    assert dump_model(again) == dump_model(model)


def test_sigmas_alone_give_a_diagonal_covariance(text):
    line = LINK.replace("}", ", sigma: 2.0e-05}")
    model = parse_model(text.replace(LINK, line))
    assert model.covariance[0, 0] == pytest.approx(4e-10)
    assert np.count_nonzero(model.covariance) == 1
    assert dump_model(parse_model(dump_model(model))) == dump_model(model)


def test_fixed_parameters_joints_home_frames_and_history_come_back():
    mechanism = load_mechanism("delta24")
    mechanism.joints = ("arm_a", "arm_b", "arm_c")
    mechanism.joint_limits = ((-1.0, 1.0), (-np.inf, np.inf), (-0.5, 2.0))
    mechanism.home = replace(mechanism.home, joints=(0.5, 0.6, 0.7))
    fixed = np.arange(24) % 2 == 0
    step = {"step": "fit", "dataset": {"source": "a: b #1", "sha256": "12"}, "after": {"x": None}}
    model = replace(
        new_model(mechanism), fixed=fixed, frames={"base": "b", "platform": "p"}, history=(step,)
    )
    again = parse_model(dump_model(model))
    assert again.joints == mechanism.joints
    assert again.mechanism.joint_limits == mechanism.joint_limits
    assert again.mechanism.home == mechanism.home
    assert (again.fixed == fixed).all()
    assert again.history == (step,)
    assert again.frames == {"base": "b", "platform": "p"}


def test_options_of_a_mechanism_come_back():
    links = [
        {"joint": "R", "axes": "parallel", "a": 0.3},
        {"joint": "R", "a": 0.2},
        {"axes": "frame", "a": 0.1},
    ]
    model = new_model(load_mechanism("serial", links=links))
    assert parse_model(dump_model(model)).mechanism.options == {"links": links}


def test_a_larger_robot_of_the_same_kind_brings_its_own_nominal_values(text):
    own = "chain1.D_x: {value: 0.2002, unit: m, nominal: 0.2, tolerance: 0.001}"
    model = parse_model(text.replace(LINK, own))
    assert model.table["chain1.D_x"].nominal == 0.2
    assert new_model("delta24").table["chain1.D_x"].nominal == 0.076


def test_a_drawing_states_each_value_once(text):
    """A value without a nominal one is the drawing's own, and its plausible range goes with it."""
    once = text.replace(LINK, "chain1.D_x: {value: 0.0961, unit: m, tolerance: 0.001}")
    model = parse_model(once, "robot.yaml")
    assert model.value("chain1.D_x") == 0.0961
    assert model.table["chain1.D_x"].nominal == 0.0961
    refused(text.replace(LINK, LINK.replace("0.0761", "0.0961")), "tolerances from its nominal")


def test_a_model_file_gives_the_robot_that_was_written(tmp_path):
    model = new_model("delta54", {"chain2.Lb": 0.2411})
    write_model(model, tmp_path / "m.yaml")
    q = np.array([0.5, 0.6, 0.7])
    again = Kinematics(read_model(tmp_path / "m.yaml")).direct(q)
    assert (again.position == Kinematics(model).direct(q).position).all()


def test_reading_is_as_few_calls_as_ten_milliseconds_allow():
    """24 000 with YAML's own parser in C; the one in Python makes millions."""
    written, calls = dump_model(with_covariance(new_model("delta54"))), []
    parse_model(written)
    before = sys.getprofile()
    sys.setprofile(lambda frame, event, argument: calls.append(1) if event == "call" else None)
    try:
        parse_model(written)
    finally:
        sys.setprofile(before)
    assert len(calls) < 40_000


# ------------------------------------------------------------------- the hash


def test_the_hash_of_a_model_is_that_of_its_file(tmp_path):
    model = with_covariance(new_model("delta54"))
    path = tmp_path / "m.yaml"
    write_model(model, path)
    assert model_hash(model) == model_hash(path.read_bytes()) == model_hash(path.read_text())
    assert model_hash(read_model(path)) == model_hash(model)


def test_the_hash_is_the_same_in_another_process(tmp_path):
    write_model(new_model("delta24"), tmp_path / "m.yaml")
    code = (
        "import sys; from parallel_cal.model.file.modelfile import *; "
        "print(model_hash(read_model(sys.argv[1])))"
    )
    found = {
        subprocess.run(
            [sys.executable, "-c", code, str(tmp_path / "m.yaml")],
            env={**os.environ, "PYTHONHASHSEED": seed},
            capture_output=True,
            text=True,
            check=True,
        ).stdout.strip()
        for seed in ("1", "2")
    }
    assert found == {model_hash(new_model("delta24"))}


def test_one_changed_bit_changes_the_hash():
    model = new_model("delta24")
    values = model.values.copy()
    values[0] = np.nextafter(values[0], 1)
    assert model_hash(model.with_values(values)) != model_hash(model)


# ------------------------------------------------------------------- writing


def test_writing_keeps_the_permissions_of_the_file(tmp_path):
    path = tmp_path / "m.yaml"
    write_model(new_model("delta24"), path)
    path.chmod(0o640)
    write_model(new_model("delta24", {"chain1.Lb": 0.2401}), path)
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    assert [p.name for p in tmp_path.iterdir()] == ["m.yaml"]


def test_writing_through_a_link_keeps_the_link(tmp_path):
    real, link = tmp_path / "real.yaml", tmp_path / "link.yaml"
    write_model(new_model("delta24"), real)
    link.symlink_to(real)
    write_model(new_model("delta24", {"chain1.Lb": 0.2401}), link)
    assert link.is_symlink()
    assert read_model(real).value("chain1.Lb") == 0.2401


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[" * 30_000 + "]" * 30_000, "m:1: nested more than 30 levels deep"),
        ("{a: " * 15_000, "m:1: nested more than 30 levels deep"),
        ("".join(" " * k + "a:\n" for k in range(400)), "m:31: nested more than 30 levels deep"),
        ("parallel_cal: " + "9" * 5000, "m:1: parallel_cal: a whole number has 5000 digits"),
    ],
)
def test_a_text_that_would_break_a_parser_is_refused_before_it_does(text, words):
    with pytest.raises(ModelFileError, match=re.escape(words)):
        parse_model(text, "m")


def test_what_is_no_plain_file_of_a_sane_size_is_not_waited_for(tmp_path):
    pipe, large = tmp_path / "pipe", tmp_path / "large"
    os.mkfifo(pipe)
    large.write_bytes(b"#" * ((4 << 20) + 1))
    for path, words in (
        (pipe, "not a regular file"),
        ("/dev/zero", "not a regular file"),
        (large, "larger than 4 MB"),
        (tmp_path, "Is a directory"),
    ):
        with pytest.raises(ModelFileError, match=f"cannot be read: .*{words}"):
            read_model(path)


def test_a_failed_write_leaves_the_old_file_and_no_other(tmp_path, monkeypatch):
    path = tmp_path / "m.yaml"
    write_model(new_model("delta24"), path)
    before = path.read_text()

    def broken(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", broken)
    with pytest.raises(ModelFileError, match="No space left"):
        write_model(new_model("delta24", {"chain1.Lb": 0.2401}), path)
    assert path.read_text() == before
    assert [p.name for p in tmp_path.iterdir()] == ["m.yaml"]


def test_a_model_that_could_not_be_read_back_is_not_written(tmp_path):
    for value, word in ((0.2, "tolerances"), (np.nan, "nan")):
        with pytest.raises(ModelFileError, match=word):
            write_model(new_model("delta24", {"chain1.D_x": value}), tmp_path / "m.yaml")
    assert not list(tmp_path.iterdir())


def test_writing_into_a_missing_folder_is_a_clear_error(tmp_path):
    with pytest.raises(ModelFileError, match=r"cannot be written: No such file or directory"):
        write_model(new_model("delta24"), tmp_path / "no" / "m.yaml")


# ------------------------------------------------------------------- mistakes in numbers


def test_a_value_in_millimetres_is_refused_with_line_key_range_and_a_guess(text):
    bad = text.replace("value: 0.0761", "value: 76.1")
    refused(
        bad,
        f"robot.yaml:{line_of(bad, '76.1')}: parameters.chain1.D_x.value: 76.1 m",
        "tolerances from its nominal 0.076",
        "expected 0.066 to 0.086 m",
        "is it in mm? That would be 0.0761 m",
    )


def test_an_angle_in_degrees_is_refused_with_a_guess(text):
    old = re.search(r"chain2\.theta: \{value: [0-9.]+", text)[0]
    refused(
        text.replace(old, "chain2.theta: {value: 120.008"), "chain2.theta", "in degrees?", "rad"
    )


def test_a_value_ten_tolerances_away_is_accepted_and_eleven_is_not(text):
    assert parse_model(text.replace("value: 0.0761", "value: 0.0859")).value("chain1.D_x") == 0.0859
    refused(text.replace("value: 0.0761", "value: 0.087"), "11 tolerances")


def test_a_physically_impossible_value_is_refused(text):
    bad = text.replace("joint2.width: {value: 0.0", "joint2.width: {value: -0.001")
    refused(
        bad,
        "effects.0.parameters.joint2.width.value",
        "physically impossible",
        "expected 0 to 0.003 rad",
    )


@pytest.mark.parametrize("number", [".nan", "nan", ".inf", "-.inf", "1e999"])
def test_a_number_that_is_not_finite_is_refused(text, number):
    refused(
        text.replace("value: 0.0761", f"value: {number}"),
        "parameters.chain1.D_x.value: expected a finite number",
        "expected 0.066 to 0.086 m",
    )


@pytest.mark.parametrize("word", ["null", "'0.0761'", "76.1 mm", "true", "[0.0761]", ""])
def test_something_else_than_a_number_is_refused(text, word):
    refused(
        text.replace("value: 0.0761", f"value: {word}"),
        "parameters.chain1.D_x.value: expected a number",
        "expected 0.066 to 0.086 m",
    )


def test_exponents_and_integers_are_numbers(text):
    model = parse_model(text.replace("value: 0.0761", "value: 761e-4").replace("1.0e-05", "1"))
    assert model.value("chain1.D_x") == 0.0761
    assert model.noise.position == 1.0


def test_a_negative_sigma_is_refused(text):
    bad = text.replace(LINK, LINK.replace("}", ", sigma: -0.1}"))
    refused(bad, "parameters.chain1.D_x.sigma", "expected 0 or more, found -0.1", "(in m)")


def test_a_tolerance_of_zero_is_refused(text):
    refused(text.replace(LINK, LINK.replace("0.001", "0.0")), "D_x.tolerance", "above 0", "(in m)")


def test_only_noise_that_was_not_measured_is_marked_so(text):
    assert "assumed" not in text
    words = text.replace("noise: {", "noise: {assumed: true, ")
    model = parse_model(words)
    assert model.noise.assumed
    assert parse_model(dump_model(model)).noise == model.noise
    refused(words.replace("true", "perhaps"), "noise.assumed: expected true or false")


def test_negative_noise_is_refused(text):
    refused(
        text.replace("joint: 0.0001", "joint: -1"), "noise.joint", "expected 0 or more, found -1"
    )


def test_a_sigma_that_contradicts_the_covariance_is_refused():
    written = dump_model(with_covariance(new_model("delta24")))
    sigma = re.search(r"sigma: ([0-9.e-]+)", written)[1]
    refused(
        written.replace(f"sigma: {sigma}", "sigma: 0.5"), "covariance: sigma of chain1.D_x is 0.5"
    )


def test_a_matrix_that_is_not_a_covariance_is_refused():
    written = dump_model(with_covariance(new_model("delta24")))
    head, rows = written.split("  lower:\n")
    _, *others = rows.split("\n")
    bad = head + "  lower:\n" + "\n".join(["  - [1.0e-30]", *others])
    refused(re.sub(r", sigma: [0-9.e-]+", "", bad), "covariance.lower", "a correlation is above 1")
    refused(
        head + "  lower:\n" + "\n".join(others), "covariance.lower: found 22 values, expected 23"
    )


# ------------------------------------------------------------------- mistakes in keys


def test_an_unknown_key_is_refused_and_the_nearest_is_suggested(text):
    bad = text.replace("noise:", "nois:")
    refused(bad, f"robot.yaml:{line_of(bad, 'nois:')}: nois: unknown key", "did you mean 'noise'?")


def test_an_unknown_key_of_a_parameter_is_refused(text):
    bad = text.replace(LINK, LINK.replace("tolerance", "tolerence"))
    refused(bad, "parameters.chain1.D_x", "tolerence: unknown key; did you mean 'tolerance'?")


def test_an_unknown_parameter_is_refused_and_the_nearest_is_suggested(text):
    bad = text.replace("chain1.D_x", "chain1.Dx")
    refused(
        bad, "chain1.Dx: unknown parameter; did you mean 'chain1.D_x'?", str(line_of(bad, "Dx"))
    )


def test_a_missing_parameter_is_named(text):
    without = re.sub(r"  chain2\.Lb:.*\n", "", text)
    refused(without, f":{line_of(text, 'parameters:')}: parameters:", "missing: chain2.Lb")


def test_a_missing_parameter_of_an_effect_is_named(text):
    refused(re.sub(r"    joint2\.width:.*\n", "", text), "effects.0.parameters", "joint2.width")


@pytest.mark.parametrize("key", ["value", "unit", "tolerance"])
def test_a_missing_key_of_a_parameter_is_named_with_its_line(text, key):
    bad = text.replace(LINK, re.sub(rf"{key}: [^,}}]+(, )?", "", LINK))
    line = line_of(text, LINK)
    refused(bad, f"robot.yaml:{line}: parameters.chain1.D_x.{key}: this key is missing")


@pytest.mark.parametrize("key", ["mechanism", "joints", "parameters"])
def test_a_missing_section_is_named(text, key):
    bad = re.sub(rf"^{key}:.*\n(  .*\n)*", "", text, flags=re.M)
    refused(bad, key)


def test_a_wrong_unit_is_refused(text):
    bad = text.replace(LINK, LINK.replace("unit: m", "unit: mm"))
    line = line_of(bad, "unit: mm")
    refused(bad, f"robot.yaml:{line}: parameters.chain1.D_x.unit: found 'mm', expected 'm'", "SI")


def test_a_key_that_occurs_twice_is_refused(text):
    bad = text.replace(LINK, f"{LINK}\n  {LINK}")
    line = line_of(bad, LINK)
    refused(bad, f":{line + 1}:", "chain1.D_x", "occurs twice", f"first in line {line}")


# ------------------------------------------------------------------- mistakes in what it is about


def test_another_version_is_refused(text):
    bad = text.replace("parallel_cal: 1", "parallel_cal: 2")
    refused(bad, "robot.yaml:3: parallel_cal: found version 2, expected 1")


def test_a_file_of_something_else_is_refused():
    refused("- a\n- b\n", "robot.yaml:1", "not a model file", "parallel_cal: 1")
    refused("a: 1\n", "not a model file")


def test_an_empty_file_is_refused():
    refused("", "robot.yaml:1: the file is empty", "parallel-cal new")
    refused("# nothing\n", "the file is empty")


def test_what_is_not_yaml_is_refused_with_its_line():
    refused("parallel_cal: 1\nmechanism: {delta24\njoints: [\n", "robot.yaml:", "not YAML")


def test_a_binary_file_is_refused(tmp_path):
    (tmp_path / "m.yaml").write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(ModelFileError, match="not YAML"):
        read_model(tmp_path / "m.yaml")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ModelFileError, match=r"no\.yaml: cannot be read: No such file"):
        read_model(tmp_path / "no.yaml")


def test_aliases_are_refused():
    refused("parallel_cal: 1\na: &x [*x]\n", "aliases")


def test_an_unknown_mechanism_is_refused_and_the_nearest_is_suggested(text):
    bad = text.replace("mechanism: delta24", "mechanism: delta_nominl")
    refused(
        bad,
        "robot.yaml:4: mechanism:",
        "no mechanism 'delta_nominl'",
        "did you mean 'delta_nominal'?",
    )


@pytest.mark.parametrize("name", ["../my_robot", ".", "os.nothing"])
def test_a_mechanism_that_is_nowhere_is_refused(text, name):
    bad = text.replace("mechanism: delta24", f"mechanism: '{name}'")
    refused(
        bad, f"mechanism: no mechanism '{name}': expected one of ankle_2rsu, ", "my_pkg.my_file"
    )


def test_a_model_file_of_another_mechanism_names_what_does_not_fit(text):
    refused(text.replace("mechanism: delta24", "mechanism: delta_nominal"), "unknown parameter")


def test_an_option_that_the_mechanism_does_not_take_is_refused(text):
    bad = text.replace("mechanism: delta24", "mechanism: {name: delta24, options: {legs: 6}}")
    refused(bad, "delta24: there is no option 'legs'; its options: base=None, platform")
    refused(
        bad.replace("legs", "name"), "there is no option 'name'; its options: base=None, platform"
    )


def test_an_unknown_effect_is_refused_and_the_nearest_is_suggested(text):
    bad = text.replace("name: backlash", "name: backlsh")
    line = line_of(bad, "backlsh")
    refused(bad, f":{line}: effects.0.name: no effect 'backlsh'", "did you mean 'backlash'?")


def test_an_effect_that_occurs_twice_is_refused(text):
    effect = text[text.index("- name: backlash") : text.index("history")]
    refused(text.replace(effect, effect + effect), "effects.1.name", "occurs twice")


PLATE = "{height: 0.23, holes: [[-0.03, 0.0], [0.03, 0.0]], bars: [0.07, 0.07], sigma: 2.0e-05}"


def with_sensors(*entries):
    """A file of model 24 with these entries of its list of sensors."""
    text = dump_model(new_model("delta24"))
    return text.replace(
        "history:", "sensors:\n" + "".join(f"- {e}\n" for e in entries) + "history:"
    )


def test_sensors_come_back_in_order_with_their_numbers_and_masks():
    model = parse_model(
        with_sensors(f"{{name: plane_spheres, options: {PLATE}}}", "name: device_frame")
    )
    plate, frame = model.sensors
    assert (plate.height, plate.bars, plate.sigma) == (0.23, (0.07, 0.07), 2e-5)
    assert plate.holes == ((-0.03, 0.0), (0.03, 0.0))
    assert frame.name == "device_frame"
    names = model.table.names
    assert names[24] == "plane_spheres.plane.z"
    assert model.fixed[24:38].all()
    assert not model.fixed[38:].any()
    values, fixed = model.values.copy(), model.fixed.copy()
    values[names.index("plane_spheres.bar2.length")] = 0.0701
    fixed[names.index("plane_spheres.bar2.length")] = False
    model = replace(model, values=values, fixed=fixed)
    text = dump_model(model)
    again = parse_model(text)
    assert f"  options: {PLATE}\n" in text
    assert again.sensors == model.sensors
    assert (again.values == values).all()
    assert (again.fixed == fixed).all()
    assert dump_model(again) == text


def test_a_sensor_without_numbers_has_its_own_and_with_some_lacks_the_others():
    text = with_sensors("{name: probe, options: {height: 0.3}}")
    assert parse_model(text).value("probe.plate.z") == 0.3
    part = "{name: probe, options: {height: 0.3}, parameters: {plate.z: {value: 0.3, unit: m}}}"
    refused(
        with_sensors(part), "sensors.0.parameters: parameters missing: plate.rx, plate.ry, tip.x"
    )


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ("name: plane_sphers", "did you mean 'plane_spheres'?"),
        ("{name: probe, options: {heigth: 0.3}}", "options.heigth: unknown option; did you mean"),
        ("{name: probe, options: {height: low}}", "options.height: expected a number, found 'low'"),
        ("name: probe", "sensors.0.options.height: this key is missing"),
        ("{name: probe, options: [0.3]}", "sensors.0.options: expected a mapping"),
        ("{name: probe, options: {height: .nan}}", "sensors.0.options: a number is not finite"),
        (
            "{name: plane_spheres, options: {height: 0.2, bars: [0.1]}}",
            "expected one bar for each hole",
        ),
        ("{name: device_frame, option: {}}", "0.option: unknown key; did you mean 'options'"),
        ("{name: plane_spheres, options: {height: 0.2, holes: [[0.1]]}}", "holes.0.1: this key is"),
    ],
)
def test_a_sensor_described_wrongly_is_refused_with_its_line(entry, words):
    text = with_sensors(entry)
    refused(text, f"robot.yaml:{line_of(text, entry)}: ", words)


def test_a_sensor_that_occurs_twice_is_refused():
    bad = with_sensors("name: device_frame", "name: device_frame")
    refused(bad, "sensors.1.name: the sensor 'device_frame' occurs twice")


def test_a_number_of_a_sensor_in_another_unit_is_refused_with_a_guess():
    text = dump_model(parse_model(with_sensors("{name: probe, options: {height: 0.3}}")))
    bad = text.replace("plate.z: {value: 0.3,", "plate.z: {value: 300.0,")
    refused(bad, "sensors.0.parameters.plate.z.value", "is it in mm? That would be 0.3 m")


def test_a_wrong_number_of_joints_is_refused(text):
    bad = re.sub(r"  joint3: .*\n", "", text)
    refused(bad, "joints: 2 joints, found joint1, joint2", "delta24 has 3: joint1, joint2, joint3")


def test_joints_in_another_order_are_refused(text):
    bad = text.replace("  joint1:", "  jointX:").replace("  joint2:", "  joint1:")
    bad = bad.replace("  jointX:", "  joint2:")
    refused(bad, "joints: joints are in another order: found joint2, joint1, joint3")


def test_a_joint_name_with_spaces_and_a_wrong_joint_unit_are_refused(text):
    refused(text.replace("  joint1: {", "  'joint 1': {"), "must not contain spaces or dots")
    refused(text.replace("joint1: {unit: rad", "joint1: {unit: deg"), "found 'deg', expected 'rad'")


def test_joint_limits_that_make_no_sense_are_refused(text):
    limit = re.search(r"joint1: (\{.*\})", text)[1]
    refused(
        text.replace(limit, "{unit: rad, low: 2, high: 1}", 1), "joints.joint1.low", "not below"
    )
    refused(text.replace(limit, "{unit: rad, low: -30, high: 135}", 1), "are these degrees?")


def test_a_home_of_the_wrong_length_is_refused(text):
    refused(
        re.sub(r"(home:\n  joints: )\[.*\]", r"\1[0.5, 0.5]", text), "home.joints: found 2 values"
    )
    refused(
        re.sub(r"  position: \[.*\]", "  position: [0, 0]", text), "home.position: too few values"
    )
    for nothing in ("[0, 0, 0, 0]", "[0, 0, 0, 1e-300]"):
        refused(re.sub(r"quaternion: \[.*\]", f"quaternion: {nothing}", text), "home.quaternion")


def test_a_workspace_of_the_wrong_length_is_refused(text):
    bad = re.sub(r"workspace: .*", "workspace: {low: [0, 0], high: [1, 1]}", text)
    refused(bad, "workspace.low: found 2 values, expected 3, one for each of x, y, z")


def test_a_workspace_that_is_inside_out_is_refused(text):
    box = "workspace: {low: [0, 0, 0.3], high: [0.1, 0.1, 0.2]}"
    refused(re.sub(r"workspace: .*", box, text), "workspace.low.2: 0.3 is above high, 0.2")


def test_a_history_that_could_not_be_written_back_is_refused(text):
    bad = text.replace("history: []", "history: [{before: {position_rms: .nan}}]")
    refused(bad, "history.0.before", "expected a finite number, found nan")


def test_several_mistakes_are_counted(text):
    refused(text.replace("unit: m,", "unit: 3,"), "(and ", "more)")


# ------------------------------------------------------------------- presets


@pytest.mark.parametrize("path", sorted((ROOT / "config").glob("*.yaml")), ids=lambda p: p.stem)
def test_every_preset_can_be_read(path):
    assert len(read_model(path).table) > 0


@pytest.mark.parametrize(
    ("name", "table"),
    [
        ("delta_mockup_nominal", "5.12"),
        ("delta_mockup_identified", "5.18"),
        ("delta24_mockup_identified", "5.13"),
    ],
)
def test_the_presets_of_the_delta_mockup_name_their_table_and_noise(name, table):
    path = ROOT / "config" / f"{name}.yaml"
    model = read_model(path)
    assert f"table {table}" in model.history[0]["source"]
    assert model.noise.position == 1e-5
    assert model_hash(model) == model_hash(path.read_bytes())


def test_the_presets_are_what_their_generator_writes():
    done = subprocess.run(
        [sys.executable, str(ROOT / "config" / "make_presets.py"), "--check"],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert done.returncode == 0, done.stderr


def test_the_mockup_misses_its_targets_as_table_5_15_says():
    true, believed = (
        read_model(ROOT / "config" / f"delta_mockup_{name}.yaml")
        for name in ("identified", "nominal")
    )
    rng = np.random.default_rng(0)
    r = rng.uniform([-0.06, -0.06, 0.14], [0.06, 0.06, 0.26], (500, 3))
    error = Kinematics(true).inverse(r).position - (
        Kinematics(believed).direct(Kinematics(true).inverse(r).joints).position
    )
    assert error.mean(axis=0) == pytest.approx([270e-6, 409e-6, -318e-6], abs=15e-6)


def test_the_public_names_are_the_promised_ones():
    assert set(modelfile.__all__) >= {"read_model", "parse_model", "write_model", "dump_model"}


@pytest.mark.parametrize(
    "stated",
    [
        {"anchors": [[0, -2, 0], [2, 1, 0], [-2, 1, 0], [0, 0, 3], [1, 1, 3]], "radius": 0.075},
        {
            "anchors": [[0, -2, 0], [2, 1, 0], [-2, 1, 0], [0, 0, 3]],
            "advantages": [2, 2, 2, 4],
            "spools": [1, 1, 1, 2],
        },
    ],
)
def test_an_older_file_of_a_cable_robot_that_does_not_state_its_spools_is_read(stated):
    today = new_model(load_mechanism("cable", **stated))
    text = dump_model(today)
    lines = [line for line in text.splitlines() if line.strip().split(":")[0] not in stated]
    anchors = f"    anchors: {stated['anchors']}"
    lines.insert(lines.index("  options:") + 1, anchors)
    older = parse_model("\n".join(lines) + "\n")
    assert older.joints == today.joints
    np.testing.assert_array_equal(older.values, today.values)


def test_a_model_that_is_written_again_does_not_replace_the_file_before_it(tmp_path):
    path, model = tmp_path / "m.yaml", new_model("delta_nominal")
    replace_model(model, path)
    first = path.read_text()
    changed = model.with_values(1.001 * model.values)
    for _ in range(2):
        replace_model(changed, path)
        assert (tmp_path / "m.yaml.previous").read_text() == first
    assert path.read_text() != first
