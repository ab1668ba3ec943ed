"""Estimate from poses where a pose device stands and where its target sits.

The frames of device and target are those for which measured poses are nearest to the predicted
ones (`frames.py`). The errors of the robot remain.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.errors import FitError
from parallel_cal.base.rotation import (
    quaternion_to_matrix,
    rotation_vector,
    turns_from_mean,
)
from parallel_cal.identification.checks import free_mask
from parallel_cal.identification.frames import IDENTITY_FRAMES, Frames, PosePairs
from parallel_cal.identification.linearisation import Linearisation, follow_closure
from parallel_cal.identification.methods import implicit
from parallel_cal.identification.methods.forward import minimise_pose_errors
from parallel_cal.identification.moved_frames import (
    Explanation,
    describe_what_moved,
    explain_by_frames,
)
from parallel_cal.identification.observability import find_independent_columns
from parallel_cal.identification.observations import Observations, observe
from parallel_cal.identification.options import FitOptions
from parallel_cal.identification.predictions import predict_configurations, reach
from parallel_cal.identification.prior import Prior
from parallel_cal.identification.thresholds import (
    MAX_DISPLACEMENT_M,
    MAX_DISPLACEMENT_RAD,
    MAX_REMAINING_SHARE,
    MAX_REMAINING_SHARE_IDENTIFIED,
    MAX_UNCERTAIN_TILT_RAD,
    MIN_EXPLAINED_ERROR_RATIO,
    MIN_FRAME_COLUMN_REMAINDER,
    MIN_FRAME_POSES,
    MIN_REGISTRATION_POSES,
    MIN_UNREGISTERED_ERROR_RATIO,
    ROUNDING,
    UNKNOWN_TOLERANCES,
)
from parallel_cal.model.mechanism import POSE, list_shown_displacements
from parallel_cal.model.model import Model
from parallel_cal.model.parameters import Named
from parallel_cal.model.shelf import load_sensor
from parallel_cal.recordings.dataset import Dataset

SENSOR = "device_frame"
FRAME, TARGET = f"{SENSOR}.frame.", f"{SENSOR}.target."  # and a coordinate
TARGET_PLACE = tuple(f"{TARGET}{axis}" for axis in "xyz")
# Of the effect that describes a station for each of several recordings
STATION_EFFECT = "parallel_cal.identification.stations"
TARGET_EFFECT = "target_offset"  # an effect that states where the target sits
LARGEST_EFFECT = 30.0  # of its usual sizes
TOLERANCE_SAMPLE_SIZE = 24  # poses for the median error that tolerances explain

Array = np.ndarray


@dataclass(frozen=True)
class Registration:
    """Pose of a device's frame in the base, and of its target on the platform.

    `why` is the reason for the registration. `told` is whether the platform turned enough to
    determine the target. `held` are the coordinates of the device's frame that the samples do not
    show, because the robot does not move in them: they stay as the model has them. Positions in m,
    quaternions x y z w.
    """

    frame: str
    base: str
    platform: str
    why: str
    position: tuple[float, ...]
    quaternion: tuple[float, ...]
    target_position: tuple[float, ...]
    target_quaternion: tuple[float, ...]
    told: bool
    held: tuple[str, ...] = ()

    @property
    def description(self) -> str:
        """`frame 'tracker' was registered to 'base': 2.1 -1.3 0.4 m, rotation 3 -4 115 deg ...`"""
        vectors = [
            np.degrees(rotation_vector(quaternion_to_matrix(q)))
            for q in (self.quaternion, self.target_quaternion)
        ]
        # Adding 0.0 turns -0.0 into 0.0.
        turned = [" ".join(f"{v + 0.0:.3f}" for v in np.round(vector, 3)) for vector in vectors]
        target = " ".join(f"{1e3 * v:.2f}" for v in self.target_position)
        also = f", rotation {turned[1]} deg" if turned[1] != "0.000 0.000 0.000" else ""
        if not self.told:
            also += " (assumed: the platform does not turn enough to determine it; if it is off by "
            also += "more than 2 mm, state it as target_position of the sensor device_frame)"
        if self.held:
            also += f"; {', '.join(self.held)} of the frame are not measured and were held"
        # The device states the base's name, but measured in another frame.
        own, of = ("", "") if self.frame != self.base else (" of the poses", " of the model")
        return (
            f"frame '{self.frame}'{own} was registered to '{self.base}'{of} ({self.why}): "
            f"{' '.join(f'{v:.5f}' for v in self.position)} m, rotation {turned[0]} deg; "
            f"its target in '{self.platform}': {target} mm{also}"
        )

    def document(self) -> dict[str, Any]:
        return dict(vars(self))


def register_device(
    model: Model, dataset: Dataset, joint_sigma: float | None = None, insist: bool = False
) -> tuple[Model, Registration | None]:
    """Add the sensor `device_frame` to the model if the poses are in a frame that is not its base,
    or if frames explain the error that the data show; else return the same model.

    FitError for joint readings that no such robot shows, unless the caller insists.
    """
    observations = observe(model, dataset, joint_sigma, insist)
    there = DevicePoses.of(model, observations)
    return register_observed(model, dataset.frame, observations, there)


def register_observed(
    model: Model, frame: str, observations: Observations, there: DevicePoses | None
) -> tuple[Model, Registration | None]:
    """Register as `register_device` does, from observations in `frame` and their poses."""
    if there is None:
        return model, None
    found, base, stated = there.frames, model.frames["base"], _device(model) is not None
    elsewhere = frame not in ("", base) and not stated
    plain = elsewhere or there.exceeds_tolerances(found)
    if not (plain or there.is_misplaced(found, is_identified(model), stated)):
        return model, None
    placed = _with_fitted_frames(model, observations, there)
    if not (plain or is_identified(model) or _stays_displaced(placed, observations, there)):
        return model, None
    why = "the poses are in another frame" if elsewhere else "the poses did not fit without it"
    if not elsewhere and is_identified(model):
        why += (
            f"; {there.now.describe_move(found)} from where the model has it; "
            f"{describe_what_moved(model, observations, there)}"
        )
    return placed, Registration(
        frame or "device",
        base,
        model.frames["platform"],
        why,
        told=there.tells_target,
        held=there.held,
        **_state_frames(placed),
    )


def _stays_displaced(placed: Model, observations: Observations, there: DevicePoses) -> bool:
    """Whether the frames are still displaced if the robot's own parameters are fitted beside them.

    Frames alone take over what a robot's errors have in common: zeros of joints move the platform
    nearly as a displaced device does. Beside the robot's parameters, with their tolerances as
    priors, they keep only what these do not describe better. Nothing is known of the frames, so
    where a robot and its frames can move alike the frames keep the displacement.
    """
    own = there.find_free(placed)
    free = (~np.asarray(placed.fixed) & (placed.table.tolerance > 0)) | own
    near = observations.select(there.find_near(frames_of(placed)))
    try:
        beside = _fit_beside_robot(placed, near, free, own)
    except FitError:  # no tolerances describe these samples
        return True
    return there.are_far_apart(frames_of(beside))


def registered_by(model: Model, observations: Observations) -> Model | None:
    """The model with the frames that leave the smallest errors of the poses, None if the samples
    are too few. No other parameter changes."""
    return place_frames(model, observations, DevicePoses.of(model, observations))


def place_frames(
    model: Model, observations: Observations, there: DevicePoses | None
) -> Model | None:
    """Fit the frames as `registered_by` does, from the poses of the same observations."""
    placed = model
    if there is not None:
        placed = _with_fitted_frames(model, observations, there)
    elif not shows_pose(model):
        return None
    patterns = [f"{sensor.name}.*" for sensor in placed.sensors if sensor.shows_pose]
    own = placed.table.matching(patterns) & ~np.asarray(placed.fixed)
    # A fit fixes where parts stand as far as the robot explains it. Here the robot does not move.
    known = placed.table.matching(p for s in placed.sensors for p in s.fixed_patterns())
    parts = _placements(placed) & ~_numbers(placed) & ~known
    own |= parts
    if not own.any():
        return placed
    try:
        values = implicit.estimate(placed, observations, own, prior=None).values
        placed = placed.with_values(values, placed.covariance)
        # In an image, a shift and a turn of the board nearly cancel. Least squares of pixels may
        # leave millimetres that all poses share, although they are an error of where parts stand.
        return minimise_pose_errors(placed, observations, parts) if parts.any() else placed
    except FitError:  # the search does not converge: the views stay
        return placed


def is_registrable(model: Model, there: DevicePoses | None) -> bool:
    """Whether an error can be judged after registration: nothing states where the device stands,
    and the platform turns far enough in enough poses to determine its frame and target.

    An identified model is taken as it is: its own fit has placed the robot before the device.
    """
    if _device(model) is not None or model.covariance is not None:
        return False
    if shows_pose(model):
        return True
    return there is not None and there.determines_target


def prepared_for_fit(
    model: Model, registration: Registration | None, dataset: Dataset, options: FitOptions
) -> tuple[Model, Registration | None]:
    """A registered model as the start of a fit: the frames are fitted together with the robot, and
    those of their parameters are free that are independent of the robot's.

    A model that was not registered, and has no sensor that shows poses, is unchanged. A model that
    an earlier fit registered is unchanged, too, unless other parameters of the robot are free now:
    if one that was free is fixed, the frame must be able to move in its place. If an effect is new,
    the frame stands where the lack of this effect has moved it.

    Coordinates of a frame that no pose of the robot shows are held. A tilt of the plane in which a
    robot moves only makes it smaller, by the square of the angle: a fit from 0 does not see it, and
    a fit from elsewhere takes errors of scale for it.
    """
    hidden = np.isin(model.table.names, [f"{SENSOR}.{name}" for name in _list_hidden(model)])
    if (hidden & ~np.asarray(model.fixed)).any():
        model = replace(model, fixed=model.fixed | hidden)
    refixed = registration is None and not shows_pose(model)
    if refixed and not _are_others_free(model, options):
        return model, None
    if registration is not None and options.update and model.covariance is not None:
        return model, registration  # the last calibration knows the robot: its frames are free
    observations = observe(model, dataset, options.joint_sigma, options.insist)
    told = registration is None or registration.told
    if refixed:
        if (there := DevicePoses.of(model, observations)) is None:
            return model, None
        freed = np.asarray(model.fixed) & ~there.find_free(model)
        model, told = replace(model, fixed=freed), there.tells_target
    settled = _fit_frames(model, observations, options, told)
    return settled, registration and replace(registration, **_state_frames(settled))


def _are_others_free(model: Model, options: FitOptions) -> bool:
    """Whether an earlier fit registered the model, and other parameters of the robot are free now
    than in that fit."""
    if options.refit or not any(entry.get("registered") for entry in model.history):
        return False
    if model.covariance is None:  # effects were added or removed since
        return True
    free = free_mask(model, options.free, options.fix)
    return bool(((free == model.fixed) & ~_placements(model)).any())


def add_registration_warning(dataset: Dataset, registration: Registration | None) -> Dataset:
    """The dataset with a warning that says where the device was registered."""
    if registration is None:
        return dataset
    return replace(dataset, warnings=(*dataset.warnings, registration.description))


@dataclass(frozen=True)
class DevicePoses(PosePairs):
    """Predicted poses in {B} and poses as the device shows them.

    `tilts` is whether the platform turned further than its tolerances explain, or so far that no
    robot's errors explain it: otherwise no pose determines where the target sits. The target is
    not free if the model states it. `poses` counts different poses.
    """

    tilts: bool = field(kw_only=True)
    poses: int = field(kw_only=True)
    expected: Array = field(kw_only=True)  # rms (2,) that tolerances allow, of position and of
    # `length` times orientation

    @classmethod
    def of(
        cls, model: Model, observations: Observations, quick: bool = False
    ) -> DevicePoses | None:
        """None if too little was measured, or the model moves nothing that was measured. If
        `quick`, poses that are not found at once count as not measured."""
        n, m = len(model.joints), model.mechanism
        seen = model.configuration(observations.x)
        reached = reach(model, observations, quick)
        solved = reached.solved
        moves = [any(i in m.moved for i in part) for part in (range(3), range(3, 6))]
        measured = solved[:, None] & observations.measured[:, n : n + 6]
        measured[:, :3] &= moves[0]
        placed, turned = (measured[:, part].any(axis=1) for part in (slice(3), slice(3, 6)))
        if max(placed.sum(), turned.sum() * moves[1]) < MIN_FRAME_POSES:
            return None
        # The error that tolerances allow differs little between poses: a few poses are enough.
        few = np.flatnonzero(solved)[:: max(int(solved.sum()) // TOLERANCE_SAMPLE_SIZE, 1)]
        rows, a = reached.configuration.rows[few], observations.a[few]
        C, J = model.structure.jacobians(rows, a, model.values)
        free = ~np.asarray(model.fixed) & (model.table.tolerance > 0)
        by, _ = follow_closure(model, np.nan_to_num(C), np.nan_to_num(J[:, :, free]))
        spread = np.zeros((len(C), 6))
        frame = model.table.tolerance[_numbers(model)]
        turned_by = np.array([p.unit == "rad" for p in model.table])[_numbers(model)]
        shifts, turns = (np.sum(frame[k] ** 2) for k in (~turned_by, turned_by))
        away = float(np.median(np.linalg.norm(seen.r[placed], axis=1))) if placed.any() else 0.0
        spread[:, m.moved] = np.sqrt(np.sum((by * model.table.tolerance[free]) ** 2, axis=2))
        sizes = [
            np.sqrt(np.median(np.sum(spread[:, part] ** 2, axis=1)) + more)
            for part, more in ((slice(3), shifts + turns * away**2), (slice(3, 6), turns))
        ]
        turned_away = turns_from_mean(reached.rotation[solved])
        # Wide tolerances must not hide a rotation that nobody mistakes for an error.
        allowed = min(
            float(np.median(np.sum(spread[:, 3:] ** 2, axis=1))), MAX_UNCERTAIN_TILT_RAD**2
        )
        tilts = bool(np.mean(np.sum(turned_away**2, axis=1)) > allowed) and moves[1]
        return cls(
            reached.position,
            reached.rotation,
            seen.r,
            seen.R,
            measured,
            m.length,
            tilts and not _states_target(model),
            m.moves,
            frames_of(model),
            tilts=tilts,
            poses=len(np.unique(observations.group[placed | turned])),
            expected=np.array([sizes[0], m.length * sizes[1]]),
        )

    @property
    def held(self) -> tuple[str, ...]:
        """Coordinates of the device's frame that no sample shows: the robot does not move in them,
        and the device does not measure that it does not. If the robot moves in x, y and z, these
        are the axes of the device along which nothing was measured."""
        if self._hidden or not self.placed.any():
            return self._hidden
        seen = np.any(self.measured[:, :3], axis=0)
        return tuple(axis for axis, shown in zip(POSE, seen, strict=False) if not shown)

    @property
    def tells_target(self) -> bool:
        """Whether the poses tell where the target sits, or nothing measured depends on it."""
        return self.tilts or not (self.turns and self.placed.any())

    @property
    def determines_target(self) -> bool:
        """Whether enough measured positions tell a displaced target from a displaced frame."""
        return self.tilts and self.poses >= MIN_REGISTRATION_POSES and bool(self.placed.any())

    def exceeds_tolerances(self, found: Frames) -> bool:
        """Whether the error exceeds what the robot's tolerances explain, and frames explain most
        of it."""
        before, after = self.compute_median_errors(self.now), self.compute_median_errors(found)
        off = before > MIN_UNREGISTERED_ERROR_RATIO * self.expected
        return bool((off & (before > MIN_EXPLAINED_ERROR_RATIO * after)).any())

    def is_misplaced(self, found: Frames, identified: bool, stated: bool) -> bool:
        """Whether frames explain a significant part of an error that tolerances may explain, too,
        and differ from the model's by more than a workshop would call aligned.

        An `identified` robot has no errors of its own that resemble frames, so the limit of
        alignment does not apply to it. If the model has `stated` where the device stands, a fit
        moves the frame from there.
        """
        # On a platform that never turns, a displaced target is a displaced frame.
        separate = self.determines_target or not (self.turns or stated) or identified
        judged = separate and self.poses >= MIN_REGISTRATION_POSES
        return judged and self.is_displaced(found, identified)

    def is_displaced(self, found: Frames, identified: bool) -> bool:
        """Whether frames explain a significant part of the error and differ from the model's by
        more than a workshop calls aligned."""
        before = Explanation.of("nothing moved", self, self.now, 0)
        after = explain_by_frames("frames", self, found)
        share = MAX_REMAINING_SHARE_IDENTIFIED if identified else MAX_REMAINING_SHARE
        significant = after.criterion < before.criterion
        smaller = np.sum(after.errors**2) < share * np.sum(before.errors**2)
        return bool(significant and smaller and (identified or self.are_far_apart(found)))

    def are_far_apart(self, found: Frames) -> bool:
        now = self.now
        # Compare at the robot's base: the origin of a device far away moves a lot with a small
        # rotation, and at the poses the robot's own errors of angle look like shifts.
        turn = found.F @ now.F.T
        shifts = (found.f - turn @ now.f, found.t - now.t)
        turns = (rotation_vector(turn), rotation_vector(found.T @ now.T.T))
        return bool(
            max(np.linalg.norm(v) for v in shifts) > MAX_DISPLACEMENT_M
            or max(np.linalg.norm(v) for v in turns) > MAX_DISPLACEMENT_RAD
        )

    def find_free(self, model: Model) -> Array:
        """Mask of the parameters of the sensor that can be fitted: the closure holds only the
        coordinates in which the robot moves, no pose determines the target of a platform that does
        not tilt, and an effect may state it."""
        shown = [f"{FRAME}{c}" for c in list_shown_displacements(self.moves)]
        turns_or_told = [c.startswith("r") or self._free[6 + i] for i, c in enumerate(POSE)]
        shown += [f"{TARGET}{c}" for c, free in zip(POSE, turns_or_told, strict=True) if free]
        return np.isin(model.table.names, shown)


def _with_frames(model: Model, frames: Frames) -> Model:
    """The model whose sensor `device_frame` has these frames as nominal values."""
    now: Any = _device(model) or load_sensor(SENSOR)
    names = [p.name for p in now.parameters(model.mechanism)]
    hidden = [name for name in _list_hidden(model) if name in names]
    placed = now.placed(frames.f, frames.F, frames.t, frames.T, np.eye(3))
    sensor = replace(placed, fixed=tuple(dict.fromkeys([*now.fixed, *hidden])))
    others = tuple(s for s in model.sensors if s.name != SENSOR)
    model = model.with_sensors((*others, sensor))
    model = replace(model, fixed=model.fixed | model.table.matching(sensor.fixed_patterns()))
    own = [name.startswith((FRAME, TARGET)) for name in model.table.names]
    return model.with_values(np.where(own, 0.0, model.values), model.covariance)


def _list_hidden(model: Model) -> list[str]:
    """The parameters of a device's frame that no pose of the robot shows."""
    shown = list_shown_displacements(model.mechanism.moves)
    return [f"frame.{coordinate}" for coordinate in POSE if coordinate not in shown]


