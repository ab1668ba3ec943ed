"""Simulate a recording: model, effects, poses and noise give the recorded arrays."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from parallel_cal.base.arguments import check_arguments
from parallel_cal.base.errors import SolveError
from parallel_cal.base.rotation import matrix_to_quaternion, rotation_matrix
from parallel_cal.base.threads import single_threaded
from parallel_cal.base.units import ARCSEC
from parallel_cal.kinematics.answers import select_rows
from parallel_cal.kinematics.contacts import (
    find_nearest_contacts,
    list_contacts,
    make_contact,
    spread_over_contacts,
)
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.effect import parse_effect
from parallel_cal.model.mechanism import poses_in_workspace
from parallel_cal.model.model import Model, Noise
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.joining import fingerprint
from parallel_cal.recordings.loading import dataset_from_recording
from parallel_cal.recordings.recording import (
    Array,
    JointStream,
    PoseStream,
    Recording,
    ScalarStream,
    TextStream,
)

MOVE, DWELL = 0.5, 1.0  # s per motion and per dwell
JOINT_RATE, POSES_EVERY = 100, 5  # Hz; the device reports at every fifth joint reading, 20 Hz
JITTER = 0.2  # part of the noise sigma drawn for every message; the rest is one draw per dwell
# The payload (kg) changes after this number of poses.
PAYLOADS = (0.0, 0.5)
POSES_PER_PAYLOAD = 5
# The temperature of the workshop is a sine wave.
MEAN_TEMPERATURE_DEGC = 21.0
TEMPERATURE_AMPLITUDE_DEGC = 3.0
TEMPERATURE_PERIOD_S = 180.0
# Noise if the model file states none: the instruments of the thesis (sections 2.3.2 and 4.2).
TYPICAL = {"rad": 25 * ARCSEC, "m": 10e-6, "position": 10e-6, "orientation": 15 * ARCSEC}
MIN_TARGET_DISTANCE = 0.02  # of a joint's travel, between successive targets
MAX_DRAWS = 20  # draws per pose before the workspace counts as unreachable


@dataclass(frozen=True)
class Simulation:
    """What a robot and its measuring device would publish.

    Attributes
    ----------
    model : Model
        The simulated robot: a model with its effects.
    recording : Recording
        The streams of joints, poses and conditions.
    """

    model: Model
    recording: Recording

    def __repr__(self) -> str:
        return f"Simulation({self.model!r}, {self.recording!r})"

    def dataset(self) -> Dataset:
        """Return its samples; a recording of it (`write_bag`) has the same."""
        samples = dataset_from_recording(self.recording)
        return replace(samples, sha256=fingerprint(samples))


def with_effects(model: Model, effects: Iterable[tuple[str, Mapping[str, float]]]) -> Model:
    """Return the robot with these effects in addition.

    A parameter that is not given has the value of its tolerance, or, if it is known rather than
    identified (a mass, a gear's ratio), its nominal value.
    """
    for name, given in effects:
        if all(effect.name != name for effect in model.effects):
            model = model.with_effect(name)
        values = model.values.copy()
        table, effect = model.table, next(e for e in model.effects if e.name == name)
        own = table.matching([f"{name}.*"])
        values[own] = table.tolerance[own]
        known = table.matching(effect.fixed_patterns())
        values[known] = table.nominal[known]
        for key, value in given.items():
            # `width` is every joint's, `joint1.width` that of one, `joint?.width` a pattern.
            exact = f"{name}.{key}" in table.names
            of_joint = any(n.startswith(f"{name}.") and n.endswith(f".{key}") for n in table.names)
            pattern = f"{name}.{key}" if exact or not of_joint else f"{name}.*.{key}"
            values[table.matching([pattern])] = value
        model = model.with_values(values)
    return model


@check_arguments(SolveError)
@single_threaded()
def simulate(
    model: Model,
    poses: int,
    seed: int = 0,
    *,
    effects: Iterable[str] = (),
    replicates: int = 0,
    quiet: bool = False,
    targets: np.ndarray | None = None,
    with_device: bool | None = None,
) -> Simulation:
    """Simulate a recording of a robot.

    Parameters
    ----------
    model : Model
        The simulated robot. Its noise is that of the model, or typical noise where the model states
        none.
    poses : int
        Number of poses, drawn at random in the workspace.
    seed : int, optional
        Seed of the random poses and of the noise.
    effects : iterable of str, optional
        Effects that the robot has in addition: `"NAME"` or `"NAME:parameter=value,..."`.
    replicates : int, optional
        Number of random poses that are visited twice.
    quiet : bool, optional
        Simulate readings and measurements without noise. The recording states the usual
        covariances nevertheless.
    targets : ndarray (poses, nq), optional
        Joint positions (rad or m) of the poses, in the order of the visits. They replace the
        random poses and `replicates`. If a sensor of the model has contacts, each target is moved
        into the nearest one.
    with_device : bool, optional
        Whether a device measures the poses. Default: only if no sensor of the model has contacts,
        such as sockets for a ball on the platform.

    Returns
    -------
    Simulation
        `dataset()` returns the samples. `write_bag` writes the recording.

    Raises
    ------
    SolveError
        If the robot cannot reach the poses, or if `poses` or `replicates` is out of range.

    Examples
    --------
    >>> import parallel_cal as pc
    >>> simulation = pc.simulate(pc.new_model("delta24"), 12, effects=["backlash:width=0.005"])
    >>> len(simulation.dataset())
    12
    """
    if targets is not None and np.shape(targets) != (poses, len(model.joints)):
        raise SolveError(
            f"targets have the shape {np.shape(targets)}; expected {(poses, len(model.joints))}, "
            "a row of joint readings for each pose"
        )
    if poses < 1 or not 0 <= replicates <= poses:
        raise SolveError(f"{replicates} replicates of {poses} poses: expected at most one each")
    model = with_effects(model, map(parse_effect, effects))
    rng = np.random.default_rng(seed)
    contacts = list(list_contacts(model))
    if targets is None:
        targets = _targets(model, poses, rng)
        targets = np.vstack([targets, targets[rng.permutation(poses)[:replicates]]])
        if not contacts:  # between two contacts, the tip lifts off
            targets = _separate_neighbours(targets)
    motion = _motion(model, targets)
    touch = None
    if contacts:
        motion, touch = _touch(model, motion, targets, rng, quiet)
    if model.structure.equations > len(model.mechanism.moves):
        # With more lines than coordinates, the joints depend on each other, and an effect changes
        # how. Use the joints of the same poses under the conditions at the end of each dwell.
        last = np.searchsorted(motion.dwell, np.arange(len(targets)), side="right") - 1
        pose = Kinematics(model).direct(targets)
        at = {key: column[last] for key, column in motion.at.items()}
        motion = _motion(model, Kinematics(model).inverse(pose.position, pose.rotation, at).joints)
    stated = stated_noise(model)
    errors = _Errors(model, Noise() if quiet else stated, len(targets), rng)
    joints = JointStream(
        "joint_states",
        model.joints,
        motion.time,
        errors.add_to_joints(motion.joints, motion.dwell),
        np.full_like(motion.joints, np.nan),
    )
    if with_device is None:
        with_device = not contacts
    measured = _measure_poses(model, motion, errors, np.diag(_pose_sigma(stated) ** 2), with_device)
    slow, payload = np.arange(0.0, motion.time[-1], 1.0), motion.at["payload"]
    changes = np.flatnonzero(np.diff(payload, prepend=np.nan) != 0)
    conditions = {
        "temperature": ScalarStream("temperature", slow, _temperature(slow)),
        "payload": ScalarStream("payload", motion.time[changes], payload[changes]),
    }
    read = _read_sensors(model, motion, rng, quiet)
    return Simulation(
        model,
        Recording("simulated", 0, joints, measured, conditions, constraint=touch, distances=read),
    )


def _touch(
    model: Model, motion: _Motion, targets: np.ndarray, rng: np.random.Generator, quiet: bool
) -> tuple[_Motion, TextStream]:
    """Return the motion that ends in the contact nearest to each target (N, nq), to within the
    seating error, and the names of the contacts over time."""
    contacts = list_contacts(model)
    last = np.searchsorted(motion.dwell, np.arange(len(targets)), side="right") - 1
    at = {key: column[last] for key, column in motion.at.items()}
    a = model.condition_rows(at, len(targets))
    poses = Kinematics(model).direct(targets, at)
    which = find_nearest_contacts(model, poses, a)
    held = np.array(list(contacts.values()))[which]
    seat = model.structure.standard_uncertainty * rng.standard_normal(held.shape)
    found = make_contact(model, poses, held, np.zeros(held.shape) if quiet else seat, a)
    if missed := int((~found.solved).sum()):
        raise SolveError(
            f"{missed} of {len(targets)} poses reach no contact of {', '.join(contacts)}: state "
            "its place in the model file, inside the workspace"
        )
    names = tuple(np.array(list(contacts))[which].tolist())
    start: Array = np.arange(len(targets), dtype=float) * (MOVE + DWELL)
    return _motion(model, found.joints), TextStream("constraint", start, names)


def _read_sensors(
    model: Model, motion: _Motion, rng: np.random.Generator, quiet: bool
) -> dict[str, ScalarStream]:
    """Return the readings of the sensors that read wherever the robot moves, with their noise: one
    draw per dwell."""
    read = [c for s in model.sensors if s.reads_always for c in s.channels]
    if not read:
        return {}
    seen = slice(None, None, POSES_EVERY)
    at = {key: column[seen] for key, column in motion.at.items()}
    answer = Kinematics(model).direct(motion.joints[seen], at)
    solved, structure = answer.solved, model.structure
    rows = structure.residuals(
        answer[solved].configuration.rows,
        model.condition_rows(select_rows(at, solved), int(solved.sum())),
        model.values,
    )[0]
    values = rows[:, structure.phi.shape[0] :]
    if not quiet:
        errors = rng.standard_normal((motion.dwell[-1] + 1, values.shape[1]))
        values = values + structure.standard_uncertainty * errors[motion.dwell[seen][solved]]
    time = motion.time[seen][solved]
    return {
        channel: ScalarStream("distance", time, values[:, k])
        for k, channel in enumerate(structure.channels)
        if channel in read
    }


def _measure_poses(
    model: Model, motion: _Motion, errors: _Errors, covariance: np.ndarray, with_device: bool
) -> PoseStream:
    """Return the poses that the device reports, with the covariance (6, 6) that it states; none
    without a device."""
    seen = slice(None, None if with_device else 0, POSES_EVERY)
    at = {key: column[seen] for key, column in motion.at.items()}
    answer = Kinematics(model).direct(motion.joints[seen], at)
    # On its straight path between two poses, a robot may pass configurations without a solution.
    solved = answer.solved
    position, rotation = errors.add_to_pose(answer.position, answer.rotation, motion.dwell[seen])
    m = int(solved.sum())
    return PoseStream(
        "measured_pose" if with_device else "",
        model.frames["base"],
        motion.time[seen][solved],
        position[solved],
        matrix_to_quaternion(rotation[solved]),
        np.ones((m, 6), bool),
        np.tile(covariance, (m, 1, 1)),
    )


def _separate_neighbours(targets: np.ndarray) -> np.ndarray:
    """Reorder the targets so that two near ones do not follow each other.

    Otherwise they would look like one long dwell.
    """
    order = targets / np.maximum(np.ptp(targets, axis=0), 1e-12)
    targets = targets.copy()
    for k in range(1, len(order)):
        far = np.abs(order[k:] - order[k - 1]).max(axis=1) > MIN_TARGET_DISTANCE
        other = k + int(np.argmax(far))  # k itself if it is far, or if none is
        for rows in (order, targets):
            rows[[k, other]] = rows[[other, k]]
    return targets


def _targets(model: Model, n: int, rng: np.random.Generator) -> np.ndarray:
    """Draw joints (n, nq) of poses in the workspace that the robot reaches within its limits; in
    its contacts in turn if sensors of the model have some."""
    kinematics, found = Kinematics(model), np.empty((0, len(model.joints)))
    has_contacts = bool(list_contacts(model))
    for _ in range(MAX_DRAWS):
        r, R = poses_in_workspace(model.mechanism, n, rng)
        joints = kinematics.inverse(r, R)
        reached = joints.joints[joints.ok]
        if len(reached):
            reached = reached[kinematics.direct(reached).ok]
        if has_contacts:
            start, a = kinematics.direct(reached), model.condition_rows(None, len(reached))
            reached = spread_over_contacts(model, start, a)[0].joints
        found = np.vstack([found, reached])
        if len(found) >= n:
            return np.asarray(found[:n])
    low, high = model.mechanism.workspace.low, model.mechanism.workspace.high
    raise SolveError(
        f"only {len(found)} of {MAX_DRAWS * n} poses between {low} and {high} (m, "
        "rad) are within reach and joint limits; make the workspace in the model "
        "file smaller"
    )


@dataclass(frozen=True)
class _Motion:
    """Time (n,), joints (n, nq), conditions (n,), and the number of the dwell at each time (n,)."""

    time: np.ndarray
    joints: np.ndarray
    at: dict[str, np.ndarray]
    dwell: np.ndarray


def _motion(model: Model, targets: np.ndarray) -> _Motion:
    """Move from home to each target (N, nq) in turn, joints in straight lines, and dwell there."""
    stops = np.vstack([model.mechanism.home.joints, targets])
    n = round(len(targets) * (MOVE + DWELL) * JOINT_RATE)
    time = np.arange(n) / JOINT_RATE
    dwell = np.arange(n) * len(targets) // n
    part = np.clip((time - dwell * (MOVE + DWELL)) / MOVE, 0, 1)[:, None]
    steps = np.diff(stops, axis=0)
    joints = stops[dwell] + part * steps[dwell]
    moving = part < 1
    at = {"time": time, "temperature": _temperature(time)}
    at["payload"] = np.array(PAYLOADS)[dwell // POSES_PER_PAYLOAD % len(PAYLOADS)]
    direction = np.where(np.abs(steps) > 1e-9, np.sign(steps), 0.0)
    at_start = np.zeros(steps.shape)  # the travel since the last reversal when a step begins
    for k in range(1, len(steps)):
        # A joint that does not move keeps the direction of its last motion.
        direction[k] = np.where(direction[k] == 0, direction[k - 1], direction[k])
        goes_on = direction[k] == direction[k - 1]
        at_start[k] = np.where(goes_on, at_start[k - 1] + steps[k - 1], 0.0)
    travel = at_start[dwell] + part * steps[dwell]
    for j, name in enumerate(model.joints):
        at[f"direction.{name}"] = direction[dwell, j]
        at[f"travel.{name}"] = travel[:, j]
        at[f"velocity.{name}"] = np.where(moving[:, 0], steps[dwell, j] / MOVE, 0.0)
    return _Motion(time, joints, at, dwell)


def _temperature(time: np.ndarray) -> np.ndarray:
    return np.asarray(
        MEAN_TEMPERATURE_DEGC
        + TEMPERATURE_AMPLITUDE_DEGC * np.sin(2 * np.pi * time / TEMPERATURE_PERIOD_S)
    )


class _Errors:
    """Measurement errors: one draw per dwell, plus a smaller one per message (JITTER)."""

    def __init__(self, model: Model, noise: Noise, dwells: int, rng: np.random.Generator):
        self.joint_sigma = np.nan_to_num(replace(model, noise=noise).joint_noise)
        self.pose_sigma = _pose_sigma(noise)
        self._rng = rng
        self._joint = rng.standard_normal((dwells, len(self.joint_sigma)))
        self._pose = rng.standard_normal((dwells, 6))

    def add_to_joints(self, joints: np.ndarray, dwell: np.ndarray) -> np.ndarray:
        return joints + self.joint_sigma * self._draws(self._joint, dwell)

    def add_to_pose(
        self, position: np.ndarray, rotation: np.ndarray, dwell: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        error = self.pose_sigma * self._draws(self._pose, dwell)
        return position + error[:, :3], rotation_matrix(error[:, 3:]) @ rotation

    def _draws(self, constant: np.ndarray, dwell: np.ndarray) -> np.ndarray:
        return constant[dwell] + JITTER * self._rng.standard_normal((len(dwell), constant.shape[1]))


def stated_noise(model: Model) -> Noise:
    """Return the model's noise, completed with that of typical instruments."""
    own, joint = model.noise, model.noise.joint
    if np.isnan(model.joint_noise).any():
        typical = {unit: TYPICAL[unit] for unit in model.mechanism.joint_units}
        stated = joint if isinstance(joint, Mapping) else {}
        joint = {**typical, **stated} if len(typical) > 1 or stated else typical.popitem()[1]
    return Noise(
        joint,
        TYPICAL["position"] if own.position is None else own.position,
        TYPICAL["orientation"] if own.orientation is None else own.orientation,
    )


def with_noise(model: Model) -> Model:
    """Return the model with typical noise of the joints and of the device if it states none.

    A device for which only one of position and orientation is stated does not measure the other.
    """
    own, stated = model.noise, stated_noise(model)
    joint, device = stated.joint, (own.position, own.orientation)
    if device == (None, None) and not model.structure.channels:
        device = (stated.position, stated.orientation)
    return replace(model, noise=Noise(joint, *device))


def _pose_sigma(noise: Noise) -> np.ndarray:
    return np.repeat([noise.position or 0.0, noise.orientation or 0.0], 3)


def document(session: Simulation, poses: int, replicates: int) -> dict[str, Any]:
    """Describe a simulation for the command line: counts, duration in s, the effects' values."""
    model, joints = session.model, session.recording.joints.time
    start = len(model.mechanism.parameters)
    names: Sequence[str] = model.table.names[start:]
    return {
        "poses": poses,
        "replicates": replicates,
        "joint_messages": len(joints),
        "pose_messages": len(session.recording.pose.time),
        "duration": float(joints[-1]),
        "effects": [effect.name for effect in model.effects],
        "effect_parameters": dict(zip(names, model.values[start:].tolist(), strict=True)),
        "noise": vars(stated_noise(model)),
    }
