"""A mechanism that tests share is the shelf's, and no test can change it unseen."""

from functools import cache

import numpy as np
import pytest
import shared_models
from shared_models import new_model

from parallel_cal.model.model import new_model as package


def test_a_shared_model_is_that_of_the_package():
    ours, theirs = (new("slider_crank", effects=["backlash"]) for new in (new_model, package))
    assert ours.table.names == theirs.table.names
    np.testing.assert_array_equal(ours.values, theirs.values)
    assert ours.structure is new_model("slider_crank", effects=["backlash"]).structure


def test_a_test_that_changes_a_shared_mechanism_is_told(monkeypatch):
    """What is derived from it is no change."""
    monkeypatch.setattr(shared_models, "shared", cache(shared_models.shared.__wrapped__))
    model = new_model("slider_crank")
    assert model.structure.rows_function is not None
    assert new_model("slider_crank").mechanism is model.mechanism
    model.mechanism.joint_limits = ((0.0, 1.0),)
    with pytest.raises(AssertionError, match="a test has changed the slider_crank that others"):
        new_model("slider_crank")
