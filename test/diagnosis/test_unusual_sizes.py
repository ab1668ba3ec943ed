"""Effects that are larger than usual are named with size and gain; the owner decides."""

import json
from dataclasses import replace

import law_sessions
import numpy as np
import pytest
import virtual_day as vd
import virtual_findings as vf
import virtual_laws
from datasets import measured
from findings import dataset
from scipy.spatial.transform import Rotation
from twins import hexapod

from parallel_cal.base.errors import FitError
from parallel_cal.cli import main as cli
from parallel_cal.diagnosis import diagnose as diagnosing
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.diagnosis.verdict import judge
from parallel_cal.identification.fit import fit
from parallel_cal.identification.unusual import UnusualSize, describe_by_effect
from parallel_cal.model.file.modelfile import read_model, write_model
from parallel_cal.model.model import new_model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.reporting import text
from parallel_cal.reporting.contents import parameters
from parallel_cal.session.steps import add
from parallel_cal.virtual import joint_effects as ve
from parallel_cal.virtual import robot as vr

TESTED = ["backlash", "encoder_eccentricity", "encoder_gain"]


@pytest.fixture(scope="module")
def worn():
    """Gears with up to a degree of backlash: five times what a gear of a robot has."""
    return measured(7, effects=[vr.Backlash((16e-3, 10e-3, 12e-3))])


@pytest.mark.parametrize(
    ("size", "words"),
    [
        (UnusualSize("a.b", 34e-3, 0.0, 3e-3, "rad"), "larger than usual (34 mrad; usual up to 3)"),
        (
            UnusualSize("a.b", -4e-4, -1e-4, 1e-4, "m"),
            "larger than usual (-400 um; usual up to 100)",
        ),
        (UnusualSize("a.b", 2e-3, 0.0, 2e-4, "m"), "larger than usual (2 mm; usual up to 0.2)"),
        (UnusualSize("a.b", 4e-5, 0.0, 1e-5, "m/N"), "larger than usual (40 um/N; usual up to 10)"),
        (UnusualSize("a.b", 0.02, -5e-3, 5e-3, "1"), "larger than usual (0.02; usual up to 0.005)"),
        (UnusualSize("a.b", 2e-4, -2e-6, 1e-4, "1/K"), "(0.0002 1/K; usual -2e-06 to 0.0001)"),
    ],
)
def test_a_size_is_described_in_units_that_people_use(size, words):
    assert words in size.description
    assert size.description.endswith(": a fault, or another effect")


def test_an_effect_is_described_once_by_the_parameter_furthest_outside_its_range():
    sizes = [UnusualSize(f"a.joint{i}", v, 0.0, 1e-3, "rad") for i, v in enumerate((2e-3, 9e-3))]
    assert describe_by_effect(sizes) == {
        "a": "a.joint1 is larger than usual (9 mrad; usual up to 1): a fault, or another effect "
        "(1 more of its parameters are, too)"
    }


@pytest.mark.wide
def test_a_diagnosis_names_the_unusual_effect_its_size_and_its_gain_and_add_accepts_it(worn):
    model = new_model("delta54")
    found = diagnose(model, worn, effects=TESTED)
    assert found.effects == ("backlash",)
    [one] = found.document()["unusual"]
    assert one["effect"] == "backlash"
    assert one["text"] in found.verdict.text
    assert "larger than usual (15.9 mrad; usual up to 3)" in one["text"]
    assert one["parameters"][0]["usual"] == pytest.approx([0.0, 3e-3])
    assert one["holdout_with"]["position_rms"] < 0.1 * one["holdout_without"]["position_rms"]
    [row] = [one for one in found.entries if one.name == "backlash"]
    assert not row.reason  # it was named, not refused
    assert row.alone.after.position_rms == one["holdout_with"]["position_rms"]
    step = add(model, found.additions[0], worn)
    assert not step.acceptance.against
    [words] = [w for w in step.warnings if "larger than usual" in w]
    assert words.startswith("backlash.joint1.width is larger than usual (15.9")
    assert {u["parameter"] for u in step.document()["unusual"]} == {
        f"backlash.joint{i}.width" for i in (1, 2, 3)
    }


@pytest.mark.wide
def test_unusual_sizes_are_stated_in_usual_tolerances_also_by_later_fits(worn, tmp_path):
    """The tolerance that a fit raises follows from the value: in units of it, every unusual size
    would be 8.3 tolerances."""
    first = add(new_model("delta54"), "backlash", worn).result
    write_model(first.model, tmp_path / "worn.yaml")
    later = fit(read_model(tmp_path / "worn.yaml"), worn)
    for found in (first, later):
        moved = [found.parameters()[f"backlash.joint{i}.width"].moved_tolerances for i in (1, 2, 3)]
        assert moved == pytest.approx([16e-3 / 0.3e-3, 10e-3 / 0.3e-3, 12e-3 / 0.3e-3], rel=0.02)
        shown = parameters(found)["backlash.joint1.width"]
        assert shown.sigma_tolerances == pytest.approx(shown.sigma / 0.3e-3)
        assert not [words for words in found.warnings if "width moved" in words]


