"""The measurement equations by the chain rule, against CasADi's derivatives of the whole."""

import casadi as ca
import numpy as np
import pytest
from camera_cells import Cell

from parallel_cal.base.compiled import Batch, dense
from parallel_cal.base.rotation import rotation_matrix
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_sensor

DEVICE = load_sensor("device_frame", position=(1.0, 2.0, 0.5))


def with_camera(*effects):
    cell = Cell("stewart", 1)
    return new_model(cell.drawn.mechanism, effects=effects, sensors=[cell.sensor()])


MODELS = {
    "no effect": lambda: new_model("rssr"),
    "an effect on the joints": lambda: new_model("delta54", effects=["backlash"]),
    "effects on the geometry": lambda: new_model(
        "delta24", effects=["thermal_expansion", "rod_compliance"]
    ),
    "effects on the pose, and a device": lambda: new_model(
        "stewart42", effects=["base_drift", "device_field"], sensors=[DEVICE]
    ),
    "readings": lambda: with_camera("encoder_gain"),
}


def as_a_whole(s):
    """The rows and their derivatives by an expression of each entry of the configuration."""
    x = ca.vertcat(s.configuration, s.v)
    return Batch(dense("whole", (s.configuration, s.a, s.v), (s.rows, ca.jacobian(s.rows, x))))


@pytest.mark.parametrize("name", MODELS)
def test_rows_and_slopes_are_those_of_the_whole_expression(name):
    model, n, rng = MODELS[name](), 5, np.random.default_rng(1)
    s, joints = model.structure, len(model.joints)
    home = np.array(model.mechanism.home.configuration)
    x = home + 1e-3 * rng.standard_normal((n, len(home)))
    R = rotation_matrix(0.02 * rng.standard_normal((n, 3)))
    R = R @ home[joints + 3 : joints + 12].reshape(3, 3)
    x[:, joints + 3 : joints + 12] = R.reshape(n, 9)
    a = np.array(s.neutral) + 0.3 * rng.standard_normal((n, len(s.conditions)))
    v = model.values + 0.3 * model.table.tolerance * rng.standard_normal(len(model.values))
    rows, by_x, by_v = s.rows_batch(x, a, v)
    expected, J = as_a_whole(s)(x, a, v)
    m, c = rows.shape[1], s.configuration.numel()
    J = J.reshape(n, -1, m)
    turned = np.empty((n, 3, m))
    for k, axis in enumerate(np.eye(3)):  # d R / dw_k = e_k x R, column by column
        moved = np.cross(axis, R, axisb=1, axisc=1).reshape(n, 9)
        turned[:, k] = np.einsum("ne,nem->nm", moved, J[:, joints + 3 : joints + 12])
    by_configuration = [J[:, : joints + 3], turned, J[:, joints + 12 : c]]
    np.testing.assert_allclose(rows, expected, rtol=1e-12, atol=1e-13)
    for found, true in ((by_x, np.concatenate(by_configuration, axis=1)), (by_v, J[:, c:])):
        size = np.abs(true).max()
        np.testing.assert_allclose(found.reshape(n, -1, m), true, atol=1e-12 * size)
