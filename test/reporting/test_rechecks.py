"""What the page says of a recheck."""

import numpy as np

from parallel_cal.identification.drift_test import DEVICE, Change, Look
from parallel_cal.identification.recheck import Recheck
from parallel_cal.reporting.rechecks import VERDICTS, describe_recheck, tabulate_parts

CHANGES = (
    Change("zero of joint1", "zero", np.eye(1), title="zero of joint1"),
    Change("leg2.L0", "part", np.eye(1), title="offset of leg 2"),
    Change(DEVICE, DEVICE, np.eye(1), device=DEVICE, title=DEVICE),
)


def found(*shares, rival=5.0):
    """A recheck of three samples, with the probabilities of its changes after each."""
    looks = []
    for k, one in enumerate(shares):
        changed = [[[p / 5] * 5] for p in one]
        looks.append(Look(k + 1, 1 - sum(one), np.array(changed), ("", rival)))
    return Recheck(tuple(looks), CHANGES)


def test_a_drift_is_described_by_when_it_was_decided_and_by_its_parts():
    drifted = found((0.1, 0.1, 0.1), (0.8, 0.17, 0.02), (0.95, 0.04, 0.005))
    said = describe_recheck(drifted.document(), drifted.warnings[0])
    assert said.label == "drifted"
    assert said.remarks == ("Decided after 2 of 3 samples, at a certainty of 95 %.",)
    assert said.summary.startswith("Since the last calibration the robot drifted")
    rows = tabulate_parts(drifted.document()).rows
    assert rows == [("nothing", "< 1 %"), ("zero of joint1", "95 %"), ("leg2.L0", "4 %")]


def test_a_change_that_may_be_the_device_is_not_called_decided():
    open_ = found((0.5, 0.1, 0.39))
    said = describe_recheck(open_.document(), open_.warnings[0])
    assert said.label == "robot or device"
    assert said.remarks[0].startswith("Not decided by 1 samples")
    assert ("measuring device", "39 %") in tabulate_parts(open_.document()).rows


def test_without_a_change_no_part_is_listed():
    still = found((0.1, 0.1, 0.1), rival=-9.0)
    assert describe_recheck(still.document(), still.warnings[0]).label == "unchanged"
    assert not tabulate_parts(still.document()).rows
    assert set(VERDICTS) == {"unchanged", "device_moved", "drifted", "changed", "undecided"}