@pytest.mark.wide
def test_with_two_unusual_effects_each_one_is_named_with_its_own_gain():
    drives, gears = ve.WrongPitch((0.015, -0.01, 0.012)), vr.Backlash((8e-3, 6e-3, 7e-3))
    data = dataset(vf.samples(vf.session(0), [drives, gears], vr.THESIS_NOISE, 0), vr.THESIS_NOISE)
    found = diagnose(new_model("delta54"), data, effects=["encoder_gain", "backlash"])
    assert set(found.effects) == {"encoder_gain", "backlash"}
    for one in found.unusual:
        assert f"{one.name}." in one.description
        assert "this effect changes the error at held-out poses from" in one.description
        assert one.description in found.verdict.text
        assert one.ratio < 0.9


@pytest.mark.wide
def test_the_owner_refuses_unusual_sizes_with_one_option(worn):
    model = new_model("delta54")
    found = diagnose(model, worn, effects=TESTED, usual_only=True)
    assert "backlash" not in found.effects
    assert not found.unusual
    with pytest.raises(FitError, match=r"usual \(15.9 mrad; .*nothing was .*--usual-only"):
        add(model, "backlash", worn, usual_only=True)


@pytest.mark.wide
def test_a_superfluous_effect_is_not_named_to_keep_another_one_in_its_usual_range():
    """Backlash of 7 mrad is larger than usual. Half of it as a hysteresis is not, but explains
    nothing more, so that `add` would refuse it."""
    play = vr.Backlash((6e-3, 5.5e-3, 6.5e-3))
    data = dataset(vf.samples(vf.session(0), [play], vr.THESIS_NOISE, 0), vr.THESIS_NOISE)
    found = diagnose(new_model("delta54"), data)
    [chosen] = found.best.chosen
    assert chosen.name in ("backlash", "hysteresis")
    assert chosen.unusual


@pytest.mark.wide
def test_a_law_outside_the_catalogue_is_searched_before_an_unusual_effect_that_leaves_an_error():
    """A spindle that is softer the more it is loaded: compliance, 24 times the usual, explains a
    part."""
    data, _, _ = law_sessions.hiding("hexapod", virtual_laws.spring, 0, 8.0)
    tested = ["joint_compliance", "encoder_gain"]
    found = diagnose(new_model("stewart42"), data, effects=tested)
    assert found.effects == ("joint_compliance",)
    assert found.verdict.suspected_of_law == ("joint_compliance",)
    assert "joint_compliance leaves an error, so the cause may be" in found.verdict.text
    # `add` takes the sample under the largest load for a knocked one, and so says the diagnosis.
    *_, first, second = found.next_steps
    assert "parallel-cal discover MODEL RECORDING" in first
    assert "parallel-cal add MODEL joint_compliance RECORDING" in second
    assert found.document()["next_steps"] == list(found.next_steps)
    shown = text.show(found)
    last = " ".join(shown[shown.index("next:") :].replace("then:", "").split())
    assert last == " ".join(["next:", *found.next_steps]).replace(": parallel-cal", " parallel-cal")


@pytest.mark.wide
def test_no_law_is_searched_where_an_unusual_effect_leaves_nothing(worn):
    found = diagnose(new_model("delta54"), worn, effects=["backlash"])
    assert not found.verdict.suspected_of_law
    assert found.unusual
    assert found.left == "no"
    [step] = found.next_steps
    assert "parallel-cal add MODEL backlash RECORDING" in step


def run(*arguments):
    with pytest.raises(SystemExit) as ended:
        cli.main([str(a) for a in arguments])
    return ended.value.code


def test_the_command_add_accepts_an_unusual_size_unless_usual_only_is_given(worn, tmp_path, capsys):
    robot, samples, better = (tmp_path / n for n in ("robot.yaml", "samples.json", "better.yaml"))
    write_model(new_model("delta54"), robot)
    worn.to_json(samples)
    assert run("add", robot, "backlash", samples, "--usual-only", "-o", better) != 0
    assert "larger than usual (15.9" in capsys.readouterr().err
    assert not better.exists()
    assert run("add", robot, "backlash", samples, "-o", better, "--json") == 0
    out, err = capsys.readouterr()
    assert "larger than usual (15.9" in err
    assert json.loads(out)["unusual"][0]["usual"] == pytest.approx([0.0, 3e-3])
    assert better.exists()


