"""Touches on a plate: what pure noise looks like, and where a bad touch was."""

import numpy as np
import pytest
import virtual_setups as vs

from parallel_cal.diagnosis.comparison import compare
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_sensor
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.reporting.text import show


def touched(seed, bad=()):
    """120 touches of the nominal Delta on a level plate; `bad` ones are half a millimetre off."""
    robot, plate = vs.random_delta(0, factor=0.0), vs.Plate(holes=())
    joints, _ = plate.session(robot, 120, seed)
    read = np.zeros(len(joints))
    read[list(bad)] += 5e-4
    model = new_model("delta24", sensors=[load_sensor("probe", height=0.23, sigma=plate.sigma)])
    data = Dataset.from_arrays(
        model.joints,
        joints,
        np.zeros((len(joints), 3)),
        measured=np.zeros(6, bool),
        joint_sigma=np.full(3, plate.joint),
        conditions={"reading.probe": read},
    )
    return compare(model, data), plate


@pytest.mark.parametrize("seed", range(4))
def test_noise_of_touches_has_no_structure(seed):
    compared, _ = touched(seed)
    assert compared.structure.p_value > 0.01
    assert min(a.p_value for a in compared.residual_profiles) > 0.01
    assert "z" not in [a.name for a in compared.residual_profiles]  # it is the residual once more
    assert {"x", "y"} <= {a.name for a in compared.residual_profiles}


def test_a_bad_touch_is_located():
    compared, plate = touched(1, bad=[17])
    [odd] = compared.odd_samples
    assert odd.sample == compared.dataset.numbers[17]
    assert odd.place[2] == pytest.approx(plate.height, abs=1e-3)
    assert np.abs(odd.place[:2]).max() <= plate.reach + 1e-3
    first = show(compared).split("worst samples:\n")[1].splitlines()[:2]
    assert "|error|" not in first[0]
    assert "z" not in show(compared).split("worst region: ")[1].split(",")[0]
    assert first[1].split()[1:3] == [f"{v:.1f}" for v in 1e3 * odd.place[:2]]
