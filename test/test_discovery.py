"""Laws of nobody's catalogue, hidden in independent virtual robots, and found again."""

import json
import sys

import findings
import numpy as np
import pytest
import virtual_findings as vf
import virtual_laws as laws

from parallel_cal.base.errors import ModelError
from parallel_cal.cli import main as cli
from parallel_cal.discovery.discovery import discover
from parallel_cal.model.file.modelfile import read_model, write_model
from parallel_cal.model.model import new_model
from parallel_cal.reporting.pictures import figure
from parallel_cal.reporting.text import show
from parallel_cal.session.steps import add
from parallel_cal.virtual import robot as vr


def hiding(law, seed=0, sigmas=1.5, visits=(90, 20)):
    """A session of the virtual Delta that hides a law of so many sigmas."""
    day = vf.session(seed, *visits)
    effect = findings.sized(laws.LAWS[law], 3e-4, sigmas, day, vr.THESIS_NOISE, seed)
    return findings.dataset(vf.samples(day, [effect], vr.THESIS_NOISE, seed), vr.THESIS_NOISE)


def names(law):
    """All that a law may be called: its name, and those of equally good ones."""
    return {law.name, *law.alternatives}


@pytest.fixture(scope="module")
def spring():
    """The discovery of a cubic spring in one joint, and its data."""
    data = hiding("cubic spring in joint 3")
    return discover(new_model("delta54"), data), data


@pytest.mark.wide
def test_a_cubic_spring_in_one_joint_is_found_with_its_place_driver_and_power(spring):
    found, _ = spring
    assert found.verdict == "described"
    (law,) = found.laws
    assert law.name == "joint3 by load.joint3"
    assert law.formula == "cubic * load.joint3^3"
    assert law.share > 0.9
    assert law.after.position_rms < 0.6 * law.before.position_rms
    low, high = law.tested["load.joint3"]
    assert -1.1 < low < high < 0


@pytest.mark.wide
def test_the_written_effect_is_judged_by_add_and_its_history_names_it(
    spring, tmp_path, monkeypatch
):
    found, data = spring
    (path,) = found.write(tmp_path / "cubic_law_of_a_test.py")
    monkeypatch.syspath_prepend(str(tmp_path))
    step = add(new_model("delta54"), path.stem, data)
    assert not step.acceptance.against
    assert step.model.history[-1]["effect"] == path.stem
    name = f"{path.stem}.cubic"
    (parameter,) = found.laws[0].parameters
    assert step.model.value(name) == pytest.approx(parameter.value, rel=1e-3)
    write_model(step.model, tmp_path / "with.yaml")
    assert read_model(tmp_path / "with.yaml").value(name) == pytest.approx(
        parameter.value, rel=1e-3
    )
    assert "its cause is not known" in step.model.effects[-1].physics
    sys.modules.pop(path.stem)


@pytest.mark.wide
def test_a_discovery_is_shown_as_text_and_as_a_figure_of_the_law_over_the_shape(spring):
    found, _ = spring
    assert show(found).startswith("described: The reading of joint3 errs with load.joint3")
    band, curve, law = figure(found).data
    assert np.ptp(np.array(curve.y) - np.array(law.y)) < 0.2 * np.ptp(law.y)
    assert len(band.x) == 2 * len(curve.x)


@pytest.mark.wide
def test_the_command_writes_one_json_document_and_the_effect(tmp_path, capsys, monkeypatch):
    hiding("cubic spring in joint 3").to_json(tmp_path / "samples.json")
    write_model(new_model("delta54"), tmp_path / "m.yaml")
    out = tmp_path / "spring_law_of_a_test.py"
    monkeypatch.chdir(tmp_path)
    cli.application(["discover"])(
        ["discover", "m.yaml", "samples.json", "-o", str(out), "--json"], standalone_mode=False
    )
    document = json.loads(capsys.readouterr().out)
    assert document["verdict"] == "described"
    (law,) = document["laws"]
    assert law["place"] == "joint3"
    assert law["drivers"] == ["load.joint3"]
    assert law["parameters"]["cubic"]["unit"] == "rad/(N m)^3"
    assert law["validation"]["after"]["position_rms"] < law["validation"]["before"]["position_rms"]
    assert document["file"] == str(out)
    assert "class FoundLaw(Effect)" in out.read_text()


def test_an_effect_file_that_python_cannot_import_is_refused_before_the_search(tmp_path):
    with pytest.raises(ModelError, match=r"my-law.py: .* expected a name such as my_effect.py"):
        cli.application(["discover"])(
            ["discover", "m.yaml", "s.json", "-o", "my-law.py"], standalone_mode=False
        )
