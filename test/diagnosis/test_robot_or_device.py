"""A robot must not learn its device's errors: what either may have made is said to be doubtful."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import law_sessions
import numpy as np
import pytest
import virtual_blind as vb
import virtual_day as vd
import virtual_effects_more as more
import virtual_findings as vf
import virtual_laws as laws
from datasets import JOINTS, as_dataset, measured
from findings import dataset, hiding, sized
from twins import hexapod

from parallel_cal.base.errors import FitError, ModelError
from parallel_cal.diagnosis import addition
from parallel_cal.diagnosis.catalogue import candidate
from parallel_cal.diagnosis.device import find_doubtful_effects
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.diagnosis.search import Chosen, Search
from parallel_cal.identification.fit import fit, fit_unjudged
from parallel_cal.identification.options import FitOptions
from parallel_cal.identification.platform_shift import explain_unseparated_device
from parallel_cal.model.file.modelfile import read_model, write_model
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_effect, load_sensor
from parallel_cal.posterior.scene import Scene
from parallel_cal.recordings.csv_import import import_csv
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.session.steps import UnprovenStepError, add
from parallel_cal.virtual import joint_effects as ve
from parallel_cal.virtual import robot as vr

VERDICTS = Path(__file__).parents[3] / "shared" / "data" / "verdicts"


@pytest.fixture(scope="module")
def refracted():
    """A robot without hidden effects before a device whose light bends with height."""
    day = vf.session(0)
    bent = sized(vb.DEVICE["refraction"], 2e-5, 1.5, day, vf.FINE, 3)
    return dataset(vf.samples(day, [bent], vf.FINE, 0), vf.FINE)


@pytest.mark.wide
def test_a_field_of_the_device_that_is_larger_than_usual_is_named(refracted):
    """Three times the usual field explains the error; the robot's effects only imitate it."""
    found = diagnose(new_model("delta54"), refracted)
    assert found.effects == ("device_field",)
    assert found.verdict.word == "partly_explained"
    assert "usual up to 0.005): a fault, or another" in found.verdict.text


def sagging(seed):
    """A hexapod that sinks with the payload and a power of its distance from the middle, as no
    effect of the catalogue does: its model, the data, and the true error (m) of a model."""
    data, _, effect = law_sessions.hiding("hexapod", laws.sag, seed, 1.5)

    def error(model):
        return law_sessions.compute_true_error(
            "hexapod", model, effect, seed, float(data.time.max())
        )

    return new_model("stewart42"), data, error


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 4])
def test_a_field_of_the_device_that_goes_with_the_payload_is_the_robots(seed):
    """As a field of the device it would take the mean deflection away from the robot, whose true
    error then rose from 40 to 51 um (seed 0)."""
    model, data, error = sagging(seed)
    found = diagnose(model, data)
    assert found.effects == ("payload_sag",)
    assert found.verdict.word == "partly_explained"
    fitted = add(model, "payload_sag", data)
    plain = error(fit(model, data, hold_out=0).model)
    assert error(fitted.model) < 0.85 * plain
    forced = add(model, "payload_sag+device_field", data, force=True)
    assert error(forced.model) > 1.1 * plain
    for effects in ("payload_sag+device_field", "device_field"):
        with pytest.raises(UnprovenStepError, match="its deflection under the payload"):
            add(model, effects, data)


@pytest.mark.wide
def test_an_error_that_goes_with_the_payload_is_told_from_one_of_the_device(refracted):
    """The same field under both payloads stays with the device; where the payload never changed,
    nothing is said about it."""
    model, data, _ = sagging(0)

    def found(model, data):
        base = fit(model, data, hold_out=0)
        scene = Scene.of(base.model, base.dataset, base.observations, base.free)
        return find_doubtful_effects(scene, [candidate(scene, "device_field")])

    assert np.ptp(refracted.conditions["payload"]) > 0
    assert found(new_model("delta54"), refracted) == []
    assert found(model, data) == ["device_field"]
    same = replace(data, conditions=data.conditions | {"payload": np.full(len(data), 1.2)})
    assert found(model, same) == []


