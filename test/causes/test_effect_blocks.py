"""Effects of the catalogue as blocks of the sum."""

from dataclasses import replace

import numpy as np

import parallel_cal as pc
from parallel_cal.causes.effects import list_effect_blocks
from parallel_cal.diagnosis.addition import see
from parallel_cal.diagnosis.explanation import Causes
from parallel_cal.model.model import Noise, new_model

LEGS = [f"leg{k}" for k in range(1, 7)]


def test_a_pitch_that_changes_needs_no_waves_of_the_screw():
    """With waves of 317 leads to pay for, a wrong gain was likelier than what is there."""
    noise = Noise(joint=1e-6, position=2e-6, orientation=1e-5)
    model = replace(new_model("stewart42"), noise=noise)
    bends = (-1.4, -1.4, -2.0, -1.3, -1.9, 1.2)
    numbers = [
        f"{leg}.bend={1e-3 * bend},{leg}.sin=0,{leg}.cos=0"
        for leg, bend in zip(LEGS, bends, strict=True)
    ]
    hidden = "screw_pitch_error:" + ",".join(numbers)
    data = pc.simulate(model, 40, 1, effects=[hidden]).dataset()
    scene = see(pc.fit(model, data, hold_out=0))
    names = ["screw_pitch_error", "encoder_crosstalk", "encoder_gain"]
    found = Causes.of(scene, names).sum.search()
    [one] = [one for one in found.chosen if one.block.name == "screw_pitch_error"]
    assert found.probability["screw_pitch_error"] > 0.9
    assert one.block.settings[one.setting] == {}
    assert one.block.columns[one.setting].shape[1] == len(LEGS)


def test_the_waves_of_a_known_lead_are_one_set_of_columns():
    model = new_model("stewart42")
    scene = see(pc.fit(model, pc.simulate(model, 30, 1).dataset(), hold_out=0))
    [block] = list_effect_blocks(
        scene, ["screw_pitch_error"], {"screw_pitch_error": {"lead": 5e-3}}
    )
    assert block.settings == ({"lead": 5e-3},)
    assert [one.shape[1] for one in block.columns] == [3 * len(LEGS)]
    assert np.all(block.squares[0] > 0)
