"""The URDF of a model as text, and where each of its links is: what RViz shows of the robot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from parallel_cal.base.compiled import Single, dense
from parallel_cal.base.rotation import matrix_to_quaternion, quaternion_to_matrix
from parallel_cal.exporting.arm_urdf import arm_joints
from parallel_cal.exporting.targets.urdf import urdf_text
from parallel_cal.exporting.tree import Tree, tree_of
from parallel_cal.mechanisms.serial import Serial
from parallel_cal.model.model import Model

Z = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class LinkMotions:
    """How n joints of a URDF move their links, as arrays with one row for each joint.

    Joint i is at `origins[i]` (m) and `turned[i]` in its parent. Its value is `factors[i]` times
    the readings of driven and passive joints, plus `offsets[i]` (rad or m).
    """

    origins: np.ndarray = field(repr=False)  # (n, 3) m
    turned: np.ndarray = field(repr=False)  # (n, 3, 3)
    turns: np.ndarray = field(repr=False)  # (n, 3): the axis of a joint that turns, or 0
    slides: np.ndarray = field(repr=False)  # (n, 3): the axis of a joint that slides, or 0
    factors: np.ndarray = field(repr=False)  # (n, nq + number of passive joints)
    offsets: np.ndarray = field(repr=False)  # (n,) rad or m

    def place(self, readings: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
        """Return the position (n, 3) m and the rotation (n, 3, 3) of each link in its parent."""
        values = self.factors @ readings + self.offsets
        position = self.origins + np.einsum(
            "nij,nj->ni", self.turned, self.slides * values[:, None]
        )
        half = 0.5 * values[:, None]
        turn = np.hstack([np.sin(half) * self.turns, np.cos(half)])
        turn[~self.turns.any(axis=1)] = (0.0, 0.0, 0.0, 1.0)
        return position, self.turned @ quaternion_to_matrix(turn)


@dataclass(frozen=True)
class Description:
    """The URDF of a model, and how its joints move its links.

    Attributes
    ----------
    urdf : str
        The text of the URDF.
    tree : Tree or None
        The links of the URDF of a robot with loops; None for a serial arm.
    parents, children : tuple of str
        The links that each joint connects.
    motions : LinkMotions
        What each joint does.
    """

    model: Model
    urdf: str
    tree: Tree | None
    parents: tuple[str, ...]
    children: tuple[str, ...]
    motions: LinkMotions

    def transforms(
        self, configuration: np.ndarray, at: Mapping[str, Any] | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the pose of each link in its parent: positions (n, 3) m, quaternions (n, 4) xyzw.

        The driven joints are where the effects of the model place them, and the platform is at the
        pose of the configuration.

        Parameters
        ----------
        configuration : ndarray, shape (nq + 12,)
            The joint readings (rad or m), and the pose of {P} in {B} that belongs to them.
        at : mapping
            The conditions by name.
        """
        x = self._actual(configuration, at)
        passive = np.zeros(0) if self.tree is None else self.tree.values(x)
        position, rotation = self.motions.place([*x[: len(self.model.joints)], *passive])
        if self.tree is None:
            self._place_platform(position, rotation, x)
        return position, matrix_to_quaternion(rotation)

    def _actual(self, configuration: np.ndarray, at: Mapping[str, Any] | None) -> np.ndarray:
        """Return the configuration with the joints where they are: as the ideal mechanism's."""
        if not self.model.effects:
            return configuration
        rows = self.model.condition_rows(at, 1)
        [q] = self._ideal_joints(configuration, rows[0], self.model.values)
        return np.concatenate([q, configuration[-12:]])

    @cached_property
    def _ideal_joints(self) -> Single:
        s = self.model.structure
        return Single(dense("ideal_joints", (s.configuration, s.a, s.v), (s.seen.q,)))

    def _place_platform(self, position: np.ndarray, rotation: np.ndarray, x: np.ndarray) -> None:
        """Set the last joint of an arm, which is fixed, so that its link is at the pose of {P}.

        What an effect changes besides the joints, such as a length, is in this joint.
        """
        last, above = len(self.parents) - 1, {link: i for i, link in enumerate(self.children)}
        r, R, link = np.zeros(3), np.eye(3), self.parents[last]
        while link in above:
            i = above[link]
            r, R = position[i] + rotation[i] @ r, rotation[i] @ R
            link = self.parents[i]
        position[last] = R.T @ (x[-12:-9] - r)
        rotation[last] = R.T @ x[-9:].reshape(3, 3)


def describe(model: Model) -> Description:
    """Describe the robot of a model, without its sensors and the errors of its device.

    Raise ModelError if no pose of the workspace is reached.
    """
    model, name = model.robot(), model.mechanism.name
    if isinstance(model.mechanism, Serial):
        return _describe_arm(model, name)
    tree = tree_of(model)
    order = {name: i for i, name in enumerate([*model.joints, *tree.passive])}
    factors = np.zeros((len(tree.joints), len(order)))
    for row, joint in zip(factors, tree.joints, strict=True):
        row[order[joint.name]] = 1.0
    turns = np.array([joint.turns for joint in tree.joints])[:, None]
    axes = np.array([joint.axis for joint in tree.joints])
    motions = LinkMotions(
        origins=np.array([joint.origin for joint in tree.joints]),
        turned=np.tile(np.eye(3), (len(tree.joints), 1, 1)),
        turns=axes * turns,
        slides=axes * ~turns,
        factors=factors,
        offsets=np.zeros(len(tree.joints)),
    )
    return Description(
        model,
        urdf_text(model, name, tree),
        tree,
        tuple(joint.parent for joint in tree.joints),
        tuple(joint.child for joint in tree.joints),
        motions,
    )


def _describe_arm(model: Model, name: str) -> Description:
    joints, readings = arm_joints(model), list(model.joints)
    factors, offsets = np.zeros((len(joints), len(readings))), np.zeros(len(joints))
    for row, (i, joint) in zip(factors, enumerate(joints), strict=True):
        if joint.follows:
            row[readings.index(joint.follows.reading)] = joint.follows.factor
            offsets[i] = joint.follows.offset
        elif joint.kind:
            row[readings.index(joint.name)] = 1.0
    kinds = np.array([joint.kind or "" for joint in joints])[:, None]
    origins = np.array([joint.origin for joint in joints])
    motions = LinkMotions(
        origins=origins[:, :3, 3],
        turned=origins[:, :3, :3],
        turns=(kinds == "R") * Z,
        slides=(kinds == "P") * Z,
        factors=factors,
        offsets=offsets,
    )
    return Description(
        model,
        urdf_text(model, name, None),
        None,
        tuple(joint.parent for joint in joints),
        tuple(joint.child for joint in joints),
        motions,
    )