def _with_fitted_frames(model: Model, observations: Observations, there: DevicePoses) -> Model:
    """The model with the frames, and with the stations of later recordings, that leave the smallest
    errors of the poses. Poses that are far off do not count."""
    placed = _with_frames(model, there.frames)
    stations = [name.startswith(f"{STATION_EFFECT}.") for name in placed.table.names]
    free = np.array(stations) & ~np.asarray(placed.fixed)
    if not free.any():
        return placed
    free |= there.find_free(placed)
    near = observations.select(there.find_near(there.frames))
    try:
        fitted = minimise_pose_errors(placed, near, free)
    except FitError:
        return placed
    return _with_frames(fitted, frames_of(fitted))


def _turn_target(model: Model, observations: Observations) -> Frames:
    """The frames of the model, with the target turned as the orientations show if the platform
    never turns: the robot's equations then hold no orientation, and no fit turns the target."""
    frames = frames_of(model)
    if max(model.mechanism.moved) >= 3:  # the platform turns
        return frames
    there = DevicePoses.of(model, observations)
    if there is None or not there.turned.any() or there.placed.sum() < 3:
        return frames
    T = there.find_target_turn(frames.F, there.turned)
    near = there.find_near(replace(frames, T=T))  # without those that are far off
    return replace(frames, T=there.find_target_turn(frames.F, near[there.turned[near]]))


