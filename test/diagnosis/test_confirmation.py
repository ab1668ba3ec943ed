"""What a search found is judged as `add` judges it; what `add` refuses does not stay."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from parallel_cal.base.errors import FitError
from parallel_cal.diagnosis import confirmation
from parallel_cal.diagnosis.confirmation import Confirmed
from parallel_cal.diagnosis.search import Chosen, Trial
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_mechanism

GAIN, PLAY = Chosen("encoder_gain"), Chosen("backlash")
REFUSED = "leg1 was identified 40 tolerances from its nominal"


class Imitated:
    """A search of a robot whose gain is wrong: without it, no robot has the geometry, and the play
    that the device may have instead cannot be fitted."""

    def __init__(self) -> None:
        held_out = SimpleNamespace(judged=np.ones(4, dtype=bool))
        self.fitted: Any = SimpleNamespace(
            model=new_model(load_mechanism("stewart42")),
            held_out=held_out,
            observations=SimpleNamespace(unknown=True),
        )

    def fit(self) -> Trial:
        return Trial((), self.fitted)

    def fit_as_shown(self, *chosen: Chosen, judged: bool = True) -> Trial:
        imitated = chosen and GAIN not in chosen
        return Trial(chosen, None if imitated else self.fitted, REFUSED if imitated else "")


def explained(search: Any, *chosen: Chosen, imitating: Any = ()) -> Any:
    """An explanation in which the device may cause the first of the effects."""
    doubtful, best = (chosen[0].name,), search.fit_as_shown(*chosen)
    return SimpleNamespace(best=best, robot_or_device=doubtful, imitating=imitating)


def refuse(text: str, base: Any, result: Any) -> Any:
    raise FitError(f"{text} is not proven")


def test_what_cannot_stand_without_a_refused_effect_does_not_stay():
    search: Any = Imitated()
    found = Confirmed.of(search, explained(search, PLAY, GAIN), refuse)
    assert found.best.chosen == ()
    assert found.against == {
        "encoder_gain": "encoder_gain is not proven",
        "backlash": REFUSED,
    }


@pytest.mark.parametrize("ratio", [0.99, 1.01])
@pytest.mark.parametrize("imitating", [(), ("encoder_gain",)])
def test_what_only_imitates_a_law_stays_if_the_error_falls_with_it(ratio, imitating, monkeypatch):
    """A gain with 2 % beside a law, which the device may cause, raised the error, and was named."""
    monkeypatch.setattr(confirmation, "ratio_of", lambda before, after: ratio)
    search: Any = Imitated()
    found = Confirmed.of(search, explained(search, GAIN, imitating=imitating), refuse)
    stays = ratio < 1 or not imitating
    assert (found.best.chosen, found.robot_or_device) == (
        ((GAIN,), ("encoder_gain",)) if stays else ((), ())
    )
    assert ("does not fall with it" in found.against.get("encoder_gain", "")) == (not stays)
