"""Cable robots whose lines run over pulleys on the platform: l = m + n, l = m + 2 k."""

import numpy as np
import pytest
from virtual_lines import routed_length

from parallel_cal.base.errors import ModelError
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.effects._lines import needs_lines
from parallel_cal.identification.fit import fit
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.file.modelfile import dump_model, parse_model
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import list_plugins, load_effect, load_mechanism
from parallel_cal.recordings.dataset import Dataset

# A crane on two masts in the plane of x and z, and one on four masts. The first line goes down from
# a mast to the platform and up to a second point; the second one goes there and back again.
PLANE = [[-2.0, 0.0, 3.0], [2.0, 0.0, 3.1]]
SPACE = [[-2.0, -1.5, 3.0], [2.0, -1.4, 3.1], [1.9, 1.5, 2.9], [-1.8, 1.6, 3.0]]
CRANES = {
    "plane": (PLANE, [[-1.2, 0.0, 2.8], [1.3, 0.0, 2.9]], [1, 2]),
    "space": (SPACE, [[2.1, -1.5, 2.9], [2.0, 1.6, 3.0], None, None], [1, 2, 1, 1]),
}
SIGMA = 0.2e-3  # m, of lengths and positions


def model(crane):
    anchors, ends, strands = CRANES[crane]
    options = {"anchors": anchors, "second_anchors": ends, "second_strands": strands}
    return new_model(load_mechanism("cable", **options))


def places(crane, n, seed):
    r = np.random.default_rng([seed, 9]).uniform((-1, -0.8, 0.2), (1, 0.8, 1.8), (n, 3))
    return r * [1, crane == "space", 1]


def strayed(crane):
    """Stops of each line, None for the pulley at P; the true anchors are off by 10 mm."""
    rng, (anchors, ends, strands) = np.random.default_rng(3), CRANES[crane]
    in_plane = np.array([1, crane == "space", 1])
    numbers, stops = {}, []
    for i, (anchor, end, times) in enumerate(zip(anchors, ends, strands, strict=True), start=1):
        A = anchor + rng.normal(0, 10e-3, 3) * in_plane
        stops.append([A, None])
        numbers |= {f"line{i}.A_{a}": A[k] for k, a in enumerate("xyz") if in_plane[k]}
        if end is not None:
            E = end + rng.normal(0, 10e-3, 3) * in_plane
            stops[-1] += [E, None, E][: 2 * times - 1]
            if times == 2:
                stops[-1] = [A, None, E, None]
            numbers |= {f"line{i}.E_{a}": E[k] for k, a in enumerate("xyz") if in_plane[k]}
    return stops, numbers


def session(crane, seed=0, noise=SIGMA, n=120):
    rng, r = np.random.default_rng([seed, 1]), places(crane, n, seed)
    pose = rng.permutation(np.r_[np.arange(n), rng.choice(n, 30, replace=False)])
    r, (stops, _) = r[pose], strayed(crane)
    q = routed_length(r, stops) - routed_length(np.zeros(3), stops)
    return Dataset.from_arrays(
        model(crane).joints,
        q + rng.normal(0, noise, q.shape),
        r + rng.normal(0, noise, r.shape),
        pose_cov=np.diag([SIGMA**2] * 3 + [np.nan] * 3),
        joint_sigma=SIGMA,
        pose_id=pose,
    )


def test_a_line_to_a_pulley_at_3_4_m_and_back_down_at_6_8_m_is_15_m_long():
    """Anchors 3 m aside and 4 m up, 6 m aside and 8 m up: 5 + 10 m. Twice to the second: 25 m."""
    options = {"anchors": [[3, 4], [-3, 4]], "second_anchors": [[-6, 8], None], "zero": "anchors"}
    for strands, expected in ((1, 15.0), (2, 25.0)):
        m = load_mechanism("cable", second_strands=[strands, 1], **options)
        found = Kinematics(new_model(m)).inverse(np.zeros(3))
        np.testing.assert_allclose(found.joints, [expected, 5.0], atol=1e-12)


@pytest.mark.parametrize("crane", CRANES)
def test_the_true_anchors_close_every_line_of_the_virtual_crane(crane):
    stops, numbers = strayed(crane)
    r = places(crane, 40, 5)
    q = routed_length(r, stops) - routed_length(np.zeros(3), stops)
    true = new_model(model(crane).mechanism, numbers)
    found = Kinematics(true).direct(q)
    assert found.ok.all()
    np.testing.assert_allclose(found.position, r, atol=1e-9)
    np.testing.assert_allclose(Kinematics(true).inverse(r).joints, q, atol=1e-9)
    again = parse_model(dump_model(true), "file")
    np.testing.assert_array_equal(again.values, true.values)


@pytest.mark.parametrize("crane", CRANES)
def test_anchors_are_found_within_their_sigmas(crane):
    result, (_, numbers) = fit(model(crane), session(crane)), strayed(crane)
    table = result.model.table
    for name, true in numbers.items():
        sigma = result.estimate.sigma[table.index_of(name)]
        assert abs(result.model.value(name) - true) < 4 * sigma
        assert sigma < 12e-3
    before, after = (e.summary.position_rms for e in (result.held_out_before, result.held_out))
    assert after < 1.3 * SIGMA * np.sqrt(3) < before


@pytest.mark.wide
@pytest.mark.parametrize("crane", CRANES)
def test_a_crane_that_hides_nothing_is_at_noise(crane):
    found = diagnose(model(crane), session(crane, seed=1))
    assert (found.verdict.word, found.effects) == ("at_noise", ())


def test_effects_of_single_lines_do_not_apply():
    mechanism = model("plane").mechanism
    of_lines = [name for name in list_plugins("effects") if name.startswith("line_")]
    for name in (*of_lines, "pulley_radius"):
        assert load_effect(name).applies(mechanism) == needs_lines(mechanism) != ""


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"second_anchors": [[1, 0, 2]]}, "1 second_anchors for 2 anchors"),
        ({"second_anchors": [[1, 1, 2], None]}, "outside the plane of the anchors"),
        ({"second_anchors": [[0, 0, 0], None], "home": [0, 0]}, "at home"),
        ({"second_anchors": [[1], None]}, r"expected \[x, y, z\]"),
        ({"second_strands": [0, 1]}, "expected numbers above 0"),
    ],
)
def test_second_anchors_that_make_no_sense_are_refused(options, reason):
    with pytest.raises(ModelError, match=reason):
        load_mechanism("cable", anchors=PLANE, **options)
