"""A model is proven in the region of its samples; one warning says how far a use is beyond it."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest
import virtual_findings as vf
import virtual_sessions as vss
from findings import dataset

from parallel_cal.cli import main as cli
from parallel_cal.diagnosis.comparison import compare
from parallel_cal.exporting.export import export
from parallel_cal.identification.fit import fit
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.file.modelfile import dump_model, parse_model, write_model
from parallel_cal.model.mechanism import Workspace
from parallel_cal.model.model import Noise, new_model
from parallel_cal.model.region import (
    IdentifiedRegion,
    describe_untested_conditions,
    describe_workspace_excess,
)
from parallel_cal.planning.plan import plan
from parallel_cal.reporting import text
from parallel_cal.session.steps import add, fitted
from parallel_cal.virtual import robot as vr

GEARS = vr.Backlash((0.9e-3, 1.1e-3, 0.8e-3))


def sampled(session):
    return dataset(vf.samples(session, [GEARS], vr.THESIS_NOISE, 1), vr.THESIS_NOISE)


@pytest.fixture(scope="module")
def inside():
    """A session in a cube of 0.12 m."""
    return sampled(vss.brisk(1))


@pytest.fixture(scope="module")
def wider():
    """A session in a cube of 0.16 m about the same point."""
    return sampled(vss.wide(2))


@pytest.fixture(scope="module")
def step(inside):
    return add(new_model("delta54"), "backlash", inside)


def test_a_step_writes_the_region_of_its_samples_into_the_model_file(step, inside):
    region = IdentifiedRegion.of_model(parse_model(dump_model(step.model)))
    for axis, middle in zip("xyz", (0.0, 0.0, 0.2), strict=True):
        assert region.position[axis] == pytest.approx((middle - 0.06, middle + 0.06), abs=4e-3)
    for i, joint in enumerate(step.model.joints):
        ends = inside.q[:, i].min(), inside.q[:, i].max()
        assert region.joints[joint] == pytest.approx(ends, rel=1e-5)
    assert step.document()["region"] == region.document()
    assert IdentifiedRegion.of_model(new_model("delta54")) is None


def test_comparing_samples_beyond_the_region_gives_one_warning_that_says_how_far(
    step, inside, wider
):
    assert not any("outside the region" in w for w in compare(step.model, inside).dataset.warnings)
    [words] = [w for w in compare(step.model, wider).dataset.warnings if "outside the region" in w]
    at = {name: wider.conditions[name] for name in step.model.conditions}
    region = IdentifiedRegion.of_model(step.model)
    middle = np.array([np.mean(region.position[axis]) for axis in "xyz"])
    half = np.array([np.ptp(region.position[axis]) / 2 for axis in "xyz"])
    away = np.abs(Kinematics(step.model).direct(wider.q, at).position - middle) - half
    beyond = (away > 0.2 * half).any(axis=1).sum()
    assert words.startswith(f"{beyond} of {len(wider)} samples are outside the region")
    assert words.endswith(
        f"by up to {1e3 * away.max():.3g} mm: an effect that helps inside may be wrong there"
    )


def test_add_says_for_which_region_its_gain_was_shown(step):
    assert "these errors are of samples in x -59..59, y -59..59, z 143..259 mm" in text.show(
        step, details=True
    )
    reaching = replace(step.model.mechanism.workspace, low=(-0.1, -0.1, 0.1), high=(0.1, 0.1, 0.3))
    model = parse_model(dump_model(step.model))
    model.mechanism.workspace = reaching
    words = describe_workspace_excess(model)
    assert words.startswith("the workspace exceeds the region in which the model was identified")
    assert "by up to 4" in words
    model.mechanism.workspace = Workspace((-0.05, -0.05, 0.15), (0.05, 0.05, 0.25))
    assert describe_workspace_excess(model) == ""


@pytest.mark.wide
def test_a_plan_an_export_and_a_prediction_beyond_the_region_give_one_warning(
    step, tmp_path, capsys
):
    model = parse_model(dump_model(step.model))
    model = replace(model, noise=Noise(vr.THESIS_NOISE.joint, 1e-5, 1e-4))
    usual = plan(model, 30, pool=200)
    assert not any("outside the region" in words for words in usual.warnings)
    model.mechanism.workspace = Workspace((-0.09, -0.09, 0.12), (0.09, 0.09, 0.28))
    [words] = [w for w in plan(model, 30, pool=200).warnings if "outside the region" in w]
    assert words.endswith("samples of these poses would extend the region")
    [remark] = [w for w in export(model, "c", tmp_path / "c").remarks if "region" in w]
    assert remark == describe_workspace_excess(model)
    write_model(model, tmp_path / "robot.yaml")
    assert run("inverse", tmp_path / "robot.yaml", "--position", "0.05 0 0.2") == 0
    assert "outside the region" not in capsys.readouterr().err
    assert run("inverse", tmp_path / "robot.yaml", "--position", "0.085 0 0.2") == 0
    assert "1 of 1 solutions are outside the region" in capsys.readouterr().err
    assert run("info", tmp_path / "robot.yaml", "--json") == 0
    region = json.loads(capsys.readouterr().out)["region"]
    assert region["position"]["z"] == pytest.approx([0.14, 0.26], abs=4e-3)


def run(*arguments):
    with pytest.raises(SystemExit) as ended:
        cli.main([str(a) for a in arguments])
    return ended.value.code


def test_a_partial_fit_extends_the_region_and_a_fit_of_all_parameters_replaces_it(
    step, inside, wider
):
    few = wider.select(np.arange(40))
    partial = fitted(step.model, few, True, refit=["backlash.*"], hold_out=0).model
    region, before = IdentifiedRegion.of_model(partial), IdentifiedRegion.of_model(step.model)
    own = fit(partial, few, hold_out=0, refit=["backlash.*"]).region
    for axis in "xyz":
        low = min(before.position[axis][0], own.position[axis][0])
        assert region.position[axis][0] == pytest.approx(low, abs=1e-4)
    middle = inside.select(np.flatnonzero(np.abs(inside.r - [0, 0, 0.2]).max(axis=1) < 0.05))
    narrow = fitted(partial, middle, True, hold_out=0, prior=True).model
    assert IdentifiedRegion.of_model(narrow).position["x"] == pytest.approx((-0.05, 0.05), abs=5e-3)


def test_a_history_that_cannot_be_read_states_no_region():
    history = ({"step": "fit", "region": {"position": {"x": "wide"}, "joints": [1, 2]}},)
    model = replace(new_model("delta54"), history=history)
    region = IdentifiedRegion.of_model(model)
    assert not region.compute_excess(np.ones((1, 3)), np.ones((1, 3))).any()


WARM = """from parallel_cal import Effect, Parameter


