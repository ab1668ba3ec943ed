"""A hexapod on spools whose model does not state what drives its legs.

The lines are wound numerically on spools whose radii are off by some per cent and grow with every
layer; the program sees lengths by the stated radius. The robot is as the Jugglebot in real/.
"""

from dataclasses import replace

import numpy as np
import pytest

from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.effects.encoder_gain import EncoderGain
from parallel_cal.mechanisms.stewart42 import BASE, PLATFORM, RETRACTED, Stewart42
from parallel_cal.model.drive import Drive
from parallel_cal.model.model import Noise, new_model
from parallel_cal.model.shelf import load_mechanism
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.virtual import robot as vr

RADIUS, Q = 0.0115, 0.03e-3
TESTED = ("encoder_gain", "encoder_crosstalk", "spool_buildup")
RADII = RADIUS * np.array([0.94, 1.0, 0.99, 1.005, 1.006, 0.994])


def wind(radius):
    """Line on a spool (m) at angles up to 25 rad, by the midpoint rule from the area it fills."""
    angle = np.linspace(0.0, 25.0, 20_001)
    line = np.zeros_like(angle)
    for k in range(1, len(angle)):
        half = line[k - 1] + np.sqrt(radius**2 + Q * line[k - 1]) * angle[1] / 2
        line[k] = line[k - 1] + np.sqrt(radius**2 + Q * half) * angle[1]
    return angle, line


@pytest.fixture(scope="module")
def session():
    """Lengths by the stated radius (80, 6), and poses with the noise of motion capture."""
    rng = np.random.default_rng(3)
    base, platform = (points + rng.normal(0, 2e-3, (6, 3)) for points in (BASE, PLATFORM))
    r = np.array([0.0, 0.0, 0.36]) + rng.uniform(-0.06, 0.06, (80, 3))
    R = vr.turn(rng.uniform(-0.2, 0.2, (80, 3)))
    lengths = np.linalg.norm(r[:, None] + np.einsum("nij,kj->nki", R, platform) - base, axis=2)
    angle = np.stack(
        [
            np.interp(lengths[:, k] - RETRACTED, *wind(radius)[::-1])
            for k, radius in enumerate(RADII)
        ],
        axis=1,
    )
    r = r + rng.normal(0, 2e-4, r.shape)
    R = vr.turn(rng.normal(0, 6e-4, r.shape)) @ R
    return RADIUS * angle, r, R


def hexapod(drive=None):
    mechanism = Stewart42(tolerance=5e-3)
    mechanism.drives = (drive,) * 6 if drive else ()
    return replace(new_model(mechanism), noise=Noise(None, 3e-4, 1e-3))


def samples(session):
    return Dataset.from_arrays(hexapod().joints, *session)


@pytest.fixture(scope="module")
def unstated(session):
    return diagnose(hexapod(), samples(session), effects=TESTED)


@pytest.mark.wide
def test_without_a_stated_drive_the_gain_of_a_spool_is_named(unstated):
    assert "encoder_gain" in unstated.effects
    assert "encoder_crosstalk" not in unstated.effects


@pytest.mark.wide
def test_the_diagnosis_says_how_to_state_the_spool(unstated):
    [gain] = [one for one in unstated.unusual if one.name == "encoder_gain"]
    assert "leg1: {..., drive: {kind: spool, radius: 0.05}}" in gain.description
    assert gain.description in unstated.verdict.against


@pytest.mark.wide
def test_with_the_drive_stated_as_advised_the_error_falls_to_the_noise(session):
    model = hexapod(Drive("spool", radius=RADIUS, line="in"))
    found = diagnose(model, samples(session), effects=TESTED)
    assert {"encoder_gain", "spool_buildup"} <= set(found.effects)
    assert found.best.result.held_out.summary.position_rms < 0.5e-3
    assert found.best.result.model.value("spool_buildup.Q") == pytest.approx(Q, rel=0.3)


def test_only_lines_and_struts_without_a_drive_may_have_a_spool():
    screws = hexapod(Drive("screw", per_rev=5e-3)).mechanism
    assert EncoderGain().other_kinds(screws) == {}
    assert EncoderGain().other_kinds(new_model("delta24").mechanism) == {}
    # Carriages: a gain of this size beside a bent bed imitated the screws of a printer.
    assert EncoderGain().other_kinds(new_model("linear_delta").mechanism) == {}
    line = new_model(load_mechanism("cable", anchors=[[-0.5, 0], [0.5, 0]], home=[0, -0.4]))
    assert EncoderGain().other_kinds(line.mechanism)
    [factor] = EncoderGain().other_kinds(hexapod().mechanism).values()
    usual, spool = (
        EncoderGain().parameters(m)[0].tolerance
        for m in (hexapod().mechanism, hexapod(Drive("spool", radius=RADIUS)).mechanism)
    )
    assert factor == pytest.approx(spool / usual)