@pytest.mark.wide
def test_a_scale_of_the_device_that_the_samples_do_not_separate_from_the_robot_is_refused():
    """A stand that yields: after the field, the device's axes would lower the error by 4 um and
    move the robot by 300 um, because a wrong scale of the device imitates a robot of another
    size."""
    rng, day = np.random.default_rng(770000), vf.session(770000, 120, 30)
    yielding = sized(vb.DEVICE["yielding stand"], 2e-5, 1.5, day, vf.FINE, rng.integers(1 << 20))
    data = dataset(vf.samples(day, [yielding], vf.FINE, 0), vf.FINE)
    bent = add(new_model("delta54"), "device_field", data, force=True)
    with pytest.raises(UnprovenStepError, match="the samples do not separate errors of the device"):
        add(bent.model, "device_axes", data)
    forced = add(bent.model, "device_axes", data, force=True)
    shift = forced.platform_shift
    assert shift.measured > 10 * shift.shown
    assert explain_unseparated_device(bent.rival, bent.result) == ""


def test_what_is_certain_among_all_causes_is_not_doubted(monkeypatch):
    """However well a device alone would imitate it: others, not added yet, leave it no room."""
    base = fit(new_model("delta54"), measured(3, effects=[vr.Backlash((2e-3,) * 3)]), hold_out=0)
    scene = Scene.of(base.model, base.dataset, base.observations, base.free)
    monkeypatch.setattr("parallel_cal.diagnosis.device._compute_probability", lambda *_: 1.0)
    chosen = [candidate(scene, name) for name in ("backlash", "encoder_eccentricity")]
    assert find_doubtful_effects(scene, chosen) == ["encoder_eccentricity"]


@pytest.mark.wide
def test_an_effect_that_the_device_may_cause_is_added_only_with_force(refracted):
    with pytest.raises(FitError, match="the measuring device may cause"):
        add(new_model("delta54"), "encoder_eccentricity", refracted)
    step = add(new_model("delta54"), "encoder_eccentricity", refracted, force=True)
    assert "the measuring device may cause" in step.model.history[-1]["forced"]


def test_a_doubt_about_the_device_says_with_how_many_of_many_samples_it_was_weighed(
    refracted, monkeypatch
):
    monkeypatch.setattr(addition, "MAX_DIAGNOSED_SAMPLES", 80)
    monkeypatch.setattr("parallel_cal.posterior.scene.MIN_POSES_OF_PART", 40)
    words = r"the measuring device may cause.*\(weighed with 7\d of 150 samples, evenly spread"
    with pytest.raises(FitError, match=words):
        add(new_model("delta54"), "encoder_eccentricity", refracted)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 18])
def test_a_dent_in_the_devices_field_teaches_the_robot_nothing(seed):
    """A spot of 20 mm, a third of a millimetre deep: waves of joint angles follow it."""
    dented = dent(seed)
    found = diagnose(new_model("delta54"), dented)
    assert not [name for name in found.effects if not load_effect(name).of_device]
    assert found.left == "yes"
    assert found.explanation.laws["field of the device"] > 0.99
    with pytest.raises(UnprovenStepError):
        add(new_model("delta54"), "gear_transmission_error", dented)


def dent(seed):
    day, rng = vf.session(seed), np.random.default_rng(seed)
    make, noise = vf.OUTSIDE["a dented field"], vr.THESIS_NOISE
    deep = sized(make, 0.5e-3, 1.5, day, noise, rng.integers(1 << 20))
    return dataset(vf.samples(day, [deep], noise, seed), noise)


@pytest.mark.slow
def test_an_eccentric_disc_keeps_its_name_whatever_the_certificate_allows():
    """Discs 60 um off-centre leave 12 um. A device may err by as much, but not in this form."""
    disc = vr.EncoderEccentricity((2.7e-3, -1.5e-3, 0.9e-3), (-1.2e-3, 2.6e-3, 2.8e-3))
    data = dataset(vf.samples(vf.session(0), [disc], vr.THESIS_NOISE, 0), vr.THESIS_NOISE)
    for accuracy in (10e-6, 100e-6):
        found = diagnose(certified(accuracy), data)
        assert (found.verdict.word, found.robot_or_device) == ("explained", ())
        assert found.effects == ("encoder_eccentricity",)


def certified(accuracy, **options):
    sensor = load_sensor("certificate", volumetric_accuracy=accuracy, **options)
    return new_model("delta54", sensors=[sensor])