class Warm(Effect):
    needs = ("temperature",)
    found_in_data = True
    physics = source = "a law of a test"

    def parameters(self, mechanism):
        return [Parameter("gain", "rad/K", 0.0, 1e-4)]

    def ideal(self, seen, e, at, mechanism):
        return seen.with_q(seen.q + e.gain * (at.temperature - 20))
"""


@pytest.fixture(scope="module")
def law(inside, tmp_path_factory):
    """A model with a law that was found in data, tested between 24 and 30 degC."""
    folder = tmp_path_factory.mktemp("law")
    (folder / "warm_of_a_test.py").write_text(WARM)
    sys.path.insert(0, str(folder))
    warm = np.linspace(24.0, 30.0, len(inside))
    data = replace(
        inside,
        conditions={**inside.conditions, "temperature": warm},
        q=inside.q - 2e-4 * (warm - 20)[:, None],
    )
    model = add(new_model("delta54"), "warm_of_a_test", data, force=True).model
    yield replace(model, noise=Noise(vr.THESIS_NOISE.joint, 1e-5, 1e-4)), data
    sys.path.remove(str(folder))
    sys.modules.pop("warm_of_a_test", None)


@pytest.mark.wide
def test_a_law_that_was_found_in_data_is_not_used_in_silence_beyond_what_it_was_tested_in(
    law, tmp_path, capsys
):
    model, data = law
    region = IdentifiedRegion.of_model(parse_model(dump_model(model)))
    assert region.conditions == {"temperature": (24.0, 30.0)}
    words = "beyond the conditions in which warm_of_a_test was found in data"
    tested = "(tested 24..30 degC)"
    assert not any(words in warning for warning in compare(model, data).dataset.warnings)
    hot = replace(data, conditions={**data.conditions, "temperature": np.full(len(data), 41.0)})
    [warning] = [w for w in compare(model, hot).dataset.warnings if words in w]
    assert f"temperature 41 {tested}" in warning
    [remark] = [w for w in export(model, "c", tmp_path / "c").remarks if words in w]
    assert f"temperature 20 {tested}" in remark
    [warning] = [w for w in plan(model, 30, pool=200).warnings if words in w]
    assert tested in warning
    write_model(model, tmp_path / "law.yaml")
    ask = ("direct", tmp_path / "law.yaml", "--joints", "0.5 0.5 0.5", "--at")
    assert run(*ask, "temperature=27") == 0
    assert words not in capsys.readouterr().err
    assert run(*ask, "temperature=35") == 0
    shown = capsys.readouterr().err
    assert shown.count(words) == 1
    assert "temperature 35" in shown


def test_conditions_of_an_effect_whose_physics_is_known_have_no_tested_range(step):
    assert IdentifiedRegion.of_model(step.model).conditions == {}
    rows = np.full((1, len(step.model.conditions)), 99.0)
    assert describe_untested_conditions(step.model, rows) == ""
