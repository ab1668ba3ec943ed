"""Read, test and exchange the model in use. This module does not use ROS."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from threading import Lock, Thread

import numpy as np

from parallel_cal.base.errors import FitError, ModelFileError, ParallelCalError
from parallel_cal.campaign.path_guard import Guard
from parallel_cal.exporting.description import Description, describe
from parallel_cal.identification.age import Age
from parallel_cal.kinematics.kinematics import Kinematics, Solutions, Status
from parallel_cal.model.file.modelfile import model_hash, model_text, parse_model
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.model import Model
from parallel_cal.model.region import IdentifiedRegion

log = logging.getLogger(__name__)

TEST_POSES = 8
AGREEMENT = 1e-9  # m or rad: largest error of a round trip pose -> joints -> pose


@dataclass(frozen=True)
class ServedModel:
    """A model in use. It is immutable, so that a request keeps the model that it began with."""

    model: Model
    kinematics: Kinematics
    hash: str
    path: str
    text: str = ""
    description: Description | None = None  # of the links; None until it is made, after loading

    @cached_property
    def region(self) -> IdentifiedRegion | None:
        """The region in which the model was identified; None if its file states none."""
        return IdentifiedRegion.of_model(self.model)

    @cached_property
    def age(self) -> Age:
        """Until when the model can be trusted, as its file states."""
        try:
            return Age.of_model(self.model)
        except FitError as error:
            return Age(unknown=str(error))

    @cached_property
    def guard(self) -> Guard:
        """The limits of a path of poses."""
        return Guard.of(replace(self.model, covariance=None))


@dataclass(frozen=True)
class Attempt:
    """The result of loading a file; `reason` says what changed or why it failed."""

    ok: bool
    source: str
    path: str
    reason: str


class ModelServer:
    """Holds the model in use and exchanges it; if loading fails, the model before stays."""

    def __init__(
        self,
        report: Callable[[Attempt], None] = lambda attempt: None,
        on_description: Callable[[], None] = lambda: None,
    ):
        self.current: ServedModel | None = None
        self.last = Attempt(False, "startup", "", "no model has been loaded")
        self._report, self._on_description = report, on_description
        self._loading, self._exchange = Lock(), Lock()
        self._completion: Thread | None = None

    def load(self, path: str | Path, source: str) -> Attempt:
        """Read, validate and test a file, then use its model.

        Only one file is loaded at a time. Requests are answered meanwhile with the model in use.
        """
        with self._loading:
            try:
                reason = self._load(path)
                self.last = Attempt(True, source, str(path), reason)
            except Exception as error:  # a user's own mechanism may raise anything
                self.last = Attempt(False, source, str(path), _reason(error))
            self._report(self.last)
            return self.last

    def _load(self, path: str | Path) -> str:
        if not str(path):
            raise ModelFileError("no model file: set the parameter model_file or call load_model")
        text = model_text(path)
        known = self.current
        model = parse_model(text, str(path), known.model if known else None)
        kinematics = Kinematics(model.robot())
        try:
            self_test(kinematics)
        except ModelFileError as error:
            raise ModelFileError(f"{path}: {error}") from None
        served = ServedModel(model, kinematics, model_hash(text), str(path), text)
        before = self.current
        if before is not None and before.hash == served.hash:
            self._exchange_for(replace(before, path=served.path))
            return f"{path}: the same content as before ({served.hash[:12]})"
        self._exchange_for(served)
        self._completion = Thread(target=self._complete, args=(served,), daemon=True)
        self._completion.start()
        was = f", was {before.hash[:12]}" if before is not None else ""
        return f"{path}: {served.hash[:12]} in use{was}"

    def _exchange_for(self, served: ServedModel) -> None:
        with self._exchange:
            self.current = served

    def _complete(self, served: ServedModel) -> None:
        """Add what takes up to a second, while the model is already in use."""
        self._describe(served)
        self._compile(served)  # CasADi's virtual machine answers until it is done

    def _describe(self, served: ServedModel) -> None:
        try:
            description = describe(served.model)
        except Exception as error:
            log.warning("no robot_description: %s", _reason(error))
            return
        with self._exchange:
            if self.current is not None and self.current.hash == served.hash:
                self.current = replace(self.current, description=description)
                self._on_description()

    def _compile(self, served: ServedModel) -> None:
        try:
            kinematics = Kinematics(served.model.robot(), compile=True)
            self_test(kinematics)
        except Exception as error:  # the virtual machine has passed the test and stays in use
            log.warning("the compiled functions are not used: %s", _reason(error))
            return
        with self._exchange:
            if self.current is not None and self.current.hash == served.hash:
                self.current = replace(self.current, kinematics=kinematics)

    def wait_until_compiled(self, timeout: float | None = None) -> None:
        """Wait for the compiler, s; requests never do."""
        if self._completion is not None:
            self._completion.join(timeout)


def self_test(kinematics: Kinematics) -> None:
    """Solve inverse and forward kinematics at poses in the workspace.

    Raise ModelFileError unless every pose is recovered to AGREEMENT.
    """
    r, R = workspace_poses(kinematics.model.mechanism, TEST_POSES)
    there = kinematics.inverse(r, R)
    _require_solved(there, "inverse", r)
    back = kinematics.direct(there.joints, start=there)
    _require_solved(back, "direct", r)
    errors = [np.abs(getattr(back, k) - getattr(there, k)).max() for k in ("position", "rotation")]
    if max(errors) > AGREEMENT:
        raise ModelFileError(
            f"self-test: the direct problem misses the inverse problem's poses by "
            f"{max(errors):.1e} (m or rad; allowed {AGREEMENT:.0e})"
        )
    # A request for a single configuration runs other code: compile it now, and test it.
    alone = kinematics.direct(there.joints[0])
    if alone.status != Status.CONVERGED or not np.isfinite(alone.position).all():
        raise ModelFileError(
            f"self-test: direct problem {describe_status(alone.status)} for a single configuration"
        )
    kinematics.inverse(r[0], R[0])


def workspace_poses(mechanism: Mechanism, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Draw n poses in the inner half of the workspace: positions (n, 3), rotations (n, 3, 3).

    A good robot may be unable to reach the corners of its workspace box.
    """
    low, high = np.array(mechanism.workspace.low), np.array(mechanism.workspace.high)
    drawn = mechanism.sample(n, np.random.default_rng(0))
    return mechanism.poses((drawn + (low + high) / 2) / 2)


def _require_solved(found: Solutions, problem: str, r: np.ndarray) -> None:
    solved = np.isin(found.status, (Status.CONVERGED, Status.OUTSIDE_LIMITS))
    if not solved.all():
        i = int(np.argmin(solved))
        raise ModelFileError(
            f"self-test: {problem} problem {describe_status(found.status[i])} at "
            f"{np.round(r[i], 4).tolist()} m, inside the workspace of the file"
        )


def describe_status(status: int | np.ndarray) -> str:
    """Return a status in words, such as `outside limits`."""
    return Status(int(status)).text.replace("_", " ")


def _reason(error: Exception) -> str:
    if isinstance(error, ParallelCalError):
        return str(error)
    return f"{type(error).__name__}: {error}"