def test_the_tolerances_from_a_certificate_cause_the_stated_error_at_the_workspace_corner(tmp_path):
    model = certified(60e-6, scale=7e-6)
    for effect in ("device_field", "device_axes", "base_drift"):
        model = model.with_effect(effect)
    low, high = model.mechanism.workspace.low, model.mechanism.workspace.high
    reach = np.linalg.norm(np.subtract(high, low)) / 2
    bend = model.table["device_field.x_xy"]
    # Six terms of one axis, each so large at the corner, drawn independently.
    assert 6**0.5 * bend.tolerance * reach**2 == pytest.approx(60e-6)
    assert bend.high == pytest.approx(10 * bend.tolerance)
    assert model.table["device_axes.scale_x"].tolerance == 7e-6
    assert 3**0.5 * model.table["device_axes.square_xy"].tolerance * reach == pytest.approx(60e-6)
    assert model.table["base_drift.v_x"].tolerance == pytest.approx(3e-7)
    bent = model.with_values(model.table.vector({"device_field.x_xy": 5 * bend.tolerance}))
    write_model(bent, tmp_path / "bent.yaml")
    assert read_model(tmp_path / "bent.yaml").table["device_field.x_xy"] == bend


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"kind": "laser_trackr"}, "no kind 'laser_trackr'; did you mean 'laser_tracker'"),
        ({}, "expected a kind of device, or a volumetric_accuracy"),
        ({"volumetric_accuracy": -1e-5}, "above 0"),
    ],
)
def test_an_empty_certificate_is_refused(options, words):
    with pytest.raises(ModelError, match=words):
        load_sensor("certificate", **options)


def test_a_kind_of_device_has_what_its_data_sheets_promise():
    tracker = new_model("delta54", sensors=[load_sensor("certificate", kind="laser_tracker")])
    assert tracker.with_effect("device_axes").table["device_axes.scale_x"].tolerance == 10e-6


@pytest.mark.slow
def test_a_refused_lookalike_of_two_effects_together_is_no_objection_to_one_of_them():
    """Compliance and eccentricity: a sag out of its range fits better than either alone."""
    day = vf.session(0)
    kinds = [vf.KINDS["eccentricity"], vf.KINDS["joint compliance"]]
    hidden = [sized(k.make, k.size, 0.8, day, vr.THESIS_NOISE, 0) for k in kinds]
    data = dataset(vf.samples(day, hidden, vr.THESIS_NOISE, 0), vr.THESIS_NOISE)
    found = diagnose(new_model("delta54"), data)
    assert len(found.effects) == 2
    assert "joint_compliance" in found.effects
    assert found.verdict.word == "explained"


@pytest.mark.wide
def test_a_weak_effect_beside_a_strong_one_is_compared_with_what_both_leave():
    """Not against what the geometry leaves, which is ten times the noise here."""
    day = vf.session(0)
    kinds = [(vf.KINDS["backlash"], 3.0), (vf.KINDS["joint compliance"], 0.2)]
    hidden = [sized(k.make, k.size, times, day, vr.THESIS_NOISE, 0) for k, times in kinds]
    data = dataset(vf.samples(day, hidden, vr.THESIS_NOISE, 0), vr.THESIS_NOISE)
    found = diagnose(new_model("delta54"), data)
    assert len(found.effects) == 2
    assert not found.robot_or_device
    assert found.verdict.word == "explained"


@pytest.mark.wide
@pytest.mark.parametrize("kind", ["eccentricity", "joint compliance"])
def test_an_effect_that_no_usual_device_error_imitates_is_explained_as_the_robots(kind):
    data, _ = hiding([vf.KINDS[kind]], 0.4, 1)
    found = diagnose(new_model("delta54"), data)
    assert found.verdict.word == "explained"
    assert not found.robot_or_device


@pytest.mark.wide
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_axes_that_lean_by_a_milliradian_keep_their_name(seed):
    """A bent field imitates them, with three times as many numbers. They are so large that the
    samples do not separate them from the size of the robot: `add` refuses them for this reason."""
    data, _ = hiding([vf.KINDS["leaning axes"]], 2.0, seed)
    found = diagnose(new_model("delta54"), data)
    assert found.effects == ("device_axes",)
    assert not found.robot_or_device
    assert found.verdict.word == "partly_explained"
    assert len(found.verdict.against) == 1
    assert "the samples do not separate errors of the device" in found.verdict.against[0]
    assert found.unseparated == ("device_axes",)
    assert found.next_steps[0].startswith("once you know whether the robot or the device errs")
    # The command without --force is refused.
    assert found.next_steps[0].endswith(" device_axes RECORDING -o BETTER.yaml --force")
    refused = found.doubted.acceptance
    assert refused.device_may_err
    other = replace(refused, device_may_err=False)  # refused for another reason: no proposal
    doubted = SimpleNamespace(acceptance=other, text="device_axes")
    none = replace(found, confirmed=replace(found.confirmed, doubted=doubted))
    assert not any("parallel-cal add" in step for step in none.next_steps)


