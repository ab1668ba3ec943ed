"""What every effect on the shelf keeps to, on every mechanism where it makes sense."""

from __future__ import annotations

import ast
import sys
from pathlib import Path

import numpy as np
import pytest

from parallel_cal.base.errors import ModelError
from parallel_cal.base.rotation import quaternion_to_matrix, rotation_matrix
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.effect import CONDITIONS, Effect, format_effect, parse_effects
from parallel_cal.model.file.modelfile import dump_model, parse_model
from parallel_cal.model.mechanism import poses_in_workspace
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import list_plugins, load_effect, load_mechanism, load_sensor

HERE = Path(__file__).parent
EFFECTS = list_plugins("effects")
MECHANISMS = (
    *("delta54", "delta24", "stewart42", "planar_stewart", "argos27", "argos9"),
    *("scara16", "cable", "linear_delta", "slider_crank"),
)
SAMPLES = 12
PROBE = load_sensor("probe", height=0.2, tip=(0.01, 0.02, 0.0), mounted=True)
# What a session may bring, around the value that means "nothing special".
SPREAD = {
    **{"time": 3000.0, "temperature": 8.0, "payload": 2.0},
    **{"velocity": 0.5, "acceleration": 5.0, "travel": 0.1},
}


def accepted(mechanism):
    """Effects that make sense for it."""
    return [name for name in EFFECTS if not load_effect(name).applies(mechanism)]


PAIRS = [(m, e) for m in MECHANISMS for e in accepted(load_mechanism(m))]
REFUSED = [(m, e) for m in MECHANISMS for e in EFFECTS if (m, e) not in PAIRS]
each_effect = pytest.mark.parametrize("name", EFFECTS)
each_pair = pytest.mark.parametrize(("mechanism", "name"), PAIRS)


def without(mechanism, name):
    """The model before the effect, with a sensor where the effect is on what one reads."""
    return new_model(mechanism, sensors=[PROBE] if load_effect(name).reads else [])


def configurations(mechanism, rng):
    """(n, nq + 12) rows about home that need not close; only moved coordinates differ."""
    m, home = mechanism, mechanism.home
    scale = [0.3 if unit == "rad" else 0.02 for unit in m.joint_units]
    q = np.array(home.joints) + rng.uniform(-1, 1, (SAMPLES, len(scale))) * scale
    move = np.zeros((SAMPLES, 6))
    move[:, m.moved] = rng.uniform(-1, 1, (SAMPLES, len(m.moved)))
    r = np.array(home.position) + 0.05 * move[:, :3]
    R = rotation_matrix(0.2 * move[:, 3:]) @ quaternion_to_matrix(np.array(home.quaternion))
    return np.hstack([q, r, R.reshape(-1, 9)])


def circumstances(conditions, rng):
    """(n, n_conditions) rows, each condition drawn as a session may bring it."""
    rows = np.empty((SAMPLES, len(conditions)))
    for k, condition in enumerate(conditions):
        name = condition.split(".")[0]
        if name == "session":
            rows[:, k] = np.arange(SAMPLES) % 4
        elif name == "direction":
            rows[:, k] = rng.choice([-1.0, 1.0], SAMPLES)
        else:
            rows[:, k] = CONDITIONS[name][1] + SPREAD[name] * rng.uniform(0.1, 1, SAMPLES)
    return rows


def evaluated(model, x, a, values=None):
    """Rows (closure, then readings) and d rows / dv at each configuration."""
    values = model.values if values is None else values
    rows, _, by_v = model.structure.rows_batch(x, a, values)
    return rows, by_v.reshape(len(x), -1, rows.shape[1]).transpose(0, 2, 1)


def own(model, name):
    """Mask of the effect's free parameters."""
    mine = np.array([n.startswith(f"{name}.") for n in model.table.names])
    return mine & ~model.fixed


@pytest.mark.wide
@each_pair
def test_an_effect_that_was_only_added_changes_nothing(mechanism, name):
    plain = without(mechanism, name)
    model, rng = plain.with_effect(name), np.random.default_rng(1)
    if model.mechanism is not plain.mechanism:  # a larger model in its stead: the same poses
        q = np.array(plain.mechanism.home.joints) + rng.uniform(-0.05, 0.05, (5, 3))
        one, other = (Kinematics(m).direct(q).position for m in (plain, model))
        np.testing.assert_allclose(one, other, atol=1e-12)
        return
    x = configurations(plain.mechanism, rng)
    before, _ = evaluated(plain, x, np.zeros((SAMPLES, 0)))
    after, _ = evaluated(model, x, circumstances(model.conditions, rng))
    np.testing.assert_array_equal(after, before)


