"""One function is one: on the virtual machine, compiled, and without common parts shared."""

from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from parallel_cal.base import compiled
from parallel_cal.base.rotation import rotation_matrix
from parallel_cal.identification import linearisation
from parallel_cal.identification.linearisation import Linearisation
from parallel_cal.identification.observations import Observations
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model import structure
from parallel_cal.model.model import Structure, new_model

STEP = 1e-6  # m and rad


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("PARALLEL_CAL_COMPILE", raising=False)


def configurations(model, n):
    """Poses of the workspace, the platform moved off them a little, so that no row is zero."""
    rng = np.random.default_rng(3)
    pose = Kinematics(model).inverse(model.mechanism.sample(n, rng))
    R = rotation_matrix(0.02 * rng.standard_normal((n, 3))) @ pose.rotation
    r = pose.position + 1e-3 * rng.standard_normal((n, 3))
    return np.hstack([pose.joints, r, R.reshape(n, 9)])


def samples(model, n):
    return Observations(
        configurations(model, n),
        np.tile(1e-8 * np.eye(9), (n, 1, 1)),
        np.ones((n, 9), bool),
        np.ones((n, len(model.structure.conditions))),
        np.arange(n),
        np.zeros((n, 0)),
        {},
    )


def linearised(model, observations):
    return Linearisation(model, observations, ~model.fixed, True)(model.values, observations.x)


def test_after_many_samples_all_models_of_a_mechanism_share_machine_code_with_the_same_result(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(structure, "MIN_SAMPLES_TO_COMPILE", 1000)
    structure._cached_structure.cache_clear()
    plain = new_model("delta24")
    models = [plain, *(plain.with_effect(name) for name in ("backlash", "encoder_gain"))]
    first = [linearised(model, samples(model, 520)) for model in models[:2]]
    assert not list(tmp_path.rglob("*.so"))
    again = [linearised(model, samples(model, 520)) for model in models]
    assert len(list(tmp_path.rglob("*.so"))) == 1
    for before, after in zip(first, again, strict=False):
        np.testing.assert_array_equal(after.residual, before.residual)
        np.testing.assert_array_equal(after.jacobian, before.jacobian)
    structure._cached_structure.cache_clear()


def test_machine_code_that_is_there_is_taken_long_before_compiling_would_pay(tmp_path):
    compiled.compile_function(squared())
    batch = compiled.Batch(squared(), compile_after=1000)
    given = np.ones((5, 2))
    kinds = []
    for _ in range(3):
        batch(given)
        kinds.append(batch.function.class_name())
    assert kinds == ["SXFunction", "SXFunction", "External"]


@pytest.mark.parametrize("unturned", [False, True], ids=["all measured", "without orientation"])
def test_a_jacobian_too_large_to_hold_is_computed_anew_with_the_same_result(unturned, monkeypatch):
    model = new_model("delta54")
    observations = samples(model, 50)
    observations.measured[::2, 6:] = not unturned
    monkeypatch.setattr(linearisation, "BLOCK", 16)
    held = linearised(model, observations)
    monkeypatch.setattr(linearisation, "MAX_JACOBIAN_BYTES", 0)
    streamed = linearised(model, observations)
    assert isinstance(streamed, linearisation.Streamed)
    step = 1e-2 * model.table.tolerance[~model.fixed]
    for ours, theirs in (
        (streamed.residual, held.residual),
        (streamed.informative, held.informative),
        (streamed.adjusted(step), held.adjusted(step)),
        (streamed.jacobian, held.jacobian),
    ):
        np.testing.assert_array_equal(ours, theirs)
    columns = held.columns
    for ours, theirs in (
        (streamed.normal, columns.T @ columns),
        (streamed.triangle.T @ streamed.triangle, columns.T @ columns),
        (streamed.gradient, columns.T @ held.residual.ravel()),
    ):
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-12 * np.abs(theirs).max())


def test_one_batch_that_pays_for_compiling_is_compiled_before_it_is_evaluated(tmp_path):
    batch = compiled.Batch(squared(), compile_after=1000)
    np.testing.assert_array_equal(batch(np.full((1000, 2), 3.0))[0], 9.0)
    assert batch.function.class_name() == "External"


def test_without_a_compiler_very_many_samples_take_the_virtual_machine(tmp_path, monkeypatch):
    monkeypatch.setenv("PARALLEL_CAL_COMPILE", "never")
    batch = compiled.Batch(squared(), compile_after=5)
    for _ in range(3):
        np.testing.assert_array_equal(batch(np.full((5, 2), [3.0, 4.0]))[0], [[9.0, 16.0]] * 5)
    assert batch.function.class_name() == "SXFunction"
    assert not list(tmp_path.rglob("*.so"))


def unwritable(folder, monkeypatch):
    (folder / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder / "file"))


def of_somebody_else(folder, monkeypatch):
    def refused(path):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "exists", refused)


