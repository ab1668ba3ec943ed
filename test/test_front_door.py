"""What `import parallel_cal` offers: every name in any order, nothing heavy before its use."""

import random
import subprocess
import sys

import numpy as np
import pytest

import parallel_cal as pc

HEAVY = "numpy casadi scipy yaml pydantic plotly rich rosbags rclpy typer".split()
SHELVES = {"effects": "backlash", "mechanisms": "delta24", "sensors": "probe"}


def fresh(code):
    """The last line that a new interpreter prints."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()[-1]


def test_importing_the_package_imports_nothing_heavy():
    assert (
        fresh(f"import sys, parallel_cal; print(sorted({set(HEAVY)!r} & set(sys.modules)))") == "[]"
    )


@pytest.mark.wide
@pytest.mark.parametrize("seed", [None, 1])
def test_every_name_is_there_in_whatever_order_it_is_asked_for(seed):
    names = list(pc.__all__)
    if seed is not None:
        random.Random(seed).shuffle(names)
    code = (
        "import parallel_cal\n"
        f"found = {{name: getattr(parallel_cal, name) for name in {names!r}}}\n"
        "again = {name: getattr(parallel_cal, name) for name in found}\n"
        "print(all(found[name] is again[name] for name in found), len(found))"
    )
    assert fresh(code) == f"True {len(names)}"


def test_star_gives_them_all():
    code = (
        "before = set(globals())\nfrom parallel_cal import *\nprint(len(set(globals()) - before))"
    )
    assert fresh(code) == str(len(pc.__all__) + 1)  # and `before` itself


@pytest.mark.parametrize("shelf", SHELVES)
@pytest.mark.parametrize(
    "first", ["", "import parallel_cal.{0}.{1}; ", "from parallel_cal.{0} import {1}; "]
)
def test_a_shelf_is_itself_however_its_files_were_imported_before(shelf, first):
    name = SHELVES[shelf]
    code = (
        f"import parallel_cal; {first.format(shelf, name)}shelf = parallel_cal.{shelf}; "
        f"one = shelf.load({name!r}, **{options(shelf)}); "
        f"print({name!r} in shelf.names(), type(one).__module__)"
    )
    assert fresh(code) == f"True parallel_cal.{shelf}.{name}"


def options(shelf):
    return {"height": 0.3} if shelf == "sensors" else {}


def test_a_name_that_is_not_there_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'calibrate_it_all'"):
        pc.calibrate_it_all  # noqa: B018


def test_every_name_is_shown_to_whoever_presses_tab():
    assert set(pc.__all__) <= set(dir(pc))


def test_a_simulated_session_is_the_dataset_of_its_own_recording(tmp_path):
    robot = pc.new_model("delta24")
    session = pc.simulate(robot, 12, seed=1, effects=["backlash:width=0.002"], replicates=3)
    pc.write_bag(session, tmp_path / "bag")
    here, there = session.dataset(), pc.load_dataset(tmp_path / "bag", joints=robot.joints)
    assert len(here) == len(there) == 15
    # Stamps in a bag are whole microseconds: at a dwell's edge that is one reading more or less.
    for name, near in {"q": 2e-6, "r": 2e-6, "R": 2e-5, "pose_cov": 1e-12, "time": 0.02}.items():
        np.testing.assert_allclose(getattr(here, name), getattr(there, name), rtol=0, atol=near)
    np.testing.assert_array_equal(here.pose_id, there.pose_id)
    np.testing.assert_array_equal(here.measured, there.measured)
    assert here.conditions.keys() == there.conditions.keys()
    for joint in robot.joints:
        column = f"direction.{joint}"
        np.testing.assert_array_equal(here.conditions[column], there.conditions[column])
    np.testing.assert_allclose(here.conditions["payload"], there.conditions["payload"])
    assert session.model.value("backlash.joint1.width") == 0.002
    assert here.sha256 != session_of(robot, seed=2).sha256


def session_of(robot, seed):
    return pc.simulate(robot, 4, seed).dataset()