@pytest.mark.wide
@each_pair
def test_every_free_number_is_felt(mechanism, name):
    model, rng = without(mechanism, name).with_effect(name), np.random.default_rng(2)
    grown = model.mechanism.name != mechanism  # what was added are the larger model's own numbers
    free = ~model.fixed if grown else own(model, name)
    assert free.any()
    drawn = np.where(free, model.table.tolerance * rng.uniform(0.5, 1, len(free)), 0)
    x = configurations(model.mechanism, rng)
    at = circumstances(model.conditions, rng)
    _, by_number = evaluated(model, x, at, model.values + drawn)
    felt = np.abs(by_number).max(axis=(0, 1)) * model.table.tolerance > 1e-9
    unfelt = [n for n, f, p in zip(model.table.names, free, felt, strict=True) if f and not p]
    assert unfelt == []


@pytest.mark.parametrize(("mechanism", "name"), REFUSED)
def test_where_an_effect_makes_no_sense_it_is_refused_with_the_reason(mechanism, name):
    model = new_model(mechanism)
    reason = load_effect(name).applies(model.mechanism)
    with pytest.raises(
        ModelError, match=f"effect {name} does not apply to {mechanism}: "
    ) as refusal:
        model.with_effect(name)
    assert str(refusal.value).endswith(reason)


@pytest.mark.parametrize("name", [n for n in EFFECTS if load_effect(n).reads])
def test_an_effect_on_readings_needs_a_sensor_that_takes_them(name):
    with pytest.raises(ModelError, match="no sensor measures probe") as refusal:
        new_model("stewart42").with_effect(name)
    assert str(refusal.value).startswith(f"effect {name} does not apply to stewart42: ")


@each_pair
def test_a_model_file_keeps_an_effect_with_its_numbers(mechanism, name):
    model = without(mechanism, name).with_effect(name)
    free = own(model, name)
    model = model.with_values(model.values + np.where(free, 0.5 * model.table.tolerance, 0))
    again = parse_model(dump_model(model), "file")
    assert [effect.name for effect in again.effects] == [effect.name for effect in model.effects]
    assert again.table.names == model.table.names
    np.testing.assert_array_equal(again.values, model.values)
    np.testing.assert_array_equal(again.fixed, model.fixed)


@each_pair
def test_numbers_have_a_physical_range_around_no_effect(mechanism, name):
    model = without(mechanism, name).with_effect(name)
    for parameter in load_effect(name).table(model.mechanism):
        assert parameter.tolerance > 0, parameter.name
        assert parameter.low <= parameter.nominal <= parameter.high, parameter.name
        assert np.isfinite([parameter.low, parameter.high]).any(), parameter.name


# Where nothing is tried, the effect is as it was added: one mechanism shows that for each.
SEARCHED = [
    (mechanism, name)
    for mechanism, name in PAIRS
    if type(load_effect(name)).scan is not Effect.scan
    or mechanism == next(m for m, other in PAIRS if other == name)
]


@pytest.mark.wide
@pytest.mark.parametrize(("mechanism", "name"), SEARCHED)
def test_a_search_tries_only_numbers_that_are_not_identified(mechanism, name):
    model, rng = without(mechanism, name), np.random.default_rng(4)
    q = configurations(model.mechanism, rng)[:, : len(model.joints)]
    recorded = {"time": 10.0 * np.arange(SAMPLES), "payload": np.ones(SAMPLES)}
    recorded |= dict(zip(model.joints, q.T, strict=True))
    settings = list(load_effect(name).scan(model.mechanism, recorded))
    assert settings
    for setting in (settings[0], settings[-1]):
        set_so = model.with_effect(name, setting)
        for key, value in setting.items():
            i = set_so.table.index_of(f"{name}.{key}")
            assert set_so.fixed[i]
            assert set_so.values[i] == value
        parse_model(dump_model(set_so), "file")  # and a file may hold it


@each_effect
def test_an_effect_says_what_it_is_where_it_comes_from_and_what_it_resembles(name):
    effect = load_effect(name)
    assert effect.physics.endswith(".")
    assert effect.source
    assert type(effect).__doc__
    assert set(effect.needs) <= set(CONDITIONS)
    assert effect.lookalikes
    assert set(effect.lookalikes) <= set(EFFECTS) - {name}
    assert effect.separated_by
    assert effect.remedy
    assert not effect.remedy.endswith(".")


@each_effect
def test_a_lookalike_names_the_effect_in_turn_unless_it_is_on_more_machines(name):
    """An effect of every machine need not name each effect that only some machines have, nor a
    special case the one that generalizes it: the diagnosis compares these by itself."""
    effect = load_effect(name)

    def machines(one):
        return {m for m, other in PAIRS if other == one}

    for other in set(effect.lookalikes) - set(effect.generalizes):
        if machines(other) <= machines(name):
            assert name in load_effect(other).lookalikes


@each_effect
def test_an_effect_is_compared_with_hand_worked_numbers_or_an_independent_robot(name):
    """Some test of a group of effects applies it, with numbers that are not the package's own."""
    groups = [ast.parse(p.read_text(encoding="utf-8")) for p in HERE.glob("test_effects_*.py")]
    strings = {n.value for tree in groups for n in ast.walk(tree) if isinstance(n, ast.Constant)}
    assert name in {str(one).partition(":")[0] for one in strings}


