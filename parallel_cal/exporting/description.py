"""The URDF of a model as text, and where each of its links is: what RViz shows of the robot."""

from __future__ import annotations

from collections.abc import Mapping
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
class Description:
    """The URDF of a model, and its joints as arrays, one row for each of n joints.

    Attributes
    ----------
    urdf : str
        The text of the URDF.
    tree : Tree or None
        The links of the URDF of a robot with loops; None for a serial arm.
    parents, children : tuple of str
        The links that each joint connects.
    """

    model: Model
    urdf: str
    tree: Tree | None
    parents: tuple[str, ...]
    children: tuple[str, ...]
    _origins: np.ndarray = field(repr=False)  # (n, 3) m
    _turned: np.ndarray = field(repr=False)  # (n, 3, 3)
    _turns: np.ndarray = field(repr=False)  # (n, 3): the axis of a joint that turns, or 0
    _slides: np.ndarray = field(repr=False)  # (n, 3): the axis of a joint that slides, or 0
    _factors: np.ndarray = field(repr=False)  # (n, nq + number of passive joints)
    _offsets: np.ndarray = field(repr=False)  # (n,) rad or m

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
        values = self._factors @ [*x[: len(self.model.joints)], *passive] + self._offsets
        position = self._origins + np.einsum(
            "nij,nj->ni", self._turned, self._slides * values[:, None]
        )
        half = 0.5 * values[:, None]
        turn = np.hstack([np.sin(half) * self._turns, np.cos(half)])
        turn[~self._turns.any(axis=1)] = (0.0, 0.0, 0.0, 1.0)
        rotation = self._turned @ quaternion_to_matrix(turn)
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
    return Description(
        model,
        urdf_text(model, name, tree),
        tree,
        tuple(joint.parent for joint in tree.joints),
        tuple(joint.child for joint in tree.joints),
        np.array([joint.origin for joint in tree.joints]),
        np.tile(np.eye(3), (len(tree.joints), 1, 1)),
        axes * turns,
        axes * ~turns,
        factors,
        np.zeros(len(tree.joints)),
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
    return Description(
        model,
        urdf_text(model, name, None),
        None,
        tuple(joint.parent for joint in joints),
        tuple(joint.child for joint in joints),
        origins[:, :3, 3],
        origins[:, :3, :3],
        (kinds == "R") * Z,
        (kinds == "P") * Z,
        factors,
        offsets,
    )