@pytest.mark.wide
def test_every_verdict_says_robot_or_device_once(monkeypatch):
    seen = []
    monkeypatch.setattr(diagnosing, "judge", lambda found: seen.append(found) or judge(found))
    disc = vr.EncoderEccentricity((2.7e-3, -1.5e-3, 0.9e-3), (-1.2e-3, 2.6e-3, 2.8e-3))
    data = dataset(vf.samples(vf.session(0), [disc], vr.THESIS_NOISE, 0), vr.THESIS_NOISE)
    diagnose(new_model("delta54"), data, effects=["encoder_eccentricity"])
    doubts = replace(seen[0].doubts, robot_or_device=("encoder_eccentricity",))
    doubtful = replace(seen[0], doubts=doubts)
    words = "robot or device: the measuring device may cause encoder_eccentricity"
    verdict = judge(doubtful)
    assert verdict.word == "partly_explained"
    assert verdict.text.count(words) == 1
    unknown = replace(doubtful.rest, noise=replace(doubtful.rest.noise, variance=None))
    verdict = judge(replace(doubtful, rest=unknown))
    assert verdict.word in ("cannot_know", "partly_explained")
    assert verdict.text.count(words) == 1


@pytest.mark.wide
def test_pairs_that_would_be_far_larger_than_usual_are_not_refitted():
    """A hexapod with drives of wrong pitch: no second effect makes their gain a usual one."""
    robot, noise = hexapod(), vr.Noise(2e-6, 5e-6, 10 * vr.ARCSEC)
    rng = np.random.default_rng(9)
    move, turn = rng.uniform(-0.05, 0.05, (108, 3)), vr.turn(rng.uniform(-0.2, 0.2, (108, 3)))
    reading = robot.inverse(robot.home + move, turn)[0]
    pitch = ve.WrongPitch((0.012, 0.0, 0.002, 0.001, -0.001, 0.0))
    _, r, R = vr.truth(robot, [pitch], reading, vr.SampleConditions(*np.zeros((4, 108))))
    q_error, r_error, w_error = vd.errors(noise, 108, 6, 1)
    model, stages = new_model("stewart42"), list[str]()
    data = Dataset.from_arrays(
        model.joints,
        reading + q_error,
        r + r_error,
        vr.turn(w_error) @ R,
        pose_cov=np.diag(np.repeat([noise.position, noise.orientation], 3) ** 2),
        joint_sigma=noise.joint,
    )
    found = diagnose(model, data, progress=lambda stage, share: stages.append(stage))
    assert found.effects == ("encoder_gain",)
    assert found.best.fitted.model.value("encoder_gain.leg1.gain") == pytest.approx(0.012, abs=2e-3)
    assert sum(stage.startswith("refitting") for stage in stages) < 15


@pytest.mark.wide
def test_the_gain_of_an_unusual_effect_is_stated_alone_if_the_others_do_not_fit_without_it():
    """One leg has a gain of 0.4 %, another one backlash. Without the gain, only a negative
    backlash would fit."""
    robot, rng = hexapod(), np.random.default_rng(3)
    n = 100
    r = robot.home + rng.uniform(-0.05, 0.05, (n, 3))
    R = Rotation.from_rotvec(rng.uniform(-0.2, 0.2, (n, 3))).as_matrix()
    q = robot.inverse(r, R)[0]
    direction = np.sign(np.diff(q, axis=0, prepend=0.0))
    q = (q + np.eye(6)[1] * 40e-6 * direction) / (1 + np.eye(6)[2] * 4e-3)
    data = Dataset.from_arrays(
        [f"leg{i}" for i in range(1, 7)],
        q + rng.normal(0, 4e-6, q.shape),
        r + rng.normal(0, 12e-6, r.shape),
        Rotation.from_rotvec(rng.normal(0, 6e-5, r.shape)).as_matrix() @ R,
        pose_cov=np.diag([12e-6**2] * 3 + [6e-5**2] * 3),
        joint_sigma=[4e-6] * 6,
        conditions={f"direction.leg{i + 1}": direction[:, i] for i in range(6)},
    )
    found = diagnose(new_model("stewart42"), data, effects=["encoder_gain", "backlash"])
    assert set(found.effects) == {"encoder_gain", "backlash"}
    [gain] = found.unusual
    assert gain.is_alone
    assert gain.ratio < 0.7
    assert gain.sizes[0].value == pytest.approx(4e-3, abs=0.3e-3)
    assert "alone, this effect changes the error at held-out poses from" in gain.description
    assert gain.description in found.verdict.text
