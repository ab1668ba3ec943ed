"""A campaign that only decides whether the virtual Delta has drifted, and updates its model."""

import json
from dataclasses import replace

import numpy as np
import pytest
from campaign_cells import SimulatedCell, calibrated, model_of

import parallel_cal as pc
from parallel_cal.base.errors import FitError
from parallel_cal.campaign.campaign import Campaign
from parallel_cal.campaign.cell import Control, Sample
from parallel_cal.campaign.goal import Goal
from parallel_cal.campaign.journal import FILE, CampaignError, find_unfinished
from parallel_cal.campaign.updating import conclude, needs_more
from parallel_cal.identification.drift_test import DEVICE, Change, Look
from parallel_cal.identification.recheck import Recheck
from parallel_cal.model.file.modelfile import dump_model, parse_model
from parallel_cal.recordings.joining import join_datasets

SEED = 3
GOAL = Goal(poses=24, update=True)


class DriftedCell(SimulatedCell):
    """The encoders' zeros (rad) and the tracker (m) have shifted since the calibration."""

    zeros, shift = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)

    def sample(self, go_on):
        sample = super().sample(go_on)
        d = sample.dataset
        return replace(sample, dataset=replace(d, q=d.q + self.zeros, r=d.r + self.shift))


def run(folder, zeros=(0.0, 0.0, 0.0), shift=(0.0, 0.0, 0.0), goal=GOAL, **more):
    cell = DriftedCell(seed=SEED)
    cell.zeros, cell.shift = zeros, shift
    campaign = Campaign(folder, calibrated(SEED), goal, cell, **more)
    outcome = campaign.run()
    campaign.close()
    return outcome


@pytest.mark.wide
def test_without_a_drift_the_model_is_kept_before_all_poses_are_measured(tmp_path):
    heard = []
    outcome = run(tmp_path, tell=heard.append)
    assert (outcome.success, outcome.verdict, outcome.text) == (True, "unchanged", "")
    assert 3 <= outcome.samples < 20
    assert "the model is kept" in outcome.message
    assert outcome.document["drift"]["decision"]["verdict"] == "unchanged"
    assert [one.verdict for one in heard][-1] == "unchanged"


def test_a_zero_that_jumped_updates_the_model(tmp_path):
    outcome = run(tmp_path, zeros=(0.0, 3e-3, 0.0))
    assert (outcome.success, outcome.verdict) == (True, "drifted")
    assert next(iter(outcome.document["drift"]["parts"])) == "zero of joint2"
    assert outcome.samples < 20
    before, after = parse_model(calibrated(SEED)), parse_model(outcome.text)
    q = np.array(before.mechanism.home.joints)[None]
    truth = pc.Kinematics(before).direct(q - [0.0, 3e-3, 0.0]).position
    errors = [np.linalg.norm(pc.Kinematics(m).direct(q).position - truth) for m in (before, after)]
    assert errors[1] < 0.25 * errors[0]


@pytest.mark.wide
def test_a_tracker_that_was_moved_changes_no_model(tmp_path):
    outcome = run(tmp_path, shift=(0.4e-3, 0.4e-3, -0.4e-3))
    assert (outcome.success, outcome.verdict, outcome.text) == (True, "device_moved", "")


def test_a_change_of_robot_or_device_writes_no_model(tmp_path):
    samples = np.arange(3)
    zero = Change("zero of joint1", "zero", np.eye(1), title="zero of joint1")
    moved = Change(DEVICE, DEVICE, np.eye(1), device=DEVICE, title=DEVICE)
    looks = [Look(k + 1, 1e-6, np.full((2, 1, 5), 0.1), ("zero of joint1", 9.0)) for k in samples]
    found = Recheck(tuple(looks), (zero, moved))
    assert (found.verdict, found.decision, needs_more(found)) == ("changed", (3, "changed"), True)
    assert "or the measuring device moved (50 %)" in found.warnings[0]
    assert "More poses like these hardly tell" in found.warnings[0]
    cell = DriftedCell(seed=SEED)
    campaign = Campaign(tmp_path, calibrated(SEED), GOAL, cell)
    data = join_datasets([cell.sample(lambda: None).dataset for _ in samples], [1, 2, 3])
    ended = conclude(campaign.folder, data, found)
    campaign.close()
    assert ended.text == ""
    assert f"parallel-cal session fit {tmp_path}" in ended.words
    assert len(pc.Session(tmp_path).samples) == 3


def test_a_limit_ends_an_update_that_is_not_decided(tmp_path):
    outcome = run(tmp_path, goal=replace(GOAL, poses=2))
    assert (outcome.success, outcome.verdict, outcome.samples) == (False, "undecided", 2)
    assert outcome.message.startswith("2 poses were measured, the maximum that was allowed: ")


@pytest.mark.wide
def test_an_update_goes_on_where_it_stopped_and_not_as_another_campaign(tmp_path, monkeypatch):
    control = Control()
    seen, documents, document = [], [], Recheck.document
    monkeypatch.setattr(Recheck, "document", lambda found: documents.append(1) or document(found))

    class Watched(DriftedCell):
        def sample(self, go_on):
            seen.append(1)
            if len(seen) == 2:
                control.abort()
            return super().sample(go_on)

    folder = tmp_path / "a"
    first = Campaign(folder, calibrated(SEED), GOAL, Watched(seed=SEED), control=control)
    stopped = first.run()
    first.close()
    assert not stopped.ended
    assert stopped.verdict
    assert len(documents) == 1  # of the outcome, and not to know whether there is one
    assert find_unfinished(tmp_path, calibrated(SEED), update=True) == folder
    assert find_unfinished(tmp_path, calibrated(SEED)) is None
    with pytest.raises(CampaignError, match="only one of both is an update"):
        Campaign(folder, calibrated(SEED), Goal(), DriftedCell(seed=SEED))
    outcome = run(folder)
    assert outcome.verdict == "unchanged"
    lines = [json.loads(line) for line in (folder / FILE).read_text().splitlines()]
    assert sum("sample" in line for line in lines) == outcome.samples
    assert find_unfinished(tmp_path, calibrated(SEED), update=True) is None


def test_an_update_needs_a_calibration_and_a_certainty(tmp_path):
    cell = DriftedCell(seed=SEED)
    outcome = Campaign(tmp_path, dump_model(model_of("delta")), GOAL, cell).run()
    assert "the model has no covariance of one" in outcome.message
    assert not cell.sent
    with pytest.raises(FitError, match=r"certainty 1: expected"):
        Goal(update=True, certainty=1.0)
    assert isinstance(cell.sample(lambda: None), Sample)