@pytest.mark.wide
@pytest.mark.parametrize(
    "bend", [(-0.94e-3, -1.27e-3), pytest.param((-1.62e-3, 1.68e-3), marks=pytest.mark.slow)]
)
def test_light_that_bends_before_a_stewart_platform_is_the_devices(bend):
    """Over a low workspace its parabola is a lean of the axes, which gains of the legs imitate."""
    form = np.zeros((3, 3, 3))
    form[:2, 2, 2] = bend
    found = diagnose(new_model("stewart42"), before_hexapod(more.BentSpace(tuple(form), (0, 0, 0))))
    assert set(found.effects) <= {"device_axes", "device_field"}
    assert found.effects


@pytest.mark.wide
def test_what_add_refuses_because_it_would_move_the_robot_the_diagnosis_says_first():
    """Leaning axes of the device move a hexapod much further than the errors show."""
    form = np.zeros((3, 3, 3))
    form[:2, 2, 2] = (-0.94e-3, -1.27e-3)
    data = before_hexapod(more.BentSpace(tuple(form), (0, 0, 0)))
    tested = ["device_axes", "encoder_gain"]
    found = diagnose(new_model("stewart42"), data, effects=tested)
    assert found.effects == ("device_axes",)
    with pytest.raises(UnprovenStepError, match="the samples do not separate") as refused:
        add(new_model("stewart42"), "device_axes", data)
    assert found.verdict.word == "partly_explained"
    assert refused.value.against in found.verdict.text


def before_hexapod(device=None, seed=1, leg_error=None):
    """120 poses of a Stewart platform and 30 of them again, as a device shows them; `leg_error`
    gives what the legs are longer than they should be (n, 6) from the platform's offset (n, 3)."""
    robot, rng = hexapod(), np.random.default_rng([seed, 9])
    noise = vr.Noise(2e-6, 5e-6, 10 * vr.ARCSEC)
    r, R = (
        robot.home + rng.uniform(-0.05, 0.05, (120, 3)),
        vr.turn(rng.uniform(-0.2, 0.2, (120, 3))),
    )
    pose = rng.permutation(np.concatenate([np.arange(120), rng.choice(120, 30, replace=False)]))
    r, R = r[pose], R[pose]
    reading = robot.inverse(r, R)[0]
    if leg_error is not None:
        reading = reading - leg_error(r - robot.home)
    if device is not None:
        _, r, R = vr.truth(robot, [device], reading, vr.SampleConditions(*np.zeros((4, 150))))
    q_error, r_error, w_error = vd.errors(noise, 150, 6, seed)
    sigma = np.repeat([noise.position, noise.orientation], 3)
    return Dataset.from_arrays(
        new_model("stewart42").joints,
        reading + q_error,
        r + r_error,
        vr.turn(w_error) @ R,
        pose_cov=np.diag(sigma**2),
        joint_sigma=noise.joint,
        pose_id=pose,
    )


@pytest.mark.slow
def test_a_leg_that_is_softer_towards_one_side_does_not_teach_the_model_a_field_of_the_device():
    """No effect of the catalogue describes it; a bent field follows it best."""

    def yielding(offset):
        sideways = offset @ np.array([0.6, 0.8, 0.0])
        return np.outer(-4e-3 * np.maximum(sideways, 0.0), np.arange(6) == 1)

    data = before_hexapod(leg_error=yielding)
    words = "robot or device: the robot may cause device_field: errors of its joints, or"
    with pytest.raises(UnprovenStepError, match=words):
        add(new_model("stewart42"), "device_field", data)
    found = diagnose(new_model("stewart42"), data)
    assert found.verdict.word == "partly_explained"
    blamed = {name for name in found.effects if load_effect(name).of_device}
    assert blamed <= set(found.robot_or_device)


@pytest.mark.wide
def test_what_two_effects_of_the_robot_take_from_each_other_is_not_blamed_on_the_device():
    """Beside a hysteresis, backlash explains nothing more, and the reverse; a device knows no
    direction of approach."""
    play = vr.Backlash((0.5e-3, 0.4e-3, 0.6e-3))
    data = dataset(vf.samples(vf.session(0), [play], vr.THESIS_NOISE, 0), vr.THESIS_NOISE)
    result = fit(new_model("delta54"), data, hold_out=0)
    scene = Scene.of(result.model, result.dataset, result.observations, result.free)
    alike = [candidate(scene, name) for name in ("backlash", "hysteresis")]
    assert find_doubtful_effects(scene, alike) == []


