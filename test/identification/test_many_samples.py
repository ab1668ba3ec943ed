"""What is computed from many samples: as from all of them, without all of them at once."""

from dataclasses import replace

import numpy as np
import pytest

from parallel_cal.base.rotation import rotation_matrix
from parallel_cal.identification import frames, noise_floor
from parallel_cal.identification.frames import Frames, PosePairs
from parallel_cal.identification.observations import observe
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_sensor
from parallel_cal.recordings.simulate import simulate

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


@pytest.mark.parametrize("sensors", [(), ("inclinometer",)])
def test_the_noise_floor_of_many_samples_is_simulated_in_parts(monkeypatch, sensors):
    model = new_model("delta24", sensors=[load_sensor(one) for one in sensors])
    data = simulate(model, 12, 3).dataset()
    samples = observe(model, data, 1e-4, False)
    assert not samples.noise_assumed
    whole = noise_floor.simulate_noise_floor(model, samples)
    sizes, errors = [], noise_floor.Errors

    def counted(**parts):
        sizes.append(len(parts["position"]))
        return errors(**parts)

    monkeypatch.setattr(noise_floor, "Errors", counted)
    monkeypatch.setattr(noise_floor, "MAX_ROWS", 30)
    found = noise_floor.simulate_noise_floor(model, samples)
    assert sizes == [2 * len(data)] * (noise_floor.DRAWS // 2)
    assert {k: v for k, v in vars(found.summary).items() if v} == pytest.approx(
        {k: v for k, v in vars(whole.summary).items() if v}, rel=1e-12
    )
    assert found.sigmas == pytest.approx(whole.sigmas, rel=1e-9)
    assert found.summary.position_rms
    assert found.sigmas["position"]
