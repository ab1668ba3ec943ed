"""Solutions of a direct or inverse problem: arrays, each row with a status."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import TYPE_CHECKING, Any

import numpy as np

from parallel_cal.base.rotation import matrix_to_quaternion, rotation_vector
from parallel_cal.model.configuration import NO_PASSIVE, Configuration

if TYPE_CHECKING:
    from parallel_cal.model.model import Model

MAX_CLOSED_RESIDUAL_M = 1e-10  # m: a closure residual below this is a solution
MAX_SETTLED_STEP_M = 1e-10  # m: a last step below this leaves an error below rounding (third order)
MIN_REGULAR_SINGULAR_VALUE = (
    1e-4  # smallest scaled singular value: errors are amplified more than 10^4 times
)
SUSPECT_PIVOT = 1e-2  # a smaller pivot means that a sample may be near a singularity


class Status(IntEnum):
    """Status of a solution; the numbers are those of parallel_cal_msgs/Solution."""

    CONVERGED = 0
    UNREACHABLE = 1
    SINGULAR = 2
    OUTSIDE_LIMITS = 3
    NOT_CONVERGED = 4
    INVALID_INPUT = 5
    OTHER_BRANCH = 8

    @property
    def text(self) -> str:
        """The name in small letters, as JSON documents have it."""
        return self.name.lower()


CONVERGED = np.array(Status.CONVERGED, dtype=np.int8)
CONVERGED.setflags(write=False)
ARRAYS = ("joints", "position", "rotation", "residual", "status")  # of Solutions, by rows
# By the number of a status
SOLVED = np.isin(
    np.arange(max(Status) + 1), [Status.CONVERGED, Status.SINGULAR, Status.OUTSIDE_LIMITS]
)


@dataclass(frozen=True)
class Solutions:
    """N solved configurations. Indexing returns one solution or a smaller set.

    A sample that cannot be solved has a row, too: `status` states why.

    Attributes
    ----------
    joints : array (N, nq)
        Joint readings, rad or m.
    position : array (N, 3)
        Position of {P} in {B}, m.
    rotation : array (N, 3, 3)
        Orientation of {P} in {B}, as matrices.
    residual : array (N,)
        Remaining error of the closure, m. If the robot has more joints than freedoms, it is the
        disagreement of the joint readings.
    status : array of int (N,)
        A `Status` for each row.
    count_complex : int or None
        Number of complex solutions that a complete search found; None without such a search.
    message : str or None
        A solver's remark on the whole set.
    complete : bool or None
        Whether these are known to be all solutions of one sample; None if not requested.
    passive : array (N, nu)
        Passive coordinates of a mechanism that declares some, rad or m.

    Examples
    --------
    >>> import parallel_cal as pc
    >>> found = pc.Kinematics(pc.new_model("delta24")).inverse([[0.0, 0.0, 0.2], [0.0, 0.0, 9.0]])
    >>> [pc.Status(number).text for number in found.status]
    ['converged', 'unreachable']
    """

    joints: np.ndarray
    position: np.ndarray
    rotation: np.ndarray
    residual: np.ndarray
    status: np.ndarray
    count_complex: int | None = None
    message: str | None = None
    complete: bool | None = None
    passive: np.ndarray = field(default_factory=lambda: NO_PASSIVE)

    @classmethod
    def of(
        cls, rows: np.ndarray, residual: np.ndarray, status: np.ndarray, passive: int = 0
    ) -> Solutions:
        """Solutions from configurations (N, nq + 12 + nu) or (nq + 12 + nu,), whose last `passive`
        = nu entries are passive coordinates."""
        x = Configuration.from_rows(rows, passive)
        u = x.u if passive else NO_PASSIVE
        return cls(x.q, x.r, x.R, residual, status, passive=u)

    def __len__(self) -> int:
        return len(self.joints)

    def __repr__(self) -> str:
        if self.joints.ndim == 1:
            status = Status(int(self.status)).text
            return f"Solutions(joints={self.joints}, position={self.position}, {status})"
        counts = {s.text: n for s in Status if (n := int(np.sum(self.status == s)))}
        return f"Solutions({len(self)}: {counts})"

    def __getitem__(self, key: Any) -> Solutions:
        q, r, R = self.joints[key], self.position[key], self.rotation[key]
        u = self.passive[key] if self.passive.size else NO_PASSIVE
        return Solutions(q, r, R, self.residual[key], self.status[key], passive=u)

    def __iter__(self) -> Iterator[Solutions]:
        return (self[i] for i in range(len(self)))

    @property
    def configuration(self) -> Configuration:
        """Joints and poses as one object."""
        return Configuration(self.joints, self.position, self.rotation, self.passive)

    @property
    def quaternion(self) -> np.ndarray:
        """x y z w with w >= 0."""
        return matrix_to_quaternion(self.rotation)

    @property
    def solved(self) -> np.ndarray:
        """Which rows close on the requested branch, including singular ones and those outside the
        joint limits."""
        return np.asarray(SOLVED[self.status])

    @property
    def ok(self) -> np.ndarray:
        """Which rows converged inside the joint limits, at regular poses."""
        return self.status == Status.CONVERGED

    def distance_from(
        self, position: np.ndarray, rotation: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Compute how far the platforms are from poses, such as those given to `inverse`.

        `inverse` meets the coordinates that the robot controls. The others follow from them, and
        may differ from the given ones.

        Parameters
        ----------
        position : array (3,) or (N, 3)
            Positions of {P} in {B}, m.
        rotation : array (3, 3) or (N, 3, 3)
            Orientations of {P} in {B}, as matrices.

        Returns
        -------
        distance, angle : arrays () or (N,)
            Distance of the positions, m, and angle between the orientations, rad; NaN for a sample
            without a solution.

        Examples
        --------
        >>> import numpy as np
        >>> import parallel_cal as pc
        >>> found = pc.Kinematics(pc.new_model("delta24")).direct([0.5, 0.5, 0.5])
        >>> distance, angle = found.distance_from([0.0, 0.0, 0.2], np.eye(3))
        >>> round(float(distance), 4), float(angle)
        (0.0, 0.0)
        """
        turn = rotation_vector(self.rotation @ np.swapaxes(rotation, -1, -2))
        distance = np.linalg.norm(self.position - position, axis=-1)
        return np.asarray(distance), np.asarray(np.linalg.norm(turn, axis=-1))


