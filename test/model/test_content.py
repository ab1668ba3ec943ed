"""Mechanisms with equal attributes are equal: their models share what is derived from them."""

import pickle
from copy import copy, deepcopy
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from chains import five_bar

from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_mechanism, load_sensor


@pytest.mark.parametrize("name", ["delta24", "scara16", "cable"])
def test_mechanisms_of_one_kind_share_their_structure(name):
    one, other = new_model(name, effects=["backlash"]), new_model(name, effects=["backlash"])
    assert one.mechanism is not other.mechanism
    assert one.mechanism == other.mechanism
    assert hash(one.mechanism) == hash(other.mechanism)
    assert one.structure is other.structure
    assert one.structure is not new_model(name).structure


def test_chains_of_equal_options_share_their_structure_and_others_do_not():
    options = five_bar()
    one, same = (new_model(load_mechanism("chain", **deepcopy(options))) for _ in range(2))
    assert one.structure is same.structure
    longer = new_model(load_mechanism("chain", **five_bar(bar=0.150001)))
    assert one.structure is not longer.structure


def test_a_mechanism_that_is_changed_changes_no_other_model():
    """Neither before the equations are derived nor afterwards, and its own model follows it."""
    changed, other = (new_model("delta24", effects=["joint_compliance"]) for _ in range(2))
    shared = changed.structure
    assert other.structure is shared
    changed.mechanism.gravity = (0.0, 9.81, 0.0)
    assert changed.structure is not shared
    assert other.structure is shared
    row, v = other.mechanism.home.configuration[None], other.values + 1e-3
    changed_rows, other_rows = (
        model.structure.residuals(row, model.condition_rows({"payload": 1.0}, 1), v)[0]
        for model in (changed, other)
    )
    assert np.abs(changed_rows - other_rows).max() > 1e-6


def test_copies_are_equal_in_this_process_and_pickles_bring_no_name_of_another_one():
    mechanism = load_mechanism("stewart42")
    assert copy(mechanism) == mechanism == load_mechanism("stewart42")
    assert "content" in vars(mechanism)
    assert pickle.loads(pickle.dumps(mechanism)) == mechanism
    assert b"content" not in pickle.dumps(mechanism)
    assert mechanism != load_mechanism("delta24")


def test_an_attribute_that_cannot_be_compared_makes_a_mechanism_one_of_a_kind():
    one, other = load_mechanism("delta24"), load_mechanism("delta24")
    one.notes, other.notes = {1, 2}, {1, 2}
    assert one == one
    assert one != other
    assert new_model(one).structure is not new_model(other).structure


def test_wherever_a_device_stands_the_robot_is_solved_by_the_same_functions():
    """Of a fit in a tracker's frame, every fold and every registration has another sensor."""
    bare = new_model("delta24", effects=["joint_compliance"])
    sensors = (load_sensor("device_frame", position=(x, 0.0, 0.0)) for x in (0.0, 0.5))
    here, there = (bare.with_sensors((sensor,)) for sensor in sensors)
    assert here.structure is not there.structure
    solved = [Kinematics(model).direct_problem for model in (bare, here, there)]
    assert solved[0].calls is solved[1].calls is solved[2].calls
    values = 1e-3 + bare.values
    q = bare.mechanism.home.joints
    answers = [
        Kinematics(replace(model, values=np.r_[values, model.values[len(values) :]])).direct(q)
        for model in (bare, here, there)
    ]
    assert answers[0].ok
    np.testing.assert_array_equal(answers[0].position, answers[1].position)
    np.testing.assert_array_equal(answers[0].position, answers[2].position)


def test_a_mechanism_that_keeps_an_expression_is_one_of_a_kind():
    """As the mechanisms do in which a method writes symbols for what it eliminates."""
    one, other = load_mechanism("delta24"), load_mechanism("delta24")
    one.heights = other.heights = ca.SX.sym("h", 3)
    assert one != other
    assert new_model(one).structure is new_model(one).structure
