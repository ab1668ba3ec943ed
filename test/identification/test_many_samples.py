"""What is computed from many samples: as from all of them, without all of them at once."""

from dataclasses import replace

import numpy as np

from parallel_cal.base.rotation import rotation_matrix
from parallel_cal.identification import frames
from parallel_cal.identification.frames import Frames, PosePairs

STANDS = Frames(
    np.array([0.4, -0.3, 1.2]),
    rotation_matrix(np.array([0.2, -0.4, 2.5])),
    np.array([0.01, 0.02, -0.05]),
    rotation_matrix(np.array([-0.3, 0.1, 0.2])),
)


def poses_of_a_device(count, fully, seed=1):
    """Poses of which all have positions, and only some orientations; a few are far off."""
    rng = np.random.default_rng(seed)
    r = rng.uniform(-0.2, 0.2, (count, 3))
    R = np.array([rotation_matrix(w) for w in rng.uniform(-0.6, 0.6, (count, 3))])
    seen_r, seen_R = STANDS.see(r, R)
    seen_r = seen_r + rng.normal(0, 1e-5, (count, 3))
    seen_r[:: count // 7] += 0.3
    measured = np.ones((count, 6), dtype=bool)
    measured[:, 3:] = np.isin(np.arange(count), rng.choice(count, fully, replace=False))[:, None]
    return PosePairs(r, R, seen_r, seen_R, measured, 0.2, True)


def test_a_part_of_many_poses_selects_the_frames_that_all_of_them_are_fitted_to(monkeypatch):
    many = poses_of_a_device(900, fully=4)
    whole = many.frames
    monkeypatch.setattr(frames, "MAX_POSES_OF_SEARCH", 40)
    descended = []
    descend = PosePairs.descend

    def counted(self, start, used, free=None):
        descended.append(len(self.r))
        return descend(self, start, used, free)

    monkeypatch.setattr(PosePairs, "descend", counted)
    found = replace(many).frames
    # Each start descends with the few, among them every pose that has an orientation.
    assert set(descended) == {44, 900}
    assert descended.count(900) == 2 < descended.count(44)
    for one, other in zip(vars(found).values(), vars(whole).values(), strict=True):
        assert np.allclose(one, other, atol=1e-9)
    assert np.allclose(found.f, STANDS.f, atol=1e-4)
    assert np.allclose(found.T, STANDS.T, atol=1e-3)
