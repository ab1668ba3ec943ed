"""NumPy's scalars and 0-d arrays, wherever a caller may give a number: documents have plain ones.

NumPy 2 writes `np.float64(1.0)` where Python writes `1.0`, and `json` refuses most of its types.
"""

import json
from dataclasses import replace

import numpy as np
import pytest

import parallel_cal as pc
from parallel_cal.base.documents import to_json_value, to_plain
from parallel_cal.model.drive import Drive
from parallel_cal.model.file.writer import dump_model
from parallel_cal.model.shelf import load_mechanism, load_sensor

FLOATS = [np.float64, np.float32, np.longdouble, np.array]
WIDTH = "backlash.joint1.width"


def written(model, folder):
    """The text of a model file, after it was read back to an equal model."""
    path = folder / "model.yaml"
    pc.write_model(model, path)
    text = path.read_text()
    assert dump_model(pc.read_model(path)) == text
    assert "np." not in text
    return text


@pytest.mark.parametrize("number", FLOATS)
def test_a_model_file_has_plain_numbers(tmp_path, number):
    noise = pc.Noise(joint={"rad": number(0.5)}, position=number(0.25), assumed=np.bool_(True))
    model = pc.new_model("delta24", {"chain1.Lb": number(0.25)}, effects=["backlash"])
    model = replace(
        model.with_settings("backlash", {"joint1.width": number(0.015625)}),
        noise=noise,
        covariance=[[number(i == j) for j in range(27)] for i in range(27)],
        fixed=[np.bool_(i > 3) for i in range(27)],
        tolerances={WIDTH: number(0.03125), "chain1.Lb": number(0.5)},
        usual_tolerances={WIDTH: number(0.015625)},
        history=({"step": np.str_("fit"), "samples": np.int64(7), "forced": np.bool_(True)},),
    )
    plain = replace(
        model,
        noise=pc.Noise(joint={"rad": 0.5}, position=0.25, assumed=True),
        covariance=np.eye(27),
        fixed=np.arange(27) > 3,
        tolerances={WIDTH: 0.03125, "chain1.Lb": 0.5},
        usual_tolerances={WIDTH: 0.015625},
        history=({"step": "fit", "samples": 7, "forced": True},),
    )
    assert written(model, tmp_path) == written(plain, tmp_path)
    assert model.value("chain1.Lb") == 0.25


@pytest.mark.parametrize("number", FLOATS)
def test_options_of_mechanisms_and_sensors_are_plain(tmp_path, number):
    corners = [(-3.0, 0.0), (3.0, 0.0), (0.0, 3.0), (0.0, -3.0)]
    given = number(corners) if number is np.array else [tuple(map(number, at)) for at in corners]
    bar = load_sensor("ball_bar", centre=tuple(map(number, (0.0, 0.5, 0.25))))
    model = pc.new_model(load_mechanism("cable", anchors=given), sensors=[bar])
    plain = pc.new_model(
        load_mechanism("cable", anchors=corners),
        sensors=[load_sensor("ball_bar", centre=(0.0, 0.5, 0.25))],
    )
    assert written(model, tmp_path) == written(plain, tmp_path)


@pytest.mark.parametrize("number", FLOATS)
def test_the_drives_of_an_exported_controller_are_stated_in_plain_numbers(tmp_path, number):
    def header(drive, folder):
        model = pc.new_model("linear_delta")
        model.mechanism.drives = (drive,) * 3
        pc.export(model, "c", folder)
        return (folder / "linear_delta.h").read_text()

    spool = Drive("belt", radius=number(0.0078125), gear=number(2.0))
    screw = Drive("screw", per_rev=number(0.00390625))
    assert "radius 0.0078125 m, advantage 1.0, gear 2.0" in header(spool, tmp_path / "belt")
    assert "(0.00390625 m per turn of the motor" in header(screw, tmp_path / "screw")


@pytest.mark.parametrize("number", FLOATS)
def test_equal_options_are_written_alike(number):
    """A study recognizes its stored sessions by the text of the options."""
    options = pc.FitOptions(hold_out=number(0.25), joint_sigma=number(0.5), seed=np.int64(3))
    assert repr(options) == repr(pc.FitOptions(hold_out=0.25, joint_sigma=0.5, seed=3))


def test_a_json_document_has_plain_values():
    given = {
        "x": [np.float64(0.5), np.float32(0.25), np.longdouble(2), np.array(1.0)],
        "n": (np.int64(3), np.uint8(7)),
        "flag": np.bool_(False),
        "text": np.str_("a"),
        "lost": np.float32("nan"),
    }
    stated = {"x": [0.5, 0.25, 2.0, 1.0], "n": [3, 7], "flag": False, "text": "a", "lost": None}
    assert json.loads(json.dumps(to_json_value(given), allow_nan=False)) == stated
    assert repr(to_plain((np.float64(1.5), [np.array([1, 2])]))) == "(1.5, [[1, 2]])"