def _states_target(model: Model) -> bool:
    """Whether the model states where the target sits: by an effect, or because the sensor fixes it
    (marks that the tool itself leaves)."""
    device, names = _device(model), [name for name in model.table.names if name in TARGET_PLACE]
    fixed = device is not None and model.table.matching(device.fixed_patterns())
    at_sensor = bool(names) and bool(np.all(fixed, where=model.table.matching(names)))
    return at_sensor or model.has_effect(TARGET_EFFECT)


def shows_pose(model: Model) -> bool:
    """Whether a sensor of the model shows poses, as a camera does."""
    return any(sensor.shows_pose for sensor in model.sensors)


def is_identified(model: Model) -> bool:
    """Whether the model is the result of a fit that also identified where the device stands."""
    return model.covariance is not None and _device(model) is not None


def _device(model: Model) -> Any:
    """The sensor that describes where the pose device stands; None if the model has none."""
    known = [sensor for sensor in model.sensors if sensor.name == SENSOR]
    return known[0] if known else None


def _numbers(model: Model) -> Array:
    """Mask of the parameters of the sensor `device_frame`."""
    return np.array([name.startswith(f"{SENSOR}.") for name in model.table.names])


def _placements(model: Model) -> Array:
    """Mask of the parameters that state where sensors stand."""
    parts = ((s.name, part) for s in model.sensors for part in (s.base_part, s.platform_part))
    return _numbers(model) | model.table.matching(f"{name}.{part}" for name, part in parts if part)