def without_a_home(folder, monkeypatch):
    def nobody():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", nobody)


def from_another_machine(folder, monkeypatch):
    compiled.compile_function(squared())
    (library,) = folder.rglob("*.so")
    library.unlink()  # it is still mapped
    library.write_text("not for this machine")


def with_a_failing_compiler(folder, monkeypatch):
    monkeypatch.setenv("CC", "false")


def squared():
    x = ca.SX.sym("x", 2)
    return ca.Function("squared", [x], [x**2])


@pytest.mark.parametrize("compile", [False, True], ids=["virtual machine", "machine code"])
@pytest.mark.parametrize("n", [1, 16, 37, 517, 1100])
def test_a_sample_is_the_same_to_the_last_bit_whatever_is_computed_beside_it(
    n, compile, tmp_path, monkeypatch
):
    x, k = ca.SX.sym("x", 3), ca.SX.sym("k", 2)
    function = ca.Function("some", [x, k], [ca.sin(x * k[0]) * x + k[1], ca.sqrt(ca.sumsqr(x))])
    one = compiled.Single(compiled.compile_function(function) if compile else function)
    given, known = np.random.default_rng(n).standard_normal((n, 3)), np.array([1.3, -0.2])
    expected = [np.array(out) for out in zip(*(one(row, known) for row in given), strict=True)]
    batch = compiled.Batch(function, 0 if compile else None)
    monkeypatch.setattr(compiled, "MIN_SAMPLES_PER_CORE", 100)
    for cores in ("1", "3"):
        monkeypatch.setenv("OMP_NUM_THREADS", cores)
        for values, constant in (
            (given, known),
            (np.asfortranarray(given), np.tile(known, (n, 1))),
        ):
            for array, out in zip(batch(values, constant), expected, strict=True):
                np.testing.assert_array_equal(array, out)
    assert len(list(tmp_path.rglob("*.so"))) == compile


def test_a_batch_leaves_what_it_was_given_and_what_it_gave_before():
    x = ca.SX.sym("x", 2)
    batch = compiled.Batch(ca.Function("twice", [x], [2 * x]))
    given = np.arange(2e3).reshape(-1, 2)
    given.setflags(write=False)
    (before,) = batch(given)
    batch(given + 1)
    np.testing.assert_array_equal(before, 2 * given)


@pytest.mark.parametrize(
    "spoiled",
    [unwritable, of_somebody_else, without_a_home, from_another_machine, with_a_failing_compiler],
)
def test_without_machine_code_the_virtual_machine_is_used(spoiled, tmp_path, monkeypatch, capfd):
    spoiled(tmp_path, monkeypatch)
    function = compiled.compile_function(squared())
    assert function.class_name() == "SXFunction"
    np.testing.assert_array_equal(np.array(function([3, 4])).ravel(), [9, 16])
    (many,) = compiled.Batch(squared(), compile_after=0)(np.full((600, 2), [3.0, 4.0]))
    np.testing.assert_array_equal(many, np.full((600, 2), [9.0, 16.0]))
    assert capfd.readouterr() == ("", "")


@pytest.mark.wide
@pytest.mark.parametrize("large", [0, 10**9], ids=["as it is", "with common parts shared"])
@pytest.mark.parametrize("effect", ["joint_compliance", "rod_compliance"])
def test_slopes_of_a_closure_under_load_are_those_of_small_steps(effect, large, monkeypatch):
    monkeypatch.setattr(compiled, "MAX_INSTRUCTIONS_FOR_CSE", large)
    model = new_model("delta54", effects=[effect])
    s, n = Structure(model.mechanism, model.effects), 3
    values = model.values + 0.3 * model.table.tolerance  # some compliance, and no nominal robot
    x, a = configurations(model, 4), np.full((4, len(s.conditions)), 0.7)
    _, by_x, by_v = s.closure_batch(x, a, values)
    rows = s.phi.shape[0]

    def phi(change, values=values):
        R = rotation_matrix(change[n + 3 :]) @ x[:, n + 3 :].reshape(-1, 3, 3)
        moved = np.hstack([x[:, : n + 3] + change[: n + 3], R.reshape(-1, 9)])
        return s.closure_batch(moved, a, values)[0]

    for k, step in enumerate(STEP * np.eye(n + 6)):
        slope = (phi(step) - phi(-step)) / (2 * STEP)
        np.testing.assert_allclose(by_x.reshape(4, -1, rows)[:, k], slope, atol=1e-7)
    for k, step in enumerate(np.diag(1e-2 * model.table.tolerance)):
        slope = (phi(np.zeros(9), values + step) - phi(np.zeros(9), values - step)) / (2 * step[k])
        scale = max(1.0, np.abs(slope).max())
        np.testing.assert_allclose(by_v.reshape(4, -1, rows)[:, k], slope, atol=1e-6 * scale)
