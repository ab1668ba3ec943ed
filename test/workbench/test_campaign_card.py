"""What the page says of a campaign."""

import math

import pytest

from parallel_cal.workbench.campaign_card import _describe_status


@pytest.mark.parametrize("answer", ["", "aborted on request"])
def test_samples_of_a_stopped_campaign_can_be_taken_although_its_answer_was_lost(answer):
    told = {
        "state": "stopped",
        "reason": "aborted on request",
        "answer": answer,
        "poses": 3,
        "error_unseen": math.nan,
    }
    assert _describe_status(told) == (
        "stopped: aborted on request; 3 poses; press Take samples, then Fit, to see the result"
    )


def test_a_campaign_without_samples_offers_none():
    told = {
        "state": "done",
        "reason": "idle",
        "answer": "rejected the goal",
        "poses": 0,
        "error_unseen": math.nan,
    }
    assert _describe_status(told) == "done: rejected the goal"