def make_unsolved(
    model: Model, q: np.ndarray | None = None, r: np.ndarray | None = None
) -> Solutions:
    """Make the solution of an unreachable sample or of an input that is not finite."""
    finite = all(np.isfinite(given).all() for given in (q, r) if given is not None)
    status = np.array(Status.UNREACHABLE if finite else Status.INVALID_INPUT, dtype=np.int8)
    x = model.configuration(np.full_like(model.mechanism.home.configuration, np.nan))
    q, r = x.q if q is None else q, x.r if r is None else r
    return Solutions(q, r, x.R, np.array(np.nan), status, passive=x.u)


def replace_rows(found: Solutions, rows: np.ndarray, others: Solutions) -> Solutions:
    """Return a set in which these rows (mask or indices) are those of another set."""
    names = (*ARRAYS, "passive") if found.passive.size else ARRAYS
    parts: dict[str, Any] = {name: getattr(found, name).copy() for name in names}
    for name, array in parts.items():
        array[rows] = getattr(others, name)
    return replace(found, **parts)


def stack_solutions(found: Sequence[Solutions]) -> Solutions:
    """Stack single solutions to one set."""
    return _combine(np.stack, found)


def concatenate_solutions(found: Sequence[Solutions]) -> Solutions:
    """Concatenate several sets to one."""
    return _combine(np.concatenate, found)


def _combine(combine: Callable[..., np.ndarray], found: Sequence[Solutions]) -> Solutions:
    q, r, R, residual, status = (combine([getattr(s, name) for s in found]) for name in ARRAYS)
    u = combine([s.passive for s in found]) if found[0].passive.size else NO_PASSIVE
    return Solutions(q, r, R, residual, status, passive=u)