def _fit_frames(model: Model, observations: Observations, options: FitOptions, told: bool) -> Model:
    """Fit the frames with the robot nearest to nominal; fix those of their parameters that depend
    on the free parameters of the robot. A target whose place the samples have not `told` stays
    where it is assumed: it moves only in the fit of the robot."""
    own = _placements(model)
    if options.refit:
        free = model.table.matching(options.refit) | own
    else:
        free = free_mask(model, options.free, options.fix)
    assumed = np.array([name in TARGET_PLACE for name in model.table.names]) & (not told)
    settled = free & ~assumed
    if not (settled & own).any():
        return model
    # Frames and robot are redundant. With every tolerance as a prior the solution is unique; with
    # priors on the weak directions only, the choice of these may change from step to step for ever.
    # The origin of a device that stands a metre away moves by millimetres if {B} tilts about the
    # robot: a tolerance of this origin would tilt {B} away from the drawing.
    frame = np.array([name.startswith(FRAME) for name in model.table.names])
    frame |= model.table.matching(f"{s.name}.{s.base_part}" for s in model.sensors if s.base_part)
    found = _fit_beside_robot(model, observations, settled, frame)
    views = model.table.matching(f"{s.name}.*" for s in model.sensors if s.shows_pose)
    if _device(model) is not None:
        model = _with_frames(model, _turn_target(found, observations))
    model = model.with_values(np.where(views, found.values, model.values), model.covariance)
    device = _numbers(model)
    if not (free & device).any():
        # Where a camera stands is a matter of the lens, too. Fixed there, the robot's tolerances
        # would determine the principal point.
        return model
    robot = np.where(device, 0.0, found.values)
    linearise = Linearisation(model, observations, free, weighted=True)
    # Linearise at poses that satisfy the closure: at others, the columns of equal motions differ.
    system = linearise(robot, predict_configurations(model.with_values(robot), observations))
    columns = system.columns * model.table.tolerance[free]
    order = np.argsort(device[free], kind="stable")  # the robot's first
    sizes = np.linalg.norm(columns, axis=0)
    unit = columns / np.where(sizes > ROUNDING * sizes.max(), sizes, np.inf)
    adds = np.zeros(int(free.sum()), dtype=bool)
    adds[order] = find_independent_columns(
        np.asarray(np.linalg.qr(unit[:, order], mode="r")), MIN_FRAME_COLUMN_REMAINDER
    )
    fixed = model.fixed.copy()
    fixed[np.flatnonzero(free)[device[free] & ~adds]] = True
    return replace(model, fixed=fixed)


