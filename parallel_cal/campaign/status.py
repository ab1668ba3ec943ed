"""What a campaign tells: its state, the error so far, and how it ended."""

from __future__ import annotations

from dataclasses import dataclass, replace

from parallel_cal.campaign.cell import Question
from parallel_cal.model.file.modelfile import model_hash, replace_text
from parallel_cal.session import goals


@dataclass(frozen=True)
class CurvePoint:
    """The rms error at the validation poses (m or rad) after `poses` samples, of the model with
    these effects; after 0 samples it is the initial model's."""

    poses: int
    error: float
    effects: tuple[str, ...] = ()


@dataclass(frozen=True)
class Curve:
    """How the error at the validation poses fell, from the initial model on.

    `kind` is position or orientation, `noise` the noise floor in m or rad (None: unknown)."""

    points: tuple[CurvePoint, ...] = ()
    kind: str = "position"
    noise: float | None = None


@dataclass(frozen=True)
class Status:
    """The state of a campaign (one of STATES), the reason for it, and the progress so far.

    `unseen` is the rms error of the best model at the validation poses (m or rad, NaN while
    unknown). `purpose` says why the present pose is measured (moving, sampling). `questions` are
    the conditions that a person is asked to change (asking). `curve` is the error so far."""

    state: str
    reason: str
    samples: int
    unseen: float
    verdict: str
    purpose: str = ""
    questions: tuple[Question, ...] = ()
    curve: Curve = Curve()


STATES = "planning moving sampling judging asking paused stopped done".split()


@dataclass(frozen=True)
class Outcome(goals.Outcome):
    """Outcome of a campaign.

    Attributes
    ----------
    success : bool
        Whether the goal was reached.
    message : str
        Why the campaign ended.
    text : str
        The model file's text if the model is proven better; else empty. The property `model` is
        the model of it.
    document : dict
        The JSON document of `parallel-cal calibrate`.
    ended : bool
        False if the campaign was stopped and can continue.
    samples : int
        Number of samples.
    curve : tuple of (int, float)
        Number of samples and rms error at the validation poses (m or rad): first for the initial
        model, then for each judgement.
    """

    ended: bool = True
    samples: int = 0
    curve: tuple[tuple[int, float], ...] = ()


def write_improved_model(outcome: Outcome, path: str) -> Outcome:
    """Write the proven model to a file and keep the previous file as a backup."""
    if not outcome.text:
        return outcome
    replace_text(path, outcome.text)
    return replace(outcome, path=path, hash=model_hash(outcome.text))
