"""Orientations that were read by another convention than the one by which they were written.

Three numbers are the angles of rotations about three axes, in one of 24 orders, or a rotation
vector. The rotations that were read give these numbers back, but several sets of numbers read as
the same rotation: the samples decide which of them was written.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache

import numpy as np

from parallel_cal.identification.registration import DevicePoses

Array = np.ndarray

VECTOR = "rotation vector"
# Lower case: rotations about fixed axes, upper case: about rotated axes, as in a column map
ORDERS = ("xyz", "zyx", "zyz", "zxz", "xzy", "yxz", "yzx", "zxy", "xyx", "xzx", "yxy", "yzy")
MEANT = (*ORDERS, *(order.upper() for order in ORDERS))
# What a reader states. The angles of an order are those of the order backwards about the other kind
# of axes, backwards: these include ZYX, XYZ, ZYZ and ZXZ.
READ = ("xyz", "zyx", "zyz", "zxz")


@dataclass(frozen=True)
class Convention:
    """A meaning of orientations: `read` returns, for the rotations (N, 3, 3) that were read, the
    rotations (N, K, 3, 3) of which one was written."""

    words: str
    read: Callable[[Array], Array] = field(repr=False)

    def choose(self, there: DevicePoses, F: Array | None) -> Array:
        """Return the rotations (N, 3, 3) that were written, of which the same rotation of the
        target explains the most; `F` is the rotation of the device, as positions show it."""
        meant = self.read(there.seen_R)
        if F is None or meant.shape[1] == 1 or not there.turned.any():
            return meant[:, 0]
        targets = there.R.transpose(0, 2, 1)[:, None] @ F @ meant
        seen = targets[there.turned]
        tried = seen.reshape(-1, 3, 3)
        nearest = np.einsum("hij,nkij->hnk", tried, seen).max(axis=2)
        best = tried[int(np.argmax(np.median(nearest, axis=1)))]
        kept = np.argmax(np.nan_to_num(np.einsum("ij,nkij->nk", best, targets)), axis=1)
        return np.asarray(meant[np.arange(len(meant)), kept])


@cache
def list_conventions() -> tuple[Convention, ...]:
    """List what orientations may mean. Angles in deg that were taken for rad cannot be found
    again."""
    found = [
        Convention(
            "the rotations are those of the device seen by the target",
            lambda R: R.transpose(0, 2, 1)[:, None],
        ),
        Convention("the quaternions are w x y z, not x y z w", _read_scalar_first),
    ]
    for read in READ:
        found += [
            Convention(
                f"the angles are {meant}, not {read} (column map: axes: {meant} in place of "
                f"{read}, or {_backwards(meant)} in place of {_backwards(read)})",
                _reader(read, meant),
            )
            for meant in MEANT
            if meant != read
        ]
        found += [
            Convention(
                "the three numbers are a rotation vector, not angles (column map: "
                "rotation_vector in place of angles)",
                _reader(read, VECTOR, order=order),
            )
            for order in (slice(None), slice(None, None, -1))
        ]
    found += [
        Convention(
            f"the three numbers are the angles {meant}, not a rotation vector (column map: "
            f"angles: {{columns: ..., axes: {meant}}} in place of rotation_vector)",
            _reader(VECTOR, meant),
        )
        for meant in MEANT
    ]
    found += [
        Convention(
            "the angles are in rad, not deg (column map: unit)",
            _reader(read, read, np.degrees(1.0)),
        )
        for read in ("xyz", "zyx", VECTOR)
    ]
    return tuple(found)


def _backwards(order: str) -> str:
    """The order of axes that means the same rotation with its angles in the reverse order."""
    return order[::-1].swapcase()


def _reader(
    read: str, meant: str, factor: float = 1.0, order: slice = slice(None)
) -> Callable[[Array], Array]:
    """Return what reads the numbers of one convention by another one."""

    def turn(R: Array) -> Array:
        from scipy.spatial.transform import Rotation

        numbers = factor * find_numbers(R, read)[:, :, order]
        flat = numbers.reshape(-1, 3)
        if meant == VECTOR:
            turned = Rotation.from_rotvec(flat)
        else:
            turned = Rotation.from_euler(meant, flat)
        return np.asarray(turned.as_matrix().reshape(*numbers.shape[:2], 3, 3))

    return turn


def find_numbers(R: Array, read: str) -> Array:
    """Return the numbers (N, K, 3) that a convention reads as the rotations (N, 3, 3)."""
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_matrix(R)
    if read == VECTOR:  # a whole turn about the same axis changes nothing
        vector = rotation.as_rotvec()
        size = np.linalg.norm(vector, axis=1, keepdims=True)
        turn = 2 * np.pi * vector / np.where(size > 0, size, 1.0)
        return np.stack([vector, vector - turn, vector + turn], axis=1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # one of many solutions where two axes agree
        first = rotation.as_euler(read)
    a, b, c = first.T
    other = np.stack([a + np.pi, -b if read[0] == read[2] else np.pi - b, c + np.pi], axis=1)
    return np.stack([first, (other + np.pi) % (2 * np.pi) - np.pi], axis=1)


def _read_scalar_first(R: Array) -> Array:
    """Read quaternions that were taken for x y z w as w x y z."""
    from scipy.spatial.transform import Rotation

    turned = Rotation.from_quat(Rotation.from_matrix(R).as_quat()[:, [1, 2, 3, 0]])
    return np.asarray(turned.as_matrix()[:, None])