def _fit_beside_robot(
    model: Model, observations: Observations, free: Array, unknown: Array
) -> Model:
    """Fit the `free` parameters. The tolerances of all are their prior, but nothing is known of
    those that are `unknown` (mask).

    Effects may be as large as the largest that a diagnosis weighs. If they were held to their usual
    sizes, frames would stand where they imitate the rest of a large one.
    """
    effects = np.array([p.group == "effect" for p in model.table])
    sizes = np.where(effects, LARGEST_EFFECT, 1.0)
    sigma = np.where(unknown, UNKNOWN_TOLERANCES, sizes) * model.table.tolerance
    prior = Prior(model.table.names, model.table.nominal, np.diag(sigma**2))
    found = implicit.estimate(model, observations, free, prior)
    return model.with_values(found.values)


def frames_of(model: Model) -> Frames:
    """The frames of a model's sensor, or those of the base and the platform without one."""
    device = _device(model)
    if device is None:
        return IDENTITY_FRAMES
    own = Named(model.table.names, model.values, f"{SENSOR}.")
    parts = (part for frame in device.frames(own) for part in frame)
    f, F, t, T = (np.array(ca.evalf(ca.SX(part))) for part in parts)
    return Frames(f[:, 0], F, t[:, 0], T)


def _state_frames(model: Model) -> dict[str, Any]:
    """What a registration states of the frames of a model's sensor."""
    names = ("position", "quaternion", "target_position", "target_quaternion")
    return {name: getattr(_device(model), name) for name in names}
