"""What a search found is judged as `add` judges it; what `add` refuses does not stay."""

from types import SimpleNamespace
from typing import Any

import numpy as np

from parallel_cal.base.errors import FitError
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


def refuse(text: str, base: Any, result: Any) -> Any:
    raise FitError(f"{text} is not proven")


def test_what_cannot_stand_without_a_refused_effect_does_not_stay():
    search: Any = Imitated()
    found = Confirmed.of(search, search.fit_as_shown(PLAY, GAIN), ("backlash",), refuse)
    assert found.best.chosen == ()
    assert found.against == {
        "encoder_gain": "encoder_gain is not proven",
        "backlash": REFUSED,
    }