def with_all(mechanism):
    """A model with every effect that suits, each number off by half its tolerance."""
    model = new_model(mechanism, sensors=[PROBE])
    for name in EFFECTS:
        if not load_effect(name).applies(model.mechanism):
            model = model.with_effect(name)
    free = np.any([own(model, effect.name) for effect in model.effects], axis=0)
    return model.with_values(model.values + np.where(free, 0.5 * model.table.tolerance, 0))


@pytest.mark.wide
@pytest.mark.parametrize("mechanism", MECHANISMS)
def test_with_all_effects_at_once_the_direct_problem_undoes_the_inverse(mechanism):
    model, rng = with_all(mechanism), np.random.default_rng(3)
    rows = circumstances(model.conditions, rng)
    at = dict(zip(model.conditions, rows.T, strict=True))
    r, R = poses_in_workspace(model.mechanism, SAMPLES, rng)
    joints = Kinematics(model).inverse(r, R, at)
    pose = Kinematics(model).direct(joints.joints, at)
    assert joints.ok.all()
    np.testing.assert_allclose(pose.position, joints.position, atol=1e-12)
    np.testing.assert_allclose(pose.rotation, joints.rotation, atol=1e-11)


USERS = '''
"""Wear of a brake: the crank slips a little with every hour."""

from parallel_cal.model.effect import Effect
from parallel_cal.model.parameters import Parameter


class Slip(Effect):
    """q_ideal = q - rate * time."""

    needs = ("time",)
    physics = "A worn brake slips."
    source = "the workshop's log"

    def parameters(self, mechanism):
        return [Parameter("rate", "rad/s", 0.0, 1e-6, low=0.0, high=1e-5)]

    def ideal(self, seen, e, at, mechanism):
        return seen.with_q(seen.q - e.rate * at.time)
'''


def test_a_users_own_effect_acts_after_ours(tmp_path, monkeypatch):
    package = tmp_path / "workshop"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "slip.py").write_text(USERS)
    monkeypatch.syspath_prepend(str(tmp_path))
    numbers = {"encoder_gain.crank.gain": 1e-3, "workshop.slip.rate": 2e-6}
    model = new_model("slider_crank", numbers, effects=["encoder_gain", "workshop.slip"])
    assert model.conditions == ("time",)
    answer = Kinematics(model).direct(np.array([0.5]), at={"time": 1000.0})
    expected = Kinematics(new_model("slider_crank")).direct(np.array([0.5 * 1.001 - 2e-3]))
    np.testing.assert_allclose(answer.position, expected.position, atol=1e-15)
    again = parse_model(dump_model(model), "file")
    assert [effect.name for effect in again.effects] == ["encoder_gain", "workshop.slip"]


@pytest.mark.parametrize(
    ("right", "wrong", "words"),
    [
        ("def ideal", "def ideally", "slip: TypeError: Can't instantiate abstract class Slip"),
        (
            '("time",)',
            '("hour",)',
            "slip needs the condition 'hour', which is unknown; known conditions: time, ",
        ),
        ('"rad/s"', '"deg/s"', "slip.rate has the unit deg, expected SI units"),
        ("0.0, 1e-6", "0.0, 0.0", "slip.rate: tolerance is 0.0, expected above 0"),
        ("seen.with_q(seen.q - e.rate * at.time)", "seen.q", "slip: ideal returns a SX"),
        (
            "seen.with_q(",
            "seen.with_q([1, 2] + ",
            "slip: ideal returns q, r, R of shapes [(2, 1), ",
        ),
        ("e.rate", "e.speed", "slip: no entry 'workshop_wrong.slip.speed'; there are"),
        ("at.time", "at.hour", "slip: no entry 'hour'; there are time"),
    ],
)
def test_a_users_effect_with_a_mistake_is_refused_in_one_line(
    right, wrong, words, tmp_path, monkeypatch
):
    package = tmp_path / "workshop_wrong"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "slip.py").write_text(USERS.replace(right, wrong))
    monkeypatch.syspath_prepend(str(tmp_path))
    for name in ("workshop_wrong", "workshop_wrong.slip"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    with pytest.raises(ModelError) as caught:
        Kinematics(new_model("slider_crank", effects=["workshop_wrong.slip"])).direct(np.ones(1))
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_pattern_sets_all_joints_and_is_printed_as_it_is_read():
    model = new_model("delta24")
    text = "hysteresis:*.width=0.00222"
    ((name, settings),) = parse_effects(text)
    worn = model.with_effect(name, settings)
    widths = worn.table.matching(["hysteresis.*.width"])
    assert worn.values[widths].tolist() == [0.00222] * 3
    assert np.asarray(worn.fixed)[widths].all()
    each = {f"{joint}.width": 0.00222 for joint in worn.joints}
    assert format_effect("hysteresis", each, worn.table.names) == text
    other = each | {f"{worn.joints[0]}.width": 0.001}
    assert parse_effects(format_effect("hysteresis", other, worn.table.names)) == [
        ("hysteresis", other)
    ]
    with pytest.raises(ModelError, match=r"no parameter matches 'hysteresis\.\*\.breadth'"):
        model.with_effect("hysteresis", {"*.breadth": 0.1})