@pytest.mark.wide
def test_an_effect_larger_than_usual_is_preferred_to_a_lookalike_that_fits_worse():
    """Drives that go 2 % too far: no eccentric disc, though discs may be off by as much."""
    data = dataset(
        vf.samples(vf.session(0), [ve.WrongPitch((0.02, -0.015, 0.018))], vr.THESIS_NOISE, 0),
        vr.THESIS_NOISE,
    )
    found = diagnose(new_model("delta54"), data, effects=["encoder_gain", "encoder_eccentricity"])
    assert found.verdict.word == "partly_explained"
    assert found.effects == ("encoder_gain",)
    assert "gain is larger than usual (0.0196; usual up to 0.005)" in found.verdict.text


@pytest.mark.wide
def test_a_device_effect_that_another_outdoes_is_not_added():
    """Leaning axes are not what a stand that gives way does; what is, has an implausible size."""
    day = vf.session(201)
    stand = sized(vb.DEVICE["yielding stand"], 2e-5, 1.2, day, vf.FINE, 3)
    yielding = dataset(vf.samples(day, [stand], vf.FINE, 0), vf.FINE)
    better = "device_field explains the error clearly better than 'device_axes'"
    with pytest.raises(FitError, match=f"{better}|the robot may cause device_axes"):
        add(new_model("delta54"), "device_axes", yielding)


PLAY = vr.Backlash((0.6e-3, 0.5e-3, 0.4e-3))


@pytest.mark.wide
def test_backlash_is_named_beside_the_larger_model_where_only_positions_were_measured():
    """The platform tilts: model 24 needs the larger model, whose closure has more rows."""
    samples = vd.dwell_samples(vr.MOCK_UP, seed=0, noise=vf.FINE, effects=[PLAY], n_poses=70)
    only_position = np.tile([True] * 3 + [False] * 3, (len(samples["q"]), 1))
    data = as_dataset(samples, vf.FINE, only_position)
    tried = ["backlash", "parallelogram_errors", "device_axes"]
    found = diagnose(new_model("delta24"), data, effects=tried)
    assert set(found.effects) == {"backlash", "parallelogram_errors"}
    assert found.verdict.word == "explained"
    assert not found.robot_or_device
    estimated = found.best.fitted.parameters()
    widths = [estimated[f"backlash.{joint}.width"].value for joint in JOINTS]
    np.testing.assert_allclose(widths, PLAY.width, rtol=0.1)


@pytest.mark.wide
@pytest.mark.skipif(not VERDICTS.exists(), reason=f"needs {VERDICTS}, which is not in every clone")
def test_the_shared_session_of_positions_alone_names_its_backlash():
    table, columns = (VERDICTS / f"positions_model24.{end}" for end in ("csv", "columns.yaml"))
    model = read_model(VERDICTS / "positions_model24.model.yaml")
    found = diagnose(model, import_csv(table, columns))
    causes = [set(one["effects"]) for one in found.missing]
    assert {"parallelogram_errors"} in causes
    assert {"backlash", "hysteresis"} in causes  # the visits of this session do not tell them apart
    assert found.verdict.word == "explained"


@pytest.mark.wide
@pytest.mark.parametrize("order", [1, -1])
def test_effects_are_weighed_on_the_rows_of_the_larger_model_where_that_is_chosen(order):
    """One of the effects makes sense for the larger model only: it has no scene of its own."""
    result = fit(new_model("delta24"), measured(0, effects=[PLAY]), hold_out=0)
    scene = Scene.of(result.model, result.dataset, result.observations, result.free)
    names = ["backlash", "parallelogram_errors", "target_offset"]
    chosen = [candidate(scene, name) for name in names[::order]]
    assert {one.scene and one.scene.rows for one in chosen} == {3, 6, None}
    assert find_doubtful_effects(scene, chosen) == []


@pytest.mark.wide
def test_an_effect_that_only_the_larger_model_can_have_fails_without_it_and_says_why():
    data = measured(0, effects=[PLAY])
    search = Search(
        new_model("delta24"),
        lambda model, insist, *_: fit_unjudged(model, data, FitOptions(insist=insist)),
        lambda stage, fraction: None,
    )
    both = search.fit(Chosen("parallelogram_errors"), Chosen("target_offset"))
    assert both.result is not None
    alone = search.fit(Chosen("target_offset"))
    assert alone.result is None
    assert "the platform does not rotate" in alone.reason
