"""The recordings in bags/: readable, as their truth files say, and honest about what is missing."""

from functools import cache
from pathlib import Path

import make_bags
import make_baselines
import numpy as np
import pytest
import yaml
from bag_catalogue import RECORDINGS
from marks import keep

from parallel_cal.identification.fit import fit
from parallel_cal.identification.fit_warnings import chi2_band
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.recordings.loading import load_dataset

REPOSITORY = Path(__file__).parents[2]
BAGS = REPOSITORY / "bags"
# Their effects are real, but smaller than what chi2/dof can tell from noise in 94 samples.
SUBTLE = {"delta_eccentricity": "encoder_eccentricity", "delta_backlash": "backlash"}
AT_NOISE = [name for name, bag in RECORDINGS.items() if bag.verdict == "at_noise"]
LACKING = [n for n in RECORDINGS if n not in {*SUBTLE, *AT_NOISE, "delta_tilting"}]
SLOW = ["delta_thermal", "delta_drift", "delta_backlash_thermal", "delta_warming"]


@cache
def truth(name):
    return yaml.safe_load((BAGS / "truth" / f"{name}.yaml").read_text())


@cache
def baseline(name):
    return read_model(REPOSITORY / truth(name)["baseline"])


@cache
def dataset(name):
    return load_dataset(BAGS / name, joints=baseline(name).joints, mode=truth(name)["mode"])


@cache
def refitted(name, effect=""):
    model = baseline(name).with_effect(effect) if effect else baseline(name)
    return fit(model, dataset(name), hold_out=0.0)


def chi2(result):
    return result.estimate.chi2_per_dof * result.estimate.dof


@pytest.mark.wide
@pytest.mark.parametrize(
    "name",
    keep(
        [n for n in RECORDINGS if n != "delta_latency"],
        *("argos_gear_ripple", "delta_backlash_thermal", "delta_clean_sqlite", "stewart_backlash"),
    ),
)
def test_every_visit_becomes_a_sample_reached_from_where_the_truth_says(name):
    data, dwells = dataset(name), truth(name)["dwells_arrive_leave_pose_direction"]
    assert data.dropped == ()
    assert len(data) == len(dwells)
    directions = [data.conditions[f"direction.{joint}"] for joint in data.joint_names]
    np.testing.assert_array_equal(np.transpose(directions), [dwell[3] for dwell in dwells])


@pytest.mark.parametrize("name", [n for n in RECORDINGS if n != "delta_latency"])
def test_revisits_are_recognised(name):
    visited = [dwell[2] for dwell in truth(name)["dwells_arrive_leave_pose_direction"]]
    assert len(np.unique(dataset(name).pose_id)) == len(set(visited)) < len(visited)


def test_the_moving_robot_is_read_pose_by_pose_at_many_speeds():
    data = dataset("delta_latency")
    assert data.dropped == ()
    assert len(data) == 600
    velocity = np.abs([data.conditions[f"velocity.{joint}"] for joint in data.joint_names])
    assert velocity.max() > 1.0
    assert np.median(velocity) < 0.5 * np.quantile(velocity, 0.95)


@pytest.mark.parametrize("name", RECORDINGS)
def test_temperature_and_payload_are_recorded(name):
    conditions = dataset(name).conditions
    masses = {0.2, 1.2} if name == "delta_compliance" else {0.2}
    assert set(conditions["payload"]) == masses
    width = np.ptp(conditions["temperature"])
    wanders = name in ("delta_thermal", "delta_backlash_thermal")
    assert width > 14 if wanders else width < 8


def test_only_the_warming_hall_warms_like_a_clock():
    like_a_clock = {
        name: np.corrcoef(dataset(name).time, dataset(name).conditions["temperature"])[0, 1]
        for name in SLOW
    }
    assert like_a_clock.pop("delta_warming") > 0.998
    assert max(np.abs(list(like_a_clock.values()))) < 0.6


def test_argos_measures_orientations_only():
    np.testing.assert_array_equal(
        dataset("argos_gear_ripple").measured[0], [False] * 3 + [True] * 3
    )


@pytest.mark.wide
@pytest.mark.parametrize("name", RECORDINGS)
def test_the_noise_is_stated_and_not_guessed(name):
    noise, found = truth(name)["noise"], refitted(name).observations
    n = len(baseline(name).joints)
    sigma = np.sqrt(np.diagonal(found.S[0]))
    assert found.noise_from["joint"] == "model file"
    np.testing.assert_allclose(sigma[:n], noise["joint"])
    np.testing.assert_allclose(sigma[n + 3 :], noise["orientation"])
    if name != "argos_gear_ripple":
        np.testing.assert_allclose(sigma[n : n + 3], noise["position"])


@pytest.mark.parametrize("name", AT_NOISE)
def test_where_nothing_can_be_seen_geometry_alone_explains_the_data(name):
    found = refitted(name).estimate
    low, high = chi2_band(found.dof)
    assert low < found.chi2_per_dof < high


@pytest.mark.parametrize("name", LACKING)
def test_no_geometry_of_the_baseline_explains_what_is_hidden(name):
    found = refitted(name).estimate
    assert found.chi2_per_dof > 1.15 * chi2_band(found.dof)[1]


@pytest.mark.parametrize(("name", "effect"), SUBTLE.items())
def test_a_subtle_effect_is_seen_by_adding_it_and_hardly_by_chi2(name, effect):
    assert refitted(name).estimate.chi2_per_dof < 1.2
    assert chi2(refitted(name)) - chi2(refitted(name, effect)) > 40  # of six numbers: p < 1e-6


def test_model_24_positions_are_at_noise_while_it_misses_the_tilt_by_far():
    found = refitted("delta_tilting")
    assert found.estimate.chi2_per_dof < chi2_band(found.estimate.dof)[1]
    after, noise = found.after.document(), truth("delta_tilting")["noise"]
    assert after["orientation_rms"] > 50 * noise["orientation"]


@pytest.mark.parametrize("effect", ["backlash", "encoder_eccentricity"])
def test_effects_of_single_joints_do_not_imitate_cross_talk(effect):
    before, after = (refitted("delta_crosstalk", e).estimate.chi2_per_dof for e in ("", effect))
    assert before - after < 0.1 * (before - 1)


@pytest.mark.parametrize("name", RECORDINGS)
def test_a_truth_file_says_what_the_catalogue_hides_in_the_recording(name):
    assert truth(name) == yaml.safe_load(yaml.safe_dump(make_bags.truth_of(RECORDINGS[name])))


def test_all_recordings_together_are_small():
    sizes = [file.stat().st_size for file in BAGS.rglob("*") if file.is_file()]
    assert max(sizes) < 2_000_000
    assert sum(sizes) < 15_000_000


def test_the_baselines_are_what_a_user_gets_from_new():
    for name in make_baselines.BASELINES:
        model, expected = (
            read_model(BAGS / "models" / f"{name}.yaml"),
            make_baselines.baseline(name),
        )
        np.testing.assert_allclose(model.values, expected.values, atol=1e-15)
        assert model.table.names == expected.table.names
        assert model.noise == expected.noise
