"""The study behind docs/camera_model.md: robots identified by a camera, beside a tracker of 30 um.

`CAMERA_STUDY_RUNS` sets the runs of each robot; the default is 67, so that all three make 200.
"""

import os

import numpy as np
import pytest
import virtual_arm as va
from camera_cells import Cell

import parallel_cal as pc
from parallel_cal.identification.position_uncertainty import compute_shape_sigma
from parallel_cal.virtual.robot import Backlash

RUNS = int(os.environ.get("CAMERA_STUDY_RUNS", "67"))
LENS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "limit"), [("delta", 70e-6), ("stewart", 40e-6), ("ur5", 65e-6)])
def test_intervals_of_the_lens_and_of_positions_hold_the_truth(kind, limit):
    held, errors, sigmas, trackers = [], [], [], []
    for seed in range(1, RUNS + 1):
        cell = Cell(kind, seed)
        model = cell.drawn.with_sensors((cell.sensor(),))
        found = pc.fit(model, cell.seen_by_camera(seed=seed), hold_out=0)
        true = dict(zip(LENS, (*vars(cell.lens).values(),)[:4] + cell.lens.k, strict=True))
        numbers = found.parameters()
        for name, value in true.items():
            one = numbers[f"camera.{name}"]
            held.append(abs(one.value - value) < 1.96 * one.sigma)
        errors.append(cell.error_at_unseen_poses(found.model))
        sigmas.append(compute_shape_sigma(found.model, found.observations))
        tracked = pc.fit(cell.drawn, cell.seen_by_tracker(seed=seed), hold_out=0)
        trackers.append(cell.error_at_unseen_poses(tracked.model))
    camera, stated, tracker = (
        float(np.sqrt(np.mean(np.square(e)))) for e in (errors, sigmas, trackers)
    )
    print(f"{kind}: {1e6 * camera:.0f} um, stated {1e6 * stated:.0f}, tracker {1e6 * tracker:.0f}")
    assert np.mean(held) >= 0.93
    assert camera < limit
    assert 0.75 < camera / stated < 1.33


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "hidden"),
    [
        ("delta", (Backlash((1e-3,) * 3),)),
        ("ur5", tuple(va.Play(k, backlash=1e-3) for k in (0, 1))),
    ],
)
def test_a_hidden_backlash_of_one_milliradian_is_named(kind, hidden):
    named = 0
    for seed in range(1, RUNS + 1):
        cell = Cell(kind, seed, effects=hidden)
        model = cell.drawn.with_sensors((cell.sensor(),))
        named += pc.diagnose(model, cell.seen_by_camera(seed=seed)).effects == ("backlash",)
    assert named >= 0.95 * RUNS
